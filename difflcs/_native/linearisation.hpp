// One stage of the MPC around a trajectory, with lam eliminated: dlam = K_lam (dx, du), ds = K_s (dx, du) and
// dx+ = A_hat (dx, du), and the second derivative of lam. difflcs/mpc/kkt.py derives it.
#pragma once
#include "lanes.hpp"
#include "low_rank.hpp"
#include "lu.hpp"
#include "matrix.hpp"
#include "mpc_problem.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Factors of each stage that the adjoint reuses.
template <class S>
struct Stage {
  Matrix<Vec, S::kL, S::kL> M;  // LU factors of diag(a) + diag(b) F, and the row exchanges
  Mask* rows;
  Vec *size, *y;                         // 1 / (lam + s), and the multiplier of lam o s = eps
  Matrix<Vec, S::kL, S::kW> K_lam, K_s;  // K_s in the adjoint only
  Matrix<Vec, S::kX, S::kW> A_hat;
};

template <class T, class S>
class Linearisation {
  static constexpr int64_t kX = S::kX, kL = S::kL, kW = S::kW;
  const Problem<T, S>& problem;
  const S n;
  const Elimination<kL == 0> lu;
  const bool kept;  // every stage is kept; else each takes the place of the one before it, but for K_lam
  Stages<Matrix<Vec, kL, kL>> M;
  Stages<Matrix<Vec, kL, kW>> K_lam, K_s;
  Stages<Matrix<Vec, kX, kW>> A_hat;
  Matrix<Vec, 0, kL> size, y;
  Mask *rows, *right_rows;
  Vec *a, *b, *right_factors, *column;
  Vec *bend, *damped;  // of each contact: curvature of the cost along lam - s, exact, and what damping adds
  Matrix<Vec, kL, kW> slopes, weighted;

 public:
  Linearisation(const Problem<T, S>& problem, bool kept)
      : problem(problem), n(problem.n), lu{problem.batch.pivot}, kept(kept) {}

  void layout(Arena& arena) {
    const int64_t nx = n.x(), nl = n.l(), nw = n.w(), count = kept ? n.h : 1;
    arena.take(M, count, nl, nl);
    arena.take(K_lam, n.h, nl, nw);
    arena.take(A_hat, nl > 0 || problem.AB.count > 1 ? count : 1, nx, nw);  // without contacts it is [A B]
    arena.take(K_s, kept ? count : 0, nl, nw);
    arena.take(size, count, nl);
    arena.take(y, count, nl);
    arena.take(rows, count * nl);
    arena.take_all(nl, right_rows, a, b, bend, damped);
    arena.take(right_factors, nl * nl);
    arena.take(column, nl * kColumns);
    arena.take(slopes, nl, nw);
    arena.take(weighted, nl, nw);
  }

  Stage<S> stage(int64_t k) const {
    const int64_t own = kept ? k : 0;
    return {M[own], rows + own * n.l(), size[own], y[own], K_lam[k], K_s[own], A_hat[own]};
  }

  // Predicts lam of stage k for a change of state and action, to first order.
  Vec change(int64_t k, int64_t i, const Vec* dx, const Vec* du) const {
    const Matrix<Vec, kL, kW> K = K_lam[k];
    Vec sum = all(0);
    for (int64_t j = 0; j < n.x(); j++) sum += K(i, j) * dx[j];
    for (int64_t j = 0; j < n.u(); j++) sum += K(i, n.x() + j) * du[j];
    return sum;
  }

  // Stage k at lam and s, with p the costate of the next state. `damping` adds to the curvature, see `curvature`.
  Stage<S> at(int64_t k, const Vec* lam, const Vec* s, const Vec* p, Vec damping) {
    const int64_t nx = n.x(), nl = n.l(), nw = n.w();
    const Stage<S> stage = this->stage(k);
    const StageData<T, S>& data = problem.stage(k);
    const auto F = data.F;
    const auto C = data.C;
    const LowRank& low_rank = problem.low_rank[k];
    const bool short_cut = kLanes == 1 && kL == 0 && !kept && low_rank;
    for (int64_t i = 0; i < nl; i++) {
      stage.size[i] = 1.0 / (lam[i] + s[i]);
      a[i] = s[i] * stage.size[i];
      b[i] = lam[i] * stage.size[i];
      if (short_cut) low_rank.weigh(i, a[i], b[i]);
    }
    Local<kL * kL> left(stage.M.entries), right(right_factors);
    // diag(a) + diag(b) F, or diag(a) + F diag(b)
    auto eliminate = [&](auto& matrix, Mask* exchanged, bool by_row) {
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) {
        DIFFLCS_UNROLL
        for (int64_t j = 0; j < nl; j++) matrix[i * nl + j] = b[by_row ? i : j] * F(i, j);
        matrix[i * nl + i] += a[i];
      }
      lu.factor(nl, matrix, exchanged);
    };
    if (short_cut) {
      low_rank.factor();
    } else {
      eliminate(left, stage.rows, true);
      for (int64_t i = 0; i < nl * nl; i++) stage.M.entries[i] = left[i];
    }
    // y = (diag(s) + F^T diag(lam))^-1 (-C^T p), from the same factors.
    for (int64_t i = 0; i < nl; i++) stage.y[i] = all(0) - C.column(i) * p;
    if (short_cut)
      low_rank.solve_transposed(stage.y);
    else
      lu.solve_transposed(nl, stage.M.entries, stage.rows, stage.y);
    // Since a dlam + b ds = 0, both follow from one T: K_lam = b T, K_s = -a T with (diag(a) + F diag(b)) T = -[D E].
    if (!short_cut) eliminate(right, right_rows, false);
    by_columns(0, nw, [&](int64_t j, auto kind) {
      using V = decltype(kind);
      Local<kL, V> t(column);
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) t[i] = V{} - read<V>(data.DE[i], j);
      if constexpr (kLanes == 1 && kL == 0)
        short_cut ? low_rank.solve_right(t.v) : lu.solve(nl, right, right_rows, t);
      else
        lu.solve(nl, right, right_rows, t);
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) {
        write<V>(slopes[i], j, t[i]);
        t[i] *= b[i];
        write<V>(stage.K_lam[i], j, t[i]);
      }
      multiply(
          C, t, [&](int64_t i) { return V{} + read<V>(data.AB[i], j); },
          [&](int64_t i, V sum) { write<V>(stage.A_hat[i], j, sum); });
    });
    for (int64_t i = 0; i < nl; i++) {
      stage.y[i] *= stage.size[i];
      bend[i] = -2.0 * stage.y[i] * a[i] * b[i];
      damped[i] = 0.5 * damping * abs(stage.y[i]);
      weigh(i, bend[i] + damped[i]);
    }
    if (kept)
      for (int64_t i = 0; i < nl; i++)
        for (int64_t j = 0; j < nw; j++) stage.K_s(i, j) = -a[i] * slopes(i, j);
    return stage;
  }

  // Y_ij = sum_m y_m (K_lam_mi K_s_mj + K_s_mi K_lam_mj) of the stage that was linearised last, the second derivative
  // of lam in the cost. With z = lam - s, of which lam and s are smoothed positive and negative parts, it is
  // sum_m bend_m dz_m dz_m'. It knows of a contact's kink only next to it. Damping adds what bounds a kink that lies
  // lam + s away: |y| / (2 (lam + s)) is the curvature of the parabola that touches y |z| / 2 and lies above it, so
  // that with a damping of one a contact that opens or closes on the way costs no more than the model says.
  Vec curvature(int64_t i, int64_t j) const { return Vec{} + weighted.column(i) * slopes.column(j); }

  // Calls store(i, j, Y_ij) for the rows [from, to) and the columns [begin, end(i)), see `products`.
  template <class End, class Store>
  void curvatures(int64_t from, int64_t to, int64_t begin, End end, Store store) const {
    products(weighted, slopes, from, to, begin, end, [](int64_t, int64_t, auto zero) { return zero; }, store);
  }

  // Drops Y (Gauss-Newton).
  void drop(Mask which) {
    for (int64_t i = 0; i < n.l(); i++) {
      bend[i] = select(which, all(0), bend[i]);
      weigh(i, bend[i] + damped[i]);
    }
  }

  // Drops what is negative in Y.
  void make_convex(Mask which) {
    for (int64_t i = 0; i < n.l(); i++) weigh(i, select(which, max(bend[i], all(0)), bend[i]) + damped[i]);
  }

 private:
  void weigh(int64_t i, Vec weight) {
    by_columns(0, n.w(), [&](int64_t j, auto kind) {
      using V = decltype(kind);
      write<V>(weighted[i], j, weight * read<V>(slopes[i], j));
    });
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
