// Forces between bounds on soft rows: a complementarity problem whose matrix is of low rank, beside the compliance.
//
// The forces are λ = clip(−(q + J z)/c, low, high), with the motion z = R Jᵀ λ that they bring about. With R = L Lᵀ,
// z = L s and K = J L, s is where a strictly convex function, quadratic in pieces, is least; its gradient is s − Kᵀ λ.
// Newton's method with exact steps along its directions finds it in finitely many, each as large as s.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

namespace difflcs::physics {

constexpr int kMostSteps = 200;  // of Newton's method; about ten are needed

class SoftForces {
 public:
  // For so many rows and degrees of freedom.
  SoftForces(int rows, int dofs)
      : m_(rows), n_(dofs), L_(n_ * n_), K_(m_ * n_), H_(n_ * n_), s_(n_), way_(n_), y_(m_), dy_(m_), inside_(m_) {}

  // Write the forces (m) for J (m, n), R (n, n), q, low and high (m), and a compliance. False: not found.
  bool solve(const double* J, const double* R, const double* q, double compliance, const double* low,
             const double* high, double* force) {
    factor(R);
    std::fill(K_.begin(), K_.end(), 0.0);
    for (int i = 0; i < m_; i++)
      for (int k = 0; k < n_; k++)
        if (J[i * n_ + k] != 0) add(J[i * n_ + k], &L_[k * n_], k + 1, &K_[i * n_]);
    c_ = compliance;
    low_ = low;
    high_ = high;
    std::fill(s_.begin(), s_.end(), 0.0);
    std::copy_n(q, m_, y_.begin());
    bool found = false;
    for (int step = 0; step < kMostSteps; step++) {
      for (int i = 0; i < m_; i++) inside_[i] = y_[i] > -c_ * high[i] && y_[i] < -c_ * low[i];
      direct();
      const double length = found ? 1.0 : search();
      for (int j = 0; j < n_; j++) s_[j] += length * way_[j];
      bool same = length == 1.0;
      for (int i = 0; i < m_; i++) {
        y_[i] = q[i];
        for (int j = 0; j < n_; j++) y_[i] += K_[i * n_ + j] * s_[j];
        same = same && inside_[i] == (y_[i] > -c_ * high[i] && y_[i] < -c_ * low[i]);
      }
      if (found) break;  // a second step, for what rounding left
      // Rounding may move rows that are on a bound in and out for ever.
      found = same || size(way_) <= 1e-13 * size(s_);
    }
    for (int i = 0; i < m_; i++) force[i] = clip(i, y_[i]);
    return found;
  }

 private:
  static double size(const std::vector<double>& v) {
    double most = 0;
    for (const double x : v) most = std::max(most, std::fabs(x));
    return most;
  }

  double clip(int i, double y) const { return std::clamp(-y / c_, low_[i], high_[i]); }

  // into += factor · row, of so many numbers: what a compiler can do side by side.
  static void add(double factor, const double* row, int count, double* __restrict into) {
    for (int k = 0; k < count; k++) into[k] += factor * row[k];
  }

  // Overwrite the upper triangle of H by U with Uᵀ U = H, with rows of zeros where pivots are no more than `least`.
  void factor_upper(double least) {
    for (int j = 0; j < n_; j++) {
      double* row = &H_[j * n_];
      const double root = row[j] > least ? std::sqrt(row[j]) : 0.0;
      for (int k = j; k < n_; k++) row[k] = root > 0 ? row[k] / root : 0.0;
      for (int i = j + 1; i < n_; i++)
        if (row[i] != 0) add(-row[i], row + i, n_ - i, &H_[i * n_ + i]);
    }
  }

  // R = L Lᵀ.
  void factor(const double* R) {
    std::copy_n(R, n_ * n_, H_.begin());
    double most = 0;
    for (int j = 0; j < n_; j++) most = std::max(most, R[j * n_ + j]);
    factor_upper(1e-15 * most);
    for (int j = 0; j < n_; j++)
      for (int i = j; i < n_; i++) L_[i * n_ + j] = H_[j * n_ + i];
  }

  // Newton's direction: (1 + Kᵀ K/c over the rows inside) way = Kᵀ λ − s.
  void direct() {
    for (int j = 0; j < n_; j++) {
      way_[j] = -s_[j];
      std::fill_n(&H_[j * n_ + j], n_ - j, 0.0);
      H_[j * n_ + j] = 1.0;
    }
    for (int i = 0; i < m_; i++) {
      const double* row = &K_[i * n_];
      const double force = clip(i, y_[i]);
      if (force != 0) add(force, row, n_, way_.data());
      for (int j = 0; inside_[i] && j < n_; j++)
        if (row[j] != 0) add(row[j] / c_, row + j, n_ - j, &H_[j * n_ + j]);
    }
    factor_upper(0.0);
    for (int j = 0; j < n_; j++) {
      way_[j] /= H_[j * n_ + j];
      add(-way_[j], &H_[j * n_ + j] + 1, n_ - j - 1, &way_[j] + 1);
    }
    for (int j = n_ - 1; j >= 0; j--) {
      for (int k = j + 1; k < n_; k++) way_[j] -= H_[j * n_ + k] * way_[k];
      way_[j] /= H_[j * n_ + j];
    }
    for (int i = 0; i < m_; i++) {
      dy_[i] = 0;
      for (int j = 0; j < n_; j++) dy_[i] += K_[i * n_ + j] * way_[j];
    }
  }

  // How far to go: all the way, or to where the derivative along it, which grows, is zero.
  double search() const {
    double along = 0, square = 0;
    for (int j = 0; j < n_; j++) {
      along += s_[j] * way_[j];
      square += way_[j] * way_[j];
    }
    const auto slope = [&](double t) {
      double sum = along + t * square;
      for (int i = 0; i < m_; i++) sum -= dy_[i] * clip(i, y_[i] + t * dy_[i]);
      return sum;
    };
    if (!(slope(1.0) > 1e-12 * square)) return 1.0;
    double less = 0.0, more = 1.0;
    for (int k = 0; k < 40; k++) {
      const double middle = 0.5 * (less + more);
      (slope(middle) > 0 ? more : less) = middle;
    }
    return less > 0 ? less : more;
  }

  const int m_, n_;
  double c_ = 1;
  const double *low_ = nullptr, *high_ = nullptr;
  std::vector<double> L_, K_, H_, s_, way_, y_, dy_;
  std::vector<char> inside_;
};

}  // namespace difflcs::physics
