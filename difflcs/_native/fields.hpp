// Tables that Python and the kernels share: fields of a problem with their dimensions, outcomes of a solve, and
// tolerances. A new field or code is a new line here. difflcs.mpc.problem checks its own fields against these;
// difflcs.status takes its codes from here, and the reference in Python its tolerances.
#pragma once
#include <cstdint>

namespace difflcs {

// FIELD(name, rows, columns, stages); a vector has one column. A field may be given by stage: for each of the H steps,
// or for each of the H + 1 nodes. The order is that of every list of arrays that the kernels take.
#define DIFFLCS_SYSTEM_FIELDS(FIELD) \
  FIELD(A, n_x, n_x, steps)          \
  FIELD(B, n_x, n_u, steps)          \
  FIELD(C, n_x, n_lam, steps)        \
  FIELD(d, n_x, one, steps)          \
  FIELD(D, n_lam, n_x, steps)        \
  FIELD(E, n_lam, n_u, steps)        \
  FIELD(F, n_lam, n_lam, steps)      \
  FIELD(c, n_lam, one, steps)

#define DIFFLCS_MPC_FIELDS(FIELD) \
  DIFFLCS_SYSTEM_FIELDS(FIELD)    \
  FIELD(Q, n_x, n_x, steps)       \
  FIELD(R, n_u, n_u, steps)       \
  FIELD(S, n_x, n_u, steps)       \
  FIELD(Q_final, n_x, n_x, once)  \
  FIELD(q, n_x, one, steps)       \
  FIELD(r, n_u, one, steps)       \
  FIELD(q_final, n_x, one, once)  \
  FIELD(u_min, n_u, one, steps)   \
  FIELD(u_max, n_u, one, steps)   \
  FIELD(G_x, n_c, n_x, nodes)     \
  FIELD(G_u, n_c, n_u, steps)     \
  FIELD(g, n_c, one, nodes)       \
  FIELD(price, n_c, one, nodes)   \
  FIELD(x0, n_x, one, once)

// Transitions, the system that they are compared with, which has no stages here, and the weight of its slack.
#define DIFFLCS_VIOLATION_FIELDS(FIELD) \
  DIFFLCS_SYSTEM_FIELDS(FIELD)          \
  FIELD(x, n_x, one, once)              \
  FIELD(u, n_u, one, once)              \
  FIELD(x_next, n_x, one, once)         \
  FIELD(gamma, one, one, once)

enum class Size { one, n_x, n_u, n_lam, n_c };
constexpr const char* kSizeNames[] = {"one", "n_x", "n_u", "n_lam", "n_c"};

enum class Given { once, steps, nodes };
constexpr const char* kGivenNames[] = {"", "H", "H+1"};

struct Field {
  const char* name;
  Size rows, columns;
  Given stages;
};

#define DIFFLCS_FIELD(name, rows, columns, stages) {#name, Size::rows, Size::columns, Given::stages},
constexpr Field kMpcFields[] = {DIFFLCS_MPC_FIELDS(DIFFLCS_FIELD)};
constexpr Field kViolationFields[] = {DIFFLCS_VIOLATION_FIELDS(DIFFLCS_FIELD)};
#undef DIFFLCS_FIELD

// Positions in these tables: kA, kB, ... of an MPC problem, vA, vB, ... of the violation loss.
#define DIFFLCS_FIELD(name, rows, columns, stages) k##name,
enum Input { DIFFLCS_MPC_FIELDS(DIFFLCS_FIELD) kInputs };
#undef DIFFLCS_FIELD
#define DIFFLCS_FIELD(name, rows, columns, stages) v##name,
enum ViolationInput { DIFFLCS_VIOLATION_FIELDS(DIFFLCS_FIELD) kViolationInputs };
#undef DIFFLCS_FIELD

namespace {

// Numbers in one dimension, and in one field, of a batch.
template <class Batch>
inline int64_t extent(const Batch& batch, Size size) {
  const int64_t sizes[] = {1, batch.n_x, batch.n_u, batch.n_lam, batch.n_c};  // in the order of Size
  return sizes[int(size)];
}
template <class Batch>
inline int64_t extent(const Batch& batch, const Field& field) {
  return extent(batch, field.rows) * extent(batch, field.columns);
}

// Number of stages of a field that may vary by stage; 0 of one that cannot.
template <class Batch>
inline int64_t stages_of(const Batch& batch, const Field& field) {
  return field.stages == Given::once ? 0 : field.stages == Given::steps ? batch.horizon : batch.horizon + 1;
}

}  // namespace

// Outcomes of a solve.
#define DIFFLCS_STATUS_CODES(CODE) CODE(converged) CODE(max_iter) CODE(infeasible) CODE(numerical) CODE(degenerate)

#define DIFFLCS_CODE(name) name,
enum class Status : int8_t { DIFFLCS_STATUS_CODES(DIFFLCS_CODE) };
#undef DIFFLCS_CODE
#define DIFFLCS_CODE(name) #name,
constexpr const char* kStatusNames[] = {DIFFLCS_STATUS_CODES(DIFFLCS_CODE)};
#undef DIFFLCS_CODE
constexpr int8_t kUnreached = -1;  // inside the native code only

namespace {

// Returns whether an element with this outcome can be used.
constexpr bool solved(int8_t status) {
  return status == int8_t(Status::converged) || status == int8_t(Status::degenerate);
}

}  // namespace

// Tolerances of the kernels that the reference in Python (difflcs/mpc/conditions.py, riccati.py, difflcs/losses.py)
// has too.
struct Tolerance {
  const char* name;
  double value;
};

// A bound is weakly active where both the distance to it and the Newton step across it are below this part of the
// range; a constraint likewise, in parts of its row's unit.
constexpr double kWeak = 1e-5;
// A reduced Hessian is singular below this pivot, in units of each action's curvature. Directions below it are
// held: their sensitivity is zero.
constexpr double kSingular = 1e-10;
// An action with a barrier is differentiated as one at its bound below this part of its range.
constexpr double kClose = 1e-8;
// Rows of constraints that miss their limits by more than this part, however often they are refined, depend on each
// other.
constexpr double kDependent = 1e-3;
// A multiplier above this part of its price counts as the price.
constexpr double kAtPrice = 1.0 - 1e-12;
// A scale is at least this part of its terms without cancellation: 1e-9 of that is rounding.
constexpr double kCancelled = 1e-3;
// What a contact answers to a costate counts with this factor there: beside F nearly singular it is so large that only
// its rounding is forgiven.
constexpr double kAnswered = 1e-5;
// Factor of a step along a chain of states: so small that in most systems no size grows with it.
constexpr double kFurther = 0.1;
// Rounding of a sum, in parts of its terms.
constexpr double kRounding = 4e-16;
// Least gamma sigma_min(F + F^T) of the violation loss, in parts of n_lam times the largest squared column of F.
constexpr double kGammaLeast = 4e-13;

constexpr Tolerance kTolerances[] = {
    {"weak", kWeak},           {"singular", kSingular}, {"close", kClose},
    {"dependent", kDependent}, {"at_price", kAtPrice},  {"cancelled", kCancelled},
    {"answered", kAnswered},   {"further", kFurther},   {"rounding", kRounding}, {"gamma_least", kGammaLeast},
};

}  // namespace difflcs
