// LU without pivoting for one small matrix per lane (or of plain numbers). The matrices met here have positive
// principal minors, so the factors exist; the callers refine the solution or check its residual. With a compile-time
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

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
