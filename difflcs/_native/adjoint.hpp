// The adjoint of the MPC: gradients of all inputs from upstream gradients of the solution, by one Riccati sweep and one
// sweep forward (difflcs/mpc/riccati.py: the forward half of `_solve`).
#pragma once
#include "input_gradients.hpp"
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

template <class T, class S>
class Adjoint {
  static constexpr int64_t kX = S::kX, kU = S::kU, kL = S::kL, kW = S::kW;
  const MpcBatch& batch;
  const S n;
  const Elimination<kL == 0> lu;
  Problem<T, S> problem;
  Riccati<T, S, true> riccati;
  InputGradients<T> out;
  Trajectory<S> at;               // those of `out`
  Upstream<S> upstream, shifted;  // shifted by the multipliers' directions along the rows of held constraints
  Vec* sum;                       // of the shared inputs' gradients

 public:
  Adjoint(const MpcBatch& b, void* memory)
      : batch(b), n(b), lu{b.pivot}, problem(b, true), riccati(problem), out(b, problem) {
    layout(memory);
  }

  // Lays the arrays out in `memory`, or only counts them where it is null.
  DIFFLCS_NOINLINE int64_t layout(void* memory) {
    const int64_t h = n.h;
    Arena arena{memory};
    problem.layout(arena);
    riccati.layout(arena);
    out.layout(arena);
    at = out.at;
    upstream = out.upstream;
    arena.take(shifted.x, h + 1, n.x());
    arena.take(shifted.u, h, n.u());
    int64_t inputs = 0;
    for (int i = 0; i < kInputs; i++) inputs += extent(batch, kMpcFields[i]) * (batch.step[i] ? h + 1 : 1);
    arena.take(sum, inputs);
    return arena.used;
  }

  // Of elements [begin, end), which are block number `block`.
  void vjp(const MpcGradient& o, int64_t begin, int64_t end, int64_t block, Watch watch) {
    for (int64_t i = 0; i < o.shared_size; i++) sum[i] = all(0);
    for (int64_t group = begin; group < end && !watch.stop(watch.context); group += kLanes) {
      const Mask valid = out.load(o, group, end);
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
      bool acting = false;  // without a multiplier there is nothing to test
      for (int64_t i = group * rows; i < (group + kLanes < end ? group + kLanes : end) * rows; i++)
        acting = acting || o.mu[i] > 0;
      if (!acting) continue;
      out.load_solutions(o, group, end);
      for (int64_t i = 0; i < upstream.x.size(); i++) upstream.x.entries[i] = all(0);
      for (int64_t i = 0; i < upstream.u.size(); i++) upstream.u.entries[i] = all(0);
      for (int64_t i = 0; i < upstream.lam.size(); i++) upstream.lam.entries[i] = all(0);
      out.move_limits();
      Mask weak = ~(hold_constraints(true) <= kDependent);
      for (int64_t k = 0; k <= n.h; k++)
        for (int64_t i = 0; i < n.c(); i++)
          weak |= (riccati.stiffness(k, i) > 0) & (riccati.force(k, i) <= kWeak * abs(out.dm(k, i)));
      for (int l = 0; l < kLanes && group + l < end; l++) {
        int8_t& status = o.status[group + l];
        if (status == int8_t(Status::converged) && weak[l]) status = int8_t(Status::degenerate);
      }
    }
  }

 private:
  // The sweep with held constraints as equations a (dx, du) = 0: a weight on them, and their multipliers' directions
  // dm, which repeated sweeps refine. Rows whose multiplier is zero or the price are not held. With `moved` the
  // equations are a (dx, du) = target instead. Returns by how much they are missed, in parts of it.
  Vec hold_constraints(bool moved) {
    const int64_t nx = n.x(), nu = n.u(), nc = n.c();
    Vec missed = all(0);
    Mask refining = ~Mask{};
    for (int64_t k = 0; k <= n.h; k++)
      for (int64_t i = 0; i < nc; i++) {
        const Vec m = problem.multiplier(k, i);
        riccati.force(k, i) = m;
        out.dm(k, i) = all(0);
        riccati.stiffness(k, i) =
            select((m > 0) & (m < kAtPrice * problem.price[k][i]), kHold * problem.weight, all(0));
      }
    const auto pull = [&](int64_t k, int64_t r) {
      return moved ? out.dm(k, r) - riccati.stiffness(k, r) * out.target(k, r) : out.dm(k, r);
    };
    for (int pass = 0; pass < 8; pass++) {
      for (int64_t k = 0; k <= n.h; k++) {
        const auto G = problem.G(k);
        for (int64_t i = 0; i < nx; i++) {
          Vec t = upstream.x(k, i);
          for (int64_t r = 0; r < nc; r++) t -= G(r, i) * pull(k, r);
          shifted.x(k, i) = select(refining, t, shifted.x(k, i));
        }
        for (int64_t j = 0; j < nu && k < n.h; j++) {
          Vec t = upstream.u(k, j);
          for (int64_t r = 0; r < nc; r++) t -= G(r, nx + j) * pull(k, r);
          shifted.u(k, j) = select(refining, t, shifted.u(k, j));
        }
      }
      shifted.lam = upstream.lam;
      riccati.sweep(at, shifted);
      Vec largest = all(0), change = all(0);
      Vec worst = all(0);
      for (int64_t i = 0; i < nx; i++) out.dw[i] = all(0);
      for (int64_t k = 0; k <= n.h; k++) {
        if (k < n.h) primal_direction(k);
        for (int64_t r = 0; r < nc; r++) {
          const Mask held = riccati.stiffness(k, r) > 0;
          const Vec off = moved ? out.along(k, r) - out.target(k, r) : out.along(k, r);
          const Vec more = select(refining, riccati.stiffness(k, r) * off, all(0));
          out.dm(k, r) += more;
          change = max(change, abs(more));
          largest = max(largest, abs(out.dm(k, r)));
          if (moved) worst = max(worst, select(held, abs(off / out.target(k, r)), all(0)));
        }
        for (int64_t i = 0; i < nx && k < n.h; i++) out.dw[i] = out.dx_next[i];
      }
      missed = select(refining, worst, missed);
      // Finished lanes keep their result: an element depends on nothing but itself.
      refining &= change > 1e-12 * largest;
      if (!any(refining)) break;
    }
    return missed;
  }

  void forward(const Sink& sink) {
    const int64_t nx = n.x();
    for (int64_t i = 0; i < nx; i++) out.dw[i] = all(0);
    for (int64_t k = 0; k < n.h; k++) {
      direction(k);
      out.add_stage(sink, k, {riccati.value(k + 1).p, riccati.force, riccati.lower, riccati.upper});
    }
    out.add_final(sink, riccati.force);
  }

  // du and the next dx from dx in dw.
  void primal_direction(int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nw = n.w();
    const Stage<S> stage = riccati.stage(k);
    const Matrix<Vec, kU, kX> K = riccati.feedback[k];
    for (int64_t j = 0; j < nu; j++) {
      Vec t = riccati.feedforward(k, j);
      if (k > 0) t = t + K.row(j) * out.dw;
      out.dw[nx + j] = t;
    }
    for (int64_t i = 0; i < nx; i++) {
      Vec t = all(0);
      for (int64_t j = 0; j < nw; j++) t += stage.A_hat(i, j) * out.dw[j];
      out.dx_next[i] = t;
    }
  }

  // The directions of stage k from dx in dw.
  void direction(int64_t k) {
    const int64_t nx = n.x(), nl = n.l(), nw = n.w();
    const Stage<S> stage = riccati.stage(k);
    const Value<S> next = riccati.value(k + 1);
    const StageData<T, S>& data = problem.stage(k);
    const auto C = data.C;
    const auto F = data.F;
    const Vec *y = stage.y, *lam = at.lam[k];
    primal_direction(k);
    for (int64_t i = 0; i < nl; i++) {
      Vec a = all(0), b = all(0);
      for (int64_t j = 0; j < nw; j++) {
        a += stage.K_lam(i, j) * out.dw[j];
        b += stage.K_s(i, j) * out.dw[j];
      }
      out.dlam[i] = a;
      out.ds[i] = b;
    }
    for (int64_t i = 0; i < nx; i++) out.dp[i] = next.v[i] + next.P.row(i) * out.dx_next;
    for (int64_t i = 0; i < nl; i++) {
      Vec t = upstream.lam(k, i) - y[i] * out.ds[i] - C.column(i) * out.dp;
      for (int64_t j = 0; j < nl; j++) t -= F(j, i) * (y[j] * out.dlam[j]);
      out.dy[i] = t;
    }
    lu.solve_transposed(nl, stage.M.entries, stage.rows, out.dy);
    for (int64_t i = 0; i < nl; i++) {
      out.dy[i] *= stage.size[i];
      out.rho[i] = y[i] * lam[i];
      out.drho[i] = out.dy[i] * lam[i] + y[i] * out.dlam[i];
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
