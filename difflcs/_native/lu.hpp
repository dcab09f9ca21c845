// LU of one small matrix, for every kind of number: a double, or one problem per SIMD lane (lu_lanes.hpp). The
// reciprocal pivots are stored on the diagonal.
//
// Without row exchanges: the matrices met here have positive principal minors, so the factors exist, but a dominant
// skew part can make them large. The callers check the residual of the solution, and fall back to row exchanges where
// it is poor. With a compile-time size and a `Local` for M everything happens in registers.
#pragma once
#include <cstdint>

#include "unroll.hpp"

namespace difflcs {
namespace {

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

template <class N, class Matrix, class Vector>
inline void lu_solve_transposed(N n, const Matrix& M, Vector& b) {
  for (int64_t i = 0; i < n; i++) {
    for (int64_t j = 0; j < i; j++) b[i] -= M[j * n + i] * b[j];
    b[i] *= M[i * n + i];
  }
  for (int64_t i = n - 2; i >= 0; i--)
    for (int64_t j = i + 1; j < n; j++) b[i] -= M[j * n + i] * b[j];
}

// With row exchanges, for a matrix of plain numbers that lie `Distance` apart: 1, or the number of lanes. Like LAPACK,
// rows[k] is the row that was exchanged with row k. Returns whether every pivot is a number other than zero.
template <int64_t Distance>
inline bool lu_factor_pivoted(int64_t n, double* M, int64_t* rows) {
  auto at = [&](int64_t i, int64_t j) -> double& { return M[(i * n + j) * Distance]; };
  bool regular = true;
  for (int64_t k = 0; k < n; k++) {
    int64_t pivot = k;
    for (int64_t i = k + 1; i < n; i++)
      if (__builtin_fabs(at(i, k)) > __builtin_fabs(at(pivot, k))) pivot = i;
    rows[k * Distance] = pivot;
    for (int64_t j = 0; pivot != k && j < n; j++) {
      const double t = at(k, j);
      at(k, j) = at(pivot, j), at(pivot, j) = t;
    }
    regular &= __builtin_fabs(at(k, k)) > 0;
    const double inverse = at(k, k) = 1.0 / at(k, k);
    for (int64_t i = k + 1; i < n; i++) {
      const double factor = at(i, k) *= inverse;
      for (int64_t j = k + 1; j < n; j++) at(i, j) -= factor * at(k, j);
    }
  }
  return regular;
}

// Exchanges two entries of a right-hand side as its matrix's rows were.
template <int64_t Distance>
inline void lu_exchange(int64_t k, const int64_t* rows, double* b) {
  double &first = b[k * Distance], &second = b[rows[k * Distance] * Distance];
  const double t = first;
  first = second, second = t;
}

}  // namespace
}  // namespace difflcs
