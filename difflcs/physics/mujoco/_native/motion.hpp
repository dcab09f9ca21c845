// Motion of a state without contact: simulated with a nominal control, and linearised half way there.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <tuple>
#include <vector>

#include "library.hpp"

namespace difflcs::physics {

constexpr double kBeyond = 1e9;  // acceleration of a simulation that diverges and says nothing
constexpr double kDifference = 1e-6;
constexpr int kPositions = 1, kVelocities = 2;  // stages of MuJoCo that compute what depends on them, to skip

// What all states have in common.
struct Motion {
  const void* simulated;   // the model, without constraints, with the time step and integrator of the simulation
  const void* linearised;  // the same with one step of a second of Euler's method: ν + acceleration
  Act advance;             // one step of the integrator; none: Runge and Kutta's
  int nq, nv, nu, na, steps;
  bool held;  // by constraints that the linearised model has not
  std::vector<double> gain, constant, bias;  // (nu) of actuators that hold a length
  std::vector<double> low, high;             // (nu) range of controls
  std::vector<char> holds, relative;         // (nu)
  std::vector<int> activated;                // (na) the actuator of each activation
  std::vector<double> identity;              // (nv, nv)
  std::vector<int> tree;                     // (n_x + nu) group of trees that each number of states and controls moves
  std::vector<std::tuple<int, std::vector<int>>> together;  // kinds, and numbers that change at once, of different trees

  int size() const { return 2 * nv + na; }
};

// One row of each array of `Linearised` in motion.py.
struct Linearised {
  double *middle, *acceleration, *rates, *inverse_mass, *nominal, *reached;
  bool* unstable;
};

// Reads the motion at a state of qpos, qvel and act, with nominal controls, NaN where actuators have no force.
class Reader {
 public:
  Reader(const Library& library, const Motion& motion, const Place& place)
      : library_(library), motion_(motion), place_(place) {}

  // There is memory for a state, controls, rates and three directions (nv).
  void read(const double* state, const double* ctrl, const Linearised& into, double* memory) const {
    const Motion& m = motion_;
    read_mass(state, into.inverse_mass);
    hold(ctrl);
    for (int j = 0; j < m.nu; j++)
      into.nominal[j] = place_.ctrl[j] - (m.relative[j] ? place_.actuator_length[j] : 0.0);
    simulate(m.steps / 2, kPositions);
    double *held = memory + m.size() + m.nq + m.nv + m.na + m.nu, *applied = held + m.nv;
    if (m.held) forward(m.simulated);
    std::copy_n(place_.qfrc_constraint, m.nv, held);
    forward(m.linearised);
    if (!std::all_of(place_.qacc, place_.qacc + m.nv, [](double a) { return std::fabs(a) < kBeyond; })) {
      set(state);
      forward(m.linearised);
    }
    change(state, into.middle);
    std::copy_n(place_.qacc, m.nv, into.acceleration);
    std::copy_n(place_.act_dot, m.na, into.acceleration + m.nv);
    for (const Act check : {library_.check_pos, library_.check_vel, library_.check_acc}) check(m.linearised, place_.data);
    std::copy_n(place_.qfrc_applied, m.nv, applied);
    if (m.held) {  // what constraints hold is far from where it would go alone, and has other rates there
      for (int v = 0; v < m.nv; v++) place_.qfrc_applied[v] += held[v] - place_.qfrc_constraint[v];
      forward(m.linearised);
    }
    differentiate(into, memory);
    std::copy_n(applied, m.nv, place_.qfrc_applied);
    simulate(m.steps - m.steps / 2);
    change(state, into.reached);
  }

  // Write M⁻¹.
  void read_mass(const double* state, double* inverse_mass) const {
    begin(state);
    library_.fwd_position(motion_.simulated, place_.data);
    library_.solve_mass(motion_.simulated, place_.data, inverse_mass, motion_.identity.data(), motion_.nv);
  }

  // Compute the forces at rest of that state, in which activation has settled.
  void settle(const double* ctrl) const {
    hold(ctrl);
    for (int j = 0; j < motion_.na; j++) place_.act[j] = place_.ctrl[motion_.activated[j]];
    library_.forward(motion_.simulated, place_.data, kPositions, 1);
  }

  // Write ζ, ν and the change of activation after the steps from a state at a control.
  void advance(const double* state, const double* ctrl, double* after) const {
    begin(state);
    std::copy_n(ctrl, motion_.nu, place_.ctrl);
    simulate(motion_.steps);
    change(state, after);
  }

 private:
  // Set a state, and forget the accelerations of other motions, which may be infinite.
  void begin(const double* state) const {
    set(state);
    std::fill_n(place_.qacc_warmstart, motion_.nv, 0.0);
  }

  void set(const double* state) const {
    std::copy_n(state, motion_.nq, place_.qpos);
    std::copy_n(state + motion_.nq, motion_.nv, place_.qvel);
    std::copy_n(state + motion_.nq + motion_.nv, motion_.na, place_.act);
  }

  // Set nominal controls.
  void hold(const double* ctrl) const {
    const Motion& m = motion_;
    for (int j = 0; j < m.nu; j++) {
      const double balance = m.holds[j] ? -(m.constant[j] + m.bias[j] * place_.actuator_length[j]) / m.gain[j] : 0.0;
      place_.ctrl[j] = std::clamp(std::isnan(ctrl[j]) ? balance : ctrl[j], m.low[j], m.high[j]);
    }
  }

  void forward(const void* model, int known = 0) const { library_.forward(model, place_.data, known, 1); }

  // Without the checks of `mj_step`, which warn of a motion that grows; `known`: the stages that are computed already.
  void simulate(int steps, int known = 0) const {
    for (int k = 0; k < steps; k++, known = 0) {
      forward(motion_.simulated, known);
      if (motion_.advance != nullptr) {
        motion_.advance(motion_.simulated, place_.data);
      } else {
        library_.runge_kutta(motion_.simulated, place_.data, 4);
      }
    }
  }

  // Write differences of the rates of velocities and activation that there are now, like those of `mjd_transitionFD`.
  void differentiate(const Linearised& into, double* now) const {
    const Motion& m = motion_;
    const int nx = m.size(), begins[] = {0, m.nv, 2 * m.nv, nx}, stages[] = {0, kPositions, kVelocities, kVelocities};
    double *ctrl = now + m.nq + m.nv + m.na, *way = ctrl + m.nu, *rates = way + m.nv;
    std::copy_n(place_.qpos, m.nq, now);
    std::copy_n(place_.qvel, m.nv, now + m.nq);
    std::copy_n(place_.act, m.na, now + m.nq + m.nv);
    std::copy_n(place_.ctrl, m.nu, ctrl);
    std::copy_n(place_.qacc, m.nv, rates);
    std::copy_n(place_.act_dot, m.na, rates + m.nv);
    const auto side = [&](int j) {  // 1 where a number may be more by the difference; −1: less; or neither
      if (j < nx) return 1;
      const double u = ctrl[j - nx], low = m.low[j - nx], high = m.high[j - nx];
      return u >= low && u + kDifference <= high ? 1 : -(u - kDifference >= low && u <= high);
    };
    for (const auto& [kind, columns] : m.together) {
      double* const changed[] = {way, place_.qvel, place_.act, place_.ctrl};
      std::fill_n(way, m.nv, 0.0);
      for (const int j : columns) changed[kind][j - begins[kind]] += kind == 0 ? 1.0 : side(j) * kDifference;
      if (kind == 0) library_.integrate(m.linearised, place_.qpos, way, kDifference);
      library_.forward(m.linearised, place_.data, stages[kind], 1);
      for (const int j : columns) {
        for (int i = m.nv; i < nx; i++) {
          if (m.tree[i] != m.tree[j] || side(j) == 0) continue;
          const double rate = i < 2 * m.nv ? place_.qacc[i - m.nv] : place_.act_dot[i - 2 * m.nv];
          into.rates[(i - m.nv) * (nx + m.nu) + j] = (rate - rates[i - m.nv]) / (side(j) * kDifference);
        }
      }
      set(now);
      std::copy_n(ctrl, m.nu, place_.ctrl);
    }
  }

  // Write ζ, ν and the change of activation since `state`.
  void change(const double* state, double* into) const {
    const Motion& m = motion_;
    library_.difference(m.simulated, into, 1.0, state, place_.qpos);
    std::copy_n(place_.qvel, m.nv, into + m.nv);
    for (int j = 0; j < m.na; j++) into[2 * m.nv + j] = place_.act[j] - state[m.nq + m.nv + j];
  }

  const Library& library_;
  const Motion& motion_;
  const Place& place_;
};

}  // namespace difflcs::physics
