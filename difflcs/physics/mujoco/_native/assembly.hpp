// The system of a state with Anitescu's cone, as `assemble_lcs` of complementarity.py makes it. A contact moves with few
// degrees of freedom, so its rows are mostly zeros, which are left out of each product.
#pragma once

#include "matrices.hpp"

namespace difflcs::physics {

constexpr double kRounding = 1e-12;  // of a trace, and of the largest of n sums: more than rounding

// What all states have in common. A force has rows: the rays of contacts, then the normals of those with a cap, then
// others, of which the last are bounded.
struct Layout {
  int nv, nx, nu, contacts, tangents, caps, others, bounded;
  double length, force, drag;

  int each() const { return tangents > 0 ? 2 * tangents : 1; }
  int rows() const { return contacts * each() + caps + others; }
  int forces() const { return rows() + bounded + caps; }
};

// Of a state, arrays as in `Readings.assemble`; without `turn`, `effect` and `rest` where there are none.
struct Given {
  const double *gap, *normal, *tangent, *friction, *turn, *A, *B, *d, *response, *x, *soft, *other_gap, *other_normal,
      *effect, *bound, *cap, *rest;
};

struct Matrices {
  double *C, *d, *D, *E, *F, *c;
};

// Writes the matrices of a state, zero before; false where only their numbers say whether they are finite, F + Fᵀ ≻ 0.
DIFFLCS_CLONES static bool assemble_state(const Layout& s, const Given& g, const Matrices& into) {
  const int nv = s.nv, nx = s.nx, rays = s.contacts * s.each(), m = s.rows(), all = s.forces(), first = m - s.bounded;
  std::vector<double> rows(m * nv), counted(m * nv), gap(m), soft(m), left(m * nv), right(nv * all);
  const auto put = [&](int i, const double* row, bool counts, double apart, double compliance) {
    std::copy_n(row, nv, &rows[i * nv]);
    if (counts) std::copy_n(row, nv, &counted[i * nv]);
    gap[i] = apart;
    soft[i] = compliance;
  };
  for (int k = 0; k < s.contacts; k++) {
    for (int r = 0; r < s.each(); r++) {
      const int i = k * s.each() + r;
      put(i, g.normal + k * nv, true, g.gap[k], g.soft[k]);
      const double friction = r % 2 == 0 ? g.friction[k] : -g.friction[k];
      if (s.tangents > 0) add(friction, g.tangent + (k * s.tangents + r / 2) * nv, nv, &rows[i * nv]);
    }
    if (k < s.caps) put(rays + k, g.normal + k * nv, true, g.gap[k], g.soft[k]);
  }
  for (int k = 0, i = rays + s.caps; k < s.others; k++, i++)
    put(i, g.other_normal + k * nv, i < first, g.other_gap[k], g.soft[s.contacts + k]);
  for (auto* of_rows : {&rows, &counted}) {
    if (g.turn == nullptr) break;
    multiply(of_rows->data(), g.turn, m, nv, nv, left.data());
    std::copy_n(left.data(), m * nv, of_rows->data());
  }
  for (int i = 0; i < m; i++)
    for (int v = 0; v < nv; v++) right[v * all + i] = rows[i * nv + v] * s.force;
  multiply(g.response, right.data(), nx, nv, all, into.C, nx);
  for (int v = 0; v < nx && g.effect != nullptr; v++)
    for (int k = 0; k < s.others; k++) into.C[v * all + rays + s.caps + k] = g.effect[v * s.others + k] * s.force;
  for (int i = 0; i < m * nv; i++) left[i] = rows[i] / s.length;
  multiply(left.data(), into.C, m, nv, all, into.F);
  multiply(left.data(), g.A, m, nv, nx, into.D);
  multiply(left.data(), g.B, m, nv, s.nu, into.E);
  double size = 0, largest = 0, softest = INFINITY;
  for (int i = 0; i < m; i++) {
    const double *row = &rows[i * nv], *along = &left[i * nv];
    for (int v = 0; v < nv; v++) into.D[i * nx + v] -= (row[v] - counted[i * nv + v]) / s.length;
    into.c[i] = gap[i] / s.length + dot(along, g.d, nv) - dot(&counted[i * nv], g.x, nv) / s.length;
    if (g.rest != nullptr) into.c[i] -= soft[i] * g.rest[i] / s.force;
    size += dot(along, row, nv);
    softest = std::min(softest, soft[i]);
  }
  for (int i = 0; i < m; i++) {
    double* row = into.F + i * all;
    for (int j = 0; j < i; j++) row[j] = into.F[j * all + i] = 0.5 * (row[j] + into.F[j * all + i]);
    row[i] += soft[i];
    largest = std::max(largest, row[i]);
  }
  std::copy_n(g.d, nx, into.d);
  for (int k = 0; k < s.bounded; k++) {  // they become λ − bound
    const double lower = -g.bound[k] / s.force;
    for (int v = 0; v < nx; v++) into.d[v] += lower * into.C[v * all + first + k];
    for (int i = 0; i < m; i++) into.c[i] += lower * into.F[i * all + first + k];
  }
  for (int k = 0, i = m; i < all; k++, i++) {
    const bool is_cap = k >= s.bounded;
    const int from = is_cap ? (k - s.bounded) * s.each() : first + k;
    for (int j = from; j < from + (is_cap ? s.each() : 1); j++) {
      into.F[j * all + i] = 1.0;
      into.F[i * all + j] = -1.0;
    }
    into.F[i * all + i] = s.drag / into.F[from * all + from];
    into.c[i] = (is_cap ? g.cap[k - s.bounded] : 2 * g.bound[k]) / s.force;
  }
  // What is rows R rowsᵀ with a positive R is no less than zero (an `effect` is another in the velocities alone), and the
  // compliance is more than rounding.
  Matrix R;
  double trace = 0;
  R.resize(nv, nv);
  for (int v = 0; v < nv; v++) trace += g.response[v * nx + v];
  for (int v = 0; v < nv; v++)
    for (int w = 0; w < nv; w++) R[v][w] = 0.5 * (g.response[v * nx + w] + g.response[w * nx + v]);
  R.add_identity(kRounding * trace);
  const double off = kRounding * (trace * size * s.force + m * largest);
  double squares = 0;
  for (const auto& [numbers, count] :
       {std::pair<const double*, int>{g.A, nx * nx}, {g.B, nx * s.nu}, {into.C, nx * all}, {into.d, nx},
        {into.D, all * nx}, {into.E, all * s.nu}, {into.F, all * all}, {into.c, all}})
    squares += dot(numbers, numbers, count);
  return std::isfinite(squares) && softest > 2 * off && factor(R);
}

}  // namespace difflcs::physics
