// The relaxed LCP lam o w = eps, w = F lam + q, by damped Newton on the smoothed complementarity function of
// Chen-Harker-Kanzow-Smale,
//   g_i = lam_i + w_i - sqrt((lam_i - w_i)^2 + 4 eps) = 0  <=>  lam_i > 0, w_i > 0, lam_i w_i = eps.
// One problem per SIMD lane. `solve` starts next to the solution and stays at one eps, as the MPC needs it; `follow`
// comes from eps = 1 without a guess, as a single problem needs it.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "low_rank.hpp"
#include "lu.hpp"
#include "matrix.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// w = F lam + q, and bound_i = |q_i| + sum_j |F_ij lam_j|, the size of the terms whose rounding w_i carries.
template <class T, class Vector>
inline void lcp_slack(int64_t n, const T* F, const Vec* q, const Vector& lam, Vector& w, Vec* bound) {
  for (int64_t i = 0; i < n; i++) {
    Vec sum = q[i], b = abs(sum);
    DIFFLCS_UNROLL
    for (int64_t j = 0; j < n; j++) {
      const Vec t = F[i * n + j] * lam[j];
      sum += t;
      b += abs(t);
    }
    w[i] = sum;
    bound[i] = b;
  }
}

// Parts of the terms of g below which it counts as zero: rounding, and what is enough on the way to other problems.
constexpr double kExactly = 1e-15, kRoughly = 1e-9;

// Where lam o w differs from eps by more than this part of it, a solution is polished.
constexpr double kMissed = 1e-7;

// T is the type of an entry of F: double where all lanes share it, else Vec. N is the size where it is known when
// compiling, else zero; `kMayPivot` can eliminate with row exchanges.
template <class T, int64_t N, bool kMayPivot>
class RelaxedLcp {
  const Elimination<kMayPivot> lu;
  const LowRank* const low_rank;
  const int64_t given;
  const Matrix<const T, N, N> F;
  const Vec* const q;
  Mask* const rows;
  Local<N * N> jacobian;
  // The iterate; the next iterate starts from what the last trial computed.
  Local<N> lam, w, root, step, next, w_next, root_next;
  Vec merit, magnitude;  // squared norm of g; of the numbers whose rounding g carries

  int64_t size() const { return N ? N : given; }

 public:
  static int64_t scratch(int64_t n) { return n * n + 7 * n; }

  // `memory`: scratch(n) numbers; `exchanged`: n row numbers; `low_rank`: of F, or null.
  DIFFLCS_INLINE RelaxedLcp(int64_t n, const T* F, const Vec* q, Vec* memory, Mask* exchanged, bool pivot = false,
                            const LowRank* low_rank = nullptr)
      : lu{pivot},
        low_rank(low_rank),
        given(n),
        F{F, {n}, {n}, {n}},
        q(q),
        rows(exchanged),
        jacobian(memory),
        lam(memory + n * n),
        w(memory + n * n + n),
        root(memory + n * n + 2 * n),
        step(memory + n * n + 3 * n),
        next(memory + n * n + 4 * n),
        w_next(memory + n * n + 5 * n),
        root_next(memory + n * n + 6 * n) {}

  // From the guess in `lam_out`, at eps, to g of this part of its terms. Lanes in `skip` keep lam_out and w_out.
  DIFFLCS_INLINE void solve(Vec* lam_out, Vec* w_out, Vec eps, Vec rounding, Mask skip) {
    const int64_t n = size();
    const Vec eps4 = 4.0 * eps;
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) lam[i] = next[i] = lam_out[i];
    merit = evaluate(eps4);
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) w[i] = w_next[i], root[i] = root_next[i];
    Vec best = all(1e300);
    Mask done = skip;
    for (int iteration = 0; iteration < 50; iteration++) {
      magnitude = all(0);
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < n; i++) {
        const Vec part = unlike() ? 1.0 + (lam[i] - w[i]) / root[i] : all(1);  // of the rounding of w that g has
        magnitude = max(magnitude, part * (abs(lam[i]) + abs(w[i]) + abs(q[i])));
      }
      // Converged at rounding level, or stuck just above it.
      const Vec floor = rounding * magnitude;
      done |= (merit <= floor * floor) | ((merit <= 1e-24 * magnitude * magnitude) & (merit > 0.25 * best)) |
              (merit != merit);
      best = min(best, merit);
      if (!any(~done)) break;
      advance(eps4, done, 8);
    }
    finish(lam_out, w_out, eps, skip);
    if (kMayPivot && (lu.pivot || unlike())) polish(lam_out, w_out, eps, skip);
  }

  // From eps = 1 down to `target`. Returns the lanes that converged; `bound` is scratch.
  template <class Halted>
  DIFFLCS_INLINE Mask follow(Vec* lam_out, Vec* w_out, Vec* bound, Vec target, int64_t max_iter, Halted halted) {
    const int64_t n = size();
    Vec eps = max(target, all(1)), smallest = all(1e300);  // smallest residual met at the target
    Mask solved = Mask{};
    int stalled[kLanes] = {};
    for (int64_t i = 0; i < n; i++) lam[i] = sqrt(eps);
    for (int64_t it = 0; it < max_iter && !halted(); it++) {
      refresh(eps, bound);
      const Vec residual = sqrt(merit);
      const Mask at_target = eps <= target;
      for (int l = 0; l < kLanes; l++) {
        if (solved[l]) continue;
        // Converged at 1e-14, or at the level where rounding stops progress, if that is below 1e-10.
        if (at_target[l]) {
          if (residual[l] <= 1e-14 * magnitude[l])
            solved[l] = -1;
          else if (residual[l] < 0.5 * smallest[l]) {
            smallest[l] = residual[l];
            stalled[l] = 0;
          } else if (residual[l] <= 1e-10 * magnitude[l] && ++stalled[l] >= 2)
            solved[l] = -1;
        }
      }
      if (!any(~solved)) break;
      advance(4.0 * eps, solved, 9);
      // Shrink eps once the current point is near the path.
      const Mask near = (residual <= 0.5 * sqrt(eps)) & ~solved;
      eps = select(near, max(target, 0.1 * eps), eps);
    }
    refresh(target, bound);
    finish(lam_out, w_out, target, Mask{});
    return solved;
  }

 private:
  bool short_cut() const { return kMayPivot && kLanes == 1 && low_rank && *low_rank; }

  bool unlike() const { return kMayPivot && kLanes == 1 && low_rank && low_rank->unlike(); }

  // g_i without the cancellation that rounds it to the size of the larger number.
  static Vec exact_g(Vec lam, Vec w, Vec root, Vec eps4) {
    return any(lam + w <= 0) ? lam + w - root : (4.0 * lam * w - eps4) / (lam + w + root);
  }

  // to = q + F x
  template <class Vector, class To>
  DIFFLCS_INLINE void slack(Vector& x, To& to) {
    if (short_cut())
      low_rank->slack(F, &x[0], q, &to[0]);
    else
      multiply(F, x, [&](int64_t i) { return q[i]; }, [&](int64_t i, Vec t) { to[i] = t; });
  }

  // `step` becomes (diag(a) + diag(b) F)^-1 step, after `row` has told a_i and b_i of every row, from the first on.
  struct Row {
    Vec a, b;
  };
  template <class Rows>
  DIFFLCS_INLINE void eliminate(Rows row) {
    const int64_t n = size();
    const bool short_cut = this->short_cut();
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) {
      const Row weights = row(i);
      if (short_cut) {
        low_rank->weigh(i, weights.a, weights.b);
        continue;
      }
      DIFFLCS_UNROLL
      for (int64_t j = 0; j < n; j++) jacobian[i * n + j] = weights.b * F(i, j);
      jacobian[i * n + i] += weights.a;
    }
    if (short_cut) {
      low_rank->factor();
      low_rank->solve(&step[0]);
    } else {
      lu.factor(n, jacobian, rows);
      lu.solve(n, jacobian, rows, step);
    }
  }

  // w, root and the squared norm of g at `next`.
  DIFFLCS_INLINE Vec evaluate(Vec eps4) {
    const int64_t n = size();
    Vec sum = all(0);
    slack(next, w_next);
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) {
      const Vec t = w_next[i], diff = next[i] - t;
      root_next[i] = sqrt(diff * diff + eps4);
      const Vec g = unlike() ? exact_g(next[i], t, root_next[i], eps4) : next[i] + t - root_next[i];
      sum += g * g;
    }
    return sum;
  }

  // The same at the iterate for another eps, with the rounding of w in view.
  DIFFLCS_INLINE void refresh(Vec eps, Vec* bound) {
    const int64_t n = size();
    lcp_slack(n, F.entries, q, lam, w, bound);
    merit = magnitude = all(0);
    for (int64_t i = 0; i < n; i++) {
      const Vec diff = lam[i] - w[i];
      root[i] = sqrt(diff * diff + 4.0 * eps);
      const Vec g = root[i] - lam[i] - w[i];
      merit += g * g;
      magnitude = max(magnitude, max(bound[i], abs(lam[i])));
    }
  }

  // One step of Newton with an Armijo search of at most `trials` lengths, the last of which is taken anyhow, in the
  // lanes that are not `done`. The generalised Jacobian of g is diag(a) + diag(b) F, a = 1 - ratio and b = 1 + ratio.
  DIFFLCS_INLINE void advance(Vec eps4, Mask done, int trials) {
    const int64_t n = size();
    eliminate([&](int64_t i) {
      const Vec ratio = (lam[i] - w[i]) / root[i];
      step[i] = unlike() ? -exact_g(lam[i], w[i], root[i], eps4) : root[i] - lam[i] - w[i];
      return Row{1.0 - ratio, 1.0 + ratio};
    });
    Vec length = all(1), merit_next = merit;
    for (int trial = 0; trial < trials; trial++) {
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < n; i++) next[i] = lam[i] + length * step[i];
      merit_next = evaluate(eps4);
      // Near the rounding level the merit cannot fall further; the full step is right there.
      const Mask poor = (merit_next > merit * (1.0 - 0.2 * length)) & (merit > 1e-24 * magnitude * magnitude) & ~done;
      if (!any(poor)) break;
      if (trial + 1 < trials) length = select(poor, 0.4 * length, length);
    }
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) {
      lam[i] = select(done, lam[i], next[i]);
      w[i] = select(done, w[i], w_next[i]);
      root[i] = select(done, root[i], root_next[i]);
    }
    merit = select(done, merit, merit_next);
  }

  // Positive exactly: the larger of (lam, w) from the smoothed function, the smaller as eps / larger.
  DIFFLCS_INLINE void finish(Vec* lam_out, Vec* w_out, Vec eps, Mask skip) {
    const int64_t n = size();
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) {
      const Vec diff = lam[i] - w[i], larger = 0.5 * (abs(diff) + root[i]), smaller = eps / larger;
      lam_out[i] = select(skip, lam_out[i], select(diff > 0, larger, smaller));
      w_out[i] = select(skip, w_out[i], select(diff > 0, smaller, larger));
    }
  }

  // The root of g loses the smaller of lam and w where they differ by 1e16, and what `finish` makes of a large force, or
  // that loss, is carried into other rows by large entries of F. Newton on lam o (F lam + q) = eps itself, from a point
  // that is nearly there, mends it: (diag(w) + diag(lam) F) dlam = eps - lam o (F lam + q), by rows in parts of lam + w.
  DIFFLCS_INLINE void polish(Vec* lam_out, Vec* w_out, Vec eps, Mask skip) {
    const int64_t n = size();
    Vec before = all(1e300);
    for (int iteration = 0; iteration < 4; iteration++) {
      slack(lam_out, step);
      Vec missed = all(0);
      for (int64_t i = 0; i < n; i++) {
        step[i] = eps - lam_out[i] * step[i];
        missed = max(missed, abs(step[i]) / eps);
      }
      if (!lu.pivot && !any((missed > kMissed) & (missed < 0.5 * before))) break;
      before = missed;
      eliminate([&](int64_t i) {
        const Vec unit = 1.0 / (lam_out[i] + w_out[i]);
        step[i] *= unit;
        return Row{w_out[i] * unit, lam_out[i] * unit};
      });
      Mask keep = skip;  // a step that would leave the interior, or is not a number
      for (int64_t i = 0; i < n; i++) keep |= ~(abs(step[i]) <= 0.5 * lam_out[i]);
      for (int64_t i = 0; i < n; i++) {
        lam_out[i] = select(keep, lam_out[i], lam_out[i] + step[i]);
        w_out[i] = select(keep, w_out[i], eps / lam_out[i]);
      }
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
