// The tables that Python and the kernels share: fields of a problem with their dimensions, and how a solve can end. A
// new field or code is a new line here. difflcs.mpc.problem checks its own fields against these, and difflcs.status
// takes its codes from here.
#pragma once
#include <cstdint>

namespace difflcs {

// FIELD(name, rows, columns); a vector has one column. The order is that of every list of arrays that the kernels take.
#define DIFFLCS_SYSTEM_FIELDS(FIELD) \
  FIELD(A, n_x, n_x)                 \
  FIELD(B, n_x, n_u)                 \
  FIELD(C, n_x, n_lam)               \
  FIELD(d, n_x, one)                 \
  FIELD(D, n_lam, n_x)               \
  FIELD(E, n_lam, n_u)               \
  FIELD(F, n_lam, n_lam)             \
  FIELD(c, n_lam, one)

#define DIFFLCS_MPC_FIELDS(FIELD) \
  DIFFLCS_SYSTEM_FIELDS(FIELD)    \
  FIELD(Q, n_x, n_x)              \
  FIELD(R, n_u, n_u)              \
  FIELD(Q_final, n_x, n_x)        \
  FIELD(q, n_x, one)              \
  FIELD(r, n_u, one)              \
  FIELD(q_final, n_x, one)        \
  FIELD(u_min, n_u, one)          \
  FIELD(u_max, n_u, one)          \
  FIELD(x0, n_x, one)

// Transitions, and the system that they are compared with.
#define DIFFLCS_VIOLATION_FIELDS(FIELD) \
  DIFFLCS_SYSTEM_FIELDS(FIELD)          \
  FIELD(x, count, n_x)                  \
  FIELD(u, count, n_u)                  \
  FIELD(x_next, count, n_x)

enum class Size { one, n_x, n_u, n_lam, count };
constexpr const char* kSizeNames[] = {"one", "n_x", "n_u", "n_lam", "count"};

struct Field {
  const char* name;
  Size rows, columns;
};

#define DIFFLCS_FIELD(name, rows, columns) {#name, Size::rows, Size::columns},
constexpr Field kMpcFields[] = {DIFFLCS_MPC_FIELDS(DIFFLCS_FIELD)};
constexpr Field kViolationFields[] = {DIFFLCS_VIOLATION_FIELDS(DIFFLCS_FIELD)};
#undef DIFFLCS_FIELD

// Positions in these tables: kA, kB, ... of an MPC problem, vA, vB, ... of the violation loss.
#define DIFFLCS_FIELD(name, rows, columns) k##name,
enum Input { DIFFLCS_MPC_FIELDS(DIFFLCS_FIELD) kInputs };
#undef DIFFLCS_FIELD
#define DIFFLCS_FIELD(name, rows, columns) v##name,
enum ViolationInput { DIFFLCS_VIOLATION_FIELDS(DIFFLCS_FIELD) kViolationInputs };
#undef DIFFLCS_FIELD

namespace {

// Numbers in one dimension, and in one field, of a batch.
template <class Batch>
inline int64_t extent(const Batch& batch, Size size) {
  switch (size) {
    case Size::n_x:
      return batch.n_x;
    case Size::n_u:
      return batch.n_u;
    case Size::n_lam:
      return batch.n_lam;
    case Size::count:
      return batch.count;
    case Size::one:
      break;
  }
  return 1;
}
template <class Batch>
inline int64_t extent(const Batch& batch, const Field& field) {
  return extent(batch, field.rows) * extent(batch, field.columns);
}

}  // namespace

// How a solve can end.
#define DIFFLCS_STATUS_CODES(CODE) CODE(converged) CODE(max_iter) CODE(infeasible) CODE(numerical) CODE(degenerate)

#define DIFFLCS_CODE(name) name,
enum class Status : int8_t { DIFFLCS_STATUS_CODES(DIFFLCS_CODE) };
#undef DIFFLCS_CODE
#define DIFFLCS_CODE(name) #name,
constexpr const char* kStatusNames[] = {DIFFLCS_STATUS_CODES(DIFFLCS_CODE)};
#undef DIFFLCS_CODE
constexpr int8_t kUnreached = -1;  // inside the native code only

namespace {

// Whether an element that ended so can be used.
constexpr bool solved(int8_t status) {
  return status == int8_t(Status::converged) || status == int8_t(Status::degenerate);
}

}  // namespace

}  // namespace difflcs
