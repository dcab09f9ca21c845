// Gradients of the inputs of an MPC from the directions of its solution, stage by stage (difflcs/mpc/kkt.py: `vjp`).
// Its sizes are known at run time only, so that it is compiled once for all of them.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "matrix.hpp"
#include "mpc_problem.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Adds products to gradients: into the lanes' sums where the input is shared, else into those of each element.
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

template <class T>
struct InputGradients {
  // Results of the Riccati sweep: the costate of the next state, the multipliers of the constraints, and the actions
  // that are held at their bounds.
  struct Held {
    const Vec* p;
    Matrix<Vec, 0, 0> force;
    Matrix<Mask, 0, 0> lower, upper;
  };
  const MpcBatch& batch;
  const AnySizes n;
  ProblemData<T>& problem;
  Trajectory<AnySizes> at;
  Upstream<AnySizes> upstream;
  Matrix<Vec, 0, 0> target;  // by which the limits of the constraints are moved
  Matrix<Vec, 0, 0> dm;      // directions of the multipliers of the constraints
  Vec objective_bar;
  // Directions w of K_z w = z_bar: dw = (dx, du), dx of the next state, dlam, ds, dp, dy; and rho = y o lam.
  Vec *gap, *dw, *dx_next, *dlam, *ds, *dp, *dy, *rho, *drho;

  InputGradients(const MpcBatch& b, ProblemData<T>& problem) : batch(b), n(b), problem(problem) {}

  void layout(Arena& arena) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    at.layout(arena, n);
    arena.take(upstream.x, h + 1, nx);
    arena.take(upstream.u, h, nu);
    arena.take(upstream.lam, h, nl);
    arena.take(target, h + 1, n.c());
    arena.take(dm, h + 1, n.c());
    arena.take_all(nl, gap, dlam, ds, dy, rho, drho);
    arena.take(dw, n.w());
    arena.take_all(nx, dx_next, dp);
  }

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
      const StageData<T, AnySizes> data = problem.stage(k);
      data.gap(at.x[k], at.u[k], gap);
      for (int64_t i = 0; i < n.l(); i++) at.s(k, i) = gap[i] + data.F.row(i) * at.lam[k];
    }
  }

  // Loads them with upstream gradients. Returns which lanes count.
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

  // a (dx, du) of row r at stage k.
  Vec along(int64_t k, int64_t r) const {
    const auto G = problem.G[k];
    Vec t = all(0);
    for (int64_t j = 0; j < (k < n.h ? n.w() : n.x()); j++) t += G(r, j) * dw[j];
    return t;
  }

  // Adds the gradients of stage k, and goes on to the next state's direction.
  void add_stage(const Sink& sink, int64_t k, const Held& held) {
    const int64_t nx = n.x();
    add_bounds(sink, k, held);
    // The objective's part of the gradients: J_bar times the derivative of the Lagrangian.
    for (int64_t i = 0; i < nx; i++) dp[i] -= objective_bar * held.p[i];
    for (int64_t i = 0; i < n.l(); i++) drho[i] -= objective_bar * rho[i];
    add_system(sink, k, held.p);
    add_weight(sink, k, kQ, kq, at.x[k], dw, nx);
    add_weight(sink, k, kR, kr, at.u[k], dw + nx, n.u());
    add_cross_weight(sink, k);
    if (n.c() > 0) add_constraints(sink, k, held.force);
    if (k == 0) add_initial_state(sink, held.force);
    for (int64_t i = 0; i < nx; i++) dw[i] = dx_next[i];
  }

  // Adds the gradients of the last state.
  void add_final(const Sink& sink, const Matrix<Vec, 0, 0>& force) {
    add_weight(sink, 0, kQ_final, kq_final, at.x[n.h], dw, n.x());
    if (n.c() > 0) add_constraints(sink, n.h, force);
  }

  // Before dp and drho take up the objective's part.
  void add_bounds(const Sink& sink, int64_t k, const Held& held) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    const StageData<T, AnySizes> data = problem.stage(k);
    const auto B = data.B();
    const auto E = data.E();
    const Vec *u = at.u[k], *p = held.p, *du = dw + nx;
    for (int64_t j = 0; j < nu; j++) {
      Vec t = upstream.u(k, j), g = data.r[j];
      for (int64_t i = 0; i < nu; i++) {
        t -= data.R(j, i) * du[i];
        g += data.R(j, i) * u[i];
      }
      if (batch.crossed)
        for (int64_t i = 0; i < nx; i++) {
          t -= data.cross(i, j) * dw[i];
          g += data.cross(i, j) * at.x(k, i);
        }
      for (int64_t i = 0; i < n.c(); i++) {
        t -= data.G(i, nx + j) * dm(k, i);
        g += data.G(i, nx + j) * held.force(k, i);
      }
      for (int64_t i = 0; i < nx; i++) {
        t -= B(i, j) * dp[i];
        g += B(i, j) * p[i];
      }
      for (int64_t i = 0; i < nl; i++) {
        t -= E(i, j) * drho[i];
        g += E(i, j) * rho[i];
      }
      t += objective_bar * g;
      Vec by_low = all(0), by_high = all(0);
      if (batch.barrier > 0) {
        const Vec below = u[j] - data.u_min[j], above = data.u_max[j] - u[j], mu = problem.mu;
        by_low = mu * (du[j] / (below * below) + objective_bar / below);
        by_high = mu * (du[j] / (above * above) - objective_bar / above);
      }
      sink.add(ku_min, k, j, select(held.lower(k, j), t, by_low));
      sink.add(ku_max, k, j, select(held.upper(k, j), t, by_high));
    }
  }

  void add_system(const Sink& sink, int64_t k, const Vec* p) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    const T* scale = problem.scale[k];
    const Vec *x = at.x[k], *u = at.u[k], *lam = at.lam[k], *dx = dw, *du = dw + nx;
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
  void add_weight(const Sink& sink, int64_t k, Input weight, Input term, const Vec* z, const Vec* dz, int64_t size) {
    const Vec J = objective_bar;
    for (int64_t i = 0; i < size; i++) {
      const Vec Jz = J * z[i];
      for (int64_t j = 0; j < size; j++)
        sink.add(weight, k, i * size + j, 0.5 * (Jz * z[j] - dz[i] * z[j] - dz[j] * z[i]));
      sink.add(term, k, i, Jz - dz[i]);
    }
  }

  // Of S, the weight of x'Su.
  void add_cross_weight(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u();
    const Vec *x = at.x[k], *u = at.u[k], *dx = dw, *du = dw + nx;
    for (int64_t i = 0; i < nx; i++)
      for (int64_t j = 0; j < nu; j++)
        sink.add(kS, k, i * nu + j, objective_bar * x[i] * u[j] - (dx[i] * u[j] + x[i] * du[j]));
  }

  void add_constraints(const Sink& sink, int64_t k, const Matrix<Vec, 0, 0>& force) {
    const int64_t nx = n.x(), nu = n.u();
    const bool last = k == n.h;
    const StageData<T, AnySizes> data = last ? problem.last() : problem.stage(k);
    const Vec *x = at.x[k], *u = last ? nullptr : at.u[k], *dx = dw, *du = dw + nx;
    for (int64_t i = 0; i < n.c(); i++) {
      const T unit = data.row_scale[i];
      const Vec m = force(k, i), change = dm(k, i) - objective_bar * m;
      for (int64_t j = 0; j < nx; j++) sink.add(kG_x, k, i * nx + j, -unit * (change * x[j] + m * dx[j]));
      for (int64_t j = 0; j < nu && !last; j++) sink.add(kG_u, k, i * nu + j, -unit * (change * u[j] + m * du[j]));
      sink.add(kg, k, i, unit * change);
      // At its price a row is a cost, price times violation.
      const Vec fined = (objective_bar * data.constraint(i, x, u) - along(k, i)) / unit;
      sink.add(kprice, k, i, select((m > 0) & (m >= kAtPrice * data.price[i]), fined, all(0)));
    }
  }

  void add_initial_state(const Sink& sink, const Matrix<Vec, 0, 0>& force) {
    const int64_t nx = n.x(), nu = n.u();
    const StageData<T, AnySizes> data = problem.stage(0);
    const auto A = data.A();
    const auto D = data.D();
    for (int64_t j = 0; j < nx; j++) {
      Vec t = upstream.x(0, j) + objective_bar * data.q[j];
      for (int64_t i = 0; i < nx; i++) t += objective_bar * data.Q(j, i) * at.x(0, i) - A(i, j) * dp[i];
      for (int64_t i = 0; i < nu; i++) t += data.cross(j, i) * (objective_bar * at.u(0, i) - dw[nx + i]);
      for (int64_t i = 0; i < n.c(); i++) t -= data.G(i, j) * (dm(0, i) - objective_bar * force(0, i));
      sink.add(kx0, 0, j, t - D.column(j) * drho);
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
