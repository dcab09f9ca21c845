// Interface between the instruction-set-independent module and the kernels compiled once per instruction set.
// Plain data only: nothing here may instantiate library templates, because the same function compiled for AVX-512
// and for the baseline would be merged by the linker and could then run on a CPU that lacks the instructions.
#pragma once
#include <cstdint>

namespace difflcs {

// Values are those of difflcs.mpc.solution.Status.
enum class Status : int8_t { converged = 0, max_iter = 1, infeasible = 2, numerical = 3, degenerate = 4 };

// A batch of linear complementarity problems 0 <= lam, w = F lam + q >= 0, lam_i w_i = relaxation.
struct LcpBatch {
  int64_t n;           // size of one problem
  const double* F;     // (n, n) row-major, of problem 0
  int64_t F_stride;    // distance from one problem's F to the next; 0 when all share one F
  const double* q;     // (batch, n)
  double relaxation;   // 0: exact
  int64_t max_iter;
  double* lam;         // out (batch, n)
  double* w;           // out (batch, n)
  int8_t* status;      // out (batch,)
  int32_t* iterations; // out (batch,)
};

struct Kernels {
  const char* isa;
  int lanes;  // problems solved side by side
  int64_t (*lcp_workspace)(int64_t n);  // bytes, to be aligned to 64
  // Solve problems [begin, end); both read and write only those.
  void (*lcp_exact)(const LcpBatch& batch, int64_t begin, int64_t end, void* workspace);
  void (*lcp_relaxed)(const LcpBatch& batch, int64_t begin, int64_t end, void* workspace);
};

// The best kernels this CPU runs, or those that the environment variable DIFFLCS_ISA names.
const Kernels& kernels();

}  // namespace difflcs
