// Choice of the instruction set when the module is loaded.
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

#include "kernels.hpp"

namespace difflcs {
namespace baseline { extern const Kernels table; }
#ifdef DIFFLCS_HAS_avx2
namespace avx2 { extern const Kernels table; }
#endif
#ifdef DIFFLCS_HAS_avx512
namespace avx512 { extern const Kernels table; }
#endif

static const Kernels& choose() {
  const char* wanted = std::getenv("DIFFLCS_ISA");
  auto accept = [&](const Kernels& k) { return !wanted || !*wanted || std::strcmp(wanted, k.isa) == 0; };
#ifdef DIFFLCS_HAS_avx512
  if (accept(avx512::table) && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma"))
    return avx512::table;
#endif
#ifdef DIFFLCS_HAS_avx2
  if (accept(avx2::table) && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return avx2::table;
#endif
  if (accept(baseline::table)) return baseline::table;
  throw std::runtime_error(std::string("DIFFLCS_ISA=") + wanted +
                           " is not available: expected baseline, avx2 or avx512 and a CPU that has it; unset the "
                           "variable to let difflcs choose");
}

const Kernels& kernels() {
  static const Kernels& chosen = choose();
  return chosen;
}

}  // namespace difflcs
