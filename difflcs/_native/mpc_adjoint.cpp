// Gradients of the inputs, and the test for degenerate constraints: both need the linearisation at a solution.
// Apart from mpc.cpp, so that the two are compiled at the same time.
#if defined(__GNUC__) && !defined(__clang__)
// The rounding of a constraint row's length depends on whether GCC vectorises the sum. Here it does.
#define DIFFLCS_ROW_LENGTHS __attribute__((optimize("tree-vectorize")))
#endif
#include "adjoint.hpp"
#include "kernels.hpp"
#include "variants.hpp"

namespace difflcs::DIFFLCS_ISA {

// Of the solver and the adjoint; that of the widest variant serves all.
int64_t mpc_workspace(const MpcBatch& batch) {
  const int64_t solve = solver_workspace(batch);
  const int64_t adjoint = Adjoint<Widest::T, Widest::S>(batch, nullptr).layout(nullptr);
  return solve > adjoint ? solve : adjoint;
}

void mpc_constraints(const MpcBatch& batch, const MpcSolve& solve, int64_t begin, int64_t end, void* workspace,
                     Watch watch) {
  dispatch(batch, [&](auto variant) {
    using V = decltype(variant);
    Adjoint<typename V::T, typename V::S>(batch, workspace).judge_constraints(solve, begin, end, watch);
  });
}

#ifndef DIFFLCS_C_LIBRARY
void mpc_vjp(const MpcBatch& batch, const MpcGradient& gradient, int64_t begin, int64_t end, int64_t block,
             void* workspace, Watch watch) {
  dispatch(batch, [&](auto variant) {
    using V = decltype(variant);
    Adjoint<typename V::T, typename V::S>(batch, workspace).vjp(gradient, begin, end, block, watch);
  });
}
#endif

}  // namespace difflcs::DIFFLCS_ISA
