// Correction of the system of a state by MuJoCo's own step, as correction.py says what it is.
#pragma once

#include "forces.hpp"

namespace difflcs::physics {

constexpr double kFar = 0.3, kSmall = 0.1;  // of motion and forces of a tree, and of all: an error worth a look
constexpr double kJams = 30.0;              // times what there is to move: contacts that press against each other
constexpr double kHeld = 10.0;              // times the speed and its change: all motion, where contacts hold more
constexpr double kWorse = 0.25;             // of all motion, by which contacts are worse than nothing: Δ counts wholly
constexpr double kTrifle = 0.2;  // of all motion, up to which Δ counts wholly if no robot presses; up to twice: in part

// Of all states: how many forces of contacts, limits, dry friction, of those that are corrected, and of all.
struct Corrected {
  int nv, nx, nu, trees, contacts, limits, bounded, forces, all;
  double still;  // [m/s, rad/s] a speed that is none
  bool firm;     // a robot may press
  const int64_t* tree;
  const double* reach;
};

// Of a state: its system, C and d of which are corrected; the state, the nominal action, the forces there; ζ, ν after
// MuJoCo's step, in the coordinates of the state; rows of limits and friction, and the step, see `DynamicStep`.
struct Known {
  const double *A, *B, *x, *idle, *lam, *after, *bound, *normal, *step, *inverse_mass;
  const bool* hard;
  double *C, *d;
};

// True where more is corrected than moves.
DIFFLCS_CLONES static bool correct_state(const Corrected& s, const Known& k) {
  const int nv = s.nv, all = s.all, trees = s.trees, forces = s.forces, columns = s.nx + s.nu + 1;
  const auto tree = [&](int i) { return static_cast<int>(s.tree[i % nv]); };
  if (!std::all_of(k.after, k.after + 2 * nv, [](double v) { return std::isfinite(v); })) return false;
  std::vector<double> force(k.lam, k.lam + forces), lower(forces), energy(trees * forces), wrong(2 * nv), of(trees * 6);
  double *off = of.data(), *before = off + trees, *changed = before + trees, *alone = changed + trees,
         *mass = alone + trees, *rubs = lower.data() + s.contacts + s.limits;
  for (int j = 0; j < s.bounded; j++) force[s.contacts + s.limits + j] += rubs[j] = -k.bound[j];
  for (int i = 0; i < 2 * nv; i++) {
    const double* C = k.C + i * all;
    const double moved = dot(k.A + i * s.nx, k.x, s.nx) + dot(k.B + i * s.nu, k.idle, s.nu) + k.d[i];
    const double change = k.after[i] - (i < nv ? 0.0 : k.x[i]), by_lam = dot(C, k.lam, all);
    wrong[i] = k.x[i] + change - moved - by_lam;
    if (i < nv) continue;
    const double free = moved + by_lam - dot(C, force.data(), forces) - k.x[i];
    const double m = 1 / k.inverse_mass[(i - nv) * (nv + 1)];
    const int t = tree(i);
    off[t] += m * wrong[i] * wrong[i];
    before[t] += m * k.x[i] * k.x[i];
    changed[t] += m * change * change;
    alone[t] += m * free * free;
    mass[t] += m;
    for (int f = 0; f < forces; f++) energy[t * forces + f] += m * std::pow(C[f] * force[f], 2);
  }
  // How much of a force each row has whatever actions do. A difference that grew with a force that actions change by
  // far would be many times as large with some. Dry friction far below its bound is whatever holds, so it does not grow
  // with this either.
  std::vector<double> constant(forces, 1.0), by_action(s.nu);
  for (int j = 0; j < s.limits + s.bounded; j++) {
    double does = 0, changes = 0;
    std::fill(by_action.begin(), by_action.end(), 0.0);
    for (int v = 0; v < nv; v++) {
      const double along = k.normal[j * nv + v];
      if (along == 0) continue;
      does += along * k.C[(nv + v) * all + s.contacts + j] * force[s.contacts + j];
      add(along, k.step + (nv + v) * columns + s.nx, s.nu, by_action.data());
    }
    for (int u = 0; u < s.nu; u++) changes += std::fabs(by_action[u]) * s.reach[u];
    double& part = constant[s.contacts + j] = std::fabs(does) / std::max(std::fabs(does) + changes, kTiny);
    if (j >= s.limits) part *= std::fabs(force[s.contacts + j]) / std::max(k.bound[j - s.limits], kTiny);
  }
  // Sizes of velocities by their energy: what is wrong, before, the change, and that without forces.
  double motion = 0;
  for (int t = 0; t < trees; t++) {
    for (double* size : {off, before, changed, alone}) size[t] = std::sqrt(size[t]);
    motion += before[t] + changed[t] + alone[t];
  }
  bool doubtful = false;
  std::vector<double> due(trees), kept(trees);
  for (int t = 0; t < trees; t++) {
    double *each = &energy[t * forces], total = 0, share = 0, grow = 0;
    for (int f = 0; f < s.contacts; f++) share += each[f] *= k.hard[f];  // soft ones press all the time, whatever moves
    for (int f = 0; f < forces; f++) total += each[f];
    total = std::max(total, 1e-20);
    share /= total;
    const double moves = before[t] + changed[t], most = before[t] + std::min(alone[t], kHeld * moves);
    const double worse = (off[t] - changed[t]) / (kWorse * most + 1e-9);
    const double slight = s.firm ? 0.0 : 2 - off[t] / (kTrifle * most + 1e-9);
    // What contacts jam stands with any action.
    const double pressed = std::max(1.0, std::sqrt(total) / std::max(kJams * (before[t] + alone[t]), kTiny));
    kept[t] = 1 - share / pressed * (1 - std::clamp(std::max(worse, slight), 0.0, 1.0));
    const double least = std::max(kFar * (moves + alone[t]), kSmall * motion);
    doubtful = doubtful || off[t] > std::max(moves, least) + s.still * std::sqrt(mass[t]);
    for (int f = 0; f < forces; f++) grow += each[f] *= constant[f];
    due[t] = (1 - share) * std::min(1.0, std::sqrt(total) / std::max(off[t], 1e-15)) * grow / total;
    for (int f = 0; f < forces; f++) each[f] /= (force[f] != 0 ? force[f] : 1.0) * std::max(grow, 1e-20);
  }
  for (int i = 0; i < 2 * nv; i++) {
    const double *part = &energy[tree(i) * forces], by = wrong[i] * due[tree(i)];
    add(by, part, forces, k.C + i * all);
    k.d[i] += by * dot(part, lower.data(), forces) + wrong[i] * (kept[tree(i)] - due[tree(i)]);
  }
  return doubtful;
}

}  // namespace difflcs::physics
