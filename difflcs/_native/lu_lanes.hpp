// LU of one small matrix per SIMD lane, where lu.hpp is not enough: larger than the registers, or with row exchanges.
#pragma once
#include "lanes.hpp"
#include "lu.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// The numbers of lu_factor for a matrix too large for registers: each row is in them while it is eliminated. `n` is N
// where that is not zero, `scratch` holds a row elsewhere.
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

// Row exchanges lane by lane, for the few problems where elimination without them loses digits.
inline void lu_factor_pivoted(int64_t n, Vec* M, Mask* rows) {
  for (int l = 0; l < kLanes; l++)
    difflcs::lu_factor_pivoted<kLanes>(n, reinterpret_cast<double*>(M) + l, reinterpret_cast<int64_t*>(rows) + l);
}

inline void lu_exchange(int64_t k, const Mask* rows, Vec* b) {
  for (int l = 0; l < kLanes; l++)
    difflcs::lu_exchange<kLanes>(k, reinterpret_cast<const int64_t*>(rows) + l, reinterpret_cast<double*>(b) + l);
}

inline void lu_solve_pivoted(int64_t n, const Vec* M, const Mask* rows, Vec* b) {
  for (int64_t k = 0; k < n; k++) lu_exchange(k, rows, b);
  lu_solve(n, M, b);
}

// Elimination of one matrix per lane, with row exchanges or without.
template <bool kPivot>
struct Elimination {
  template <class Matrix>
  static DIFFLCS_INLINE void factor(int64_t n, Matrix& M, [[maybe_unused]] Mask* rows) {
    if constexpr (kPivot)
      lu_factor_pivoted(n, M.v, rows);
    else
      lu_factor(n, M);
  }
  template <class Matrix, class Vector>
  static DIFFLCS_INLINE void solve(int64_t n, const Matrix& M, [[maybe_unused]] const Mask* rows, Vector& b) {
    if constexpr (kPivot)
      lu_solve_pivoted(n, M.v, rows, b.v);
    else
      lu_solve(n, M, b);
  }
  static DIFFLCS_INLINE void solve_transposed(int64_t n, const Vec* M, [[maybe_unused]] const Mask* rows, Vec* b) {
    lu_solve_transposed(n, M, b);
    if constexpr (kPivot)
      for (int64_t k = n - 1; k >= 0; k--) lu_exchange(k, rows, b);
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
