// What the compiler has to be told so that small arrays live in registers.
#pragma once

// Unrolls the loop behind it. Where all loops over an array are unrolled, its elements live in registers.
#if defined(__clang__)
#define DIFFLCS_UNROLL _Pragma("unroll")
#else
#define DIFFLCS_UNROLL _Pragma("GCC unroll 16")
#endif

// A function that is handed such an array has to become part of its caller.
#define DIFFLCS_INLINE __attribute__((always_inline)) inline
