// Steps the TriFinger without Python: controller and physics of one control period, several simulations side by side.
//
// Knows no MuJoCo header, hence no MuJoCo version: it gets the addresses of five functions of the library that Python
// has loaded, and of the fields of each simulation, from their NumPy views. trifinger/osc.py has the control law.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "crew.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

constexpr int kFingers = 3;
constexpr int kJoints = 9;
constexpr int kActionSize = 6;
constexpr int kStateSize = 9;

using StepFunction = void (*)(const void* model, void* data);
using GetStateFunction = void (*)(const void* model, const void* data, double* state, int signature);

// --- one simulation -------------------------------------------------------------------------------

struct Lane {
  // Functions of the MuJoCo library.
  StepFunction step1, step2, kinematics;
  GetStateFunction get_state;
  // Model and data, and fields of the data.
  const void* model;
  void* data;
  const double *axes, *anchors, *tips, *velocities, *bias, *mass;  // of the fingers, see osc.py
  double* control;
  const double *object_position, *object_quaternion;
  std::vector<const std::int32_t*> warnings;  // counters of the warnings that mean instability
  // Constants.
  double kp, kd, singular_determinant, singular_damping;
  double tip_height, timestep, workspace_radius;
  int substeps, time_signature, save_signature;
  double* saved;  // state before the step

  double time() const {
    double now = 0.0;
    get_state(model, data, &now, time_signature);
    return now;
  }

  // Joint acceleration J^T (J J^T + damping I)^-1 a near a singular posture, see osc.py.
  void damped_solve(const double (&J)[3][3], const double (&e)[3], double det, double (&q)[3]) const {
    const double ratio = det / singular_determinant;
    const double damping = singular_damping * singular_damping * (1.0 - ratio * ratio) + 1e-12;
    double G[3][3];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        G[i][j] = i == j ? damping : 0.0;
        for (int k = 0; k < 3; ++k) G[i][j] += J[i][k] * J[j][k];
      }
    // G is positive definite: Cholesky.
    double L[3][3] = {};
    for (int j = 0; j < 3; ++j) {
      double pivot = G[j][j];
      for (int k = 0; k < j; ++k) pivot -= L[j][k] * L[j][k];
      L[j][j] = std::sqrt(pivot);
      for (int i = j + 1; i < 3; ++i) {
        double entry = G[i][j];
        for (int k = 0; k < j; ++k) entry -= L[i][k] * L[j][k];
        L[i][j] = entry / L[j][j];
      }
    }
    double y[3];
    for (int i = 0; i < 3; ++i) {
      y[i] = e[i];
      for (int k = 0; k < i; ++k) y[i] -= L[i][k] * y[k];
      y[i] /= L[i][i];
    }
    for (int i = 2; i >= 0; --i) {
      for (int k = i + 1; k < 3; ++k) y[i] -= L[k][i] * y[k];
      y[i] /= L[i][i];
    }
    for (int i = 0; i < 3; ++i) q[i] = J[0][i] * y[0] + J[1][i] * y[1] + J[2][i] * y[2];
  }

  // tau_f = M_f J_f^-1 a_f + bias_f, finger by finger. Returns whether all torques are finite.
  bool control_torques(const double* target) const {
    bool finite = true;
    for (int f = 0; f < kFingers; ++f) {
      const int i = 3 * f;
      const double px = tips[i], py = tips[i + 1], pz = tips[i + 2];
      double J[3][3];  // column k: axis x (tip - anchor) of joint k
      for (int k = 0; k < 3; ++k) {
        const double* axis = axes + 9 * f + 3 * k;
        const double* anchor = anchors + 9 * f + 3 * k;
        const double rx = px - anchor[0], ry = py - anchor[1], rz = pz - anchor[2];
        J[0][k] = axis[1] * rz - axis[2] * ry;
        J[1][k] = axis[2] * rx - axis[0] * rz;
        J[2][k] = axis[0] * ry - axis[1] * rx;
      }
      const double ax = J[0][0], bx = J[0][1], cx = J[0][2];
      const double ay = J[1][0], by = J[1][1], cy = J[1][2];
      const double az = J[2][0], bz = J[2][1], cz = J[2][2];
      const double v0 = velocities[i], v1 = velocities[i + 1], v2 = velocities[i + 2];
      const double ex = kp * (target[i] - px) - kd * (ax * v0 + bx * v1 + cx * v2);
      const double ey = kp * (target[i + 1] - py) - kd * (ay * v0 + by * v1 + cy * v2);
      const double ez = kp * (target[i + 2] - pz) - kd * (az * v0 + bz * v1 + cz * v2);

      const double nx = by * cz - bz * cy, ny = bz * cx - bx * cz, nz = bx * cy - by * cx;
      const double det = ax * nx + ay * ny + az * nz;
      double q[3];
      if (std::fabs(det) > singular_determinant) {
        const double gx = ay * ez - az * ey, gy = az * ex - ax * ez, gz = ax * ey - ay * ex;
        q[0] = (ex * nx + ey * ny + ez * nz) / det;
        q[1] = (cx * gx + cy * gy + cz * gz) / det;
        q[2] = -(bx * gx + by * gy + bz * gz) / det;
      } else {
        damped_solve(J, {ex, ey, ez}, det, q);
      }
      const double* m = mass + 6 * f;  // m00, m10, m11, m20, m21, m22
      control[i] = m[0] * q[0] + m[1] * q[1] + m[3] * q[2] + bias[i];
      control[i + 1] = m[1] * q[0] + m[2] * q[1] + m[4] * q[2] + bias[i + 1];
      control[i + 2] = m[3] * q[0] + m[4] * q[1] + m[5] * q[2] + bias[i + 2];
      finite = finite && std::isfinite(control[i]) && std::isfinite(control[i + 1]) && std::isfinite(control[i + 2]);
    }
    return finite;
  }

  bool is_sane(double end_time) const {
    // MuJoCo answers NaN or huge numbers by a warning and by resetting the data, the clock with them.
    if (!(std::fabs(time() - end_time) <= 0.5 * timestep)) return false;
    for (const std::int32_t* count : warnings)
      if (*count != 0) return false;
    const auto inside = [this](double p) { return std::fabs(p) <= workspace_radius; };  // false for NaN
    bool sane = inside(object_position[0]) && inside(object_position[1]);
    for (int i = 0; i < kJoints; ++i) sane = sane && inside(tips[i]);
    return sane;
  }

  void read_state(double* state) const {
    const double qw = object_quaternion[0], qx = object_quaternion[1];
    const double qy = object_quaternion[2], qz = object_quaternion[3];
    state[0] = object_position[0];
    state[1] = object_position[1];
    state[2] = std::atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz));
    for (int f = 0; f < kFingers; ++f) {
      state[3 + 2 * f] = tips[3 * f];
      state[4 + 2 * f] = tips[3 * f + 1];
    }
  }

  // One control period. Returns whether the simulation is still sane; if not, `saved` holds the state before.
  bool step(const double* displacement, double* state) const {
    get_state(model, data, saved, save_signature);
    const double end_time = time() + timestep * substeps;
    double target[kJoints];
    for (int f = 0; f < kFingers; ++f) {
      target[3 * f] = tips[3 * f] + displacement[2 * f];
      target[3 * f + 1] = tips[3 * f + 1] + displacement[2 * f + 1];
      target[3 * f + 2] = tip_height;
    }
    for (int k = 0; k < substeps; ++k) {
      step1(model, data);
      if (!control_torques(target)) return false;
      step2(model, data);
    }
    // Integration leaves the positions of bodies and sites one substep behind the joints.
    kinematics(model, data);
    if (!is_sane(end_time)) return false;
    read_state(state);
    return true;
  }
};

template <typename T>
T* at(nb::handle address) {
  return reinterpret_cast<T*>(nb::cast<std::uintptr_t>(address));
}

Lane make_lane(const nb::dict& functions, const nb::dict& fields, const nb::dict& constants) {
  Lane lane{};
  lane.step1 = reinterpret_cast<StepFunction>(nb::cast<std::uintptr_t>(functions["mj_step1"]));
  lane.step2 = reinterpret_cast<StepFunction>(nb::cast<std::uintptr_t>(functions["mj_step2"]));
  lane.kinematics = reinterpret_cast<StepFunction>(nb::cast<std::uintptr_t>(functions["mj_kinematics"]));
  lane.get_state = reinterpret_cast<GetStateFunction>(nb::cast<std::uintptr_t>(functions["mj_getState"]));
  lane.model = at<const void>(fields["model"]);
  lane.data = at<void>(fields["data"]);
  for (auto [name, into] : {std::pair{"axes", &lane.axes}, {"anchors", &lane.anchors}, {"tips", &lane.tips},
                            {"velocities", &lane.velocities}, {"bias", &lane.bias}, {"mass", &lane.mass},
                            {"object_position", &lane.object_position}, {"object_quaternion", &lane.object_quaternion}})
    *into = at<const double>(fields[name]);
  lane.control = at<double>(fields["control"]);
  lane.saved = at<double>(fields["saved"]);
  for (nb::handle address : nb::cast<nb::list>(fields["warnings"])) lane.warnings.push_back(at<std::int32_t>(address));
  for (auto [name, into] : {std::pair{"kp", &lane.kp}, {"kd", &lane.kd}, {"tip_height", &lane.tip_height},
                            {"singular_determinant", &lane.singular_determinant},
                            {"singular_damping", &lane.singular_damping}, {"timestep", &lane.timestep},
                            {"workspace_radius", &lane.workspace_radius}})
    *into = nb::cast<double>(constants[name]);
  for (auto [name, into] : {std::pair{"substeps", &lane.substeps}, {"time_signature", &lane.time_signature},
                            {"save_signature", &lane.save_signature}})
    *into = nb::cast<int>(constants[name]);
  return lane;
}

using Actions = nb::ndarray<const double, nb::shape<-1, kActionSize>, nb::c_contig, nb::device::cpu>;
using States = nb::ndarray<double, nb::shape<-1, kStateSize>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<bool, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

void step_lanes(const std::vector<const Lane*>& lanes, Actions actions, States states, Flags stable, int threads) {
  const std::size_t n = lanes.size();
  if (actions.shape(0) != n || states.shape(0) != n || stable.shape(0) != n)
    throw std::invalid_argument("expected one row of actions, states and flags per lane");
  const double* u = actions.data();
  double* x = states.data();
  bool* ok = stable.data();
  nb::gil_scoped_release release;
  difflcs::Crew::get().each(threads, n, [&](size_t, int64_t i) {
    ok[i] = lanes[i]->step(u + kActionSize * i, x + kStateSize * i);
    return true;
  });
}

}  // namespace

NB_MODULE(_stepper, module) {
  nb::class_<Lane>(module, "Lane", "One simulation. The arrays whose addresses it has must outlive it.")
      .def_prop_ro("time", &Lane::time, "Simulated time [s].");
  module.def("make_lane", &make_lane, "functions"_a, "fields"_a, "constants"_a,
             "Bind to a simulation by addresses. Nothing is checked.");
  module.def("step_lanes", &step_lanes, "lanes"_a, "actions"_a, "states"_a, "stable"_a, "threads"_a,
             "One control period of every lane: actions (n, 6) [m] -> states (n, 9), stable (n,). Releases the GIL.");
}
