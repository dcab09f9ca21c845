# difflcs_add_kernels(target): compile the native kernels once per instruction set and link them into a target.
# dispatch.cpp picks one of them when it is loaded. "lanes" is the number of problems solved side by side.
set(DIFFLCS_NATIVE ${CMAKE_CURRENT_LIST_DIR}/../difflcs/_native)
set(DIFFLCS_ISAS "all" CACHE STRING
    "instruction sets to compile beside the baseline: all, none, or a list of avx2 and avx512; here: the widest of this CPU alone")
set(DIFFLCS_SIZES "" CACHE STRING
    "n_x,n_u,n_lam of each size of problem that gets code of its own beside the paper's, for example 4,1,2 or 4,1,2,13,3,8")

include(CheckCXXSourceRuns)

function(difflcs_add_kernels target)
  target_include_directories(${target} PRIVATE ${DIFFLCS_NATIVE})
  set(sources ${DIFFLCS_NATIVE}/search.cpp ${DIFFLCS_NATIVE}/controller.cpp ${DIFFLCS_NATIVE}/controller_file.cpp)
  target_sources(${target} PRIVATE ${DIFFLCS_NATIVE}/dispatch.cpp ${sources})
  # So that they compute the same in Python and in C, whatever else differs between the two builds.
  set_source_files_properties(${sources} PROPERTIES COMPILE_OPTIONS
                              $<$<NOT:$<CXX_COMPILER_ID:MSVC>>:-ffp-contract=off>)
  # So that a problem has the same plan whichever of them solves it: GCC would sum differently in vectors of its own.
  # Nor is there anything else for such vectors: numbers that are added up are already vectors of all lanes.
  set_source_files_properties(${DIFFLCS_NATIVE}/mpc.cpp ${DIFFLCS_NATIVE}/mpc_adjoint.cpp ${DIFFLCS_NATIVE}/violation.cpp
                              PROPERTIES COMPILE_OPTIONS $<$<CXX_COMPILER_ID:GNU>:-fno-tree-vectorize>)
  set(isas ${DIFFLCS_ISAS})
  if(isas STREQUAL "all")
    set(isas avx2 avx512)
  elseif(isas STREQUAL "here")
    difflcs_widest_here(isas)
  endif()
  if(WIN32 AND CMAKE_CXX_COMPILER_ID STREQUAL "GNU")  # it does not align wider vectors on the stack there: GCC bug 54412
    set(isas)
  endif()
  if(NOT CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|AMD64|amd64)$")
    set(isas)
  endif()
  # Problems with code of their own for the sizes of the paper's tasks and of DIFFLCS_SIZES: 0 none, 1 those that share
  # their matrices, 2 all. The C library has controllers, which have one problem.
  set(sized 2)
  if(DIFFLCS_C_LIBRARY)
    set(sized 1)
  endif()
  if(avx512 IN_LIST isas)  # first, as it compiles longest
    difflcs_add_instruction_set(${target} avx512 8 -mavx512f -mavx512dq -mavx512vl -mfma)
  endif()
  if(avx2 IN_LIST isas)
    difflcs_add_instruction_set(${target} avx2 4 -mavx2 -mfma)
  endif()
  # One problem alone, for every CPU that has AVX2. Clang would fuse other products and sums than in the others.
  if(isas AND CMAKE_CXX_COMPILER_ID STREQUAL "GNU")
    difflcs_add_instruction_set(${target} single 1 -mavx2 -mfma)
  endif()
  if(NOT isas OR DIFFLCS_C_LIBRARY AND NOT DIFFLCS_ISAS STREQUAL "here")
    difflcs_add_instruction_set(${target} baseline 2)
  elseif(NOT DIFFLCS_ISAS STREQUAL "here")  # only for CPUs without AVX2: less to compile matters more than speed
    set(sized 0)
    difflcs_add_instruction_set(${target} baseline 2 $<$<CONFIG:Release>:-O2>)
  endif()
endfunction()

# The widest instruction set of the CPU that compiles, as dispatch.cpp would choose it; empty where it is the baseline.
function(difflcs_widest_here result)
  set(${result} "" PARENT_SCOPE)
  foreach(isa avx2 avx512)
    set(features ${isa} fma)
    if(isa STREQUAL "avx512")
      set(features avx512f avx512dq avx512vl fma)
    endif()
    list(TRANSFORM features REPLACE "(.+)" "__builtin_cpu_supports(\"\\1\")")
    list(JOIN features " && " supported)
    check_cxx_source_runs("int main() { return !(${supported}); }" DIFFLCS_HERE_${isa})
    if(DIFFLCS_HERE_${isa})
      set(${result} ${isa} PARENT_SCOPE)
    endif()
  endforeach()
endfunction()

function(difflcs_add_instruction_set target isa lanes)
  set(name ${target}_${isa})
  add_library(${name} OBJECT ${DIFFLCS_NATIVE}/mpc.cpp)
  if(lanes GREATER 1)
    target_sources(${name} PRIVATE ${DIFFLCS_NATIVE}/mpc_adjoint.cpp)
    if(NOT DIFFLCS_C_LIBRARY)  # which has controllers alone
      target_sources(${name} PRIVATE ${DIFFLCS_NATIVE}/lcp.cpp ${DIFFLCS_NATIVE}/violation.cpp)
    endif()
  endif()
  set_target_properties(${name} PROPERTIES POSITION_INDEPENDENT_CODE ON)
  target_compile_definitions(${name} PRIVATE DIFFLCS_ISA=${isa} DIFFLCS_LANES=${lanes} DIFFLCS_SIZED=${sized})
  if(DIFFLCS_SIZES)
    target_compile_definitions(${name} PRIVATE DIFFLCS_SIZES=${DIFFLCS_SIZES})
  endif()
  # Of GCC's -O3 without what takes an eighth of the time to compile and gains nothing here.
  set(idle ipa-cp-clone split-paths tree-partial-pre gcse-after-reload predictive-commoning version-loops-for-strides
      tree-loop-distribution loop-interchange loop-unroll-and-jam)
  list(TRANSFORM idle REPLACE "(.+)" "$<$<CXX_COMPILER_ID:GNU>:-fno-\\1>")
  target_compile_options(${name} PRIVATE -fno-math-errno -Wno-psabi ${idle} ${ARGN})
  target_sources(${target} PRIVATE $<TARGET_OBJECTS:${name}>)
  set_property(TARGET ${target} APPEND PROPERTY DIFFLCS_OBJECTS $<TARGET_OBJECTS:${name}>)
  target_compile_definitions(${target} PRIVATE DIFFLCS_LANES_${isa}=${lanes})
endfunction()
