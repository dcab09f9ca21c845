// The MPC solver: projected Newton on the actions, with a feedback rollout clipped to the box, an Armijo search, and a
// homotopy in eps down to `relaxation`.
//
// A released problem begins without contact: one Riccati sweep from its first actions gives the feedback law of the
// free plant, which is rolled out with contact and clipped to the bounds. An unstable plant has fallen over where its
// actions alone are rolled out. The gaps along it also tell the scale of the problem, from which the homotopy starts.
// Of a quadratic program with bounds alone the law without bounds, made around x = 0, is that of every initial state.
// It is kept until another number changes, and tried where there is no guess, or one that is inside the bounds.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "matrix.hpp"
#include "mpc_problem.hpp"
#include "progress.hpp"
#include "relaxed_lcp.hpp"
#include "riccati.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

template <class T, class S>
class Solver {
  const MpcBatch& batch;
  const S n;
  Problem<T, S> problem;
  Riccati<T, S, false> riccati;
  Progress<T> progress;
  Trajectory<S> at, next;  // the iterate, which `progress` has too, and the trial
  struct Law {
    Matrix<Vec, 0, S::kU> feedforward;
    Stages<Matrix<Vec, S::kU, S::kX>> feedback;
  } law, origin;  // of the next step, and the one around x = 0 where that is kept
  Vec *newton, *dx, *du;
  const Mask large = batch.large() ? ~Mask{} : Mask{};  // where forces on the way of the homotopy need not be exact
  Mask* rows;

 public:
  Solver(const MpcBatch& b, void* memory) : batch(b), n(b), problem(b, false), riccati(problem), progress(b, problem) {
    layout(memory);
  }

  // Lays the arrays out in `memory`, or only counts them where it is null.
  DIFFLCS_NOINLINE int64_t layout(void* memory) {
    Arena arena{memory};
    problem.layout(arena);
    progress.layout(arena);
    at = progress.at;
    next.layout(arena, n);
    arena.take(newton, Lcp::scratch(n.l()));
    arena.take(rows, n.l());
    arena.take(origin.feedforward, problem.linear() ? n.h : 0, n.u());
    arena.take(origin.feedback, problem.linear() ? n.h : 0, n.u(), n.x());
    arena.take(dx, n.x());
    arena.take(du, n.u());
    riccati.layout(arena);
    return arena.used;
  }

  void solve(const MpcSolve& o, int64_t* counter, Watch watch);

 private:
  using Lcp = RelaxedLcp<T, S::kL, S::kL == 0>;

  // Large problems look at the watch at every stage, small ones once per iteration.
  bool halted(Watch watch) const { return n.l() > 16 && watch.stop(watch.context); }

  // lam and s of one stage, from the guess in `lam`; lanes in `skip` keep both.
  void contacts(int64_t k, const StageData<T, S>& data, const Vec* x, const Vec* u, Vec* lam, Vec* s, Mask skip) {
    if (n.l() == 0) return;
    data.gap(x, u, progress.gap);
    const Vec rounding = select((progress.eps > batch.relaxation) & large, all(kRoughly), all(kExactly));
    Lcp(n.l(), data.F.entries, progress.gap, newton, rows, batch.pivot, &problem.low_rank[k])
        .solve(lam, s, progress.eps, rounding, skip);
  }

  // Roll u out at eps in the lanes of `wanted`; returns the cost of every lane, unless the next step needs none.
  Vec rollout(Mask wanted, Watch watch) {
    for (int64_t i = 0; i < n.x(); i++) at.x(0, i) = problem.x0[i];
    for (int64_t k = 0; k < n.h && !halted(watch); k++) {
      const StageData<T, S>& data = problem.stage(k);
      contacts(k, data, at.x[k], at.u[k], at.lam[k], at.s[k], ~wanted | progress.released);
      data.next_state(at.x[k], at.u[k], at.lam[k], at.x[k + 1]);
    }
    return problem.linear() && !any(wanted & ~progress.released) ? all(0) : problem.cost(at);
  }

  // The trial trajectory with step length `step` along the feedback law; lanes in `frozen` stay where they are, those
  // in `skip` keep their trial.
  Vec trial(Vec step, Mask frozen, Mask skip, Watch watch) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    for (int64_t i = 0; i < nx; i++) next.x(0, i) = problem.x0[i];
    for (int64_t k = 0; k < n.h && !halted(watch); k++) {
      const StageData<T, S>& data = problem.stage(k);
      const Matrix<Vec, S::kU, S::kX> K = law.feedback[k];
      for (int64_t j = 0; j < nu; j++) {
        const Vec from = at.u(k, j);
        Vec to = from + step * law.feedforward(k, j);
        for (int64_t i = 0; i < nx; i++) to += K(j, i) * (next.x(k, i) - at.x(k, i));
        Vec low = data.u_min[j], high = data.u_max[j];
        if (batch.barrier > 0) {  // at most nine tenths of the way to a bound
          low = from - 0.9 * (from - low);
          high = from + 0.9 * (high - from);
        }
        next.u(k, j) = select(frozen, from, max(low, min(high, to)));
      }
      // The forces are near what the linearisation says, which must not leave the interior.
      for (int64_t i = 0; i < nx; i++) dx[i] = next.x(k, i) - at.x(k, i);
      for (int64_t j = 0; j < nu; j++) du[j] = next.u(k, j) - at.u(k, j);
      for (int64_t j = 0; j < nl; j++) {
        const Vec near = max(at.lam(k, j) + riccati.force_change(k, j, dx, du), 0.1 * at.lam(k, j));
        next.lam(k, j) = select(skip, next.lam(k, j), near);
      }
      contacts(k, data, next.x[k], next.u[k], next.lam[k], next.s[k], skip);
      data.next_state(next.x[k], next.u[k], next.lam[k], next.x[k + 1]);
    }
    return problem.cost(next);
  }

  // The sweep around the iterates, with the law of the next step. That around x = 0, of the lanes `fresh`, may be kept.
  Sweep sweep(Mask fresh, Mask idle) {
    for (int64_t i = 0; i < at.x.size() && any(fresh); i++) at.x.entries[i] = zero_where(fresh, at.x.entries[i]);
    Sweep made{};
    made.exact = fresh;
    law = origin;
    if (!any(~(fresh & *problem.has_law) & ~idle)) return made;
    // Gauss-Newton can creep along a curved valley: after 20 steps in one stage every other one keeps the curvature.
    Mask keep_curvature;
    for (int l = 0; l < kLanes; l++)
      keep_curvature[l] = progress.lane[l].in_stage > 20 && progress.lane[l].in_stage % 2 ? -1 : 0;
    made = riccati.sweep(at, {},
                         {progress.regularisation, keep_curvature, progress.gauss_newton, progress.released, fresh});
    law = {riccati.feedforward, riccati.feedback};
    const Mask exact = fresh & made.exact;
    made.weak &= ~exact;  // x = 0 is no plan
    const auto keep = [&](Vec* to, const Vec* from, int64_t count) {
      for (int64_t i = 0; i < count && any(exact); i++) to[i] = select(exact, from[i], to[i]);
    };
    keep(origin.feedforward.entries, law.feedforward.entries, n.h * n.u());
    keep(origin.feedback.first.entries, law.feedback.first.entries, n.h * n.u() * n.x());
    *problem.has_law |= exact;
    return made;
  }

  // Makes the trial the iterate.
  void move(Mask which) {
    const auto copy = [&](auto& to, const auto& from) {
      for (int64_t i = 0; i < to.size(); i++) to.entries[i] = select(which, from.entries[i], to.entries[i]);
    };
    copy(at.u, next.u);
    copy(at.x, next.x);
    copy(at.lam, next.lam);
    copy(at.s, next.s);
  }

  // Armijo search along the feedback law. An accepted lane keeps its trial while the others shorten their step. Returns
  // the lanes that moved, `step` how far, and `gain`, the change of the cost in parts of what a quadratic model with
  // its minimum at the end of a full step promises.
  Mask search(Mask frozen, Vec& step, Vec& gain, Watch watch) {
    Vec J_trial = progress.J;
    Mask accepted = frozen;
    step = all(1);
    gain = all(0);
    for (int search = 0; search < 5; search++) {
      const Vec value = trial(step, frozen, accepted, watch);
      if (halted(watch)) break;
      // First-order change of the cost along the step as it was clipped: the gradient is dJ/du of the whole trajectory.
      Vec slope = all(0);
      for (int64_t i = 0; i < at.u.size(); i++)
        slope += riccati.gradient.entries[i] * (next.u.entries[i] - at.u.entries[i]);
      const Mask good =
          (progress.released | (progress.ahead & (abs(value) < kHuge)) |
           (value <= progress.J + 1e-4 * min(slope, all(0)) + 1e-13 * (1.0 + abs(progress.J)))) &
          ~accepted;
      J_trial = select(good, value, J_trial);
      gain = select(good & (slope < 0), 2.0 * (value - progress.J) / slope, gain);
      accepted |= good;
      if (!any(~accepted)) break;
      step = select(accepted, step, step * (search < 2 ? 0.5 : 0.25));
    }
    const Mask moved = accepted & ~frozen;
    move(moved);
    for (int l = 0; l < kLanes; l++)
      if (moved[l]) progress.lane[l].gained = progress.J[l] - J_trial[l];
    progress.J = select(moved, J_trial, progress.J);
    return moved;
  }

  // Out of time: stores every plan as it is executed at the problem's relaxation, along the last feedback law where
  // there is one, since the actions alone can lead an unstable plant elsewhere.
  // `weak`: the lanes whose last sweep met a flat direction.
  void leave_off(const MpcSolve& o, Mask idle, Mask weak) {
    const Watch never{[](void*) { return false; }, nullptr};
    Mask fresh;
    for (int l = 0; l < kLanes; l++) fresh[l] = progress.lane[l].iterations == 0 ? -1 : 0;
    progress.released = Mask{};
    progress.eps = all(batch.relaxation);
    problem.mu = all(batch.barrier) * problem.cost_unit[0];
    if (any(fresh & ~idle)) rollout(fresh, never);
    if (any(~fresh & ~idle)) {
      trial(all(0), fresh | idle, fresh | idle, never);
      move(~fresh & ~idle);
    }
    progress.J = problem.cost(at);
    for (int l = 0; l < kLanes; l++)
      if (!idle[l]) progress.store(o, l, Status::max_iter, weak[l] && !fresh[l], problem.multiplier);
  }
};

// Takes problems from the shared counter until none is left.
template <class T, class S>
void Solver<T, S>::solve(const MpcSolve& o, int64_t* counter, Watch watch) {
  progress.eps = all(batch.relaxation);
  progress.regularisation = progress.J = all(0);
  progress.needs_rollout = progress.stale_cost = Mask{};
  progress.released = progress.gauss_newton = progress.at_origin = Mask{};
  progress.waiting = 0;
  int live = 0;
  Mask weak = Mask{};
  for (int l = 0; l < kLanes; l++) {
    if (progress.take(o, counter, l))
      live++;
    else if (live)
      problem.load(progress.lane[0].element, l);  // harmless numbers for a lane that never gets a problem
  }
  while (live > 0) {
    Mask idle;
    for (int l = 0; l < kLanes; l++) idle[l] = progress.lane[l].element < 0 ? -1 : 0;
    problem.mu = batch.barrier * (progress.eps / batch.relaxation) * problem.cost_unit[0];
    if (any(progress.needs_rollout & ~idle)) {
      const Vec rolled = rollout(progress.needs_rollout & ~idle, watch);
      progress.J = select(progress.needs_rollout, rolled, progress.J);
    }
    if (watch.stop(watch.context)) {
      leave_off(o, idle, weak);
      break;
    }
    if (any(progress.stale_cost)) progress.J = select(progress.stale_cost, problem.cost(at), progress.J);
    progress.needs_rollout = progress.stale_cost = Mask{};
    const Mask fresh = progress.at_origin & ~idle;
    const Sweep sweep = this->sweep(fresh, idle);
    const Mask frozen = progress.finish(o, sweep, riccati.force, counter, idle, live);
    if (live == 0) break;
    weak = sweep.weak;
    Vec step, gain;
    progress.go_ahead(o, sweep, frozen);
    const Mask moved = search(frozen, step, gain, watch);
    progress.advance(o, sweep, frozen, moved, step, gain);
    const Mask first = progress.released & ~frozen;
    if (any(first)) progress.start_homotopy(o, first);
    if (progress.exact(o, sweep, step) && !progress.take(o, counter, 0)) live--;
    progress.leave(o, counter, frozen | first, live);
  }
  if (progress.waiting) progress.certify(o);
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
