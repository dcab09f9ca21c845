# difflcs_add_kernels(target): compile the native kernels once per instruction set and link them into a target.
# dispatch.cpp picks one of them when it is loaded. "lanes" is the number of problems solved side by side.
set(DIFFLCS_NATIVE ${CMAKE_CURRENT_LIST_DIR}/../difflcs/_native)
set(DIFFLCS_ISAS "all" CACHE STRING "instruction sets to compile beside the baseline: all, or a list of avx2 and avx512")

function(difflcs_add_kernels target)
  target_include_directories(${target} PRIVATE ${DIFFLCS_NATIVE})
  set(sources ${DIFFLCS_NATIVE}/driver.cpp ${DIFFLCS_NATIVE}/controller.cpp ${DIFFLCS_NATIVE}/controller_file.cpp)
  target_sources(${target} PRIVATE ${DIFFLCS_NATIVE}/dispatch.cpp ${sources})
  # So that they compute the same in Python and in C, whatever else differs between the two builds.
  set_source_files_properties(${sources} PROPERTIES COMPILE_OPTIONS
                              $<$<NOT:$<CXX_COMPILER_ID:MSVC>>:-ffp-contract=off>)
  difflcs_add_instruction_set(${target} baseline 2)
  if(CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|AMD64|amd64)$")
    if(DIFFLCS_ISAS STREQUAL "all" OR "avx2" IN_LIST DIFFLCS_ISAS)
      difflcs_add_instruction_set(${target} avx2 4 -mavx2 -mfma)
    endif()
    if(DIFFLCS_ISAS STREQUAL "all" OR "avx512" IN_LIST DIFFLCS_ISAS)
      difflcs_add_instruction_set(${target} avx512 8 -mavx512f -mavx512dq -mavx512vl -mfma)
    endif()
  endif()
endfunction()

function(difflcs_add_instruction_set target isa lanes)
  set(name ${target}_${isa})
  add_library(${name} OBJECT ${DIFFLCS_NATIVE}/lcp.cpp ${DIFFLCS_NATIVE}/mpc.cpp
              ${DIFFLCS_NATIVE}/violation.cpp)
  set_target_properties(${name} PROPERTIES POSITION_INDEPENDENT_CODE ON)
  target_compile_definitions(${name} PRIVATE DIFFLCS_ISA=${isa} DIFFLCS_LANES=${lanes})
  target_compile_options(${name} PRIVATE -fno-math-errno -Wno-psabi ${ARGN})
  target_sources(${target} PRIVATE $<TARGET_OBJECTS:${name}>)
  set_property(TARGET ${target} APPEND PROPERTY DIFFLCS_OBJECTS $<TARGET_OBJECTS:${name}>)
  target_compile_definitions(${target} PRIVATE DIFFLCS_LANES_${isa}=${lanes})
endfunction()
