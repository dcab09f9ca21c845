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
using Widest = Variant<Vec, AnySizes>;

// Calls f with the variant that fits.
template <class Function>
void dispatch(const MpcBatch& b, Function f) {
  const bool paper = b.n_x == 9 && b.n_u == 6;
  if (b.pivot)
    f(Widest());
  else if (!shared_matrices(b) && paper && b.n_lam == 5)
    f(Variant<Vec, Sizes<9, 6, 5>>());
  else if (!shared_matrices(b) && paper && b.n_lam == 8)
    f(Variant<Vec, Sizes<9, 6, 8>>());
  else if (!shared_matrices(b))
    f(Widest());
  else if (paper && b.n_lam == 5)
    f(Variant<double, Sizes<9, 6, 5>>());
  else if (paper && b.n_lam == 8)
    f(Variant<double, Sizes<9, 6, 8>>());
  else
    f(Variant<double, AnySizes>());
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
