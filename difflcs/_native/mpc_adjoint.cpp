// What needs the linearisation at a solution: gradients of the inputs, and constraints that make it degenerate.
// Beside mpc.cpp so that the two compile at once.
#include "adjoint.hpp"
#include "kernels.hpp"
#include "variants.hpp"

namespace difflcs::DIFFLCS_ISA {

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
