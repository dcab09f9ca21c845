// Interface between the instruction-set-independent module and the kernels compiled once per instruction set.
// Plain data only: nothing here may instantiate library templates, because the same function compiled for AVX-512
// and for the baseline would be merged by the linker and could then run on a CPU that lacks the instructions.
#pragma once
#include <cstdint>

#include "fields.hpp"

namespace difflcs {

// Called between two steps of long work; true: stop here. A plain function, because the kernels know neither clocks nor
// Python.
struct Watch {
  bool (*stop)(void* context);
  void* context;
};

// A batch of linear complementarity problems 0 <= lam, w = F lam + q >= 0, lam_i w_i = relaxation.
struct LcpBatch {
  int64_t n;          // size of one problem
  const double* F;    // (n, n) row-major, of problem 0
  int64_t F_stride;   // distance from one problem's F to the next; 0 when all share one F
  const double* q;    // (batch, n)
  double relaxation;  // 0: exact
  int64_t max_iter;
  double* lam;     // out (batch, n)
  double* w;       // out (batch, n)
  int8_t* status;  // (batch,) kUnreached, which it stays where the watch stopped before
};

// From these sizes on LCPs are solved one by one, exact and relaxed ones: lanes are faster below, if they are full.
constexpr int64_t kAloneExact = 64, kAloneRelaxed = 128;
// From this number of forces, or of states and actions, on MPC problems are solved one by one: the matrices of several
// side by side would not fit into the cache. Forces that share few bodies are solved for faster alone, too (low_rank.hpp).
constexpr int64_t kAloneForces = 40, kAlone = 48;

// Tolerances of a solved LCP, as in difflcs.lcp.solve_lcp.
constexpr double kLcpTerms = 1e-10;  // |F lam + q - w| in parts of the terms that sum to it
constexpr double kLcpData = 1e-8;    // the same in parts of the largest |q| (and of sqrt(relaxation F_ii))
constexpr double kHuge = 1e300;      // beyond it a bound is infinite
constexpr double kSmallest = 1e-100, kLargest = 1e150;  // range of the diagonal of F; of lam and w

// A batch of LCS-MPC problems (see difflcs.mpc.MPCProblem). All arrays are row-major with the batch in front.
struct MpcBatch {
  int64_t count, n_x, n_u, n_lam, n_c, horizon;
  const int64_t* element;  // whose data each of the `count` problems has, or null: problem i has those of element i
  const double* input[kInputs];
  int64_t stride[kInputs];  // distance from one element to the next; 0 when the batch shares the input
  int64_t step[kInputs];    // distance from one stage to the next; 0 when all stages share the input
  double relaxation;
  double barrier;  // weight of the logarithmic barrier of the action bounds
  bool crossed;    // S is not zero
  bool unbounded;  // some bound of an action is infinite
  bool pivot;      // eliminate with row exchanges: slower, for F whose skew part dominates
  // A workspace keeps what it has made of the shared matrices for other calls with the same number: another one is due
  // where a matrix changes, or which fields are given by stage. 0: it keeps nothing.
  int64_t version;

  // Whether its problems are so large that they are solved one by one.
  bool large() const { return n_x + n_u >= kAlone || n_lam >= kAloneForces; }
  // Field `which` of a problem at stage k.
  int64_t element_of(int64_t problem) const { return element ? element[problem] : problem; }
  const double* at(int which, int64_t problem, int64_t k = 0) const {
    return input[which] + element_of(problem) * stride[which] + k * step[which];
  }
};

// Start of a problem's homotopy, and the length of its path.
struct MpcStart {
  // Whether the actions are first replaced by the feedback law of the problem without contact, rolled out with it.
  bool released;
  bool gauss_newton;      // without the second derivative of the forces
  double first;           // if released: first relaxation, in parts of the square of the mean gap of the contacts then
  double at_least;        // first relaxation, whatever the problem's scale
  int64_t explore;        // Newton steps at the target after which a problem is left as it is, as MAX_ITER; 0: never
  double needed = kHuge;  // if explored: left earlier where its steps gain too little to come below this objective
};

// Outputs of a batch.
struct MpcPlans {
  double *x, *u, *lam, *mu, *objective, *residual;  // residual as difflcs.mpc.kkt.residual, from the numbers returned
  int8_t* status;                                   // unreached where the watch stopped before
  int8_t* fragile;                                  // whether elimination without row exchanges lost digits
  int32_t* iterations;
};

// Options and outputs of the solver.
struct MpcSolve : MpcPlans {
  const double* u_start;    // (count, H, n_u), or null for zero
  const double* lam_start;  // (count, H, n_lam), or null for the root of the first relaxation
  const double* mu_start;   // (count, H + 1, n_c), or null for zero
  const MpcStart* start;    // (count,)
  double shrink;            // factor of the homotopy per stage
  int64_t steps;            // most Newton steps of one stage
  double tol;               // on the projected gradient
  int64_t max_iter;
  double certified;  // largest residual of a solved problem
  double* gained;    // (count,) out: what the last step at the target has saved
};

// Upstream gradients of the outputs, and the gradients of the inputs.
struct MpcGradient {
  const double *x, *u, *lam, *mu;         // the solution
  const double *x_bar, *u_bar, *lam_bar;  // upstream
  const double* objective_bar;
  const int8_t* solved;          // elements that are not contribute exactly zero
  double* per_element[kInputs];  // (count, ...) where the input is per element, else null
  double* partial;               // (blocks, shared_size): sums over each block of the shared inputs
  int64_t shared_size;
  int64_t offset[kInputs];  // position of each shared input inside a partial sum
};

// The violation loss of a batch: |r|^2 / 2 + (lam . phi + |e|^2 / (2 gamma)) / xi at the z = (lam, phi) >= 0 that
// minimises it, with r = A x + B u + C lam + d - x_next and e = D x + E u + F lam + c - phi.
struct ViolationBatch {
  int64_t count, n_x, n_u, n_lam, n_c;
  const double* input[kViolationInputs];
  int64_t stride[kViolationInputs];  // distance from one transition to the next; 0 where the batch shares the input
  bool shared;                       // all of the system and gamma are
  double xi;
  double *r, *e;  // (count, n_x), (count, n_lam): at z = 0 from violation_qp, at the minimiser from violation_value
  Watch watch;
};

// The kernels of one instruction set: KERNEL(result, name, parameters). A new kernel is one more line here, and a
// definition in the namespace DIFFLCS_ISA of a file that cmake/kernels.cmake compiles. A workspace is aligned to 64
// bytes. Problems [begin, end): no others are read or written.
#define DIFFLCS_CONTROLLER_KERNELS(KERNEL)                                                                             \
  /* Size of a workspace in bytes. */                                                                                  \
  KERNEL(int64_t, mpc_workspace, (const MpcBatch& batch))                                                              \
  /* Takes problems from the shared counter `next` until none is left, and certifies them. */                          \
  KERNEL(void, mpc_solve, (const MpcBatch& batch, const MpcSolve& solve, int64_t* next, void* workspace, Watch watch)) \
  /* Marks the solved elements whose constraints make them degenerate. */                                              \
  KERNEL(void, mpc_constraints,                                                                                        \
         (const MpcBatch& batch, const MpcSolve& solve, int64_t begin, int64_t end, void* workspace, Watch watch))

#ifdef DIFFLCS_C_LIBRARY  // which has controllers alone
#define DIFFLCS_KERNELS DIFFLCS_CONTROLLER_KERNELS
#else
#define DIFFLCS_KERNELS(KERNEL)                                                                                       \
  DIFFLCS_CONTROLLER_KERNELS(KERNEL)                                                                                  \
  KERNEL(int64_t, lcp_workspace, (int64_t n))                                                                         \
  KERNEL(void, lcp_solve, (const LcpBatch& batch, int64_t begin, int64_t end, void* workspace, Watch watch))          \
  /* Gradients of elements that are block number `block`. */                                                          \
  KERNEL(void, mpc_vjp,                                                                                               \
         (const MpcBatch& batch, const MpcGradient& gradient, int64_t begin, int64_t end, int64_t block,              \
          void* workspace, Watch watch))                                                                              \
  KERNEL(int64_t, violation_workspace, (const ViolationBatch& batch))                                                 \
  /* r and e at z = 0, and the QP min z'Qz / 2 + q'z over z >= 0: Q (2 n_lam, 2 n_lam), of each transition where */   \
  /* the system is not shared, and q (count, 2 n_lam). Returns whether they are finite, F + F^T - gamma I is */       \
  /* positive definite and Q is so by a margin, and gamma is not too small for double precision. */                   \
  KERNEL(bool, violation_qp, (const ViolationBatch& batch, double* Q, double* q, void* workspace))                    \
  /* r, e and loss (count,) at z (count, 2 n_lam), from r and e at z = 0. Returns the first transition whose e has */ \
  /* no digits that count, or -1. */                                                                                  \
  KERNEL(int64_t, violation_value, (const ViolationBatch& batch, const double* z, double* loss, void* workspace))     \
  /* Gradients of sum(upstream * loss) with z held; those of x, u and x_next only where they are not null. */         \
  KERNEL(void, violation_gradient,                                                                                    \
         (const ViolationBatch& batch, const double* z, const double* upstream,                                       \
          double* const gradient[kViolationInputs], void* workspace))
#endif

struct Kernels {
  const char* isa;
  int lanes;  // problems solved side by side
#define DIFFLCS_MEMBER(result, name, parameters) result(*name) parameters;
  DIFFLCS_KERNELS(DIFFLCS_MEMBER)
#undef DIFFLCS_MEMBER
  decltype(mpc_solve) mpc_solve_alone;  // for a batch of one, to the same bits
};

// The best kernels this CPU runs, or those that the environment variable DIFFLCS_ISA names.
const Kernels& kernels();

// Those for so few problems at a time: where lanes would idle, narrow ones take less time (AVX-512 takes 1.4 to 1.8
// times as long as AVX2 for one problem of the zoo's cube). Both have fused multiply-adds and give the same bits.
const Kernels& kernels_for(int64_t problems);

}  // namespace difflcs
