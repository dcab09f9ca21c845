// Variants of the MPC solver and its adjoint: compile-time sizes for the paper's tasks and for those of DIFFLCS_SIZES
// (cmake/kernels.cmake), matrices shared or per element.
#pragma once
#include "lanes.hpp"
#include "sizes.hpp"

namespace difflcs::DIFFLCS_ISA {

// Size of a workspace of the solver alone (mpc.cpp).
int64_t solver_workspace(const MpcBatch& batch);

namespace {

template <class Entry, class Sizes>
struct Variant {
  using T = Entry;
  using S = Sizes;
};
// That which fits every problem. With one problem at a time all numbers are plain.
using Widest = Variant<std::conditional_t<kLanes == 1, double, Vec>, AnySizes>;

// n_x, n_u and n_lam of each size that has code of its own.
#ifndef DIFFLCS_SIZES
#define DIFFLCS_SIZES
#endif
constexpr int kOwn[] = {9, 6, 5, 9, 6, 8, DIFFLCS_SIZES};
constexpr int kOwnCount = DIFFLCS_SIZED ? int(sizeof(kOwn) / sizeof(int)) / 3 : 0;

// Calls f with the variant for matrices with entries T that fits: that of size number i, or of a later one.
template <class T, int i = 0, class Function>
void dispatch_sizes(const MpcBatch& b, Function f) {
  if constexpr (i == kOwnCount)
    f(Variant<T, AnySizes>());
  else if (b.n_x == kOwn[3 * i] && b.n_u == kOwn[3 * i + 1] && b.n_lam == kOwn[3 * i + 2])
    f(Variant<T, Sizes<kOwn[3 * i], kOwn[3 * i + 1], kOwn[3 * i + 2]>>());
  else
    dispatch_sizes<T, i + 1>(b, f);
}

// Calls f with the variant that fits.
template <class Function>
void dispatch(const MpcBatch& b, Function f) {
  if (b.pivot)
    f(Widest());
  else if (kLanes == 1 || shared_matrices(b))
    dispatch_sizes<double>(b, f);
  else if constexpr (DIFFLCS_SIZED > 1 && kLanes > 1)
    dispatch_sizes<Vec>(b, f);
  else
    f(Widest());
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
