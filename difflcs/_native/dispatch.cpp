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

#define DIFFLCS_DECLARE(result, name, parameters) result name parameters;
#define DIFFLCS_ENTRY(result, name, parameters) name,
#define DIFFLCS_TABLE(ISA, LANES, ALONE)                                            \
  namespace ISA {                                                                   \
  DIFFLCS_KERNELS(DIFFLCS_DECLARE)                                                  \
  static const Kernels table = {#ISA, LANES, DIFFLCS_KERNELS(DIFFLCS_ENTRY) ALONE}; \
  }

#ifdef DIFFLCS_LANES_baseline
DIFFLCS_TABLE(baseline, DIFFLCS_LANES_baseline, mpc_solve)
#endif
#ifdef DIFFLCS_LANES_avx2
DIFFLCS_TABLE(avx2, DIFFLCS_LANES_avx2, DIFFLCS_ALONE)
#endif
#ifdef DIFFLCS_LANES_avx512
DIFFLCS_TABLE(avx512, DIFFLCS_LANES_avx512, DIFFLCS_ALONE)
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
