// The C interface, documented in difflcs.h. No exception leaves it.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <exception>
#include <iterator>
#include <limits>
#include <memory>
#include <new>
#include <stdexcept>
#include <vector>

#include "controller.hpp"
#include "difflcs.h"

using difflcs::Controller;

struct difflcs_controller {
  Controller controller;
};

namespace {

static_assert(int(difflcs::Status::converged) == DIFFLCS_CONVERGED &&
                  int(difflcs::Status::max_iter) == DIFFLCS_MAX_ITER &&
                  int(difflcs::Status::infeasible) == DIFFLCS_INFEASIBLE &&
                  int(difflcs::Status::numerical) == DIFFLCS_NUMERICAL &&
                  int(difflcs::Status::degenerate) == DIFFLCS_DEGENERATE,
              "the codes of difflcs.h are those of fields.hpp");

// Largest controller file [byte].
constexpr long kLargestFile = 1L << 30;
constexpr size_t kMostStates = 100000;

void write_error(char* error, size_t size, const char* what) {
  if (error && size > 0) std::snprintf(error, size, "%s", what);
}

difflcs_status step(difflcs_controller* c, const double* x, const double* targets, bool follow, double* u) {
  if (!c || !x || !u || (!targets && c->controller.data().n_goal > 0) || (follow && c->controller.data().n_goal == 0))
    return DIFFLCS_INVALID;
  return c->controller.step(x, targets, follow, u).status;
}

difflcs_status set_inputs(difflcs_controller* c, difflcs::Input first, int count, const double* const* values) {
  if (!c || !values) return DIFFLCS_INVALID;
  for (int i = 0; i < count; i++) {
    if (!values[i]) return DIFFLCS_INVALID;
    for (int64_t j = 0; j < c->controller.data().field[first + i].count(); j++)
      if (!std::isfinite(values[i][j])) return DIFFLCS_INVALID;
  }
  c->controller.set_inputs(first, count, values);
  return DIFFLCS_CONVERGED;
}

}  // namespace

extern "C" {

difflcs_controller* difflcs_load_bytes(const void* bytes, size_t count, char* error, size_t size) {
  try {
    if (!bytes) throw std::runtime_error("expected the bytes of a controller file, got a null pointer");
    return new difflcs_controller{{bytes, count}};
  } catch (const std::bad_alloc&) {
    write_error(error, size, "not enough memory for the controller");
  } catch (const std::exception& e) {
    write_error(error, size, e.what());
  } catch (...) {
    write_error(error, size, "unknown error");
  }
  return nullptr;
}

difflcs_controller* difflcs_load(const char* path, char* error, size_t size) {
  const auto fail = [&](const char* what) -> difflcs_controller* {
    if (error && size > 0) std::snprintf(error, size, "%s: %s", path ? path : "(null)", what);
    return nullptr;
  };
  if (!path) return fail("expected the name of a controller file");
  const std::unique_ptr<std::FILE, int (*)(std::FILE*)> file(std::fopen(path, "rb"), &std::fclose);
  if (!file) return fail("expected a file that can be read");
  if (std::fseek(file.get(), 0, SEEK_END) != 0) return fail("expected a plain file");
  const long length = std::ftell(file.get());
  if (length < 0 || length > kLargestFile) return fail("expected a controller file, got a folder or a larger file");
  std::rewind(file.get());
  try {
    std::vector<unsigned char> bytes(static_cast<size_t>(length) + 1);
    const size_t count = std::fread(bytes.data(), 1, bytes.size(), file.get());
    if (std::ferror(file.get())) return fail("expected a file that can be read");
    char what[256] = "";
    difflcs_controller* controller = difflcs_load_bytes(bytes.data(), count, what, sizeof what);
    return controller ? controller : fail(what);
  } catch (const std::bad_alloc&) {
    return fail("not enough memory");
  }
}

void difflcs_free(difflcs_controller* c) { delete c; }

difflcs_sizes difflcs_get_sizes(const difflcs_controller* c) {
  if (!c) return {};
  const difflcs::ControllerData& d = c->controller.data();
  const difflcs::MpcBatch& b = d.batch;
  return {size_t(b.n_x),    size_t(b.n_u),     size_t(b.n_lam), size_t(b.n_c),
          size_t(d.n_goal), size_t(b.horizon), d.step_seconds};
}

difflcs_status difflcs_step(difflcs_controller* c, const double* x, const double* goal, double* u) {
  return step(c, x, goal, false, u);
}

difflcs_status difflcs_follow(difflcs_controller* c, const double* x, const double* reference, double* u) {
  return step(c, x, reference, true, u);
}

void difflcs_reset(difflcs_controller* c) {
  if (c) c->controller.reset();
}

difflcs_outcome difflcs_get_outcome(const difflcs_controller* c) {
  return c ? c->controller.outcome() : difflcs_outcome{DIFFLCS_INVALID, 0, 0, 0, 0, 0, 0};
}

difflcs_plan difflcs_get_plan(const difflcs_controller* c) {
  if (!c) return {};
  const difflcs::Trace& plan = c->controller.plan();
  return {plan.x.get(), plan.u.get(), plan.lam.get(), plan.mu.get()};
}

difflcs_status difflcs_reserve(difflcs_controller* c, size_t count) {
  if (!c || count < 1 || count > kMostStates) return DIFFLCS_INVALID;
  try {
    c->controller.reserve(int64_t(count));
    return DIFFLCS_CONVERGED;
  } catch (...) {
    return DIFFLCS_INVALID;
  }
}

difflcs_status difflcs_plan_many(difflcs_controller* c, const difflcs_batch* b, difflcs_plans* plans) {
  if (!c || !b || !plans || !b->x || (!b->goal && c->controller.data().n_goal > 0)) return DIFFLCS_INVALID;
  const double* fields[difflcs::kInputs] = {b->A, b->B, b->C, b->d, b->D, b->E, b->F, b->c};
  fields[difflcs::ku_min] = b->u_min;
  fields[difflcs::ku_max] = b->u_max;
  fields[difflcs::kx0] = b->x;
  difflcs::MpcPlans found;
  if (!c->controller.plan_many(int64_t(b->count), fields, b->goal, found)) return DIFFLCS_INVALID;
  *plans = {found.x, found.u, found.lam, found.mu, found.objective, found.residual, found.status};
  const int8_t* failed = std::find_if_not(found.status, found.status + b->count, difflcs::solved);
  return failed == found.status + b->count ? DIFFLCS_CONVERGED : difflcs_status(int(*failed));
}

void difflcs_set_time_limit(difflcs_controller* c, double seconds) {
  if (c) c->controller.set_time_limit(seconds > 0 ? seconds : std::numeric_limits<double>::infinity());
}

difflcs_status difflcs_set_fallback(difflcs_controller* c, difflcs_fallback kind, const double* action) {
  if (!c || kind < DIFFLCS_HOLD || kind > DIFFLCS_UNFINISHED || (kind == DIFFLCS_GIVEN && !action))
    return DIFFLCS_INVALID;
  for (int64_t j = 0; kind == DIFFLCS_GIVEN && j < c->controller.data().batch.n_u; j++)
    if (!std::isfinite(action[j])) return DIFFLCS_INVALID;
  c->controller.set_fallback(kind, action);
  return DIFFLCS_CONVERGED;
}

difflcs_status difflcs_set_system(difflcs_controller* c, const double* const matrices[8]) {
  return set_inputs(c, difflcs::kA, 8, matrices);
}

difflcs_status difflcs_set_cost(difflcs_controller* c, const double* const terms[7]) {
  if (c && c->controller.data().n_goal > 0) return DIFFLCS_INVALID;
  return set_inputs(c, difflcs::kQ, 7, terms);
}

difflcs_status difflcs_set_bounds(difflcs_controller* c, const double* u_min, const double* u_max) {
  if (!c || !u_min || !u_max) return DIFFLCS_INVALID;
  const double* const bounds[2] = {u_min, u_max};
  const auto& field = c->controller.data().field;
  const int64_t low = field[difflcs::ku_min].count(), high = field[difflcs::ku_max].count();
  for (int64_t j = 0; j < low || j < high; j++)  // one of them may be given by stage alone
    if (!(u_min[j % low] < u_max[j % high])) return DIFFLCS_INVALID;
  return set_inputs(c, difflcs::ku_min, 2, bounds);
}

const char* difflcs_status_name(difflcs_status status) {
  constexpr const char* kNames[] = {"INVALID", "CONVERGED", "MAX_ITER", "INFEASIBLE", "NUMERICAL", "DEGENERATE"};
  const int at = int(status) - int(DIFFLCS_INVALID);
  return 0 <= at && at < int(std::size(kNames)) ? kNames[at] : "unknown";
}

const char* difflcs_isa(void) {
  try {
    return difflcs::kernels_for(1).isa;
  } catch (...) {
    return "none";
  }
}

}  // extern "C"
