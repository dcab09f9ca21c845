// Choice of the instruction set when the module is loaded.
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

#include "kernels.hpp"

namespace difflcs {
namespace single {
void mpc_solve(const MpcBatch&, const MpcSolve&, int64_t*, void*, Watch);
}
#ifdef DIFFLCS_LANES_single
#define DIFFLCS_ALONE single::mpc_solve
#else
#define DIFFLCS_ALONE mpc_solve
#endif

#define DIFFLCS_KERNELS(ISA, LANES, ALONE)                                                                            \
  namespace ISA {                                                                                                     \
  int64_t lcp_workspace(int64_t);                                                                                     \
  void lcp_solve(const LcpBatch&, int64_t, int64_t, void*, Watch);                                                    \
  int64_t mpc_workspace(const MpcBatch&);                                                                             \
  void mpc_solve(const MpcBatch&, const MpcSolve&, int64_t*, void*, Watch);                                           \
  void mpc_constraints(const MpcBatch&, const MpcSolve&, int64_t, int64_t, void*, Watch);                             \
  void mpc_vjp(const MpcBatch&, const MpcGradient&, int64_t, int64_t, int64_t, void*, Watch);                         \
  int64_t violation_workspace(const ViolationBatch&);                                                                 \
  bool violation_qp(const ViolationBatch&, double*, double*, void*);                                                  \
  int64_t violation_value(const ViolationBatch&, const double*, double*, void*);                                      \
  void violation_gradient(const ViolationBatch&, const double*, const double*, double* const*, void*);                \
  static const Kernels table = {                                                                                      \
      #ISA,    LANES, lcp_workspace,   lcp_solve, mpc_workspace,       mpc_solve,                                     \
      ALONE,   mpc_constraints, mpc_vjp, violation_workspace, violation_qp, violation_value, violation_gradient};     \
  }

#ifdef DIFFLCS_LANES_baseline
DIFFLCS_KERNELS(baseline, DIFFLCS_LANES_baseline, mpc_solve)
#endif
#ifdef DIFFLCS_LANES_avx2
DIFFLCS_KERNELS(avx2, DIFFLCS_LANES_avx2, DIFFLCS_ALONE)
#endif
#ifdef DIFFLCS_LANES_avx512
DIFFLCS_KERNELS(avx512, DIFFLCS_LANES_avx512, DIFFLCS_ALONE)
#endif

static const Kernels& choose() {
  const char* wanted = std::getenv("DIFFLCS_ISA");
  auto accept = [&](const Kernels& k) { return !wanted || !*wanted || std::strcmp(wanted, k.isa) == 0; };
#ifdef DIFFLCS_LANES_avx512
  if (accept(avx512::table) && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma"))
    return avx512::table;
#endif
#ifdef DIFFLCS_LANES_avx2
  if (accept(avx2::table) && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return avx2::table;
#endif
#ifdef DIFFLCS_LANES_baseline
  if (accept(baseline::table)) return baseline::table;
#endif
  if (!wanted || !*wanted)
    throw std::runtime_error(
        "difflcs was compiled for the CPU of another machine (DIFFLCS_ISAS=here): install it again here");
  throw std::runtime_error(std::string("DIFFLCS_ISA=") + wanted +
                           " is not available: expected baseline, avx2 or avx512 and a CPU that has it; unset the "
                           "variable to let difflcs choose");
}

const Kernels& kernels() {
  static const Kernels& chosen = choose();
  return chosen;
}

const Kernels& kernels_for(int64_t problems) {
#ifdef DIFFLCS_LANES_avx2
  const char* wanted = std::getenv("DIFFLCS_ISA");
  const bool few = problems <= avx2::table.lanes && avx2::table.lanes < kernels().lanes;
  if ((!wanted || !*wanted) && few && __builtin_cpu_supports("avx2")) return avx2::table;
#endif
  return kernels();
}

}  // namespace difflcs
