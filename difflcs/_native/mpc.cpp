// The batched LCS-MPC solver, compiled once per instruction set (cmake/kernels.cmake). Its adjoint: mpc_adjoint.cpp.
//
// For F + F^T positive definite the relaxed complementarity lam o s = eps has one solution, smooth in (x, u).
// Eliminating lam leaves a smooth optimal control problem in u alone with box bounds. difflcs/mpc/kkt.py derives its
// conditions and their sensitivity, and the names are the names there:
//   relaxed_lcp.hpp     lam of one stage (low_rank.hpp: large)  mpc_problem.hpp  data, dynamics, cost
//   linearisation.hpp   a stage with lam eliminated             riccati.hpp      gradient, active bounds, feedback law
//   newton.hpp          projected Newton along the homotopy     progress.hpp     how far each problem has come
//   adjoint.hpp         directions of the solution              input_gradients.hpp  gradients of the inputs
//   certificate.hpp     judges what is stored, from the stored numbers alone, whatever the solver thinks of them
//
// One problem per SIMD lane: the code reads like the solver of a single problem. A finished lane stores its result and
// takes the next problem. No lane's arithmetic depends on another lane: whatever iterates, iterates under a mask.
// A problem alone would leave lanes idle: for it all of this is compiled once more with a single lane, and neighbouring
// columns of matrices fill the vectors (`by_columns`).
#include "kernels.hpp"
#include "newton.hpp"
#include "variants.hpp"

namespace difflcs::DIFFLCS_ISA {

int64_t solver_workspace(const MpcBatch& batch) {
  return Solver<Widest::T, Widest::S>(batch, nullptr).layout(nullptr);
}

void mpc_solve(const MpcBatch& batch, const MpcSolve& solve, int64_t* next, void* workspace, Watch watch) {
  dispatch(batch, [&](auto variant) {
    using V = decltype(variant);
    Solver<typename V::T, typename V::S>(batch, workspace).solve(solve, next, watch);
  });
}

}  // namespace difflcs::DIFFLCS_ISA
