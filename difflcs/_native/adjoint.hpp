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

// Adds products to gradients: into the lanes' sums where the input is shared, else into each element's own.
struct Sink {
  const MpcBatch& batch;
  const MpcGradient& o;
  int64_t group, end;
  Mask valid;
  Vec* sum;

  void add(Input which, int64_t at, Vec value) const {
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
  using Lu = Elimination<S::kPivot>;
  const MpcBatch& batch;
  const S n;
  Problem<T, S> problem;
  Riccati<T, S, true> riccati;
  Trajectory<S> at;
  Upstream<S> upstream;
  Vec objective_bar;
  Vec* sum;  // of the shared inputs' gradients
  // Directions w of K_z w = z_bar: dw = (dx, du), dx of the next state, dlam, ds, dp, dy; and rho = y o lam.
  Vec *gap, *dw, *dx_next, *dlam, *ds, *dp, *dy, *rho, *drho;

 public:
  Adjoint(const MpcBatch& b, void* memory) : batch(b), n(b), problem(b, true), riccati(problem) { layout(memory); }

  // Lays the arrays out in `memory`, or only counts them where it is null.
  int64_t layout(void* memory) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), h = n.h;
    Arena arena{memory};
    problem.layout(arena), at.layout(arena, n), riccati.layout(arena);
    arena.take(upstream.x, h + 1, nx), arena.take(upstream.u, h, nu), arena.take(upstream.lam, h, nl);
    arena.take(gap, nl), arena.take(dw, nw), arena.take(dx_next, nx), arena.take(dlam, nl), arena.take(ds, nl);
    arena.take(dp, nx), arena.take(dy, nl), arena.take(rho, nl), arena.take(drho, nl);
    int64_t inputs = 0;
    for (const Field& field : kMpcFields) inputs += extent(batch, field);
    arena.take(sum, inputs);
    return arena.used;
  }

  // Of elements [begin, end), which are block number `block`.
  void vjp(const MpcGradient& o, int64_t begin, int64_t end, int64_t block, Watch watch) {
    for (int64_t i = 0; i < o.shared_size; i++) sum[i] = all(0);
    for (int64_t group = begin; group < end && !watch.stop(watch.context); group += kLanes) {
      const Mask valid = load(o, group, end);
      riccati.sweep(at, upstream, all(0), Mask{});
      forward({batch, o, group, end, valid, sum});
    }
    for (int64_t i = 0; i < o.shared_size; i++) {
      double total = 0;
      for (int l = 0; l < kLanes; l++) total += sum[i][l];
      o.partial[block * o.shared_size + i] = total;
    }
  }

 private:
  // Solutions and upstream gradients of kLanes elements; lanes past `end` repeat the last one. Returns which count.
  Mask load(const MpcGradient& o, int64_t group, int64_t end) {
    const int64_t states = at.x.size(), actions = at.u.size(), forces = at.lam.size();
    Mask valid;
    for (int l = 0; l < kLanes; l++) {
      const int64_t e = group + l < end ? group + l : end - 1;
      problem.load(e, l);
      problem.load(at.x.entries, o.x + e * states, states, l);
      problem.load(at.u.entries, o.u + e * actions, actions, l);
      problem.load_lam(at.lam.entries, o.lam + e * forces, l);
      problem.load(upstream.x.entries, o.x_bar + e * states, states, l);
      problem.load(upstream.u.entries, o.u_bar + e * actions, actions, l);
      problem.load_lam(upstream.lam.entries, o.lam_bar + e * forces, l, true);
      objective_bar[l] = o.objective_bar[e];
      valid[l] = group + l < end && o.solved[e] ? -1 : 0;
    }
    for (int64_t k = 0; k < n.h; k++) {
      problem.gap(at.x[k], at.u[k], gap);
      for (int64_t i = 0; i < n.l(); i++) at.s(k, i) = gap[i] + problem.F.row(i) * at.lam[k];
    }
    return valid;
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
      weight_gradients(sink, kQ, kq, at.x[k], dw, nx);
      weight_gradients(sink, kR, kr, at.u[k], dw + nx, n.u());
      if (k == 0) initial_state(sink);
      for (int64_t i = 0; i < nx; i++) dw[i] = dx_next[i];
    }
    weight_gradients(sink, kQ_final, kq_final, at.x[n.h], dw, nx);
  }

  // The directions of stage k from dx in dw.
  void direction(int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w();
    const Stage<S> stage = riccati.stage(k);
    const Value<S> next = riccati.value(k + 1);
    const Matrix<Vec, kU, kX> K = riccati.feedback[k];
    const auto C = problem.C;
    const auto F = problem.F;
    const Vec *y = stage.y, *lam = at.lam[k];
    for (int64_t j = 0; j < nu; j++) {
      Vec t = riccati.feedforward(k, j);
      if (k > 0) t = t + K.row(j) * dw;
      dw[nx + j] = t;
    }
    for (int64_t i = 0; i < nl; i++) {
      Vec a = all(0), b = all(0);
      for (int64_t j = 0; j < nw; j++) a += stage.K_lam(i, j) * dw[j], b += stage.K_s(i, j) * dw[j];
      dlam[i] = a, ds[i] = b;
    }
    for (int64_t i = 0; i < nx; i++) {
      Vec t = all(0);
      for (int64_t j = 0; j < nw; j++) t += stage.A_hat(i, j) * dw[j];
      dx_next[i] = t;
    }
    for (int64_t i = 0; i < nx; i++) dp[i] = next.v[i] + next.P.row(i) * dx_next;
    for (int64_t i = 0; i < nl; i++) {
      Vec t = upstream.lam(k, i) - y[i] * ds[i] - C.column(i) * dp;
      for (int64_t j = 0; j < nl; j++) t -= F(j, i) * (y[j] * dlam[j]);
      dy[i] = t;
    }
    Lu::solve_transposed(nl, stage.M.entries, stage.rows, dy);
    for (int64_t i = 0; i < nl; i++) {
      dy[i] *= stage.size[i];
      rho[i] = y[i] * lam[i];
      drho[i] = dy[i] * lam[i] + y[i] * dlam[i];
    }
  }

  // Before dp and drho take up the objective's part.
  void bounds(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    const auto B = problem.B();
    const auto E = problem.E();
    const Vec *u = at.u[k], *p = riccati.value(k + 1).p, *du = dw + nx;
    for (int64_t j = 0; j < nu; j++) {
      Vec t = upstream.u(k, j), g = problem.r[j];
      for (int64_t i = 0; i < nu; i++) t -= problem.R(j, i) * du[i], g += problem.R(j, i) * u[i];
      for (int64_t i = 0; i < nx; i++) t -= B(i, j) * dp[i], g += B(i, j) * p[i];
      for (int64_t i = 0; i < nl; i++) t -= E(i, j) * drho[i], g += E(i, j) * rho[i];
      t += objective_bar * g;
      Vec by_low = all(0), by_high = all(0);
      if (batch.barrier > 0) {
        const Vec below = u[j] - problem.u_min[j], above = problem.u_max[j] - u[j], mu = problem.mu;
        by_low = mu * (du[j] / (below * below) + objective_bar / below);
        by_high = mu * (du[j] / (above * above) - objective_bar / above);
      }
      sink.add(ku_min, j, select(riccati.lower(k, j), t, by_low));
      sink.add(ku_max, j, select(riccati.upper(k, j), t, by_high));
    }
  }

  void system_gradients(const Sink& sink, int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    const T* scale = problem.scale;
    const Vec *x = at.x[k], *u = at.u[k], *lam = at.lam[k], *p = riccati.value(k + 1).p, *dx = dw, *du = dw + nx;
    for (int64_t i = 0; i < nx; i++) {
      for (int64_t j = 0; j < nx; j++) sink.add(kA, i * nx + j, -(dp[i] * x[j] + p[i] * dx[j]));
      for (int64_t j = 0; j < nu; j++) sink.add(kB, i * nu + j, -(dp[i] * u[j] + p[i] * du[j]));
      for (int64_t j = 0; j < nl; j++) sink.add(kC, i * nl + j, -scale[j] * (dp[i] * lam[j] + p[i] * dlam[j]));
      sink.add(kd, i, -dp[i]);
    }
    for (int64_t i = 0; i < nl; i++) {
      for (int64_t j = 0; j < nx; j++) sink.add(kD, i * nx + j, -scale[i] * (drho[i] * x[j] + rho[i] * dx[j]));
      for (int64_t j = 0; j < nu; j++) sink.add(kE, i * nu + j, -scale[i] * (drho[i] * u[j] + rho[i] * du[j]));
      for (int64_t j = 0; j < nl; j++)
        sink.add(kF, i * nl + j, -(scale[i] * scale[j]) * (drho[i] * lam[j] + rho[i] * dlam[j]));
      sink.add(kc, i, -scale[i] * drho[i]);
    }
  }

  // Gradients of a weight on z, which is symmetric, and of the linear term beside it.
  void weight_gradients(const Sink& sink, Input weight, Input term, const Vec* z, const Vec* dz, int64_t size) {
    const Vec J = objective_bar;
    for (int64_t i = 0; i < size; i++) {
      const Vec Jz = J * z[i];
      for (int64_t j = 0; j < size; j++)
        sink.add(weight, i * size + j, 0.5 * (Jz * z[j] - dz[i] * z[j] - dz[j] * z[i]));
      sink.add(term, i, Jz - dz[i]);
    }
  }

  void initial_state(const Sink& sink) {
    const int64_t nx = n.x();
    const auto A = problem.A();
    const auto D = problem.D();
    for (int64_t j = 0; j < nx; j++) {
      Vec t = upstream.x(0, j) + objective_bar * problem.q[j];
      for (int64_t i = 0; i < nx; i++) t += objective_bar * problem.Q(j, i) * at.x(0, i) - A(i, j) * dp[i];
      sink.add(kx0, j, t - D.column(j) * drho);
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
