// LU without pivoting for one small matrix per lane. The matrices met here have positive principal minors, so the
// factors exist; the callers refine the solution or check its residual. N is an integer or a compile-time size.
#pragma once
#include "lanes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// In place; the reciprocal pivots are stored on the diagonal.
template <class N>
inline void lu_factor(N n, Vec* M) {
  for (int64_t k = 0; k < n; k++) {
    const Vec inverse = 1.0 / M[k * n + k];
    M[k * n + k] = inverse;
    for (int64_t i = k + 1; i < n; i++) {
      const Vec l = M[i * n + k] * inverse;
      M[i * n + k] = l;
      for (int64_t j = k + 1; j < n; j++) M[i * n + j] -= l * M[k * n + j];
    }
  }
}

template <class N>
inline void lu_solve(N n, const Vec* M, Vec* b) {
  for (int64_t i = 1; i < n; i++)
    for (int64_t j = 0; j < i; j++) b[i] -= M[i * n + j] * b[j];
  for (int64_t i = n - 1; i >= 0; i--) {
    for (int64_t j = i + 1; j < n; j++) b[i] -= M[i * n + j] * b[j];
    b[i] *= M[i * n + i];
  }
}

// The same for `columns` right-hand sides, row-major (n, columns).
template <class N, class C>
inline void lu_solve_many(N n, C columns, const Vec* M, Vec* b) {
  for (int64_t i = 1; i < n; i++)
    for (int64_t j = 0; j < i; j++)
      for (int64_t c = 0; c < columns; c++) b[i * columns + c] -= M[i * n + j] * b[j * columns + c];
  for (int64_t i = n - 1; i >= 0; i--) {
    for (int64_t j = i + 1; j < n; j++)
      for (int64_t c = 0; c < columns; c++) b[i * columns + c] -= M[i * n + j] * b[j * columns + c];
    for (int64_t c = 0; c < columns; c++) b[i * columns + c] *= M[i * n + i];
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
