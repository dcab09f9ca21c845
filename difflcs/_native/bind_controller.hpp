// Adds the controller to the module of the bindings.
#pragma once
#include <nanobind/nanobind.h>

void bind_controller(nanobind::module_& m);
