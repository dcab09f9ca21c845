// One LCP at a time, slowly, with row exchanges: where the batched kernel (lcp.cpp) gave up. Plain doubles, no lanes.
#pragma once
#include "kernels.hpp"

namespace difflcs {
namespace {

inline int64_t lcp_one_scratch(int64_t n) { return 2 * n * n + 10 * n; }

// One problem in scaled units: F' = S F S with unit diagonal, q' = S q / unit, lam = unit S lam', w = unit S^-1 w'.
struct LcpOne {
  const int64_t n;
  double *F, *M, *scale, *q, *lam, *w, *x, *y, *step, *rows, *active;
  double unit, relaxation;  // relaxation in scaled units

  LcpOne(const LcpBatch& batch, int64_t e, double* memory) : n(batch.n) {
    auto take = [&](int64_t count) {
      double* at = memory;
      memory += count;
      return at;
    };
    F = take(n * n), M = take(n * n), scale = take(n), q = take(n), lam = take(n), w = take(n), x = take(n);
    y = take(n), step = take(n), rows = take(n), active = take(n);
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
  }

  // LU of M, in place. Not that of lu.hpp: it divides by the pivots, which is one rounding less than to multiply by
  // their reciprocals, and the violation loss of a model under training is solved here often enough for that to show.
  bool factor() {
    for (int64_t k = 0; k < n; k++) {
      int64_t pivot = k;
      for (int64_t i = k + 1; i < n; i++)
        if (__builtin_fabs(M[i * n + k]) > __builtin_fabs(M[pivot * n + k])) pivot = i;
      rows[k] = double(pivot);
      if (!(__builtin_fabs(M[pivot * n + k]) > 0)) return false;
      for (int64_t j = 0; pivot != k && j < n; j++) {
        const double t = M[k * n + j];
        M[k * n + j] = M[pivot * n + j], M[pivot * n + j] = t;
      }
      for (int64_t i = k + 1; i < n; i++) {
        const double l = M[i * n + k] /= M[k * n + k];
        for (int64_t j = k + 1; j < n; j++) M[i * n + j] -= l * M[k * n + j];
      }
    }
    return true;
  }
  void back(double* b) const {
    for (int64_t k = 0; k < n; k++) {
      const int64_t other = int64_t(rows[k]);
      const double t = b[k];
      b[k] = b[other], b[other] = t;
    }
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < i; j++) b[i] -= M[i * n + j] * b[j];
    for (int64_t i = n - 1; i >= 0; i--) {
      for (int64_t j = i + 1; j < n; j++) b[i] -= M[i * n + j] * b[j];
      b[i] /= M[i * n + i];
    }
  }

  // F' v + q' in row i, and the sizes of its terms.
  double slack(int64_t i, const double* v, double* terms) const {
    double value = q[i];
    *terms = __builtin_fabs(value);
    for (int64_t j = 0; j < n; j++) {
      const double t = F[i * n + j] * v[j];
      value += t, *terms += __builtin_fabs(t);
    }
    return value;
  }

  // Writes lam and w in the caller's units if they hold by the bounds of kernels.hpp.
  bool store(const LcpBatch& batch, int64_t e) const {
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
    for (int64_t i = 0; i < n; i++) {
      batch.lam[e * n + i] = lam[i] * (unit * scale[i]);
      batch.w[e * n + i] = w[i] * (unit / scale[i]);
    }
    return true;
  }
};

// Exact LCP by Murty's least-index method: finite for every P-matrix, indifferent to degeneracy.
bool lcp_exact_one(const LcpBatch& batch, int64_t e, double* memory, Watch watch) {
  LcpOne p(batch, e, memory);
  const int64_t n = p.n, limit = int64_t{1} << (n + 2 < 16 ? n + 2 : 16);
  for (int64_t i = 0; i < n; i++) p.active[i] = 0;
  for (int64_t it = 0; it < limit && !watch.stop(watch.context); it++) {
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++)
        p.M[i * n + j] = p.active[i] != 0 && p.active[j] != 0 ? p.F[i * n + j] : (i == j ? 1.0 : 0.0);
      p.lam[i] = p.active[i] != 0 ? -p.q[i] : 0.0;
    }
    if (!p.factor()) return false;
    p.back(p.lam);
    for (int refinement = 0; refinement < 2; refinement++) {
      double terms;
      for (int64_t i = 0; i < n; i++) p.step[i] = p.active[i] != 0 ? -p.slack(i, p.lam, &terms) : 0.0;
      p.back(p.step);
      for (int64_t i = 0; i < n; i++) p.lam[i] += p.step[i];
    }
    int64_t wrong = -1;
    for (int64_t i = 0; i < n && wrong < 0; i++) {
      double terms;
      p.w[i] = p.slack(i, p.lam, &terms);
      if (!((p.active[i] != 0 ? p.lam[i] : p.w[i]) >= -1e-12 * terms)) wrong = i;
    }
    if (wrong < 0) {
      for (int64_t i = 0; i < n; i++) {
        p.lam[i] = p.lam[i] > 0 ? p.lam[i] : 0.0;
        p.w[i] = p.active[i] != 0 || !(p.w[i] > 0) ? 0.0 : p.w[i];
      }
      return p.store(batch, e);
    }
    p.active[wrong] = 1 - p.active[wrong];
  }
  return false;
}

// Relaxed LCP by an infeasible interior-point method: Newton on w = F lam + q, lam o w = mu, with mu falling to the
// relaxation and steps that keep lam and w positive. For F + F^T positive definite it converges from any start.
bool lcp_relaxed_one(const LcpBatch& batch, int64_t e, double* memory, Watch watch) {
  LcpOne p(batch, e, memory);
  const int64_t n = p.n;
  const double target = p.relaxation;
  for (int64_t i = 0; i < n; i++) p.lam[i] = p.w[i] = target > 1 ? __builtin_sqrt(target) : 1.0;
  int at_target = 0;
  for (int it = 0; it < 300 && at_target < 8 && !watch.stop(watch.context); it++) {
    double product = 0, smallest = __builtin_inf();
    for (int64_t i = 0; i < n; i++) {
      const double t = p.lam[i] * p.w[i];
      product += t / double(n), smallest = t < smallest ? t : smallest;
    }
    // A centred point shortens the path, one next to the border is centred first.
    double mu = smallest > 0.1 * product ? 0.1 * product : 0.8 * product;
    if (!(mu > target) || it > 250) mu = target;
    // w dlam + lam dw = mu - lam o w and dw = F dlam + missed: (diag(w) + diag(lam) F) dlam = mu - lam o (w + missed).
    for (int64_t i = 0; i < n; i++) {
      double terms;
      p.y[i] = p.slack(i, p.lam, &terms) - p.w[i];
      p.x[i] = mu - p.lam[i] * (p.w[i] + p.y[i]);
      for (int64_t j = 0; j < n; j++) p.M[i * n + j] = p.lam[i] * p.F[i * n + j];
      p.M[i * n + i] += p.w[i];
    }
    if (!p.factor()) return false;
    p.back(p.x);
    double length = 1.0;
    for (int64_t i = 0; i < n; i++) {
      double dw = p.y[i];
      for (int64_t j = 0; j < n; j++) dw += p.F[i * n + j] * p.x[j];
      p.step[i] = dw;
      if (p.x[i] < 0 && -0.9 * p.lam[i] / p.x[i] < length) length = -0.9 * p.lam[i] / p.x[i];
      if (dw < 0 && -0.9 * p.w[i] / dw < length) length = -0.9 * p.w[i] / dw;
    }
    for (int64_t i = 0; i < n; i++) p.lam[i] += length * p.x[i], p.w[i] += length * p.step[i];
    if (mu == target && length == 1.0) at_target++;  // Newton converges quadratically from here
  }
  for (int64_t i = 0; i < n; i++)  // lam o w = relaxation exactly: from the larger of the two
    if (p.lam[i] > p.w[i])
      p.w[i] = target / p.lam[i];
    else
      p.lam[i] = target / p.w[i];
  return p.store(batch, e);
}

}  // namespace
}  // namespace difflcs
