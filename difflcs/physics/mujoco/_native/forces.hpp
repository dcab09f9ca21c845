// Small dense systems of a state: motion along rows, and forces between bounds.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>  // which says whether there is glibc
#include <utility>
#include <vector>

// Of a function with all that it calls there is one for each instruction set, chosen when the library is loaded.
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define DIFFLCS_CLONES __attribute__((target_clones("avx512f", "avx2", "default"), flatten))
#define DIFFLCS_VERSIONS
#else
#define DIFFLCS_CLONES
#endif

namespace difflcs::physics {

constexpr double kTiny = 1e-300;     // beside a divisor that may be zero
constexpr double kLeft = 0.1;        // of the derivative along a direction, that may be left where it ends
constexpr double kSlight = 1e-13;    // of the terms of a sum: rounding
constexpr int kMostSets = 200;       // of active sets; about five are needed
constexpr int kPatience = 4;         // sets that need not be better than the best so far

template <class T>
bool is_zero(const T* row, int n) {
  return std::all_of(row, row + n, [](T x) { return x == 0; });
}

inline double dot(const double* a, const double* b, int n) {
  typedef double Two __attribute__((vector_size(16), aligned(8), may_alias));
  const auto two = [](const double* from) { return *reinterpret_cast<const Two*>(from); };
  double sums[8] = {}, sum = 0;  // side by side
  Two one{}, other{};
  int k = 0;
  for (; n >= 16 && k + 8 <= n; k += 8)
    for (int l = 0; l < 8; l++) sums[l] += a[k + l] * b[k + l];
  for (int l = 0; n >= 16 && l < 4; l++) sum += sums[l] + sums[l + 4];
  for (; k + 4 <= n; k += 4) {
    one += two(a + k) * two(b + k);
    other += two(a + k + 2) * two(b + k + 2);
  }
  one += other;
  for (; k < n; k++) sum += a[k] * b[k];
  return sum + (one[0] + one[1]);
}

// into += factor · row: what a compiler can do side by side.
inline void add(double factor, const double* row, int n, double* __restrict into) {
  for (int k = 0; k < n; k++) into[k] += factor * row[k];
}

// So many columns of a row times a matrix (·, m), by `kSide` side by side, of `count` numbers, or of `some`.
template <int kSide, int kTimes>
void multiply_columns(const double* row, const int* some, int count, const double* matrix, int m, double* into) {
  typedef double Side __attribute__((vector_size(8 * kSide), aligned(8), may_alias));
  Side sums[kTimes]{};
  for (int c = 0; c < count; c++) {
    const int v = some == nullptr ? c : some[c];
    for (int k = 0; k < kTimes; k++) sums[k] += row[v] * *reinterpret_cast<const Side*>(matrix + v * m + kSide * k);
  }
  for (int k = 0; k < kTimes; k++) *reinterpret_cast<Side*>(into + kSide * k) = sums[k];
}

// into (rows, m) = a (rows, n) times a matrix (n, m), with so many numbers from a row of a to the next. A row of contacts
// is mostly zeros: where it is long, the others are listed.
template <int kSide>
void multiply_by(const double* a, const double* matrix, int rows, int n, int m, double* into, int next) {
  constexpr int kFew = 16, kMany = 256;
  int list[kMany];
  for (int i = 0; i < rows; i++, a += next, into += m) {
    int k = 0, count = n >= kFew && n <= kMany ? n - static_cast<int>(std::count(a, a + n, 0.0)) : n;
    const int* some = 2 * count > n ? nullptr : list;
    if (some == nullptr) count = n;
    for (int v = 0, c = 0; c < count && some != nullptr; v++) {
      list[c] = v;
      c += a[v] != 0;
    }
    for (; k + 4 * kSide <= m; k += 4 * kSide) multiply_columns<kSide, 4>(a, some, count, matrix + k, m, into + k);
    for (; k + 2 * kSide <= m; k += 2 * kSide) multiply_columns<kSide, 2>(a, some, count, matrix + k, m, into + k);
    for (; k < m && m >= kSide; k += kSide) {  // at last some that are there already
      k = std::min(k, m - kSide);
      multiply_columns<kSide, 1>(a, some, count, matrix + k, m, into + k);
    }
    for (; k < m; k++) multiply_columns<1, 1>(a, some, count, matrix + k, m, into + k);
  }
}

#ifdef DIFFLCS_VERSIONS
__attribute__((target("avx2"), flatten)) static void multiply(const double* a, const double* matrix, int rows, int n,
                                                              int m, double* into, int next) {
  multiply_by<4>(a, matrix, rows, n, m, into, next);
}
__attribute__((target("default"), flatten))
#endif
static void multiply(const double* a, const double* matrix, int rows, int n, int m, double* into, int next) {
  multiply_by<2>(a, matrix, rows, n, m, into, next);
}

inline void multiply(const double* a, const double* matrix, int rows, int n, int m, double* into) {
  multiply(a, matrix, rows, n, m, into, n);
}

// Overwrites b (n, m) by M⁻¹ b and M (n, n) by its factors, with row exchanges; false where M is singular.
inline bool solve_dense(double* M, int n, double* b, int m) {
  for (int c = 0; c < n; c++) {
    int pivot = c;
    for (int i = c + 1; i < n; i++)
      if (std::fabs(M[i * n + c]) > std::fabs(M[pivot * n + c])) pivot = i;
    if (!(std::fabs(M[pivot * n + c]) > 0)) return false;
    if (pivot != c) {
      std::swap_ranges(M + c * n + c, M + c * n + n, M + pivot * n + c);
      std::swap_ranges(b + c * m, b + c * m + m, b + pivot * m);
    }
    for (int i = c + 1; i < n; i++) {
      const double factor = -M[i * n + c] / M[c * n + c];
      if (factor == 0) continue;
      add(factor, M + c * n + c + 1, n - c - 1, M + i * n + c + 1);
      add(factor, b + c * m, m, b + i * m);
    }
  }
  for (int i = n - 1; i >= 0; i--) {
    for (int j = i + 1; j < n; j++) add(-M[i * n + j], b + j * m, m, b + i * m);
    for (int k = 0; k < m; k++) b[i * m + k] /= M[i * n + i];
  }
  return true;
}

// Finds λ between bounds with w = q + F λ, for a P-matrix F (n, n): w is zero where λ is within them, and at a bound of
// the sign that presses λ against it. Newton's method by the set of those within. Where it goes round in circles, one of
// them changes at a time (J. J. Júdice and F. M. Pires, Comput. Oper. Res. 21, 1994).
//
// With F = K Kᵀ + c it is λ = clip(−(q + K s)/c, low, high) where s − Kᵀ λ is zero, the gradient of a strictly convex
// function of s = Kᵀ μ. Along each direction it goes no farther than to where that is least, and so ends in few steps.
class ActiveSet {
 public:
  // Begins at λ: with the set of those within their bounds there, or with μ = λ if c > 0. False where rounding leaves no
  // such set.
  DIFFLCS_CLONES bool solve(const double* F, const double* q, const double* low, const double* high, double c, int n,
                            double* lam) {
    side_.resize(n);
    y_.resize(n);
    dy_.resize(n);
    mu_.assign(lam, lam + n);
    if (c > 0) gaps(F, q, lam, true, n);
    for (int i = 0; i < n; i++) {
      if (c > 0) y_[i] = w_[i] - c * lam[i];
      side_[i] = c > 0 ? side(y_[i], c, low[i], high[i]) : (lam[i] >= high[i]) - (lam[i] <= low[i]);
    }
    int fewest = n + 1, patience = kPatience;
    for (int step = 0; step < kMostSets; step++) {
      find(F, q, low, high, n, lam);
      if (!solve_dense(M_.data(), static_cast<int>(part_.size()), part_.data(), 1)) return false;
      for (size_t i = 0; i < part_.size(); i++) lam[within_[i]] = part_[i];
      wrong_.clear();
      gaps(F, q, lam, c > 0, n);
      for (int i = 0; i < n; i++) {
        const double *row = F + i * n, w = side_[i] == 0 ? 0.0 : w_[i];
        const double off = side_[i] == 0 ? std::max(low[i] - lam[i], lam[i] - high[i]) * row[i] : side_[i] * w;
        if (!(off <= 0) && !(off <= kSlight * (std::fabs(q[i]) + terms(row, lam, n)))) wrong_.push_back(i);
        dy_[i] = w - c * lam[i] - y_[i];
      }
      const int count = static_cast<int>(wrong_.size());
      if (count == 0) break;
      if (c > 0) {
        const double length = search(lam, low, high, c, n);
        for (int i = 0; i < n; i++) {
          y_[i] += length * dy_[i];
          mu_[i] += length * (lam[i] - mu_[i]);
          side_[i] = side(y_[i], c, low[i], high[i]);
        }
        continue;
      }
      patience = count < fewest ? kPatience : patience - 1;
      fewest = std::min(count, fewest);
      for (int k = patience >= 0 ? 0 : count - 1; k < count; k++) {
        const int i = wrong_[k];
        side_[i] = side_[i] != 0 ? 0 : lam[i] > high[i] ? 1 : -1;
      }
    }
    for (int i = 0; i < n; i++) lam[i] = std::clamp(lam[i], low[i], high[i]);
    return wrong_.empty();
  }

 private:
  // Write q + F λ; of a symmetric F by its columns, as λ is mostly zeros.
  void gaps(const double* F, const double* q, const double* lam, bool symmetric, int n) {
    w_.assign(q, q + n);
    for (int i = 0; i < n; i++) {
      if (symmetric && lam[i] != 0) add(lam[i], F + i * n, n, w_.data());
      if (!symmetric) w_[i] += dot(F + i * n, lam, n);
    }
  }

  static double terms(const double* row, const double* lam, int n) {
    double sum = 0;
    for (int k = 0; k < n; k++) sum += std::fabs(row[k] * lam[k]);
    return sum;
  }

  static int side(double y, double c, double low, double high) { return (y <= -c * high) - (y >= -c * low); }

  // How far to go from μ to λ: all the way, or to where the derivative along it, which grows, is nearly zero.
  double search(const double* lam, const double* low, const double* high, double c, int n) const {
    const double by = -1 / c;
    const auto slope = [&](double t) {
      double sum = 0;
      for (int i = 0; i < n; i++)
        sum += dy_[i] * (mu_[i] + t * (lam[i] - mu_[i]) - std::clamp((y_[i] + t * dy_[i]) * by, low[i], high[i]));
      return sum;
    };
    const double enough = kLeft * std::fabs(slope(0.0));
    double less = 0.0, more = 1.0, middle = 1.0;
    for (int k = 0; k < 40; k++) {
      const double there = slope(middle);
      if (there < enough && (k == 0 || there > -enough)) break;
      (there > 0 ? more : less) = middle;
      middle = 0.5 * (less + more);
    }
    return middle;
  }

  // Write those on a bound to λ, and the equations of the others.
  void find(const double* F, const double* q, const double* low, const double* high, int n, double* lam) {
    within_.clear();
    for (int i = 0; i < n; i++) {
      lam[i] = side_[i] == 0 ? 0.0 : side_[i] > 0 ? high[i] : low[i];
      if (side_[i] == 0) within_.push_back(i);
    }
    const bool zero = is_zero(lam, n);
    M_.resize(within_.size() * within_.size());
    part_.clear();
    double* into = M_.data();
    for (const int i : within_) {
      for (const int j : within_) *into++ = F[i * n + j];
      part_.push_back(-q[i] - (zero ? 0.0 : dot(F + i * n, lam, n)));
    }
  }

  std::vector<int> side_, within_, wrong_;
  std::vector<double> M_, part_, y_, dy_, mu_, w_;
};

}  // namespace difflcs::physics
