// Progress of the problems in the lanes: the homotopy, damping and multipliers of each, when it is finished, and which
// problem takes its place. Its sizes are known at run time only, so that it is compiled once for all of them.
#pragma once
#include "certificate.hpp"
#include "kernels.hpp"
#include "lanes.hpp"
#include "matrix.hpp"
#include "mpc_problem.hpp"
#include "riccati.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Projected gradient, in parts of its scale (see certificate.hpp), at which a problem is solved.
constexpr double kStationary = 1e-7;
// Violation of a constraint, in parts of the sizes of its terms, at which it is met; looser if the rest is rounding.
constexpr double kMet = 1e-12, kMetHardly = 1e-10, kMetRounded = 1e-7;
// Weight of the augmented Lagrangian, in parts of the largest weight of the cost: at first, and from which on a
// violation that three steps of the multipliers in a row have not halved means that the problem is infeasible. The
// multipliers must also exceed those that the cost balances by the last factor, so that the cost is not the reason.
constexpr double kPenalty = 10.0, kLargestPenalty = 1e7, kDominates = 1e6;
// A step of the multipliers is due where the projected gradient is below this part of what the step before left, and of
// the change that it would make. The first counts where constraints are far from the actions that they act through.
constexpr double kUpdateDue = 0.03;
// A violation above a tenth of the previous one (a hundredth if it is small) raises the weight ten times, one that does
// not fall more.
constexpr double kSlow = 0.1, kSlowEnd = 0.01, kSmall = 1e-4, kStays = 0.9, kRaise = 10.0, kRaiseMore = 30.0;
// Steps after which the multipliers move in any case where little is violated: actions that constraints couple can take
// turns next to their bounds, and other multipliers end that.
constexpr int64_t kStepsBeforeUpdate = 20;
constexpr double kSlightlyViolated = 1e-6;
// Least damping, in parts of the one that bounds the kink of every contact.
constexpr double kLeastDamping = 0.25;
// Failed searches in a row, each with 4 times the damping, before a problem is given up.
constexpr int64_t kFailures = 12;
// Steps in a row that gain no more than rounding, after which the tolerance is raised ten times, and again after as
// many more: if the system is stiff, the gradient at the optimum is rounding too. A gain below kNoGain of the cost
// counts as rounding; the tolerance is then at least kLeastTolerance.
constexpr int64_t kStepsWithoutGain = 8;
constexpr double kNoGain = 1e-12, kLeastTolerance = 1e-8;
constexpr double kLooserTolerance[] = {1.0, 10.0, 100.0, 1000.0};
// After this many such steps the certificate decides about a plan that is stationary except for its scale, which
// vanishes at a vertex: the certificate knows the sizes of the terms that cancelled.
constexpr int64_t kStepsBeforeCertificate = 2;
// A large weight of the augmented Lagrangian amplifies the rounding of a constraint. If more than this part of the
// gradient is left at such a vertex, the multipliers are computed once more with the first weight.
constexpr double kRoundingLeft = 1e-9;
// Projected gradient, as a multiple of that of a solved problem, at which a stage of the homotopy is solved.
constexpr double kSolvedStage = 1e4;
// Steps that each gain as much as the last one must not be enough for a start that is left early.
constexpr double kHope = 100.0;

// After this many steps at the target a plan without constraints creeps along the kinks of hard contact. It then goes
// back to contact softer by these factors and follows the homotopy down anew. Much softer contact leads elsewhere.
constexpr int64_t kCreeping = 50, kReturns = 5;
constexpr double kBack[kReturns] = {1e1, 1e2, 1e3, 1e4, 1e5};

template <class T>
struct Progress {
  using Multipliers = Matrix<Vec, 0, 0>;
  const MpcBatch& batch;
  const AnySizes n;
  ProblemData<T>& problem;
  Certificate certificate;
  Trajectory<AnySizes> at;  // the iterate
  Vec* gap;

  // The problems in the lanes with their progress.
  struct Lane {
    int64_t element = -1;  // -1: idle
    int64_t iterations = 0, in_stage = 0, failures = 0;
    double violated = 1e300;    // at the last step of the multipliers
    double gradient_left = 0;   // projected gradient after that; 0 where it is not known yet
    int64_t stalled = 0;        // consecutive steps of the multipliers that hardly helped
    double gained = 0;          // by the last step
    bool weight_reset = false;  // see kRoundingLeft
    int64_t returns = 0;        // to softer contact, see kCreeping
    int64_t without_gain = 0;   // steps at the target in a row that gained no more than the rounding of the cost
  };
  Lane lane[kLanes];
  Vec eps, regularisation, J;
  Mask needs_rollout;  // without a trajectory at its eps
  Mask released;       // without contact yet
  Mask gauss_newton;   // by Gauss-Newton
  Mask at_origin;      // released by the law around x = 0, see newton.hpp
  Mask stale_cost;     // J is that of earlier multipliers
  Mask ahead;          // in a step to the relaxation of the next stage
  // Elements that are finished but not certified yet, and whether some direction at their plan is flat.
  int64_t finished[kLanes];
  bool flat[kLanes];
  int waiting;

  Progress(const MpcBatch& b, ProblemData<T>& problem) : batch(b), n(b), problem(problem), certificate(b) {}

  void layout(Arena& arena) {
    at.layout(arena, n);
    arena.take(gap, n.l());
    certificate.layout(arena, problem.kept);
  }

  // After the first step of the lanes that were released: the scale of their problems says where the homotopy starts.
  void start_homotopy(const MpcSolve& o, Mask which) {
    Vec sum = all(0);
    for (int64_t k = 0; k < n.h; k++) {
      problem.stage(k).gap(at.x[k], at.u[k], gap);
      for (int64_t i = 0; i < n.l(); i++) sum += abs(gap[i]);
    }
    for (int l = 0; l < kLanes; l++) {
      if (!which[l]) continue;
      const int64_t e = lane[l].element, count = n.h * n.l();
      const double mean = count ? sum[l] / double(count) : 0;
      put(&eps, 0, l, first_relaxation(o.start[e], mean));
      lane[l].iterations++;
      if (!problem.linear()) needs_rollout[l] = -1;
    }
    released &= ~which;
    at_origin &= ~which;
  }

  // Whether these actions are inside their bounds, and none weakly active.
  bool inside(const double* u, int l) const {
    for (int64_t i = 0; i < n.h * n.u(); i++) {
      const double low = problem.u_min[i / n.u()][i % n.u()][l], high = problem.u_max[i / n.u()][i % n.u()][l];
      const double margin = low < -kHuge && high > kHuge ? 0.0 : kWeak * (high - low);
      if (!(u[i] - low > margin && high - u[i] > margin)) return false;
    }
    return true;
  }

  // Whether every action has a price of its own; else a law around the origin is not exact.
  bool priced(int l) const {
    bool every = true;
    for (int64_t k = 0, nu = n.u(); k < n.h; k++)
      for (int64_t j = 0; j < nu; j++)
        every = every && lane_of(problem.R[k](j, j), l) > kPriced * lane_of(problem.rest[k][j], l);
    return every;
  }

  double first_relaxation(const MpcStart& start, double mean_gap) const {
    const double scaled = start.first * mean_gap * mean_gap;
    const double least = start.at_least > batch.relaxation ? start.at_least : batch.relaxation;
    return scaled > least && scaled < kHuge ? scaled : least;
  }

  // Take the next problem into a lane; an exhausted queue leaves the lane idle with its old data.
  bool take(const MpcSolve& o, int64_t* counter, int l) {
    const int64_t e = __atomic_fetch_add(counter, int64_t{1}, __ATOMIC_RELAXED);
    const int64_t nu = n.u(), actions = n.h * nu, forces = n.h * n.l();
    lane[l] = {};
    needs_rollout[l] = -1;
    released[l] = gauss_newton[l] = at_origin[l] = 0;
    eps[l] = batch.relaxation;
    regularisation[l] = 0;
    if (e >= batch.count) return false;
    lane[l].element = e;
    released[l] = o.start[e].released ? -1 : 0;
    gauss_newton[l] = o.start[e].gauss_newton ? -1 : 0;
    if (!released[l]) eps[l] = first_relaxation(o.start[e], 0);
    problem.load(e, l);
    const double* u_start = o.u_start ? o.u_start + e * actions : nullptr;
    if (problem.linear() && (released[l] || (u_start && inside(u_start, l))) && ((*problem.has_law)[l] || priced(l))) {
      released[l] = at_origin[l] = -1;
      needs_rollout[l] = 0;
      u_start = nullptr;
    }
    problem.load_multipliers(o.mu_start ? o.mu_start + e * (n.h + 1) * n.c() : nullptr, l);
    put(&problem.rho, 0, l, kPenalty * problem.weight[l]);
    for (int64_t i = 0; i < actions; i++) {
      const double low = problem.u_min[i / nu][i % nu][l], high = problem.u_max[i / nu][i % nu][l];
      const double margin = batch.barrier > 0 ? 0.01 * (high - low) : 0.0;
      const double a = low + margin, b = high - margin, value = u_start ? u_start[i] : 0.0;
      put(at.u.entries, i, l, value < a ? a : value > b ? b : value);
    }
    if (o.lam_start && !released[l])
      problem.load_lam(at.lam.entries, o.lam_start + e * forces, l);
    else
      for (int64_t i = 0; i < forces; i++) {
        put(at.lam.entries, i, l, released[l] ? 0.0 : __builtin_sqrt(eps[l]));
        put(at.s.entries, i, l, 1.0);
      }
    return true;
  }

  // `unfinished`: left as it is, for others to go on from; the objective is then what the solver itself descends on.
  void write(const MpcSolve& o, int l, Status status, const Multipliers& multipliers, bool unfinished = false) {
    const int64_t e = lane[l].element, states = at.x.size(), actions = at.u.size(), forces = at.lam.size();
    problem.store(o.x + e * states, at.x.entries, states, l);
    problem.store(o.u + e * actions, at.u.entries, actions, l);
    problem.store_lam(o.lam + e * forces, at.lam.entries, l);
    problem.store_multipliers(o.mu + e * (n.h + 1) * n.c(), multipliers.entries, e, l);
    const double unit = lane_of(problem.cost_unit[0], l);
    o.objective[e] = (n.c() > 0 && !unfinished ? problem.objective(at) : J)[l] / unit;
    if (o.gained) o.gained[e] = lane[l].gained / unit;
    o.iterations[e] = int32_t(lane[l].iterations);
    o.status[e] = int8_t(status);
    if (unfinished) {
      o.residual[e] = kHuge;
      o.fragile[e] = 0;
    }
  }
  void store(const MpcSolve& o, int l, Status status, bool weak, const Multipliers& multipliers) {
    write(o, l, status, multipliers);
    flat[waiting] = weak;
    finished[waiting++] = lane[l].element;
    if (waiting == kLanes) certify(o);
  }
  void certify(const MpcSolve& o) {
    certificate.judge(o, finished, waiting, flat);
    waiting = 0;
  }

  // Stores a plan as solved if the certificate confirms it.
  bool accepted(const MpcSolve& o, int l, const Sweep& sweep, const Multipliers& force) {
    write(o, l, sweep.weak[l] ? Status::degenerate : Status::converged, force);
    certificate.judge(o, &lane[l].element, 1);
    return o.status[lane[l].element] != int8_t(Status::numerical);
  }

  // Whether an exact step (riccati.hpp) led to the optimum, which it then stores: if it was full and ended inside all
  // bounds, the certificate says so as well as another sweep. Of one problem alone.
  bool exact(const MpcSolve& o, const Sweep& sweep, Vec step) {
    if (kLanes > 1 || needs_rollout[0] || !sweep.exact[0] || sweep.weak[0] || step[0] < 1) return false;
    return inside(reinterpret_cast<const double*>(at.u.entries), 0) && accepted(o, 0, sweep, problem.multiplier) &&
           o.residual[lane[0].element] <= kBrief;
  }

  // A step of the multipliers, at the target of the homotopy: earlier they would follow plans that change.
  // They become those that the augmented Lagrangian has at the iterate.
  void update_multipliers(int l) {
    Mask which = Mask{};
    which[l] = -1;
    for (int64_t k = 0; k <= n.h; k++) {
      const StageData<T, AnySizes> data = k < n.h ? problem.stage(k) : problem.last();
      for (int64_t i = 0; i < n.c(); i++) {
        Vec& multiplier = problem.multiplier(k, i);
        const Vec c = data.constraint(i, at.x[k], k < n.h ? at.u[k] : nullptr);
        multiplier = select(which, Force(c, multiplier, problem.rho, data.price[i]).value, multiplier);
      }
    }
    stale_cost |= which;
  }

  // Whether the constraints of a lane are met, except for a rest that no step of the multipliers reduces.
  bool met(const Sweep& sweep, int l) const {
    const int64_t stalled = lane[l].stalled;
    return sweep.violated[l] <= (stalled > 1 ? kMetRounded : stalled > 0 ? kMetHardly : kMet);
  }

  // Updates the multipliers or the weight of a lane at the target, if its constraints need it; returns whether.
  bool update_due_multipliers(const Sweep& sweep, int l, bool stationary) {
    const double violated = sweep.violated[l];
    if (lane[l].gradient_left == 0) lane[l].gradient_left = sweep.projected[l];
    const double due = kUpdateDue * (lane[l].gradient_left < sweep.multiplier_step[l] ? lane[l].gradient_left
                                                                                      : sweep.multiplier_step[l]);
    const bool impatient =
        lane[l].in_stage >= kStepsBeforeUpdate && violated <= kSlightlyViolated && sweep.multiplier_step[l] > 0;
    if (!impatient && (met(sweep, l) || !(stationary || sweep.projected[l] <= due))) return false;
    lane[l].gradient_left = 0;
    update_multipliers(l);
    double& rho = reinterpret_cast<double*>(&problem.rho)[l];
    lane[l].stalled = violated > 0.5 * lane[l].violated ? lane[l].stalled + 1 : 0;
    if (violated > (violated < kSmall ? kSlowEnd : kSlow) * lane[l].violated)
      rho *= violated > kStays * lane[l].violated ? kRaiseMore : kRaise;
    lane[l].violated = violated;
    lane[l].iterations++;
    lane[l].failures = lane[l].in_stage = lane[l].without_gain = 0;
    return true;
  }

  // Stores the lanes that are done and gives them other problems. Returns the lanes that make no step now.
  Mask finish(const MpcSolve& o, const Sweep& sweep, const Multipliers& force, int64_t* counter, Mask idle, int& live) {
    Mask frozen = idle;
    for (int l = 0; l < kLanes; l++) {
      if (idle[l] || released[l] || eps[l] > batch.relaxation) continue;
      const Lane& a = lane[l];
      double tol = o.tol > sweep.rounding[l] ? o.tol : sweep.rounding[l];
      // A search that fails this close to the optimum has met the rounding of the cost.
      const bool stuck = a.failures >= kFailures || a.without_gain >= 4 * kStepsWithoutGain;
      const double patience = kLooserTolerance[stuck ? 3 : a.without_gain / kStepsWithoutGain];
      if (patience > 1 && tol < kLeastTolerance) tol = kLeastTolerance;
      const bool small = sweep.projected[l] <= patience * tol;
      const bool stationary = small && sweep.stationary[l] <= patience * kStationary;
      const bool converged = stationary && met(sweep, l);
      const bool broken = !(J[l] < 1e300 && J[l] > -1e300);
      const bool doubtful =
          small && !stationary && met(sweep, l) && !broken && (a.without_gain == kStepsBeforeCertificate || stuck);
      const bool infeasible = sweep.violated[l] > o.certified && a.stalled >= 3 &&
                              sweep.largest_multiplier[l] > kDominates * sweep.cost_gradient[l] &&
                              (problem.rho[l] >= kLargestPenalty * problem.weight[l] || a.iterations >= o.max_iter);
      if (!infeasible && !broken && a.iterations < o.max_iter && n.c() > 0 &&
          update_due_multipliers(sweep, l, stationary || (small && a.without_gain >= kStepsBeforeCertificate))) {
        frozen[l] = -1;
        continue;
      }
      if (!infeasible && !converged && !doubtful && !broken && a.iterations < o.max_iter && !stuck) continue;
      // Once more without regularisation, which hides a singular Hessian.
      if ((converged || doubtful) && regularisation[l] > 0 && !broken) {
        frozen[l] = -1;
        regularisation[l] = 0;
        continue;
      }
      const bool done = doubtful && accepted(o, l, sweep, force);
      const double first = kPenalty * problem.weight[l];
      if (doubtful && !a.weight_reset && problem.rho[l] > first && o.residual[a.element] > kRoundingLeft) {
        frozen[l] = -1;
        update_multipliers(l);
        put(&problem.rho, 0, l, first);
        lane[l].weight_reset = true;
        lane[l].violated = 1e300;
        lane[l].stalled = lane[l].failures = lane[l].in_stage = lane[l].without_gain = 0;
        continue;
      }
      if (doubtful && !done && !infeasible && a.iterations < o.max_iter && !stuck) continue;
      frozen[l] = -1;
      if (!done)
        store(o, l,
              converged && !broken         ? (sweep.weak[l] ? Status::degenerate : Status::converged)
              : infeasible                 ? Status::infeasible
              : a.iterations >= o.max_iter ? Status::max_iter
                                           : Status::numerical,
              sweep.weak[l], force);
      if (!take(o, counter, l)) live--;
    }
    return frozen;
  }

  // Whether a lane that is explored gains too little to come below what its start needs.
  bool hopeless(const MpcSolve& o, int l) const {
    const double needed = o.start[lane[l].element].needed * lane_of(problem.cost_unit[0], l);
    return lane[l].in_stage > 0 && lane[l].failures == 0 && J[l] - kHope * lane[l].gained > needed;
  }

  // Leaves the lanes that have made their steps at the target to be compared, and gives them other problems.
  void leave(const MpcSolve& o, int64_t* counter, Mask frozen, int& live) {
    for (int l = 0; l < kLanes; l++) {
      if (frozen[l] || released[l] || needs_rollout[l] || eps[l] > batch.relaxation) continue;
      const int64_t steps = o.start[lane[l].element].explore;
      if (steps == 0 || (lane[l].in_stage < steps && !hopeless(o, l))) continue;
      write(o, l, Status::max_iter, problem.multiplier, true);
      if (!take(o, counter, l)) live--;
    }
  }

  // Relaxation of the next stage of a lane. A stage solved `at_once`, before its first step, leads as far as four.
  double next_stage(const MpcSolve& o, int l, bool at_once) const {
    double shrink = o.shrink;
    if (at_once) {
      shrink *= shrink;
      shrink *= shrink;
    }
    return eps[l] * shrink > batch.relaxation ? eps[l] * shrink : batch.relaxation;
  }

  // Lets the steps of large problems end at the relaxation of the next stage, which saves them a rollout there. A stage
  // has one step, whose success the cost does not tell, as it depends on the relaxation: it is taken.
  void go_ahead(const MpcSolve& o, const Sweep& sweep, Mask frozen) {
    ahead = Mask{};
    for (int l = 0; l < kLanes && batch.large() && batch.barrier == 0; l++) {
      if (frozen[l] || released[l] || eps[l] <= batch.relaxation) continue;
      put(&eps, 0, l, next_stage(o, l, sweep.projected[l] < kSolvedStage * o.tol));
      ahead[l] = -1;
    }
  }

  // Damping and homotopy after a step.
  void advance(const MpcSolve& o, const Sweep& sweep, Mask frozen, Mask moved, Vec step, Vec gain) {
    const double target = batch.relaxation;
    for (int l = 0; l < kLanes; l++) {
      if (frozen[l] || released[l]) continue;
      Lane& a = lane[l];
      a.iterations++;
      a.in_stage++;
      a.failures = moved[l] ? 0 : a.failures + 1;
      const bool gains = ahead[l] || eps[l] > target || (moved[l] && a.gained > kNoGain * (1.0 + __builtin_fabs(J[l])));
      a.without_gain = gains ? 0 : a.without_gain + 1;
      // Levenberg-Marquardt on the kinks of the contacts (linearisation.hpp): a failed step asks for more damping, one
      // that had to be shortened too, and one that gained what its model promised for less.
      double& reg = reinterpret_cast<double*>(&regularisation)[l];
      const bool shortened = step[l] < 0.3;
      if (!moved[l] || shortened)
        reg = reg > 0 ? reg * (moved[l] ? 2 : 4) : kLeastDamping;
      else if (gain[l] > 0.8 && (reg *= 0.3) < 0.2 * kLeastDamping)
        reg = 0;
      // `steps` steps per stage of the homotopy, fewer where the stage is solved.
      const bool solved = sweep.projected[l] < kSolvedStage * o.tol;
      if (ahead[l]) {
        a.in_stage = a.failures = 0;
        needs_rollout[l] = ~moved[l];
      } else if (eps[l] > target && (a.in_stage >= o.steps || solved || a.failures > 0)) {
        put(&eps, 0, l, next_stage(o, l, a.in_stage == 1 && solved));
        a.in_stage = 0;
        a.failures = 0;
        needs_rollout[l] = -1;
      } else if (eps[l] <= target && a.in_stage >= kCreeping && a.returns < kReturns && n.l() > 0 && n.c() == 0) {
        eps[l] = target * kBack[a.returns++];
        a.in_stage = a.failures = a.without_gain = 0;
        reg = 0;
        needs_rollout[l] = -1;
      }
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
