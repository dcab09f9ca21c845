// The MPC problems in the lanes: their data in the units of the solver, dynamics and cost. The names are those of
// difflcs/mpc/problem.py.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "matrix.hpp"
#include "sizes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

constexpr double kTiny = 1e-300;

// A trajectory: x[k], u[k], lam[k] and s[k] are those of stage k.
template <class S>
struct Trajectory {
  Matrix<Vec, 0, S::kX> x;
  Matrix<Vec, 0, S::kU> u;
  Matrix<Vec, 0, S::kL> lam, s;

  void layout(Arena& arena, const S& n) {
    arena.take(x, n.h + 1, n.x()), arena.take(u, n.h, n.u()), arena.take(lam, n.h, n.l()), arena.take(s, n.h, n.l());
  }
};

// T is the type of a matrix entry: double where the batch shares all matrices, else Vec.
template <class T, class S>
struct Problem {
  static constexpr int64_t kX = S::kX, kU = S::kU, kL = S::kL, kW = S::kW;
  const MpcBatch& batch;
  const S n;
  const bool caller_units;  // of the cost: the adjoint differentiates it as it is
  Matrix<T, kX, kW> AB;
  Matrix<T, kX, kL> C;
  Matrix<T, kL, kW> DE;
  Matrix<T, kL, kL> F;
  Matrix<T, kX, kX> Q, Q_final;
  Matrix<T, kU, kU> R;
  // lam = scale * lam', s = s' / scale, chosen so that F' has a unit diagonal: contacts in any units converge alike. C,
  // [D E], F, c, lam and s are kept in these units; the product lam o s does not change.
  T* scale;
  // The cost is kept in units of 1 / cost_unit: weights below 1e-3 are lifted to one, so that tolerances hold for them.
  T* cost_unit;
  T *rest, *rest_final;  // curvature of each action by the next stage's weights alone: the least scale of its gradient
  Vec *d, *c, *q, *r, *q_final, *u_min, *u_max, *x0;
  Vec* per_width;  // reciprocal of each action's range, zero where that is zero
  Vec mu;          // weight of the barrier of the bounds: follows the homotopy down to batch.barrier

  Problem(const MpcBatch& b, bool caller_units) : batch(b), n(b), caller_units(caller_units), mu(all(b.barrier)) {}

  void layout(Arena& arena) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w();
    arena.take(AB, nx, nw), arena.take(C, nx, nl), arena.take(DE, nl, nw), arena.take(F, nl, nl);
    arena.take(Q, nx, nx), arena.take(R, nu, nu), arena.take(Q_final, nx, nx);
    arena.take(scale, nl), arena.take(cost_unit, 1), arena.take(rest, nu), arena.take(rest_final, nu);
    arena.take(d, nx), arena.take(c, nl), arena.take(q, nx), arena.take(r, nu), arena.take(q_final, nx);
    arena.take(u_min, nu), arena.take(u_max, nu), arena.take(x0, nx), arena.take(per_width, nu);
    if constexpr (sizeof(T) == sizeof(double))
      if (arena.memory) load_matrices(0, 0);
  }

  Matrix<T, kX, kX, kW> A() const { return AB.block(0, Dim<kX>{n.x()}); }
  Matrix<T, kX, kU, kW> B() const { return AB.block(n.x(), Dim<kU>{n.u()}); }
  Matrix<T, kL, kX, kW> D() const { return DE.block(0, Dim<kX>{n.x()}); }
  Matrix<T, kL, kU, kW> E() const { return DE.block(n.x(), Dim<kU>{n.u()}); }

  // ---- loading ----
  const double* input(Input which, int64_t element) const { return batch.input[which] + element * batch.stride[which]; }

  void load_matrices(int64_t e, int lane) {
    const int64_t nl = n.l();
    const double* diagonal = input(kF, e);
    for (int64_t i = 0; i < nl; i++) {
      const double f = diagonal[i * nl + i];
      put(scale, i, lane, f > 0 ? 1.0 / __builtin_sqrt(f) : 1.0);
    }
    put(cost_unit, 0, lane, caller_units ? 1.0 : unit_of_cost(e));
    const auto one = [](int64_t) { return 1.0; };
    const auto contact = [&](int64_t i) { return lane_of(scale[i], lane); };
    const auto cost = [&](int64_t) { return lane_of(cost_unit[0], lane); };
    auto matrix = [&](auto to, Input which, auto by_row, auto by_column) {
      const double* from = input(which, e);
      for (int64_t i = 0; i < to.rows; i++)
        for (int64_t j = 0; j < to.columns; j++)
          put(to[i], j, lane, from[i * to.columns + j] * (by_row(i) * by_column(j)));
    };
    matrix(A(), kA, one, one), matrix(B(), kB, one, one), matrix(C, kC, one, contact);
    matrix(D(), kD, contact, one), matrix(E(), kE, contact, one), matrix(F, kF, contact, contact);
    matrix(Q, kQ, one, cost), matrix(R, kR, one, cost), matrix(Q_final, kQ_final, one, cost);
    curvature_at_rest(n, B().entries, n.w(), Q.entries, R.entries, rest, lane);
    curvature_at_rest(n, B().entries, n.w(), Q_final.entries, R.entries, rest_final, lane);
  }

  // A power of two that brings the largest weight to about one where it is below 1e-3.
  double unit_of_cost(int64_t e) const {
    double largest = 0;
    const Input weights[] = {kQ, kR, kQ_final};
    for (const Input which : weights) {
      const int64_t size = extent(batch, kMpcFields[which]);
      for (int64_t i = 0; i < size; i++) {
        const double weight = __builtin_fabs(input(which, e)[i]);
        largest = weight > largest ? weight : largest;
      }
    }
    if (!(largest > kTiny && largest < 1e-3)) return 1.0;
    int exponent;
    __builtin_frexp(largest, &exponent);
    return __builtin_ldexp(1.0, -exponent);
  }

  // Puts problem `e` into a lane.
  void load(int64_t e, int lane) {
    if constexpr (sizeof(T) != sizeof(double)) load_matrices(e, lane);
    auto vector = [&](Vec* to, Input which, double unit = 1.0) {
      const double* from = input(which, e);
      for (int64_t i = 0; i < extent(batch, kMpcFields[which]); i++) put(to, i, lane, from[i] * unit);
    };
    const double cost = lane_of(cost_unit[0], lane);
    vector(d, kd), vector(c, kc), vector(q, kq, cost), vector(r, kr, cost), vector(q_final, kq_final, cost);
    vector(u_min, ku_min), vector(u_max, ku_max), vector(x0, kx0);
    for (int64_t i = 0; i < n.u(); i++) {
      const double width = u_max[i][lane] - u_min[i][lane];
      put(per_width, i, lane, width > kTiny ? 1.0 / width : 0.0);
    }
    for (int64_t i = 0; i < n.l(); i++) put(c, i, lane, c[i][lane] * lane_of(scale[i], lane));
  }

  // One lane of an array from and to the caller's, lam from and to the caller's units.
  static void load(Vec* to, const double* from, int64_t size, int lane) {
    for (int64_t i = 0; i < size; i++) put(to, i, lane, from[i]);
  }
  static void store(double* to, const Vec* from, int64_t size, int lane) {
    for (int64_t i = 0; i < size; i++) to[i] = reinterpret_cast<const double*>(from + i)[lane];
  }
  void load_lam(Vec* to, const double* from, int lane, bool dual = false) const {
    const int64_t nl = n.l();
    for (int64_t i = 0; i < n.h * nl; i++) {
      const double unit = lane_of(scale[i % nl], lane);
      put(to, i, lane, dual ? from[i] * unit : from[i] / unit);
    }
  }
  void store_lam(double* to, const Vec* from, int lane) const {
    const int64_t nl = n.l();
    for (int64_t i = 0; i < n.h * nl; i++) to[i] = from[i][lane] * lane_of(scale[i % nl], lane);
  }

  // ---- dynamics and cost ----
  void gap(const Vec* x, const Vec* u, Vec* out) const {
    const auto D = this->D();
    const auto E = this->E();
    for (int64_t i = 0; i < n.l(); i++) out[i] = c[i] + D.row(i) * x + E.row(i) * u;
  }

  void next_state(const Vec* x, const Vec* u, const Vec* lam, Vec* out) const {
    const auto A = this->A();
    const auto B = this->B();
    for (int64_t i = 0; i < n.x(); i++) out[i] = d[i] + A.row(i) * x + B.row(i) * u + C.row(i) * lam;
  }

  Vec cost(const Trajectory<S>& at) const {
    auto quadratic = [](const auto& W, const Vec* linear, const Vec* z) {
      Vec total = all(0);
      for (int64_t i = 0; i < W.rows; i++) total += z[i] * (0.5 * (all(0) + W.row(i) * z) + linear[i]);
      return total;
    };
    Vec total = quadratic(Q_final, q_final, at.x[n.h]);
    for (int64_t k = 0; k < n.h; k++) total += quadratic(Q, q, at.x[k]) + quadratic(R, r, at.u[k]);
    if (batch.barrier > 0)
      for (int64_t k = 0; k < n.h; k++)
        for (int64_t j = 0; j < n.u(); j++) total -= mu * log((at.u(k, j) - u_min[j]) * (u_max[j] - at.u(k, j)));
    return total;
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
