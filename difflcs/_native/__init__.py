"""Native kernels: C++ without torch, one problem per SIMD lane (sources beside this file)."""
