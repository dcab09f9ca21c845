// The adjoint of the MPC: gradients of all inputs from upstream gradients of the solution, by one Riccati sweep and one
// sweep forward (difflcs/mpc/kkt.py: the forward half of `_solve`, and `vjp`).
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"
#include "matrix.hpp"
#include "mpc_problem.hpp"
#include "riccati.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Weight on held constraints, in parts of the largest weight of the cost: each sweep refines by about as much.
constexpr double kHold = 1e6;
// Rows that miss their moved limits by more than this part depend on each other. A row is weakly active whose
// multiplier this part of its unit would take away.
constexpr double kMissed = 1e-3, kWeakRow = 1e-5;

// Adds products to gradients: into the lanes' sums where the input is shared, else into each element's own.
struct Sink {
  const MpcBatch& batch;
  const MpcGradient& o;
  int64_t group, end;
  Mask valid;
  Vec* sum;

  void add(Input which, int64_t k, int64_t at, Vec value) const {
    at += k * batch.step[which];
    if (double* own = o.per_element[which]) {
      for (int l = 0; l < kLanes && group + l < end; l++)
        if (valid[l]) own[(group + l) * batch.stride[which] + at] += value[l];
    } else {
      sum[o.offset[which] + at] += select(valid, value, all(0));
    }
  }
};

template <class T, class S>
class Adjoint {
  static constexpr int64_t kX = S::kX, kU = S::kU, kL = S::kL, kW = S::kW;
  const MpcBatch& batch;
  const S n;
  const Elimination<kL == 0> lu;
  Problem<T, S> problem;
  Riccati<T, S, true> riccati;
  Trajectory<S> at;
  Upstream<S> upstream, shifted;  // shifted by the multipliers' directions along the rows of held constraints
  Matrix<Vec, 0, 0> target;       // by which the limits of the constraints are moved
  Matrix<Vec, 0, 0> dm;           // directions of the multipliers of the constraints
  Vec objective_bar;
  Vec* sum;  // of the shared inputs' gradients
  // Directions w of K_z w = z_bar: dw = (dx, du), dx of the next state, dlam, ds, dp, dy; and rho = y o lam.
  Vec *gap, *dw, *dx_next, *dlam, *ds, *dp, *dy, *rho, *drho;

 public:
  Adjoint(const MpcBatch& b, void* memory) : batch(b), n(b), lu{b.pivot}, problem(b, true), riccati(problem) { layout(memory); }

  // Lays the arrays out in `memory`, or only counts them where it is null.
  int64_t layout(void* memory) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), h = n.h;
    Arena arena{memory};
    problem.layout(arena), at.layout(arena, n), riccati.layout(arena);
    arena.take(upstream.x, h + 1, nx), arena.take(upstream.u, h, nu), arena.take(upstream.lam, h, nl);
    arena.take(shifted.x, h + 1, nx), arena.take(shifted.u, h, nu), arena.take(dm, h + 1, n.c());
    arena.take(target, h + 1, n.c());
    arena.take(gap, nl), arena.take(dw, nw), arena.take(dx_next, nx), arena.take(dlam, nl), arena.take(ds, nl);
    arena.take(dp, nx), arena.take(dy, nl), arena.take(rho, nl), arena.take(drho, nl);
    int64_t inputs = 0;
    for (int i = 0; i < kInputs; i++) inputs += extent(batch, kMpcFields[i]) * (batch.step[i] ? h + 1 : 1);
    arena.take(sum, inputs);
    return arena.used;
  }

  // Of elements [begin, end), which are block number `block`.
  void vjp(const MpcGradient& o, int64_t begin, int64_t end, int64_t block, Watch watch) {
    for (int64_t i = 0; i < o.shared_size; i++) sum[i] = all(0);
    for (int64_t group = begin; group < end && !watch.stop(watch.context); group += kLanes) {
      const Mask valid = load(o, group, end);
      if (n.c() > 0)
        (void)hold_constraints(false);
      else
        riccati.sweep(at, upstream);
      forward({batch, o, group, end, valid, sum});
    }
    for (int64_t i = 0; i < o.shared_size; i++) {
      double total = 0;
      for (int l = 0; l < kLanes; l++) total += sum[i][l];
      o.partial[block * o.shared_size + i] = total;
    }
  }

  // Solutions with constraints that depend on each other, or whose multiplier a small change of the limits would take
  // away, are degenerate. Both show where the limits are moved by parts of their units.
  void judge_constraints(const MpcSolve& o, int64_t begin, int64_t end, Watch watch) {
    const int64_t rows = (n.h + 1) * n.c();
    for (int64_t group = begin; group < end && !watch.stop(watch.context); group += kLanes) {
      bool acting = false;  // without a multiplier there is nothing to judge
      for (int64_t i = group * rows; i < (group + kLanes < end ? group + kLanes : end) * rows; i++)
        acting = acting || o.mu[i] > 0;
      if (!acting) continue;
      load_solutions(o, group, end);
      for (int64_t i = 0; i < upstream.x.size(); i++) upstream.x.entries[i] = all(0);
      for (int64_t i = 0; i < upstream.u.size(); i++) upstream.u.entries[i] = all(0);
      for (int64_t i = 0; i < upstream.lam.size(); i++) upstream.lam.entries[i] = all(0);
      move_limits();
      Mask weak = ~(hold_constraints(true) <= kMissed);
      for (int64_t k = 0; k <= n.h; k++)
        for (int64_t i = 0; i < n.c(); i++)
          weak |= (riccati.stiffness(k, i) > 0) & (riccati.force(k, i) <= kWeakRow * abs(dm(k, i)));
      for (int l = 0; l < kLanes && group + l < end; l++) {
        int8_t& status = o.status[group + l];
        if (status == int8_t(Status::converged) && weak[l]) status = int8_t(Status::degenerate);
      }
    }
  }

 private:
  // Solutions of kLanes elements; lanes past `end` repeat the last one.
  template <class Solutions>
  void load_solutions(const Solutions& o, int64_t group, int64_t end) {
    const int64_t states = at.x.size(), actions = at.u.size(), forces = at.lam.size();
    for (int l = 0; l < kLanes; l++) {
      const int64_t e = group + l < end ? group + l : end - 1;
      problem.load(e, l);
      problem.load(at.x.entries, o.x + e * states, states, l);
      problem.load(at.u.entries, o.u + e * actions, actions, l);
      problem.load_lam(at.lam.entries, o.lam + e * forces, l);
      problem.load_multipliers(o.mu + e * (n.h + 1) * n.c(), l);
    }
    for (int64_t k = 0; k < n.h; k++) {
      const StageData<T, S> data = problem.stage(k);
      data.gap(at.x[k], at.u[k], gap);
      for (int64_t i = 0; i < n.l(); i++) at.s(k, i) = gap[i] + data.F.row(i) * at.lam[k];
    }
  }

  // The same with upstream gradients. Returns which lanes count.
  Mask load(const MpcGradient& o, int64_t group, int64_t end) {
    const int64_t states = at.x.size(), actions = at.u.size(), forces = at.lam.size();
    load_solutions(o, group, end);
    Mask valid;
    for (int l = 0; l < kLanes; l++) {
      const int64_t e = group + l < end ? group + l : end - 1;
      problem.load(upstream.x.entries, o.x_bar + e * states, states, l);
      problem.load(upstream.u.entries, o.u_bar + e * actions, actions, l);
      problem.load_lam(upstream.lam.entries, o.lam_bar + e * forces, l, true);
      objective_bar[l] = o.objective_bar[e];
      valid[l] = group + l < end && o.solved[e] ? -1 : 0;
    }
    return valid;
  }

  // A distance for each row: its unit, the largest sum of the sizes of its terms, times numbers without a pattern.
  void move_limits() {
    for (int64_t i = 0; i < n.c(); i++) {
      Vec unit = all(kTiny);
      for (int64_t k = 0; k < n.h; k++) unit = max(unit, problem.stage(k).constraint_terms(i, at.x[k], at.u[k]));
      unit = max(unit, problem.last().constraint_terms(i, at.x[n.h], nullptr));
      for (int64_t k = 0; k <= n.h; k++) {
        const int64_t odd = (k * n.c() + i) * 7 % 11;
        target(k, i) = unit * (odd % 2 ? 0.5 + 0.1 * double(odd) : -0.4 - 0.1 * double(odd));
      }
    }
  }

  // The sweep with held constraints as equations a (dx, du) = 0: a weight on them, and their multipliers' directions
  // dm, which repeated sweeps refine. Rows whose multiplier is zero or the price are not held. With `moved` the
  // equations are a (dx, du) = target instead. Returns by how much they are missed, in parts of it.
  Vec hold_constraints(bool moved) {
    const int64_t nx = n.x(), nu = n.u(), nc = n.c();
    T* weight = problem.weight;
    Vec missed = all(0);
    Mask going = ~Mask{};
    for (int64_t k = 0; k <= n.h; k++)
      for (int64_t i = 0; i < nc; i++) {
        const Vec m = problem.multiplier(k, i);
        riccati.force(k, i) = m, dm(k, i) = all(0);
        riccati.stiffness(k, i) =
            select((m > 0) & (m < kAtPrice * problem.price[k][i]), all(kHold) * weight[0], all(0));
      }
    const auto pull = [&](int64_t k, int64_t r) {
      return moved ? dm(k, r) - riccati.stiffness(k, r) * target(k, r) : dm(k, r);
    };
    for (int pass = 0; pass < 8; pass++) {
      for (int64_t k = 0; k <= n.h; k++) {
        const auto G = problem.G[k];
        for (int64_t i = 0; i < nx; i++) {
          Vec t = upstream.x(k, i);
          for (int64_t r = 0; r < nc; r++) t -= G(r, i) * pull(k, r);
          shifted.x(k, i) = select(going, t, shifted.x(k, i));
        }
        for (int64_t j = 0; j < nu && k < n.h; j++) {
          Vec t = upstream.u(k, j);
          for (int64_t r = 0; r < nc; r++) t -= G(r, nx + j) * pull(k, r);
          shifted.u(k, j) = select(going, t, shifted.u(k, j));
        }
      }
      shifted.lam = upstream.lam;
      riccati.sweep(at, shifted);
      Vec largest = all(0), change = all(0);
      Vec worst = all(0);
      for (int64_t i = 0; i < nx; i++) dw[i] = all(0);
      for (int64_t k = 0; k <= n.h; k++) {
        if (k < n.h) primal_direction(k);
        for (int64_t r = 0; r < nc; r++) {
          const Mask held = riccati.stiffness(k, r) > 0;
          const Vec off = moved ? along(k, r) - target(k, r) : along(k, r);
          const Vec more = select(going, riccati.stiffness(k, r) * off, all(0));
          dm(k, r) += more;
          change = max(change, abs(more)), largest = max(largest, abs(dm(k, r)));
          if (moved) worst = max(worst, select(held, abs(off / target(k, r)), all(0)));
        }
        for (int64_t i = 0; i < nx && k < n.h; i++) dw[i] = dx_next[i];
      }
      missed = select(going, worst, missed);
      // What is done stays as it is: an element depends on nothing but itself.
      going &= change > 1e-12 * largest;
      if (!any(going)) break;
    }
    return missed;
  }

  // a (dx, du) of row r at stage k.
  Vec along(int64_t k, int64_t r) const {
    const auto G = problem.G[k];
    Vec t = all(0);
    for (int64_t j = 0; j < (k < n.h ? n.w() : n.x()); j++) t += G(r, j) * dw[j];
    return t;
  }

  void forward(const Sink& sink) {
    const int64_t nx = n.x();
    for (int64_t i = 0; i < nx; i++) dw[i] = all(0);
    for (int64_t k = 0; k < n.h; k++) {
      direction(k);
      bounds(sink, k);
      // The objective's part of the gradients: J_bar times the derivative of the Lagrangian.
      const Vec* p = riccati.value(k + 1).p;
      for (int64_t i = 0; i < nx; i++) dp[i] -= objective_bar * p[i];
      for (int64_t i = 0; i < n.l(); i++) drho[i] -= objective_bar * rho[i];
      system_gradients(sink, k);
      weight_gradients(sink, k, kQ, kq, at.x[k], dw, nx);
      weight_gradients(sink, k, kR, kr, at.u[k], dw + nx, n.u());
      cross_gradients(sink, k);
      if (n.c() > 0) constraint_gradients(sink, k);
      if (k == 0) initial_state(sink);
      for (int64_t i = 0; i < nx; i++) dw[i] = dx_next[i];
    }
    weight_gradients(sink, 0, kQ_final, kq_final, at.x[n.h], dw, nx);
    if (n.c() > 0) constraint_gradients(sink, n.h);
  }

  // du and the next dx from dx in dw.
  void primal_direction(int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nw = n.w();
    const Stage<S> stage = riccati.stage(k);
    const Matrix<Vec, kU, kX> K = riccati.feedback[k];
    for (int64_t j = 0; j < nu; j++) {
      Vec t = riccati.feedforward(k, j);
      if (k > 0) t = t + K.row(j) * dw;
      dw[nx + j] = t;
    }
    for (int64_t i = 0; i < nx; i++) {
      Vec t = all(0);
      for (int64_t j = 0; j < nw; j++) t += stage.A_hat(i, j) * dw[j];
      dx_next[i] = t;
    }
  }

  // The directions of stage k from dx in dw.
  void direction(int64_t k) {
    const int64_t nx = n.x(), nl = n.l(), nw = n.w();
    const Stage<S> stage = riccati.stage(k);
    const Value<S> next = riccati.value(k + 1);
    const StageData<T, S> data = problem.stage(k);
    const auto C = data.C;
    const auto F = data.F;
    const Vec *y = stage.y, *lam = at.lam[k];
    primal_direction(k);
    for (int64_t i = 0; i < nl; i++) {
      Vec a = all(0), b = all(0);
      for (int64_t j = 0; j < nw; j++) a += stage.K_lam(i, j) * dw[j], b += stage.K_s(i, j) * dw[j];
      dlam[i] = a, ds[i] = b;
    }
    for (int64_t i = 0; i < nx; i++) dp[i] = next.v[i] + next.P.row(i) * dx_next;
    for (int64_t i = 0; i < nl; i++) {
      Vec t = upstream.lam(k, i) - y[i] * ds[i] - C.column(i) * dp;
      for (int64_t j = 0; j < nl; j++) t -= F(j, i) * (y[j] * dlam[j]);
      dy[i] = t;
    }
    lu.solve_transposed(nl, stage.M.entries, stage.rows, dy);
    for (int64_t i = 0; i < nl; i++) {
      dy[i] *= stage.size[i];
      rho[i] = y[i] * lam[i];
      drho[i] = dy[i] * lam[i] + y[i] * dlam[i];
    }
  }

  // Before dp and drho take up the objective's part.
  void bounds(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    const StageData<T, S> data = problem.stage(k);
    const auto B = data.B();
    const auto E = data.E();
    const Vec *u = at.u[k], *p = riccati.value(k + 1).p, *du = dw + nx;
    for (int64_t j = 0; j < nu; j++) {
      Vec t = upstream.u(k, j), g = data.r[j];
      for (int64_t i = 0; i < nu; i++) t -= data.R(j, i) * du[i], g += data.R(j, i) * u[i];
      if (batch.crossed)
        for (int64_t i = 0; i < nx; i++) t -= data.cross(i, j) * dw[i], g += data.cross(i, j) * at.x(k, i);
      for (int64_t i = 0; i < n.c(); i++)
        t -= data.G(i, nx + j) * dm(k, i), g += data.G(i, nx + j) * riccati.force(k, i);
      for (int64_t i = 0; i < nx; i++) t -= B(i, j) * dp[i], g += B(i, j) * p[i];
      for (int64_t i = 0; i < nl; i++) t -= E(i, j) * drho[i], g += E(i, j) * rho[i];
      t += objective_bar * g;
      Vec by_low = all(0), by_high = all(0);
      if (batch.barrier > 0) {
        const Vec below = u[j] - data.u_min[j], above = data.u_max[j] - u[j], mu = problem.mu;
        by_low = mu * (du[j] / (below * below) + objective_bar / below);
        by_high = mu * (du[j] / (above * above) - objective_bar / above);
      }
      sink.add(ku_min, k, j, select(riccati.lower(k, j), t, by_low));
      sink.add(ku_max, k, j, select(riccati.upper(k, j), t, by_high));
    }
  }

  void system_gradients(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    const T* scale = problem.scale[k];
    const Vec *x = at.x[k], *u = at.u[k], *lam = at.lam[k], *p = riccati.value(k + 1).p, *dx = dw, *du = dw + nx;
    for (int64_t i = 0; i < nx; i++) {
      for (int64_t j = 0; j < nx; j++) sink.add(kA, k, i * nx + j, -(dp[i] * x[j] + p[i] * dx[j]));
      for (int64_t j = 0; j < nu; j++) sink.add(kB, k, i * nu + j, -(dp[i] * u[j] + p[i] * du[j]));
      for (int64_t j = 0; j < nl; j++) sink.add(kC, k, i * nl + j, -scale[j] * (dp[i] * lam[j] + p[i] * dlam[j]));
      sink.add(kd, k, i, -dp[i]);
    }
    for (int64_t i = 0; i < nl; i++) {
      for (int64_t j = 0; j < nx; j++) sink.add(kD, k, i * nx + j, -scale[i] * (drho[i] * x[j] + rho[i] * dx[j]));
      for (int64_t j = 0; j < nu; j++) sink.add(kE, k, i * nu + j, -scale[i] * (drho[i] * u[j] + rho[i] * du[j]));
      for (int64_t j = 0; j < nl; j++)
        sink.add(kF, k, i * nl + j, -(scale[i] * scale[j]) * (drho[i] * lam[j] + rho[i] * dlam[j]));
      sink.add(kc, k, i, -scale[i] * drho[i]);
    }
  }

  // Gradients of a weight on z, which is symmetric, and of the linear term beside it.
  void weight_gradients(const Sink& sink, int64_t k, Input weight, Input term, const Vec* z, const Vec* dz,
                        int64_t size) {
    const Vec J = objective_bar;
    for (int64_t i = 0; i < size; i++) {
      const Vec Jz = J * z[i];
      for (int64_t j = 0; j < size; j++)
        sink.add(weight, k, i * size + j, 0.5 * (Jz * z[j] - dz[i] * z[j] - dz[j] * z[i]));
      sink.add(term, k, i, Jz - dz[i]);
    }
  }

  // Of S, the weight of x'Su.
  void cross_gradients(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u();
    const Vec *x = at.x[k], *u = at.u[k], *dx = dw, *du = dw + nx;
    for (int64_t i = 0; i < nx; i++)
      for (int64_t j = 0; j < nu; j++)
        sink.add(kS, k, i * nu + j, objective_bar * x[i] * u[j] - (dx[i] * u[j] + x[i] * du[j]));
  }

  void constraint_gradients(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u();
    const bool last = k == n.h;
    const StageData<T, S> data = last ? problem.last() : problem.stage(k);
    const Vec *x = at.x[k], *u = last ? nullptr : at.u[k], *dx = dw, *du = dw + nx;
    for (int64_t i = 0; i < n.c(); i++) {
      const T unit = data.row_scale[i];
      const Vec m = riccati.force(k, i), change = dm(k, i) - objective_bar * m;
      for (int64_t j = 0; j < nx; j++) sink.add(kG_x, k, i * nx + j, -unit * (change * x[j] + m * dx[j]));
      for (int64_t j = 0; j < nu && !last; j++) sink.add(kG_u, k, i * nu + j, -unit * (change * u[j] + m * du[j]));
      sink.add(kg, k, i, unit * change);
      // At its price a row is a cost, price times violation.
      const Vec fined = (objective_bar * data.constraint(i, x, u) - along(k, i)) / unit;
      sink.add(kprice, k, i, select((m > 0) & (m >= kAtPrice * data.price[i]), fined, all(0)));
    }
  }

  void initial_state(const Sink& sink) {
    const int64_t nx = n.x(), nu = n.u();
    const StageData<T, S> data = problem.stage(0);
    const auto A = data.A();
    const auto D = data.D();
    for (int64_t j = 0; j < nx; j++) {
      Vec t = upstream.x(0, j) + objective_bar * data.q[j];
      for (int64_t i = 0; i < nx; i++) t += objective_bar * data.Q(j, i) * at.x(0, i) - A(i, j) * dp[i];
      for (int64_t i = 0; i < nu; i++) t += data.cross(j, i) * (objective_bar * at.u(0, i) - dw[nx + i]);
      for (int64_t i = 0; i < n.c(); i++) t -= data.G(i, j) * (dm(0, i) - objective_bar * riccati.force(0, i));
      sink.add(kx0, 0, j, t - D.column(j) * drho);
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
