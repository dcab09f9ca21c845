// Products, factors and eigenvectors of the dense matrices of a state.
#pragma once

#include <limits>

#include "forces.hpp"

namespace difflcs::physics {

constexpr double kDependent = 1e-9;                   // of the trace: contacts of one face are not independent
constexpr int kMostSquarings = 60, kMostSweeps = 60;  // for signs of eigenvalues, for one; about 7 and 2 are needed
constexpr double kGrown = 1e100, kVanished = 1e-3;    // powers whose limit is infinite, and zero

struct Matrix {  // row by row
  int rows = 0, columns = 0;
  std::vector<double> numbers;

  void read(const double* from, int n, int m) {
    rows = n;
    columns = m;
    numbers.assign(from, from + n * m);
  }
  void resize(int n, int m, double diagonal = 0.0) {  // of zeros beside it
    rows = n;
    columns = m;
    numbers.assign(n * m, 0.0);
    if (diagonal != 0) add_identity(diagonal);
  }
  void shape(int n, int m) {  // of any numbers
    rows = n;
    columns = m;
    numbers.resize(n * m);
  }
  void append(const double* row) {
    numbers.insert(numbers.end(), row, row + columns);
    rows++;
  }
  void pop() { numbers.resize(--rows * columns); }
  void add_identity(double factor = 1.0) {
    for (int i = 0; i < rows; i++) (*this)[i][i] += factor;
  }
  double* operator[](int row) { return numbers.data() + row * columns; }
  const double* operator[](int row) const { return numbers.data() + row * columns; }
};

// into = a b.
inline void multiply(const Matrix& a, const Matrix& b, Matrix& into) {
  into.shape(a.rows, b.columns);
  multiply(a[0], b[0], a.rows, b.rows, b.columns, into[0]);
}

// into = aᵀ b.
DIFFLCS_CLONES static void multiply_transposed(const Matrix& a, const Matrix& b, Matrix& into) {
  into.resize(a.columns, b.columns);
  for (int k = 0; k < a.rows; k++)
    for (int i = 0; i < a.columns; i++)
      if (a[k][i] != 0) add(a[k][i], b[k], b.columns, into[i]);
}

// into = a bᵀ.
DIFFLCS_CLONES static void multiply_rows(const Matrix& a, const Matrix& b, Matrix& into) {
  into.shape(a.rows, b.rows);
  for (int i = 0; i < a.rows; i++)
    for (int j = 0; j < b.rows; j++) into[i][j] = dot(a[i], b[j], a.columns);
}

// Overwrites b by M⁻¹ b, and M; infinite where M is singular.
DIFFLCS_CLONES static void solve(Matrix& M, Matrix& b) {
  if (!solve_dense(M[0], M.rows, b[0], b.columns)) b.numbers.assign(b.numbers.size(), INFINITY);
}

// Writes the motion (nv, m) by which rows (k, nv) move by (k, m), with the response R to forces along others (k, nv).
DIFFLCS_CLONES static void push_of(const double* R, const Matrix& rows, const Matrix& forces, Matrix by,
                                   Matrix& moved) {
  Matrix response, gives, inner;
  response.read(R, rows.columns, rows.columns);
  multiply_rows(forces, response, gives);
  multiply_rows(rows, gives, inner);
  double trace = 0;
  for (int i = 0; i < inner.rows; i++) trace += inner[i][i];
  inner.add_identity(trace > 0 ? kDependent * trace : 1.0);
  solve(inner, by);
  multiply_transposed(gives, by, moved);
}

// Overwrites a symmetric matrix by L of L Lᵀ; false where it is not positive definite.
DIFFLCS_CLONES static bool factor(Matrix& M) {
  for (int i = 0; i < M.rows; i++) {
    for (int j = 0; j <= i; j++) {
      const double left = M[i][j] - dot(M[i], M[j], j);
      if (i == j && !(left > 0)) return false;
      M[i][j] = i == j ? std::sqrt(left) : left / M[j][j];
    }
    std::fill(M[i] + i + 1, M[i] + M.rows, 0.0);
  }
  return true;
}

// into = L⁻¹ of a lower triangle.
DIFFLCS_CLONES static void invert_lower(const Matrix& L, Matrix& into) {
  into.resize(L.rows, L.rows, 1.0);
  for (int i = 0; i < L.rows; i++) {
    for (int j = 0; j < i; j++) add(-L[i][j], into[j], j + 1, into[i]);
    for (int j = 0; j <= i; j++) into[i][j] /= L[i][i];
  }
}

inline void rotate(double c, double s, double* __restrict one, double* __restrict two, int n) {
  for (int k = 0; k < n; k++) {
    const double along = one[k];
    one[k] = c * along + s * two[k];
    two[k] = c * two[k] - s * along;
  }
}

// Overwrites the lower triangle L by that of Lᵀ L + rowᵀ row, and the row by zeros.
DIFFLCS_CLONES static void add_square(double* row, Matrix& L) {
  for (int i = L.rows - 1; i >= 0; i--) {
    const double size = std::hypot(L[i][i], row[i]);
    rotate(L[i][i] / size, row[i] / size, L[i], row, i + 1);
  }
}

// Whether a matrix has an eigenvalue with a negative real part: then (s − M)(s + M)⁻¹ has one beyond one, and its
// powers grow. Overwrites both.
DIFFLCS_CLONES static bool has_negative(Matrix& M, Matrix& spare) {
  const auto size = [](const Matrix& of) { return std::sqrt(dot(of[0], of[0], of.rows * of.columns)); };
  const double s = size(M);
  spare.resize(M.rows, M.rows, 2 * s);
  M.add_identity(s);
  solve(M, spare);
  spare.add_identity(-1.0);
  for (int k = 0; k < kMostSquarings && !(size(spare) < kVanished); k++) {
    if (!(size(spare) < kGrown)) return true;
    multiply(spare, spare, M);
    std::swap(M, spare);
  }
  return false;
}

// Overwrites the symmetric part of a matrix by its eigenvectors, as rows, and writes the eigenvalues: reflections make
// it tridiagonal, and QL steps with implicit shifts diagonal (G. H. Golub and C. F. Van Loan, Matrix
// Computations, 8.3).
DIFFLCS_CLONES static void diagonalise(Matrix& M, std::vector<double>& values) {
  const int n = M.rows;
  Matrix V;
  V.resize(n, n, 1.0);
  std::vector<double> off(n), v(n), w(n);
  values.resize(n);
  for (int i = 0; i < n; i++)
    for (int j = 0; j < i; j++) M[i][j] = M[j][i] = 0.5 * (M[i][j] + M[j][i]);
  for (int k = 0; k < n; k++) {
    const int first = k + 1, size = n - first;
    values[k] = M[k][k];
    off[k] = size > 0 ? M[k][first] : 0.0;
    std::copy_n(M[k] + first, size, v.data());
    const double rest = size > 1 ? dot(&v[1], &v[1], size - 1) : 0.0;
    if (rest == 0) continue;
    off[k] = std::copysign(std::sqrt(v[0] * v[0] + rest), -v[0]);
    v[0] -= off[k];
    const double beta = 2 / (v[0] * v[0] + rest);
    for (int i = 0; i < size; i++) w[i] = beta * dot(M[first + i] + first, v.data(), size);
    add(-0.5 * beta * dot(v.data(), w.data(), size), v.data(), size, w.data());
    for (int i = 0; i < size; i++) {
      add(-v[i], w.data(), size, M[first + i] + first);
      add(-w[i], v.data(), size, M[first + i] + first);
    }
    multiply(v.data(), V[first], 1, size, n, w.data());
    for (int i = 0; i < size; i++) add(-beta * v[i], w.data(), n, V[first + i]);
  }
  const double tiny = std::numeric_limits<double>::epsilon();
  for (int l = 0; l < n; l++) {
    for (int sweep = 0; sweep < kMostSweeps; sweep++) {
      int end = l, i;
      while (end + 1 < n && std::fabs(off[end]) > tiny * (std::fabs(values[end]) + std::fabs(values[end + 1]))) end++;
      if (end == l) break;
      const double half = (values[l + 1] - values[l]) / (2 * off[l]), root = std::sqrt(half * half + 1);
      double g = values[end] - values[l] + off[l] / (half + std::copysign(root, half)), s = 1, c = 1, shift = 0;
      for (i = end - 1; i >= l; i--) {
        const double f = s * off[i], b = c * off[i];
        if ((off[i + 1] = std::sqrt(f * f + g * g)) == 0) break;
        s = f / off[i + 1];
        c = g / off[i + 1];
        const double before = values[i + 1] - shift, turned = (values[i] - before) * s + 2 * c * b;
        shift = s * turned;
        values[i + 1] = before + shift;
        g = c * turned - b;
        rotate(c, s, V[i + 1], V[i], n);
      }
      off[end] = 0;
      values[std::max(i + 1, l)] -= shift;
      if (i < l) off[l] = g;
    }
  }
  std::swap(M, V);
}

}  // namespace difflcs::physics
