// LU without pivoting for one small matrix per lane (or of plain numbers). The matrices met here have positive
// principal minors, so the factors exist, but a dominant skew part can make them large: the callers check the residual
// of the solution, and fall back to row exchanges (at the end of this file) where it is poor. With a compile-time
// size and a `Local` for M everything happens in registers.
#pragma once
#include "lanes.hpp"

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

// The same numbers for a matrix too large for registers: each row is in them while it is eliminated. `n` is N where
// that is not zero, `scratch` holds a row elsewhere.
template <int64_t N>
inline void lu_factor_by_rows(int64_t n, Vec* M, Vec* scratch) {
  Local<N> row(scratch);
  for (int64_t i = 0; i < n; i++) {
    DIFFLCS_UNROLL
    for (int64_t j = 0; j < n; j++) row[j] = M[i * n + j];
    DIFFLCS_UNROLL
    for (int64_t k = 0; k < n; k++) {
      if (k == i) break;
      row[k] *= M[k * n + k];
      DIFFLCS_UNROLL
      for (int64_t j = k + 1; j < n; j++) row[j] -= row[k] * M[k * n + j];
    }
    DIFFLCS_UNROLL
    for (int64_t j = 0; j < n; j++) M[i * n + j] = row[j];
    M[i * n + i] = 1.0 / M[i * n + i];
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

template <class N>
inline void lu_solve_transposed(N n, const Vec* M, Vec* b) {
  for (int64_t i = 0; i < n; i++) {
    for (int64_t j = 0; j < i; j++) b[i] -= M[j * n + i] * b[j];
    b[i] *= M[i * n + i];
  }
  for (int64_t i = n - 2; i >= 0; i--)
    for (int64_t j = i + 1; j < n; j++) b[i] -= M[j * n + i] * b[j];
}

// The same with row exchanges, lane by lane, for the few problems where elimination without them loses digits. Like
// LAPACK, rows[k] is the row that was exchanged with row k.
inline void lu_factor_pivoted(int64_t n, Vec* M, Mask* rows) {
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
inline void lu_solve_pivoted(int64_t n, const Vec* M, const Mask* rows, V* b) {
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
      if (pivot) return lu_factor_pivoted(n, M.v, rows);
    lu_factor(n, M);
  }
  template <class Matrix, class Vector>
  DIFFLCS_INLINE void solve(int64_t n, const Matrix& M, [[maybe_unused]] const Mask* rows, Vector& b) const {
    if constexpr (kMayPivot)
      if (pivot) return lu_solve_pivoted(n, M.v, rows, b.v);
    lu_solve(n, M, b);
  }
  DIFFLCS_INLINE void solve_transposed(int64_t n, const Vec* M, [[maybe_unused]] const Mask* rows, Vec* b) const {
    lu_solve_transposed(n, M, b);
    if constexpr (kMayPivot)
      for (int64_t k = n - 1; pivot && k >= 0; k--) exchange(b, k, rows);
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
