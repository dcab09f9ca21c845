// The MuJoCo library that Python has loaded, by addresses: no header of it, hence no version.
#pragma once

#include <algorithm>
#include <csetjmp>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <mutex>
#include <string>

namespace difflcs::physics {

constexpr int kContactDoubles = 128;  // the largest size of a contact of any version
constexpr int kMostPoints = 50;       // of a pair (mjMAXCONPAIR)

using Act = void (*)(const void* model, void* data);
using Distance = double (*)(const void* model, void* data, int first, int second, double most, double* ends);
using Collide = int (*)(const void* model, void* data, double* contacts, int first, int second, double margin);
using Solve = void (*)(const void* model, void* data, double* x, const double* y, int count);
using Forward = void (*)(const void* model, void* data, int stage, int without_sensors);
using RungeKutta = void (*)(const void* model, void* data, int order);
using Difference = void (*)(const void* model, double* velocity, double seconds, const double* from, const double* to);
using Integrate = void (*)(const void* model, double* qpos, const double* velocity, double seconds);
using OnError = void (*)(const char*);

struct Library {
  Act kinematics, com_pos, fwd_position, check_pos, check_vel, check_acc;
  Distance distance;
  Solve solve_mass;
  Forward forward;
  RungeKutta runge_kutta;
  Difference difference;
  Integrate integrate;
  const Collide* collide;  // table of kinds of geoms
  int kinds;
  int stride;  // doubles of a contact; the first ten: gap, place in the middle, normal, tangent
  OnError* on_error;
  void** clock;  // which MuJoCo reads in every stage
};

// A matrix in a model's data; without counts of its rows it is dense.
struct Sparse {
  int rows, size;  // number of its rows, and of the numbers in each
  const double* values;
  const int32_t *counts, *starts, *columns;

  void write(double* dense) const {
    if (counts == nullptr) std::copy_n(values, rows * size, dense);
    for (int i = 0; counts != nullptr && i < rows; i++) {
      std::fill_n(dense + i * size, size, 0.0);
      for (int k = starts[i]; k < starts[i] + counts[i]; k++) dense[i * size + columns[k]] = values[k];
    }
  }
};

// A model and its data, used by one thread at a time.
struct Place {
  const void* model;
  void* data;
  double *qpos, *qvel, *act, *ctrl, *qacc_warmstart, *geom_xpos, *ccd_tolerance, *qfrc_applied;
  const double *geom_xmat, *cdof, *subtree_com, *actuator_length, *qacc, *act_dot, *qfrc_smooth, *qfrc_constraint,
      *ten_length;
  Sparse moment, tendon;  // derivatives of the lengths of actuators and tendons
  int32_t* warnings;  // how often MuJoCo has warned, by kinds
  int kinds, stride;  // of warnings, and from one to the next

  bool has_warned() const {
    for (int k = 0; k < kinds; k++)
      if (warnings[k * stride] != 0) return true;
    return false;
  }

  void forget_warnings() const {
    for (int k = 0; k < kinds; k++) warnings[k * stride] = 0;
  }
};

// MuJoCo ends the process at an error. While one of these lives, its error goes back to `guarded` instead, and its
// stopwatches stand still, as reading the clock takes 8 % of a step.
class Errors {
 public:
  explicit Errors(const Library& library) : library_(library) {
    std::lock_guard<std::mutex> lock(mutex());
    if (users()++ > 0) return;
    before() = *library_.on_error;
    clock() = *library_.clock;
    *library_.on_error = &jump;
    *library_.clock = nullptr;
  }
  ~Errors() {
    std::lock_guard<std::mutex> lock(mutex());
    if (--users() > 0) return;
    *library_.on_error = before();
    *library_.clock = clock();
  }
  Errors(const Errors&) = delete;

  // Call work(), which has nothing to destroy. Return false if MuJoCo said an error, which is then in `message`.
  template <class Work>
  static bool guarded(Work work, std::string* message) {
    std::jmp_buf here;
    place() = &here;
    const bool fine = setjmp(here) == 0;
    if (fine) {
      work();
    } else {
      *message = said();
    }
    place() = nullptr;
    return fine;
  }

 private:
  static void jump(const char* text) {
    if (place() == nullptr) {  // of another thread
      if (before() != nullptr) before()(text);
      std::fprintf(stderr, "MuJoCo: %s\n", text);
      std::exit(EXIT_FAILURE);
    }
    std::snprintf(said(), kSaid, "%s", text);
    std::longjmp(*place(), 1);
  }

  static constexpr int kSaid = 1024;
  static std::mutex& mutex() {
    static std::mutex mutex;
    return mutex;
  }
  static int& users() {
    static int users = 0;
    return users;
  }
  static OnError& before() {
    static OnError before = nullptr;
    return before;
  }
  static void*& clock() {
    static void* clock = nullptr;
    return clock;
  }
  static std::jmp_buf*& place() {
    static thread_local std::jmp_buf* place = nullptr;
    return place;
  }
  static char* said() {
    static thread_local char said[kSaid];
    return said;
  }

  const Library& library_;
};

}  // namespace difflcs::physics
