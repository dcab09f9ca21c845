// The binding of the controller (controller.hpp). Arrays have been checked in Python (difflcs/mpc/controller.py) and
// are checked here once more.
#include "bind_controller.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <initializer_list>
#include <limits>
#include <stdexcept>

#include "controller.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::device::cpu, nb::c_contig>;
using Output = nb::ndarray<double, nb::device::cpu, nb::c_contig>;

// A controller that refuses a second thread.
struct Guarded {
  difflcs::Controller controller;
  std::atomic_flag busy = ATOMIC_FLAG_INIT;
  Guarded(const void* bytes, size_t size) : controller(bytes, size) {}
};

class Use {
 public:
  explicit Use(Guarded& guarded) : guarded_(guarded) {
    if (guarded.busy.test_and_set(std::memory_order_acquire))
      throw std::runtime_error(
          "controller: expected one thread at a time, got a call while another is under way; make one for each thread");
  }
  ~Use() { guarded_.busy.clear(std::memory_order_release); }
  difflcs::Controller* operator->() const { return &guarded_.controller; }

 private:
  Guarded& guarded_;
};

void expect(bool ok, const char* what) {
  if (!ok) throw std::invalid_argument(what);
}

int step(Guarded& self, Array x, std::optional<Array> targets, bool follow, Output u) {
  const Use controller(self);
  const difflcs::ControllerData& d = controller->data();
  const int64_t aims = d.n_goal * (follow ? d.batch.horizon + 1 : 1);
  expect(int64_t(x.size()) == d.batch.n_x && int64_t(u.size()) == d.batch.n_u, "x must be (n_x,) and u (n_u,)");
  expect((targets ? int64_t(targets->size()) : 0) == aims, "targets must be (n_goal,) or (H + 1, n_goal)");
  const nb::gil_scoped_release release;
  return int(controller->step(x.data(), targets ? targets->data() : nullptr, follow, u.data()).status);
}

nb::dict sizes(const Guarded& self) {
  const difflcs::ControllerData& d = self.controller.data();
  nb::dict data;
  data["n_x"] = d.batch.n_x;
  data["n_u"] = d.batch.n_u;
  data["n_lam"] = d.batch.n_lam;
  data["n_c"] = d.batch.n_c;
  data["n_goal"] = d.n_goal;
  data["horizon"] = d.batch.horizon;
  data["step_seconds"] = d.step_seconds;
  data["isa"] = self.controller.kernels().isa;
  return data;
}

nb::tuple outcome(Guarded& self) {
  const Use controller(self);
  const difflcs_outcome& o = controller->outcome();
  return nb::make_tuple(int(o.status), o.fallback != 0, o.late != 0, o.iterations, o.objective, o.residual,
                        o.solve_seconds);
}

void plan(Guarded& self, Output x, Output u, Output lam, Output mu) {
  const Use controller(self);
  const difflcs::Trace& plan = controller->plan();
  const difflcs::Numbers* from[] = {&plan.x, &plan.u, &plan.lam, &plan.mu};
  int i = 0;
  for (const Output* to : {&x, &u, &lam, &mu}) {
    expect(int64_t(to->size()) == from[i]->count(), "x, u, lam and mu must be those of a plan");
    std::copy_n(from[i]->get(), from[i]->count(), to->data());
    i++;
  }
}

void set_fallback(Guarded& self, int kind, std::optional<Array> action) {
  const Use controller(self);
  expect(kind >= 0 && kind <= 3, "the kind must be from 0 to 3");
  expect(kind != 2 || (action && int64_t(action->size()) == controller->data().batch.n_u), "the action must be (n_u,)");
  controller->set_fallback(difflcs_fallback(kind), action ? action->data() : nullptr);
}

void set_inputs(Guarded& self, std::vector<Array> values, double constant) {
  const Use controller(self);
  const difflcs::ControllerData& d = controller->data();
  expect(values.size() == difflcs::kG_x, "there must be one array for each field of system, cost and bounds");
  std::vector<const double*> from;
  for (const Array& value : values) {
    expect(int64_t(value.size()) == d.field[from.size()].count(), "the fields must have the sizes of the first");
    from.push_back(value.data());
  }
  controller->set_inputs(difflcs::kA, int(from.size()), from.data());
  controller->set_constant(constant);
}

}  // namespace

void bind_controller(nb::module_& m) {
  nb::class_<Guarded>(m, "Controller", "A controller from the bytes of its file.")
      .def("__init__", [](Guarded* self, nb::bytes content) { new (self) Guarded(content.c_str(), content.size()); })
      .def("sizes", &sizes)
      .def("step", &step, "x"_a, "targets"_a.none(), "follow"_a, "u"_a, "Plans, writes the action, returns the status.")
      .def("outcome", &outcome,
           "Status, fallback, late, iterations, objective, residual, solve_seconds of the last step.")
      .def("plan", &plan, "x"_a, "u"_a, "lam"_a, "mu"_a, "Writes the last plan.")
      .def("reset", [](Guarded& self) { Use(self)->reset(); })
      .def(
          "set_time_limit",
          [](Guarded& self, double seconds) {
            Use(self)->set_time_limit(seconds > 0 ? seconds : std::numeric_limits<double>::infinity());
          },
          "seconds"_a)
      .def("set_fallback", &set_fallback, "kind"_a, "action"_a.none())
      .def("set_inputs", &set_inputs, "values"_a, "constant"_a, "Other numbers of system, cost and bounds.");
}
