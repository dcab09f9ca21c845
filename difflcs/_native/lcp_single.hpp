// One LCP at a time, in plain doubles, with row exchanges: large problems, and those that lcp.cpp gave up.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// One problem in scaled units: F' = S F S with unit diagonal, q' = S q / unit, lam = unit S lam', w = unit S^-1 w'.
struct LcpOne {
  static constexpr int64_t kPanel = 8;
  const LcpBatch& batch;
  const int64_t e, n;
  const Watch watch;
  double *F, *M, *scale, *q, *lam, *w, *x, *y, *step, *rows, *active, *path, *gap, *best;
  double unit, relaxation;  // relaxation in scaled units
  double least;             // how far `best` is from a solution

  static int64_t scratch(int64_t n) { return (2 * n * n + 12 * n) * int64_t(sizeof(double)); }

  LcpOne(const LcpBatch& batch, int64_t e, void* scratch, Watch watch) : batch(batch), e(e), n(batch.n), watch(watch) {
    double* memory = static_cast<double*>(scratch);
    auto take = [&](int64_t count) {
      double* at = memory;
      memory += count;
      return at;
    };
    F = take(n * n);
    M = take(n * n);
    double** const vectors[] = {&scale, &q, &lam, &w, &x, &y, &step, &rows, &active, &path, &gap, &best};
    for (double** vector : vectors) *vector = take(n);
    const double *from = batch.F + e * batch.F_stride, *right = batch.q + e * n;
    unit = __builtin_sqrt(batch.relaxation);
    for (int64_t i = 0; i < n; i++) {
      const double diagonal = from[i * n + i];
      scale[i] = diagonal > 0 ? 1.0 / __builtin_sqrt(diagonal) : 1.0;
      const double size = __builtin_fabs(right[i] * scale[i]);
      unit = size > unit ? size : unit;
    }
    if (!(unit > 0)) unit = 1.0;
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++) F[i * n + j] = from[i * n + j] * scale[i] * scale[j];
      q[i] = right[i] * scale[i] / unit;
    }
    relaxation = batch.relaxation / unit / unit;
    for (int64_t i = 0; i < n; i++) best[i] = 0.0;
    least = __builtin_inf();
    remember(best);
  }

  // LU of the m x m matrix M, in place, with row exchanges; kPanel columns at a time, so that a large matrix is read
  // once for all of them. Not that of lu.hpp: it divides by the pivots, one rounding less than to multiply by their
  // reciprocals, and the violation loss of a model under training is solved here often enough for that to show.
  DIFFLCS_NOINLINE bool factor(int64_t m) {
    for (int64_t k = 0; k < m && !watch.stop(watch.context); k += kPanel) {
      const int64_t end = k + kPanel < m ? k + kPanel : m;
      for (int64_t c = k; c < end; c++) {
        int64_t pivot = c;
        for (int64_t i = c + 1; i < m; i++)
          if (__builtin_fabs(M[i * m + c]) > __builtin_fabs(M[pivot * m + c])) pivot = i;
        rows[c] = double(pivot);
        if (!(__builtin_fabs(M[pivot * m + c]) > 0)) return false;
        for (int64_t j = 0; pivot != c && j < m; j++) {
          const double t = M[c * m + j];
          M[c * m + j] = M[pivot * m + j];
          M[pivot * m + j] = t;
        }
        for (int64_t i = c + 1; i < m; i++) {
          const double l = M[i * m + c] /= M[c * m + c];
          for (int64_t j = c + 1; j < end; j++) M[i * m + j] -= l * M[c * m + j];
        }
      }
      if (end == m) return true;
      for (int64_t i = k + 1; i < m; i++) {
        double l[kPanel];
        for (int64_t c = 0; c < kPanel; c++) l[c] = k + c < i ? M[i * m + k + c] : 0.0;
        const double* __restrict above = M + k * m;
        double* __restrict row = M + i * m;
        if (i < end)
          for (int64_t c = 0; c < i - k; c++)
            for (int64_t j = end; j < m; j++) row[j] -= l[c] * above[c * m + j];
        else
          for (int64_t j = end; j < m; j++) {
            double t = row[j];
            DIFFLCS_UNROLL
            for (int64_t c = 0; c < kPanel; c++) t -= l[c] * above[c * m + j];
            row[j] = t;
          }
      }
    }
    return false;
  }
  DIFFLCS_NOINLINE void back(int64_t m, double* b) const {
    for (int64_t k = 0; k < m; k++) {
      const int64_t other = int64_t(rows[k]);
      const double t = b[k];
      b[k] = b[other];
      b[other] = t;
    }
    for (int64_t i = 0; i < m; i++)
      for (int64_t j = 0; j < i; j++) b[i] -= M[i * m + j] * b[j];
    for (int64_t i = m - 1; i >= 0; i--) {
      for (int64_t j = i + 1; j < m; j++) b[i] -= M[i * m + j] * b[j];
      b[i] /= M[i * m + i];
    }
  }

  // F' v + q' in row i, and the sizes of its terms. `Sum`: long double where a last step is corrected by it.
  template <class Sum = double>
  double slack(int64_t i, const double* v, double* terms) const {
    Sum value = q[i];
    *terms = __builtin_fabs(value);
    for (int64_t j = 0; j < n; j++) {
      const Sum t = Sum(F[i * n + j]) * v[j];
      value += t;
      *terms += __builtin_fabs(double(t));
    }
    return double(value);
  }

  // Writes lam and w in the caller's units if they hold by the bounds of kernels.hpp.
  DIFFLCS_NOINLINE bool store() const {
    double largest = 0;
    const double root = __builtin_sqrt(relaxation);
    for (int64_t i = 0; i < n; i++) {
      const double size = (__builtin_fabs(q[i]) + root) * unit / scale[i];
      largest = size > largest ? size : largest;
    }
    for (int64_t i = 0; i < n; i++) {
      double terms;
      const double missed = __builtin_fabs(slack(i, lam, &terms) - w[i]);
      const double force = lam[i] * unit * scale[i], gap = w[i] * unit / scale[i];
      const double total = missed + kRounding * terms;
      const bool held = missed <= kLcpTerms * terms && total <= kLcpData * (1 + root) &&
                        total * unit / scale[i] <= kLcpData * largest;
      const bool sane = force >= 0 && force <= kLargest && gap >= 0 && gap <= kLargest &&
                        scale[i] * scale[i] * kSmallest <= 1 && scale[i] * scale[i] >= kSmallest;
      if (!held || !sane) return false;
    }
    write();
    return true;
  }

  void write() const {
    for (int64_t i = 0; i < n; i++) {
      batch.lam[e * n + i] = lam[i] * (unit * scale[i]);
      batch.w[e * n + i] = w[i] * (unit / scale[i]);
    }
  }

  // Keeps the positive part of v if it is nearer to a solution, by the residual of Chen-Harker-Kanzow-Smale.
  DIFFLCS_NOINLINE void remember(const double* v) {
    double terms, distance = 0;
    for (int64_t i = 0; i < n; i++) x[i] = v[i] > 0 ? v[i] : 0.0;
    for (int64_t i = 0; i < n; i++) {
      const double other = slack(i, x, &terms), between = x[i] - other;
      distance += __builtin_fabs(x[i] + other - __builtin_sqrt(between * between + 4 * relaxation));
    }
    if (!(distance < least)) return;
    least = distance;
    for (int64_t i = 0; i < n; i++) best[i] = x[i];
  }

  // Principal pivoting from the set `active` of positive lam: solve for them, exchange every index whose lam or w came
  // out negative, until five exchanges have not lowered their number (Kostreva; Judice & Pires). Or, `murty`, exchange
  // the first of them alone, which is finite for every P-matrix and indifferent to degeneracy.
  bool pivot(int64_t limit, bool murty) {
    int64_t fewest = n + 1;
    int patience = 5;
    for (int64_t it = 0; it < limit && patience > 0 && !watch.stop(watch.context); it++) {
      int64_t m = 0, wrong = 0;
      auto solve = [&] {  // step, for the active rows, which it gathers and scatters
        int64_t k = 0;
        for (int64_t i = 0; i < n; i++)
          if (active[i] != 0) y[k++] = step[i];
        back(m, y);
        k = 0;
        for (int64_t i = 0; i < n; i++)
          if (active[i] != 0) lam[i] += y[k++];
      };
      for (int64_t i = 0; i < n; i++) {
        if (active[i] != 0) x[m++] = double(i);
        lam[i] = 0.0;
        step[i] = -q[i];
      }
      for (int64_t i = 0; i < m; i++)
        for (int64_t j = 0; j < m; j++) M[i * m + j] = F[int64_t(x[i]) * n + int64_t(x[j])];
      if (m > 0 && !factor(m)) return false;
      solve();
      for (int refinement = 0; refinement < 2; refinement++) {
        double terms;
        for (int64_t i = 0; i < n; i++)
          if (active[i] != 0) step[i] = -slack<long double>(i, lam, &terms);
        solve();
      }
      for (int64_t i = 0; i < n; i++) {
        double terms;
        w[i] = slack(i, lam, &terms);
        if ((active[i] != 0 ? lam[i] : w[i]) >= -1e-12 * terms) continue;
        if (!murty || wrong == 0) active[i] = 2.0 + active[i];
        wrong++;
      }
      if (wrong == 0) {
        for (int64_t i = 0; i < n; i++) {
          lam[i] = lam[i] > 0 ? lam[i] : 0.0;
          w[i] = active[i] != 0 || !(w[i] > 0) ? 0.0 : w[i];
        }
        return store();
      }
      remember(lam);
      for (int64_t i = 0; i < n; i++) active[i] = active[i] < 2 ? active[i] : 3.0 - active[i];
      if (wrong < fewest) {
        fewest = wrong;
        patience = 5;
      } else
        patience -= !murty;
    }
    return false;
  }

  // Infeasible interior-point method from `path` and `gap`: Newton on gap = F path + q, path o gap = mu, with mu
  // falling to `target` and steps that keep both positive. For F + F^T positive definite it converges from any start.
  // Returns whether it stored a solution with a relaxation; without one it ends where the mean product is below the
  // target.
  bool interior(double target) {
    int at_target = 0;
    for (int it = 0; it < 300 && at_target < 12 && !watch.stop(watch.context); it++) {
      double product = 0, smallest = __builtin_inf();
      for (int64_t i = 0; i < n; i++) {
        const double t = path[i] * gap[i];
        product += t / double(n);
        smallest = t < smallest ? t : smallest;
      }
      if (relaxation == 0 && product <= target) return false;
      // A centred point shortens the path, one next to the border is centred first.
      double mu = smallest > 0.1 * product ? 0.1 * product : 0.8 * product;
      if (relaxation > 0 && (!(mu > target) || it > 250)) mu = target;
      // gap dpath + path dgap = mu - path o gap and dgap = F dpath + missed:
      // (diag(gap) + diag(path) F) dpath = mu - path o (gap + missed).
      for (int64_t i = 0; i < n; i++) {
        double terms;
        y[i] = (at_target > 0 ? slack<long double>(i, path, &terms) : slack(i, path, &terms)) - gap[i];
        x[i] = mu - path[i] * (gap[i] + y[i]);
        for (int64_t j = 0; j < n; j++) M[i * n + j] = path[i] * F[i * n + j];
        M[i * n + i] += gap[i];
      }
      if (!factor(n)) break;
      back(n, x);
      double length = 1.0;
      for (int64_t i = 0; i < n; i++) {
        double change = y[i];
        for (int64_t j = 0; j < n; j++) change += F[i * n + j] * x[j];
        step[i] = change;
        if (x[i] < 0 && -0.9 * path[i] / x[i] < length) length = -0.9 * path[i] / x[i];
        if (change < 0 && -0.9 * gap[i] / change < length) length = -0.9 * gap[i] / change;
      }
      for (int64_t i = 0; i < n; i++) {
        path[i] += length * x[i];
        gap[i] += length * step[i];
      }
      remember(path);
      // Newton converges quadratically from here; where rounding is large, some iterates are better than others.
      if (mu == target && length == 1.0 && ++at_target > 5 && on_path()) return true;
    }
    return relaxation > 0 && on_path();
  }

  // Pivoting alone is fast where few exchanges are needed; else it begins next to the solution, where the interior
  // point's lam exceed its w. Murty's rule solves the rest in finite time.
  bool exact() {
    for (int64_t i = 0; i < n; i++) active[i] = q[i] < 0;
    if (pivot(40, false)) return true;
    const double targets[] = {1e-8, 1e-11, 1e-14};
    for (const double target : targets) {
      interior(target);
      for (int64_t i = 0; i < n; i++) active[i] = path[i] > gap[i];
      if (pivot(40, false)) return true;
    }
    for (int64_t i = 0; i < n; i++) active[i] = 0;
    return pivot(int64_t{1} << (n + 2 < 16 ? n + 2 : 16), true);
  }

  // lam o w = relaxation exactly: from the larger of the two.
  bool on_path() {
    for (int64_t i = 0; i < n; i++) {
      lam[i] = path[i] > gap[i] ? path[i] : relaxation / gap[i];
      w[i] = path[i] > gap[i] ? relaxation / path[i] : gap[i];
    }
    return store();
  }
};

inline void lcp_single(const LcpBatch& batch, int64_t e, void* scratch, Watch watch) {
  LcpOne p(batch, e, scratch, watch);
  for (int64_t i = 0; i < p.n; i++) p.path[i] = p.gap[i] = p.relaxation > 1 ? __builtin_sqrt(p.relaxation) : 1.0;
  Status status = Status::converged;
  const bool finite = p.least < __builtin_inf();  // else no step helps
  if (!finite || !(batch.relaxation > 0 ? p.interior(p.relaxation) : p.exact())) {
    double terms;
    for (int64_t i = 0; i < p.n; i++) p.lam[i] = p.best[i];
    for (int64_t i = 0; i < p.n; i++) p.w[i] = p.slack(i, p.best, &terms);
    p.write();
    status = watch.stop(watch.context) ? Status::max_iter : Status::numerical;
  }
  batch.status[e] = static_cast<int8_t>(status);
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
