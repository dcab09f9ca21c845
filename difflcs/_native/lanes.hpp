// One double per SIMD lane, by the vector extensions of GCC and Clang: plain vector code on every CPU.
#pragma once
#include <cstdint>

namespace difflcs::DIFFLCS_ISA {
constexpr int kLanes = DIFFLCS_LANES;
}  // namespace difflcs::DIFFLCS_ISA
#if DIFFLCS_LANES == 1
#include "single_lane.hpp"
#define DIFFLCS_NOINLINE_IN_LANES  // one problem alone would feel the calls
#else
#define DIFFLCS_NOINLINE_IN_LANES DIFFLCS_NOINLINE
namespace difflcs::DIFFLCS_ISA {

typedef double Vec __attribute__((vector_size(8 * DIFFLCS_LANES)));
typedef int64_t Mask __attribute__((vector_size(8 * DIFFLCS_LANES)));  // 0 or -1 in each lane

static inline Vec select(Mask m, Vec a, Vec b) { return m ? a : b; }
static inline Vec max(Vec a, Vec b) { return a > b ? a : b; }
static inline Vec min(Vec a, Vec b) { return a < b ? a : b; }
// One instruction where a comparison and a choice are three.
static inline Vec abs(Vec a) { return (Vec)((Mask)a & (Mask{} + INT64_MAX)); }
// GCC does not always turn the loop into one instruction. The header of the intrinsics would add .3 s to each file's
// compilation.
static inline Vec sqrt(Vec a) {
#if defined(__AVX512F__) && DIFFLCS_LANES == 8 && !defined(__clang__)
  constexpr int kAsTheCpuRounds = 4;
  return __builtin_ia32_sqrtpd512_mask(a, Vec{}, -1, kAsTheCpuRounds);
#elif defined(__AVX__) && DIFFLCS_LANES == 4 && !defined(__clang__)
  return __builtin_ia32_sqrtpd256(a);
#else
  Vec r;
  for (int l = 0; l < kLanes; l++) r[l] = __builtin_sqrt(a[l]);
  return r;
#endif
}
}  // namespace difflcs::DIFFLCS_ISA
#endif

namespace difflcs::DIFFLCS_ISA {

// Zero where a mask is set.
static inline Vec zero_where(Mask m, Vec a) { return select(m, Vec{}, a); }
static inline Vec all(double a) { return Vec{} + a; }
static inline Vec log(Vec a) {
  Vec r;
  for (int l = 0; l < kLanes; l++) r[l] = __builtin_log(a[l]);
  return r;
}
static inline bool any(Mask m) {
  int64_t r = 0;
  for (int l = 0; l < kLanes; l++) r |= m[l];
  return r != 0;
}

// One lane of a number; a double is the same in every lane.
static inline double lane_of(double a, int) { return a; }
static inline double lane_of(const Vec& a, int lane) { return a[lane]; }
static inline void put(double* to, int64_t at, int, double value) { to[at] = value; }
static inline void put(Vec* to, int64_t at, int lane, double value) {
  reinterpret_cast<double*>(to + at)[lane] = value;
}

// Unrolls the loop behind it. Where all loops over an array are unrolled, its elements live in registers.
#if defined(__clang__)
#define DIFFLCS_UNROLL _Pragma("unroll")
#else
#define DIFFLCS_UNROLL _Pragma("GCC unroll 16")
#endif

// A function with such an array as argument must be inlined.
#define DIFFLCS_INLINE __attribute__((always_inline)) inline
// A function with several callers, where a copy in each would only take longer to compile.
#define DIFFLCS_NOINLINE __attribute__((noinline))

// A small array for unrolled loops: on the stack where the size is known when compiling, else in the scratch given.
template <int64_t N, class V = Vec>
struct Local {
  V v[N];
  explicit Local(Vec*) {}
  V& operator[](int64_t i) { return v[i]; }
  const V& operator[](int64_t i) const { return v[i]; }
};
template <class V>
struct Local<0, V> {
  V* v;
  explicit Local(Vec* scratch) : v(reinterpret_cast<V*>(scratch)) {}
  V& operator[](int64_t i) { return v[i]; }
  const V& operator[](int64_t i) const { return v[i]; }
};

}  // namespace difflcs::DIFFLCS_ISA
