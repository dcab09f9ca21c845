// LU without pivoting for one small matrix per lane (or of plain numbers). The matrices met here have positive
// principal minors, so the factors exist, but a dominant skew part can make them large: the callers check the residual
// of the solution, and fall back to row exchanges (at the end of this file) where it is poor. With a compile-time
// size and a `Local` for M everything happens in registers.
#pragma once
#include "lanes.hpp"
#include "matrix.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// In place; the reciprocal pivots are stored on the diagonal.
template <class N, class Matrix>
inline void lu_factor(N n, Matrix& M) {
  DIFFLCS_UNROLL
  for (int64_t k = 0; k < n; k++) {
    const auto inverse = 1.0 / M[k * n + k];
    M[k * n + k] = inverse;
    DIFFLCS_UNROLL
    for (int64_t i = k + 1; i < n; i++) {
      const auto l = M[i * n + k] * inverse;
      M[i * n + k] = l;
      DIFFLCS_UNROLL
      for (int64_t j = k + 1; j < n; j++) M[i * n + j] -= l * M[k * n + j];
    }
  }
}

// The same numbers for a size that is not known when compiling. Four rows at a time eliminate all below them, which are
// so read and written a quarter as often.
DIFFLCS_NOINLINE inline void lu_factor_by_panels(int64_t n, Vec* M) {
  constexpr int64_t kPanel = 4;
  for (int64_t start = 0; start < n; start += kPanel) {
    const int64_t end = start + kPanel < n ? start + kPanel : n;
    for (int64_t i = start; i < end; i++) {
      Vec* row = M + i * n;
      for (int64_t k = start; k < i; k++) {
        row[k] *= M[k * n + k];
        by_columns(k + 1, n, [&](int64_t j, auto kind) {
          using V = decltype(kind);
          write<V>(row, j, read<V>(row, j) - row[k] * read<V>(M + k * n, j));
        });
      }
      row[i] = 1.0 / row[i];
    }
    if (end == n) break;
    const Vec *a = M + start * n + start, *b = a + n, *c = b + n, *d = c + n;
    for (int64_t i = end; i < n; i++) {
      Vec* row = M + i * n + start;
      const Vec l0 = row[0] * a[0];
      const Vec l1 = (row[1] - l0 * a[1]) * b[1];
      const Vec l2 = (row[2] - l0 * a[2] - l1 * b[2]) * c[2];
      const Vec l3 = (row[3] - l0 * a[3] - l1 * b[3] - l2 * c[3]) * d[3];
      row[0] = l0, row[1] = l1, row[2] = l2, row[3] = l3;
      by_columns(kPanel, n - start, [&](int64_t j, auto kind) {
        using V = decltype(kind);
        const V sum = read<V>(row, j) - l0 * read<V>(a, j) - l1 * read<V>(b, j) - l2 * read<V>(c, j);
        write<V>(row, j, sum - l3 * read<V>(d, j));
      });
    }
  }
}

template <class N, class Matrix, class Vector>
inline void lu_solve(N n, const Matrix& M, Vector& b) {
  DIFFLCS_UNROLL
  for (int64_t j = 0; j < n - 1; j++) {
    DIFFLCS_UNROLL
    for (int64_t i = j + 1; i < n; i++) b[i] -= M[i * n + j] * b[j];
  }
  DIFFLCS_UNROLL
  for (int64_t j = n - 1; j >= 0; j--) {
    b[j] *= M[j * n + j];
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < j; i++) b[i] -= M[i * n + j] * b[j];
  }
}

// The same numbers for a size that is not known when compiling: rows i to i + kRows wait for each other only at the end.
template <int kRows, class V>
DIFFLCS_INLINE void substitute_forward(int64_t n, const Vec* M, V* b, int64_t i) {
  V sum[kRows];
  for (int r = 0; r < kRows; r++) sum[r] = b[i + r];
  for (int64_t j = 0; j < i; j++)
    for (int r = 0; r < kRows; r++) sum[r] -= M[(i + r) * n + j] * b[j];
  for (int r = 0; r < kRows; r++) {
    for (int q = 0; q < r; q++) sum[r] -= M[(i + r) * n + i + q] * sum[q];
    b[i + r] = sum[r];
  }
}
template <int kRows, class V>
DIFFLCS_INLINE void substitute_backward(int64_t n, const Vec* M, V* b, int64_t i) {
  V sum[kRows];
  for (int r = 0; r < kRows; r++) sum[r] = b[i + r];
  for (int64_t j = n - 1; j >= i + kRows; j--)
    for (int r = 0; r < kRows; r++) sum[r] -= M[(i + r) * n + j] * b[j];
  for (int r = kRows - 1; r >= 0; r--) {
    for (int q = kRows - 1; q > r; q--) sum[r] -= M[(i + r) * n + i + q] * sum[q];
    b[i + r] = sum[r] *= M[(i + r) * n + i + r];
  }
}
template <class V>
DIFFLCS_NOINLINE void lu_solve_by_rows(int64_t n, const Vec* M, V* b) {
  constexpr int kRows = 4;
  int64_t i = 0;
  for (; i + kRows <= n; i += kRows) substitute_forward<kRows>(n, M, b, i);
  for (; i < n; i++) substitute_forward<1>(n, M, b, i);
  for (; i % kRows; i--) substitute_backward<1>(n, M, b, i - 1);
  for (; i > 0; i -= kRows) substitute_backward<kRows>(n, M, b, i - kRows);
}

// The same with row exchanges, lane by lane, for the few problems where elimination without them loses digits. Like
// LAPACK, rows[k] is the row that was exchanged with row k.
DIFFLCS_NOINLINE inline void lu_factor_pivoted(int64_t n, Vec* M, Mask* rows) {
  for (int l = 0; l < kLanes; l++) {
    auto at = [&](int64_t i, int64_t j) -> double& { return reinterpret_cast<double*>(M + i * n + j)[l]; };
    for (int64_t k = 0; k < n; k++) {
      int64_t pivot = k;
      for (int64_t i = k + 1; i < n; i++)
        if (__builtin_fabs(at(i, k)) > __builtin_fabs(at(pivot, k))) pivot = i;
      rows[k][l] = pivot;
      for (int64_t j = 0; pivot != k && j < n; j++) {
        const double t = at(k, j);
        at(k, j) = at(pivot, j);
        at(pivot, j) = t;
      }
      const double inverse = at(k, k) = 1.0 / at(k, k);
      for (int64_t i = k + 1; i < n; i++) {
        const double factor = at(i, k) *= inverse;
        for (int64_t j = k + 1; j < n; j++) at(i, j) -= factor * at(k, j);
      }
    }
  }
}

// b has one column in each lane, or as many of one problem as V holds.
template <class V>
inline void exchange(V* b, int64_t k, const Mask* rows) {
  constexpr int width = sizeof(V) / sizeof(double);
  for (int l = 0; l < width; l++) {
    double& first = reinterpret_cast<double*>(b + k)[l];
    double& second = reinterpret_cast<double*>(b + rows[k][l % kLanes])[l];
    const double t = first;
    first = second;
    second = t;
  }
}

template <class V>
DIFFLCS_NOINLINE void lu_solve_pivoted(int64_t n, const Vec* M, const Mask* rows, V* b) {
  for (int64_t k = 0; k < n; k++) exchange(b, k, rows);
  lu_solve(n, M, b);
}

// Elimination of one matrix per lane, with row exchanges if `pivot`, which only a size that is not known when compiling
// allows.
template <bool kMayPivot>
struct Elimination {
  bool pivot;
  template <class Matrix>
  DIFFLCS_INLINE void factor(int64_t n, Matrix& M, [[maybe_unused]] Mask* rows) const {
    if constexpr (kMayPivot)
      return pivot ? lu_factor_pivoted(n, M.v, rows) : lu_factor_by_panels(n, M.v);
    else
      lu_factor(n, M);
  }
  template <class Matrix, class Vector>
  DIFFLCS_INLINE void solve(int64_t n, const Matrix& M, [[maybe_unused]] const Mask* rows, Vector& b) const {
    if constexpr (kMayPivot)
      return pivot ? lu_solve_pivoted(n, M.v, rows, b.v) : lu_solve_by_rows(n, M.v, b.v);
    else
      lu_solve(n, M, b);
  }
  DIFFLCS_INLINE void solve_transposed(int64_t n, const Vec* M, [[maybe_unused]] const Mask* rows, Vec* b) const {
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < i; j++) b[i] -= M[j * n + i] * b[j];
      b[i] *= M[i * n + i];
    }
    for (int64_t i = n - 2; i >= 0; i--)
      for (int64_t j = i + 1; j < n; j++) b[i] -= M[j * n + i] * b[j];
    if constexpr (kMayPivot)
      for (int64_t k = n - 1; pivot && k >= 0; k--) exchange(b, k, rows);
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
