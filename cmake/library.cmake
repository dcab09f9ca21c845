# The C library: libdifflcs, static and shared, difflcs.h, and a package for find_package(difflcs):
#   cmake -S . -B build/c -DDIFFLCS_C_LIBRARY=ON && cmake --build build/c && cmake --install build/c --prefix DIR
# It needs a C++ compiler and nothing else.
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

file(STRINGS difflcs/__init__.py DIFFLCS_VERSION REGEX "^__version__ = ")
string(REGEX REPLACE "^__version__ = \"([0-9.]+).*" "\\1" DIFFLCS_VERSION "${DIFFLCS_VERSION}")

add_compile_definitions(DIFFLCS_C_LIBRARY)
add_library(difflcs_static STATIC ${DIFFLCS_NATIVE}/difflcs_c.cpp)
difflcs_add_kernels(difflcs_static)
set_target_properties(difflcs_static PROPERTIES POSITION_INDEPENDENT_CODE ON)
if(NOT MSVC)
  set_target_properties(difflcs_static PROPERTIES OUTPUT_NAME difflcs)
endif()

get_target_property(kernels difflcs_static DIFFLCS_OBJECTS)
add_library(difflcs SHARED $<TARGET_OBJECTS:difflcs_static> ${kernels})
set_target_properties(difflcs PROPERTIES LINKER_LANGUAGE CXX VERSION ${DIFFLCS_VERSION} SOVERSION 0)
target_compile_definitions(difflcs INTERFACE DIFFLCS_SHARED)
if(UNIX AND NOT APPLE)  # nothing but the functions of difflcs.h is to be seen
  set(exports ${CMAKE_CURRENT_LIST_DIR}/difflcs.map)
  target_link_options(difflcs PRIVATE -Wl,--version-script=${exports})
  set_target_properties(difflcs PROPERTIES LINK_DEPENDS ${exports})
endif()

foreach(target difflcs difflcs_static)
  target_include_directories(${target} INTERFACE $<BUILD_INTERFACE:${DIFFLCS_NATIVE}>
                             $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
  add_library(difflcs::${target} ALIAS ${target})
endforeach()

set(package ${CMAKE_INSTALL_LIBDIR}/cmake/difflcs)
install(TARGETS difflcs difflcs_static EXPORT difflcs LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR}
        ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR})
install(FILES ${DIFFLCS_NATIVE}/difflcs.h DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})
install(EXPORT difflcs FILE difflcsTargets.cmake NAMESPACE difflcs:: DESTINATION ${package})
configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/difflcsConfig.cmake.in difflcsConfig.cmake
                              INSTALL_DESTINATION ${package})
write_basic_package_version_file(difflcsConfigVersion.cmake VERSION ${DIFFLCS_VERSION} COMPATIBILITY SameMinorVersion)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/difflcsConfig.cmake ${CMAKE_CURRENT_BINARY_DIR}/difflcsConfigVersion.cmake
        DESTINATION ${package})
