#!/bin/sh
# sanitize.sh SANITIZER: the kernels under a sanitizer of GCC, called by the tests of all that is native, on every
# instruction set of this CPU. They are built into an environment of their own, which has the packages of .venv.
set -e
root=$(cd "$(dirname "$0")/../.." && pwd)
own=$root/build/sanitize-$1
"$root/.venv/bin/python" -m venv "$own"
packages=$("$root/.venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
printf '%s\n' "$packages" "$root" > "$("$own/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/packages.pth"
CXXFLAGS="-O1 -g -fno-omit-frame-pointer -fsanitize=$1 -fno-sanitize-recover=all" SKBUILD_CMAKE_BUILD_TYPE=None \
  SKBUILD_INSTALL_STRIP=false SKBUILD_BUILD_DIR="$own/cmake" \
  "$own/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile --no-deps --ignore-installed "$root"
# IPOPT and the conic solvers have processes of their own, which are not what is tested.
chosen="not ipopt and not relaxed and not instruction_set and not bit_for_bit_also"
case $1 in
  thread) libraries=libtsan chosen="threads_change or whatever_the_threads or change_no_bit or thread_is_refused" ;;
  *) libraries="libasan libubsan" ;;
esac
preload=$(for name in $libraries libstdc++; do "${CXX:-c++}" -print-file-name=$name.so; done)
cd "$root"
for isa in baseline $(grep -o -m1 -w avx2 /proc/cpuinfo 2>/dev/null) $(grep -o -m1 -w avx512dq /proc/cpuinfo 2>/dev/null | sed s/dq//); do
  echo "$1, $isa:"
  LD_PRELOAD=$(echo $preload) ASAN_OPTIONS=detect_leaks=0 TSAN_OPTIONS="ignore_noninstrumented_modules=1 halt_on_error=1" \
    DIFFLCS_ISA=$isa OMP_NUM_THREADS=1 "$own/bin/python" -P -m pytest -q -x -o "pythonpath=benchmarks" -p no:cacheprovider \
    -m "not slow" -k "$chosen" tests/unit/test_lcp.py tests/unit/test_losses.py tests/unit/test_batched.py \
    tests/unit/test_controller.py tests/unit/test_native_problems.py tests/conformance/hostile \
    tests/unit/test_physics_mujoco.py tests/unit/test_physics_nominal.py tests/unit/test_physics_limits.py
done
