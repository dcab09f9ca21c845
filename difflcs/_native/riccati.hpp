// The Riccati sweep of the MPC with lam eliminated: reduced gradient, active bounds, and the feedback law that solves
// the quadratic problem around a trajectory. The adjoint is the same sweep with upstream gradients as linear terms
// (difflcs/mpc/riccati.py: `linearise`, and the backward half of `_solve`).
#pragma once
#include "lanes.hpp"
#include "linearisation.hpp"
#include "matrix.hpp"
#include "mpc_problem.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Smallest curvature of an action, in parts of what would move it across its whole range: bounds Newton's step where
// the cost is flat.
constexpr double kFlat = 1e-3;
// Damping of the actions beside that of the contacts, in units of each action's own curvature: what bends the cost is
// damped where it bends, the actions only lest nothing is.
constexpr double kActionDamping = 0.01;
// Where the problem is linear, an action whose own price is above this part of its curvature is not flat: Newton's step
// is exact.
constexpr double kPriced = 1e-8;

// How the solver's step is taken.
struct Newton {
  Vec regularisation{};   // added to the curvature of contacts and actions
  Mask keep_curvature{};  // keeps the second derivative of lam where the Hessian is indefinite
  Mask gauss_newton{};    // never has it
  Mask unbounded{};       // knows no bounds
  Mask at_origin{};       // is around x = 0, which is no trajectory, and has no bounds
};

// What a sweep finds besides the feedback law.
struct Sweep {
  Vec projected;   // projected gradient in units of the gradient, with the curvature as the scale of the bounds
  Vec rounding;    // level below which rounding hides it
  Vec stationary;  // projected gradient in parts of its scale, which sees flat directions too (certificate.hpp)
  Vec violated;    // by how much constraints are not met or not complementary, in parts of the sizes of their terms
  Vec multiplier_step;  // largest change of their multipliers that the augmented Lagrangian calls for
  Vec largest_multiplier;
  Vec cost_gradient;  // sizes of the gradients of the cost in states and actions, added up over the stages
  Mask weak;          // a bound is weakly active, or the reduced Hessian is singular
  Mask exact;         // Newton's step is, within the bounds: all is linear, and no stage damped, flat or singular
};

// Value function of the steps from one on: Hessian, costate, and linear term.
template <class S>
struct Value {
  Matrix<Vec, S::kX, S::kX> P;
  Vec *p, *v;
};

template <class T, class S, bool kAdjoint>
class Riccati {
  static constexpr int64_t kX = S::kX, kU = S::kU, kW = S::kW, kLaw = kX ? kX + 1 : 0;
  const Problem<T, S>& problem;
  const S n;
  // Without contacts and constraints the Hessian depends on the active bounds alone, so that a stage keeps what it has
  // until they change there or later in the horizon.
  const bool keeps;
  Linearisation<T, S> linearisation;
  Stages<Matrix<Vec, kX, kX>> P;
  Matrix<Vec, 0, kX> p, v;
  Stages<Matrix<Vec, kW, kW>> hessians;
  Stages<Matrix<Vec, kU, kU>> factors;
  Matrix<Mask, 0, kU> held;  // the active actions of each stage that keeps H, L and its law
  bool* known;               // which stages do
  Matrix<Vec, kW, kW> H;     // of the current stage
  Matrix<Vec, kX, kW> PA;
  Matrix<Vec, kU, kU> H_uu, L;
  Matrix<Vec, kU, kLaw> law;
  Vec *linear, *flat, *column, *toward, *share;
  Vec* largest_action;             // of each action, over the stages
  Vec *row_terms, *row_violation;  // of each constraint, the largest over the stages
  Mask* active;
  Newton newton;
  bool whole;        // all of the stage is wanted: of the first, whose state is given, only around x = 0
  Vec flat_damping;  // beside the kinks of constraints: damping of what is flat
  Sweep result;

 public:
  Matrix<Vec, 0, kU> gradient, feedforward;
  Stages<Matrix<Vec, kU, kX>> feedback;
  Matrix<Mask, 0, kU> lower, upper;  // actions held at a bound
  // Of each constraint: its multiplier, and what it adds to the curvature along its row. The adjoint is given both.
  Matrix<Vec, 0, 0> force, stiffness;

  explicit Riccati(const Problem<T, S>& problem)
      : problem(problem), n(problem.n), keeps(!kAdjoint && problem.linear()), linearisation(problem, kAdjoint || keeps) {}

  void layout(Arena& arena) {
    const int64_t nx = n.x(), nu = n.u(), nw = n.w(), h = n.h, values = kAdjoint || keeps ? h + 1 : 2;
    linearisation.layout(arena);
    arena.take(P, values, nx, nx);
    arena.take(p, values, nx);
    arena.take(v, values, nx);
    arena.take(hessians, keeps ? h : 1, nw, nw);
    arena.take(factors, keeps ? h : 1, nu, nu);
    arena.take(held, keeps ? h : 0, nu);
    arena.take(known, keeps ? h : 0);
    for (int64_t k = 0; k < h && keeps && arena.memory && !problem.kept; k++) known[k] = false;
    arena.take(PA, nx, nw);
    arena.take(H_uu, nu, nu);
    arena.take(law, nu, nx + 1);
    arena.take(linear, nw);
    arena.take_all(nu, flat, active, toward, share);
    arena.take(column, nx * kColumns);
    arena.take(gradient, h, nu);
    arena.take(feedforward, h, nu);
    arena.take(feedback, h, nu, nx);
    arena.take(lower, h, nu);
    arena.take(upper, h, nu);
    const int64_t nc = n.c();
    arena.take(force, h + 1, nc);
    arena.take(stiffness, h + 1, nc);
    arena.take_all(nc, row_terms, row_violation);
    arena.take(largest_action, nu);
  }

  Stage<S> stage(int64_t k) const { return linearisation.stage(k); }

  // All of them, or this stage's and the next's.
  Value<S> value(int64_t k) const {
    const int64_t at = kAdjoint || keeps ? k : k % 2;
    return {P[at], p[at], v[at]};
  }

  // Around the trajectory `at`.
  Sweep sweep(const Trajectory<S>& at, const Upstream<S>& upstream, const Newton& how = {}) {
    newton = how;
    result = {all(0), all(0), all(0), all(0), all(0), all(0), all(0), Mask{}, keeps ? ~Mask{} : Mask{}};
    flat_damping = all(0);
    for (int64_t i = 0; i < n.c(); i++) {
      row_terms[i] = problem.reach[i];
      row_violation[i] = all(0);
      if (!kAdjoint) flat_damping = select(problem.reach[i] > 0, newton.regularisation, flat_damping);
    }
    for (int64_t j = 0; j < n.u() && problem.batch.unbounded; j++) {
      largest_action[j] = all(0);
      for (int64_t k = 0; k < n.h; k++) largest_action[j] = max(largest_action[j], abs(at.u(k, j)));
    }
    terminal(at.x[n.h], kAdjoint ? upstream.x[n.h] : nullptr);
    const Mask damped = newton.regularisation > 0;
    bool same = keeps && !any(damped) && problem.shared;  // P of the next stage is the one that this stage knows
    for (int64_t k = n.h - 1; k >= 0; k--) {
      const StageData<T, S>& data = problem.stage(k);
      const Value<S> next = value(k + 1);
      whole = k > 0 || any(newton.at_origin);
      same = same && known[k] && !(k == 0 && whole);
      H = hessians[keeps ? k : 0];
      L = factors[keeps ? k : 0];
      const Stage<S> stage =
          same ? linearisation.stage(k) : linearisation.at(k, at.lam[k], at.s[k], next.p, newton.regularisation);
      constraints(k, data, at.x[k], at.u[k]);
      if (any(newton.at_origin)) follow(data, next, at.u[k]);
      if (!same) stage_hessian(k, data, stage, next.P);
      const Vec* lam_bar = kAdjoint ? upstream.lam[k] : nullptr;
      actions(k, data, stage, next, at.x[k], at.u[k], kAdjoint ? upstream.u[k] : nullptr, lam_bar);
      states(k, data, stage, next, at.x[k], at.u[k], kAdjoint ? upstream.x[k] : nullptr, lam_bar);
      if (!kAdjoint && any(newton.gauss_newton)) linearisation.drop(newton.gauss_newton);
      action_hessian(data);
      Mask poor = damped;
      if (!same || !holds(k)) poor |= factor(data);
      if (!kAdjoint) step_within_bounds(k, data, at.u[k]);
      same = same && !any(poor) && holds(k);
      if (same)
        linear_value(k);
      else
        feedback_law(k);
      if (keeps) keep(k, data, poor);
    }
    for (int64_t i = 0; i < n.c(); i++)
      result.violated = max(result.violated, row_violation[i] / select(row_terms[i] > 0, row_terms[i], all(1)));
    return result;
  }

  // What contact i of stage k answers to a change of state and action, to first order.
  Vec force_change(int64_t k, int64_t i, const Vec* dx, const Vec* du) const {
    return linearisation.change(k, i, dx, du);
  }

 private:
  // Takes the linear term of the value after a stage at the state that follows x = 0.
  void follow(const StageData<T, S>& data, const Value<S>& next, const Vec* u) {
    for (int64_t i = 0; i < n.x(); i++) column[i] = data.d[i] + data.B().row(i) * u;
    for (int64_t i = 0; i < n.x(); i++)
      next.v[i] = select(newton.at_origin, next.v[i] + next.P.row(i) * column, next.v[i]);
  }

  void terminal(const Vec* x, const Vec* x_bar) {
    const int64_t nx = n.x();
    const Value<S> end = value(n.h);
    const Matrix<T, kX, kX> Q = problem.Q_final();
    for (int64_t i = 0; i < nx; i++) {
      for (int64_t j = 0; j < nx; j++) end.P(i, j) = all(0) + Q(i, j);
      end.p[i] = problem.q_final[i] + Q.row(i) * x;
    }
    if (n.c() > 0) {
      const StageData<T, S> data = problem.last();
      constraints(n.h, data, x, nullptr);
      for (int64_t i = 0; i < nx; i++) result.cost_gradient += abs(end.p[i]);
      for (int64_t r = 0; r < n.c(); r++) {
        const Vec stiff = stiffness(n.h, r);
        for (int64_t i = 0; i < nx; i++) {
          end.p[i] += data.G(r, i) * force(n.h, r);
          for (int64_t j = 0; j < nx; j++) end.P(i, j) += stiff * data.G(r, i) * data.G(r, j);
        }
      }
    }
    for (int64_t i = 0; i < nx; i++) end.v[i] = kAdjoint ? -x_bar[i] : end.p[i];
  }

  // What the constraints of stage k add to gradient and curvature, in the solver; without actions at the last stage.
  void constraints(int64_t k, const StageData<T, S>& data, const Vec* x, const Vec* u) {
    if (kAdjoint) return;
    for (int64_t i = 0; i < n.c(); i++) {
      const Vec c = data.constraint(i, x, u), before = problem.multiplier(k, i), price = data.price[i];
      const Force now(c, before, problem.rho, price);
      force(k, i) = now.value;
      stiffness(k, i) = select(now.held, problem.rho, all(0));
      result.multiplier_step = max(result.multiplier_step, abs(now.value - before));
      result.largest_multiplier = max(result.largest_multiplier, now.value);
      row_terms[i] = max(row_terms[i], data.constraint_terms(i, x, u));
      const Vec missed = select(now.held, abs(c), select(now.value > 0, max(-c, all(0)), max(c, all(0))));
      row_violation[i] = max(row_violation[i], missed);
    }
  }

  // H = blkdiag(Q, R) + A_hat^T P A_hat, lower triangle; its second-derivative part Y is added later. Where the first
  // state is given, only the action block of stage 0 is needed.
  void stage_hessian(int64_t k, const StageData<T, S>& data, const Stage<S>& stage, const Matrix<Vec, kX, kX>& P) {
    const int64_t nx = n.x(), nw = n.w(), first = whole ? 0 : nx;
    by_columns(first, nw, [&](int64_t j, auto kind) {
      using V = decltype(kind);
      Local<kX, V> of_A(column);
      DIFFLCS_UNROLL
      for (int64_t m = 0; m < nx; m++) of_A[m] = read<V>(stage.A_hat[m], j);
      multiply(P, of_A, [](int64_t) { return V{}; }, [&](int64_t i, V sum) { write<V>(PA[i], j, sum); });
    });
    for (int64_t i = first; i < nw; i++) {
      Local<kX> of_A(column);
      DIFFLCS_UNROLL
      for (int64_t m = 0; m < nx; m++) of_A[m] = stage.A_hat(m, i);
      const auto columns = [&](int64_t from, int64_t to, auto weight) {
        by_columns(from, to, [&](int64_t j, auto kind) {
          using V = decltype(kind);
          write<V>(H[i], j, V{} + weight(j, kind) + PA.template column<V>(j) * of_A);
        });
      };
      if (i < nx)
        columns(first, i + 1, [&](int64_t j, auto kind) { return read<decltype(kind)>(data.Q[i], j); });
      else {
        columns(first, nx, [](int64_t, auto kind) { return decltype(kind){}; });
        columns(nx, i + 1, [&](int64_t j, auto kind) { return read<decltype(kind)>(data.R[i - nx], j - nx); });
      }
    }
    if (problem.batch.crossed && whole)
      for (int64_t i = nx; i < nw; i++)
        for (int64_t j = 0; j < nx; j++) H(i, j) += data.cross(j, i - nx);
    for (int64_t r = 0; r < n.c(); r++) {
      const Vec stiff = stiffness(k, r);
      if (!any(stiff > 0)) continue;
      for (int64_t i = first; i < nw; i++) {
        const Vec row = stiff * data.G(r, i);
        for (int64_t j = first; j <= i; j++) H(i, j) += row * data.G(r, j);
      }
    }
  }

  // Reduced gradient of the actions of stage k, linear terms, and which actions are held at a bound.
  void actions(int64_t k, const StageData<T, S>& data, const Stage<S>& stage, const Value<S>& next, const Vec* x,
               const Vec* u, const Vec* u_bar, const Vec* lam_bar) {
    const int64_t nx = n.x(), nu = n.u();
    const double& barrier = problem.batch.barrier;  // a reference: from a copy GCC 12 makes two loops, and fails on one
    const Vec mu = problem.mu;
    const T* rest = data.rest;
    for (int64_t j = 0; j < nu; j++) {
      const Vec lo = data.u_min[j], hi = data.u_max[j];
      const Vec below = u[j] - lo, above = hi - u[j];
      Vec width = hi - lo, per_width = data.per_width[j];
      const Mask fixed = width <= 0;
      if (problem.batch.unbounded) {
        width = range(largest_action[j], lo, hi);
        per_width = select(width > kTiny, 1.0 / width, all(0));
      }
      Vec t = data.r[j] + data.R.row(j) * u;
      if (problem.batch.crossed) t = t + data.cross.column(j) * x;
      if (barrier > 0) {
        t += mu * (1.0 / above - 1.0 / below);
        H(nx + j, nx + j) += mu * (1.0 / (below * below) + 1.0 / (above * above));
      }
      Vec terms = abs(t);
      if (n.c() > 0) result.cost_gradient += terms;
      for (int64_t i = 0; i < n.c(); i++) {
        const Vec part = data.G(i, nx + j) * force(k, i);
        t += part;
        terms += abs(part);
      }
      Vec g = t, l = kAdjoint ? -u_bar[j] : t;
      for (int64_t i = 0; i < nx; i++) {
        const Vec part = stage.A_hat(i, nx + j) * next.p[i];
        g += part;
        terms += abs(part);
        l += stage.A_hat(i, nx + j) * next.v[i];
      }
      if (kAdjoint) l = l - stage.K_lam.column(nx + j) * lam_bar;
      linear[nx + j] = l;
      gradient(k, j) = g;
      // Away from an optimum P, and with it H, can be indefinite: |H| is still a scale for the distance to a bound.
      // Where the cost is flat, the range of the action is the scale: a descent leads across all of it.
      // Without bounds it is what the action is now, or one.
      const Vec across = abs(g) * (problem.batch.unbounded ? select(width > kTiny, per_width, all(1)) : per_width);
      const Vec gauss_newton = max(max(abs(H(nx + j, nx + j)), all(0) + data.R(j, j)), max(across, all(kTiny)));
      const Vec scaled = max(lo, min(hi, u[j] - g / gauss_newton));
      Vec projected = abs(scaled - u[j]) * gauss_newton;
      // Next to a bound the barrier is so steep that rounding u alone moves g: a step below rounding counts as none.
      if (barrier > 0) projected = select(abs(g) <= 1e-14 * width * gauss_newton, all(0), projected);
      result.projected = max(result.projected, projected);
      result.rounding = max(result.rounding, 1e-12 * terms);
      if (barrier > 0)
        terms += mu * (1.0 / below + 1.0 / above) + 1e-8 * mu * width * (1.0 / (below * below) + 1.0 / (above * above));
      const Vec reference = max(terms, rest[j] * width);
      Vec part = select(reference > 0, abs(g) / reference, all(0));
      const Vec reach = select(g > 0, below, above);
      part = min(part, problem.batch.unbounded ? select(reach > kHuge, reach, reach * per_width) : reach * per_width);
      if (barrier > 0) part = select(projected > 0, part, all(0));
      result.stationary = max(result.stationary, part);
      flat[j] = (kFlat + flat_damping) * across;
      if (keeps) flat[j] = select(data.R(j, j) > kPriced * abs(H(nx + j, nx + j)), all(0), flat[j]);
      const Vec least = 1e-10 * reference * per_width;
      const Vec curved = max(H(nx + j, nx + j) + linearisation.curvature(nx + j, nx + j), max(least, all(kTiny)));
      const Vec step = g / curved;
      if (barrier == 0) {
        Mask small = abs(step) <= kWeak * width;
        // With one bound, at zero, and at rest there in all steps, the action has no size: the gradient alone decides.
        if (problem.batch.unbounded) small |= ~(width > 0) & (abs(g) <= kWeak * terms);
        result.weak |= (min(below, above) <= kWeak * width) & small & ~fixed;
      }
      if (kAdjoint) {
        lower(k, j) = (step > below) | (fixed & (g >= 0));
        upper(k, j) = (-step > above) | (fixed & (g < 0));
      } else {
        // Next to a bound that the action's own Newton step would cross it is put onto the bound (Bertsekas).
        // Not after a failed step: the jump is not damped, and in an unstable system it can cost more than it gains.
        const Vec step = g / gauss_newton, near = select(newton.regularisation > 0, all(1e-12), all(1e-2)) * width;
        lower(k, j) = (below <= near) & (step >= below) & (g > 0) & ~newton.at_origin;
        upper(k, j) = (above <= near) & (-step >= above) & (g < 0) & ~newton.at_origin;
      }
      if (barrier > 0) {
        // A barrier that keeps no distance to speak of is the bound itself; its steepness is then only rounding.
        const Vec close = max(kClose * width, 1e-3 * kClose * max(abs(lo), abs(hi)));
        lower(k, j) = kAdjoint ? (below <= close) & (below <= above) : Mask{};
        upper(k, j) = kAdjoint ? (above <= close) & (above < below) : Mask{};
      }
      active[j] = lower(k, j) | upper(k, j) | fixed;
    }
  }

  // Costate of state k, and its linear term.
  void states(int64_t k, const StageData<T, S>& data, const Stage<S>& stage, const Value<S>& next, const Vec* x,
              const Vec* u, const Vec* x_bar, const Vec* lam_bar) {
    Vec* p = value(k).p;
    multiply_symmetric(data.Q, x, data.q, p);
    for (int64_t i = 0; i < n.x() && (problem.batch.crossed || n.c() > 0); i++) {
      if (problem.batch.crossed) p[i] = p[i] + data.cross.row(i) * u;
      if (n.c() > 0) result.cost_gradient += abs(p[i]);
      for (int64_t r = 0; r < n.c(); r++) p[i] += data.G(r, i) * force(k, r);
    }
    if constexpr (kLanes == 1 && !kAdjoint) {
      const auto A = stage.A_hat.block(0, Dim<kX>{n.x()});
      multiply_columns(A, next.v, p, linear);
      return multiply_columns(A, next.p, p, p);
    }
    by_columns(0, n.x(), [&](int64_t i, auto kind) {
      using V = decltype(kind);
      const V t = read<V>(p, i);
      V l = (kAdjoint ? -read<V>(x_bar, i) : t) + stage.A_hat.template column<V>(i) * next.v;
      if (kAdjoint) l = l - stage.K_lam.template column<V>(i) * lam_bar;
      write<V>(p, i, t + stage.A_hat.template column<V>(i) * next.p);
      write<V>(linear, i, l);
    });
  }

  // Whether the active actions of stage k are those that its law is for.
  bool holds(int64_t k) const {
    Mask differs = Mask{};
    for (int64_t j = 0; j < n.u(); j++) differs |= (active[j] & ~held(k, j)) | (held(k, j) & ~active[j]);
    return !any(differs);
  }

  void keep(int64_t k, const StageData<T, S>& data, Mask poor) {
    for (int64_t j = 0; j < n.u(); j++) {
      held(k, j) = active[j];
      poor |= ~(data.R(j, j) > kPriced * abs(H(n.x() + j, n.x() + j)));
    }
    known[k] = !any(poor);
    result.exact &= ~poor;
  }

  // Curvature that action j has at least, whatever its units.
  Vec action_scale(const StageData<T, S>& data, int64_t j) const {
    const int64_t nx = n.x();
    return max(data.R(j, j) + 1e-6 * abs(H(nx + j, nx + j)), all(kTiny));
  }

  // H_uu + Y_uu + regularisation.
  DIFFLCS_NOINLINE_IN_LANES void action_hessian(const StageData<T, S>& data) {
    const int64_t nx = n.x();
    linearisation.curvatures(
        nx, n.w(), nx, [](int64_t i) { return i + 1; },
        [&](int64_t i, int64_t j, auto Y) {
          using V = decltype(Y);
          write<V>(H_uu[i - nx], j - nx, read<V>(H[i], j) + Y);
        });
    for (int64_t i = 0; i < n.u() && !kAdjoint; i++)
      H_uu(i, i) += kActionDamping * newton.regularisation * action_scale(data, i) + flat[i];
  }

  // Cholesky of that with identity rows for active actions. An indefinite block first drops what is negative in Y at
  // this stage, then has its pivots lifted; lanes that are `keep_curvature` lift them at once. Returns where a pivot
  // was lifted or is singular.
  Mask factor(const StageData<T, S>& data) {
    const Mask weak = result.weak;
    result.weak = Mask{};
    Mask failed = cholesky(data, true);
    if (kAdjoint) result.weak |= failed;
    if (!kAdjoint && any(failed)) {
      linearisation.make_convex(failed & ~newton.keep_curvature);
      action_hessian(data);
      failed |= cholesky(data, false);
    }
    const Mask poor = failed | result.weak;
    result.weak |= weak;
    return poor;
  }

  // The factor L of H_uu, with reciprocal pivots on the diagonal. Returns where a pivot was lifted.
  DIFFLCS_NOINLINE_IN_LANES Mask cholesky(const StageData<T, S>& data, bool judged) {
    const int64_t nx = n.x(), nu = n.u();
    Mask failed = Mask{};
    for (int64_t i = 0; i < nu; i++)
      for (int64_t j = 0; j <= i; j++) L(i, j) = select(active[i] | active[j], all(i == j), H_uu(i, j));
    for (int64_t j = 0; j < nu; j++) {
      Vec pivot = L(j, j);
      for (int64_t m = 0; m < j; m++) pivot -= L(j, m) * L(j, m);
      const Vec singular = kSingular * abs(H(nx + j, nx + j));
      const Vec lift = kAdjoint ? singular : 0.05 * action_scale(data, j);
      const Mask bad = ~(pivot > lift) & ~active[j];
      failed |= bad;
      // What is added where the cost is flat vanishes with the gradient, and does not hide that it is.
      if (!kAdjoint && judged) result.weak |= ~(pivot - flat[j] > singular) & ~active[j];
      Vec inverse = 1.0 / sqrt(select(bad, max(abs(pivot), lift), pivot));
      // The adjoint holds an action that nothing moves, and takes a negative curvature by its size.
      if (kAdjoint) inverse = select(bad & (abs(pivot) <= lift), all(0), inverse);
      L(j, j) = inverse;
      for (int64_t i = j + 1; i < nu; i++) {
        Vec t = L(i, j);
        for (int64_t m = 0; m < j; m++) t -= L(i, m) * L(j, m);
        L(i, j) = t * inverse;
      }
    }
    return failed;
  }

  // The step of the actions that minimises the model of stage k within the bounds, by the primal active-set method:
  // towards the minimum over the actions that are free, up to the first bound on the way, which then holds. Clipping
  // the free minimum instead can lead uphill (Tassa, Mansard & Todorov, "Control-limited DDP", ICRA 2014).
  void step_within_bounds(int64_t k, const StageData<T, S>& data, const Vec* u) {
    const int64_t nx = n.x(), nu = n.u();
    const bool bounded = problem.batch.barrier == 0;  // a barrier has its own rule in the rollout
    Vec* d = feedforward[k];
    // An action held at a bound is put onto it exactly.
    for (int64_t i = 0; i < nu; i++)
      d[i] = select(lower(k, i), data.u_min[i] - u[i], select(upper(k, i), data.u_max[i] - u[i], all(0)));
    Mask open = ~Mask{};
    for (int64_t pass = 0; pass <= nu; pass++) {
      for (int64_t i = 0; i < nu; i++) {
        Vec t = linear[nx + i];
        for (int64_t j = 0; j < nu; j++) t += H_uu(i > j ? i : j, i > j ? j : i) * d[j];
        toward[i] = select(active[i], all(0), -t);
      }
      for (int64_t i = 0; i < nu; i++) {
        for (int64_t m = 0; m < i; m++) toward[i] -= L(i, m) * toward[m];
        toward[i] *= L(i, i);
      }
      for (int64_t i = nu - 1; i >= 0; i--) {
        for (int64_t m = i + 1; m < nu; m++) toward[i] -= L(m, i) * toward[m];
        toward[i] *= L(i, i);
      }
      Vec length = all(1);
      for (int64_t i = 0; i < nu; i++) {
        const Vec room = select(toward[i] > 0, data.u_max[i], data.u_min[i]) - u[i] - d[i];
        const Mask crosses = bounded ? (abs(toward[i]) > abs(room)) & ~active[i] & ~newton.unbounded : Mask{};
        share[i] = select(crosses, room / toward[i], all(2));
        length = min(length, share[i]);
      }
      Mask blocked = Mask{};
      for (int64_t i = 0; i < nu; i++) {
        const Mask hits = open & (share[i] <= length);
        d[i] = select(open, d[i] + length * toward[i], d[i]);
        active[i] |= hits;
        blocked |= hits;
      }
      open &= blocked;
      if (!any(open)) break;
      cholesky(data, false);
    }
  }

  // The linear term of the value function, from the feedforward.
  void linear_value(int64_t k) {
    by_columns(0, whole ? n.x() : 0, [&](int64_t i, auto kind) {
      using V = decltype(kind);
      V v = read<V>(linear, i);
      for (int64_t j = 0; j < n.u(); j++) v += read<V>(H[n.x() + j], i) * feedforward(k, j);
      write<V>(value(k).v, i, v);
    });
  }

  // Feedback -H_uu^-1 H_ux, rows of active actions zero, and the value function of stage k; in the adjoint the
  // feedforward too, -H_uu^-1 linear_u, which the solver has from `step_within_bounds`.
  void feedback_law(int64_t k) {
    const int64_t nx = n.x(), nu = n.u(), nw = n.w(), first = whole ? 0 : nx, columns = kAdjoint ? nx + 1 : nx;
    linearisation.curvatures(
        0, nw, first, [&](int64_t i) { return i < nx ? i + 1 : nx; },
        [&](int64_t i, int64_t j, auto Y) {
          using V = decltype(Y);
          write<V>(H[i], j, read<V>(H[i], j) + Y);
        });
    for (int64_t i = 0; i < nu; i++) {
      by_columns(0, nx, [&](int64_t j, auto kind) {
        using V = decltype(kind);
        write<V>(law[i], j, !whole ? V{} : zero_where(active[i], -read<V>(H[nx + i], j)));
      });
      law(i, nx) = select(active[i], all(0), -linear[nx + i]);
    }
    for (int64_t i = 0; i < nu; i++)
      by_columns(first, columns, [&](int64_t j, auto kind) {
        using V = decltype(kind);
        V t = read<V>(law[i], j);
        for (int64_t m = 0; m < i; m++) t -= L(i, m) * read<V>(law[m], j);
        t *= L(i, i);
        write<V>(law[i], j, t);
      });
    if (whole) {
      const Value<S> here = value(k);
      for (int64_t i = 0; i < nx; i++) {
        by_columns(0, i + 1, [&](int64_t j, auto kind) {
          using V = decltype(kind);
          write<V>(here.P[i], j, read<V>(H[i], j) - law.column(i) * law.template column<V>(j));
        });
        for (int64_t j = 0; j < i; j++) here.P(j, i) = here.P(i, j);
        if (kAdjoint) here.v[i] = linear[i] - law.column(i) * law.column(nx);
      }
      if (!kAdjoint) linear_value(k);
    }
    for (int64_t i = nu - 1; i >= 0; i--)
      by_columns(first, columns, [&](int64_t j, auto kind) {
        using V = decltype(kind);
        V t = read<V>(law[i], j);
        for (int64_t m = i + 1; m < nu; m++) t -= L(m, i) * read<V>(law[m], j);
        t *= L(i, i);
        write<V>(law[i], j, t);
      });
    const Matrix<Vec, kU, kX> K = feedback[k];
    for (int64_t i = 0; i < nu; i++) {
      for (int64_t j = 0; j < nx; j++) K(i, j) = law(i, j);
      if (kAdjoint) feedforward(k, i) = law(i, nx);
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
