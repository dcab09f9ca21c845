// The batched LCS-MPC solver and its adjoint, compiled once per instruction set (see cmake/kernels.cmake).
//
// For F + F^T positive definite the relaxed complementarity lam o s = eps has one solution, smooth in (x, u).
// Eliminating lam leaves a smooth optimal control problem in u alone with box bounds. difflcs/mpc/kkt.py derives its
// conditions and their sensitivity, and the names are the names there:
//   relaxed_lcp.hpp     lam of one stage                        mpc_problem.hpp  data, dynamics, cost
//   linearisation.hpp   a stage with lam eliminated             riccati.hpp      gradient, active bounds, feedback law
//   solve.hpp           projected Newton along the homotopy     adjoint.hpp      gradients of the inputs
//   certificate.hpp     judges what is stored, from the stored numbers alone, whatever the solver thinks of them
//
// One problem per SIMD lane: the code reads like the solver of a single problem. A finished lane stores its result and
// takes the next problem. No lane's arithmetic depends on another lane: whatever iterates, iterates under a mask.
#include "adjoint.hpp"
#include "kernels.hpp"
#include "sizes.hpp"
#include "solve.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

template <class Entry, class Sizes>
struct Variant {
  using T = Entry;
  using S = Sizes;
};
using Widest = Variant<Vec, Sizes<0, 0, 0>>;

// Calls f with the variant that fits: compile-time sizes for the paper's tasks, matrices shared or per element.
template <class Function>
void dispatch(const MpcBatch& b, Function f) {
  const bool paper = b.n_x == 9 && b.n_u == 6;
  if (b.pivot)
    f(Variant<Vec, Pivoting>());
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
    f(Variant<double, Sizes<0, 0, 0>>());
}

}  // namespace

// That of the widest variant serves all.
int64_t mpc_workspace(const MpcBatch& batch) {
  const int64_t solve = Solver<Widest::T, Widest::S>(batch, nullptr).layout(nullptr);
  const int64_t adjoint = Adjoint<Widest::T, Widest::S>(batch, nullptr).layout(nullptr);
  return solve > adjoint ? solve : adjoint;
}

void mpc_solve(const MpcBatch& batch, const MpcSolve& solve, int64_t* next, void* workspace, Watch watch) {
  dispatch(batch, [&](auto variant) {
    using V = decltype(variant);
    Solver<typename V::T, typename V::S>(batch, workspace).solve(solve, next, watch);
  });
}

void mpc_constraints(const MpcBatch& batch, const MpcSolve& solve, int64_t begin, int64_t end, void* workspace,
                     Watch watch) {
  dispatch(batch, [&](auto variant) {
    using V = decltype(variant);
    Adjoint<typename V::T, typename V::S>(batch, workspace).judge_constraints(solve, begin, end, watch);
  });
}

void mpc_vjp(const MpcBatch& batch, const MpcGradient& gradient, int64_t begin, int64_t end, int64_t block,
             void* workspace, Watch watch) {
  dispatch(batch, [&](auto variant) {
    using V = decltype(variant);
    Adjoint<typename V::T, typename V::S>(batch, workspace).vjp(gradient, begin, end, block, watch);
  });
}

}  // namespace difflcs::DIFFLCS_ISA
