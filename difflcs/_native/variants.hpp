// Variants of the MPC solver and its adjoint: compile-time sizes for the paper's tasks, matrices shared or per element.
#pragma once
#include "lanes.hpp"
#include "sizes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

template <class Entry, class Sizes>
struct Variant {
  using T = Entry;
  using S = Sizes;
};
// That which fits every problem. With one problem at a time all numbers are plain.
using Widest = Variant<std::conditional_t<kLanes == 1, double, Vec>, AnySizes>;

// Calls f with the variant for matrices with entries T that fits.
template <class T, class Function>
void dispatch_sizes(const MpcBatch& b, Function f) {
  const bool paper = b.n_x == 9 && b.n_u == 6;
  if (paper && b.n_lam == 5)
    f(Variant<T, Sizes<9, 6, 5>>());
  else if (paper && b.n_lam == 8)
    f(Variant<T, Sizes<9, 6, 8>>());
  else
    f(Variant<T, AnySizes>());
}

// Calls f with the variant that fits.
template <class Function>
void dispatch(const MpcBatch& b, Function f) {
  if (b.pivot)
    f(Widest());
  else if (kLanes == 1 || shared_matrices(b))
    dispatch_sizes<double>(b, f);
  else if constexpr (kSizedPerElement)
    dispatch_sizes<Vec>(b, f);
  else
    f(Widest());
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
