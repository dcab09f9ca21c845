// The MPC problems in the lanes: their data in the units of the solver, dynamics and cost. The names are those of
// difflcs/mpc/problem.py.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "low_rank.hpp"
#include "matrix.hpp"
#include "sizes.hpp"

#ifndef DIFFLCS_ROW_LENGTHS  // see mpc_adjoint.cpp
#define DIFFLCS_ROW_LENGTHS
#endif

namespace difflcs::DIFFLCS_ISA {
namespace {

// A trajectory: x[k], u[k], lam[k] and s[k] are those of stage k.
template <class S>
struct Trajectory {
  Matrix<Vec, 0, S::kX> x;
  Matrix<Vec, 0, S::kU> u;
  Matrix<Vec, 0, S::kL> lam, s;

  void layout(Arena& arena, const S& n) {
    arena.take(x, n.h + 1, n.x());
    arena.take(u, n.h, n.u());
    arena.take(lam, n.h, n.l());
    arena.take(s, n.h, n.l());
  }
  // The same with sizes that are known when compiling, or without.
  template <class Other>
  operator Trajectory<Other>() const {
    return {x, u, lam, s};
  }
};

// Upstream gradients of x, u and lam.
template <class S>
struct Upstream {
  Matrix<Vec, 0, S::kX> x;
  Matrix<Vec, 0, S::kU> u;
  Matrix<Vec, 0, S::kL> lam;
  template <class Other>
  operator Upstream<Other>() const {
    return {x, u, lam};
  }
};

// The data of one stage. T is the type of a matrix entry: double where the batch shares all matrices, else Vec.
template <class T, class S>
struct StageData {
  static constexpr int64_t kX = S::kX, kU = S::kU, kL = S::kL, kW = S::kW;
  Matrix<T, kX, kW> AB;
  Matrix<T, kW, kX> AB_t;  // transposed, of one problem alone
  Matrix<T, kX, kL> C;
  Matrix<T, kL, kW> DE;
  Matrix<T, kL, kL> F;
  Matrix<T, kX, kX> Q;
  Matrix<T, kU, kU> R;
  Matrix<T, kX, kU> cross;  // S; the letter stands for the sizes here
  Matrix<T, 0, kW> G;       // [G_x G_u]
  T *scale, *row_scale, *rest;
  Vec *d, *c, *q, *r, *u_min, *u_max, *per_width, *g, *price;

  Matrix<T, kX, kX, kW> A() const { return AB.block(0, Dim<kX>{Q.rows}); }
  Matrix<T, kX, kU, kW> B() const { return AB.block(Q.rows, Dim<kU>{R.rows}); }
  Matrix<T, kL, kX, kW> D() const { return DE.block(0, Dim<kX>{Q.rows}); }
  Matrix<T, kL, kU, kW> E() const { return DE.block(Q.rows, Dim<kU>{R.rows}); }
  Matrix<T, 0, kX, kW> G_x() const { return G.block(0, Dim<kX>{Q.rows}); }
  Matrix<T, 0, kU, kW> G_u() const { return G.block(Q.rows, Dim<kU>{R.rows}); }

  void gap(const Vec* x, const Vec* u, Vec* out) const {
    const auto D = this->D();
    const auto E = this->E();
    for (int64_t i = 0; i < D.rows; i++) out[i] = c[i] + D.row(i) * x + E.row(i) * u;
  }

  void next_state(const Vec* x, const Vec* u, const Vec* lam, Vec* out) const {
    const auto store = [&](int64_t i, Vec sum) { out[i] = sum; };
    const auto so_far = [&](int64_t i) { return out[i]; };
    if constexpr (kLanes == 1) {
      multiply_columns(Matrix<T, kX, kX>{AB_t[0], {Q.rows}, {Q.rows}, {Q.rows}}, x, d, out);
      multiply_columns(Matrix<T, kU, kX>{AB_t[Q.rows], {R.rows}, {Q.rows}, {Q.rows}}, u, out, out);
    } else {
      multiply(A(), x, [&](int64_t i) { return d[i]; }, store);
      multiply(B(), u, so_far, store);
    }
    multiply(C, lam, so_far, store);
  }

  // Row i of G_x x + G_u u - g; the last stage has no actions.
  Vec constraint(int64_t i, const Vec* x, const Vec* u) const {
    const Vec value = -g[i] + G_x().row(i) * x;
    return u ? value + G_u().row(i) * u : value;
  }

  // The sum of the sizes of its terms; none where the limit is infinite, as there is no constraint then.
  Vec constraint_terms(int64_t i, const Vec* x, const Vec* u) const {
    const int64_t nx = Q.rows, nw = u ? nx + R.rows : nx;
    Vec terms = abs(g[i]);
    for (int64_t j = 0; j < nw; j++) terms += abs(G(i, j) * (j < nx ? x[j] : u[j - nx]));
    return select(g[i] < kHuge, terms, all(0));
  }
};

// The multipliers of constraints that an augmented Lagrangian with weight rho gives to the value c of a row whose
// multiplier was `before`: it lies in [0, price].
struct Force {
  Vec value;
  Mask held;  // between 0 and the price: the row is an equation
  Force(Vec c, Vec before, Vec rho, Vec price) {
    const Vec free = before + rho * c;
    value = max(all(0), min(free, price));
    held = (free > 0) & (free < price);
  }
  // Its part of the cost.
  static Vec cost(Vec c, Vec before, Vec rho, Vec price) {
    const Vec m = Force(c, before, rho, price).value;
    // c is -inf where there is no constraint: there m = 0.
    return select(m > 0, m * c, all(0)) - 0.5 * (m - before) * (m - before) / rho;
  }
};

// The data of the problems in the lanes, whatever their sizes.
template <class T>
struct ProblemData {
  const MpcBatch& batch;
  const AnySizes n;
  const bool caller_units;                               // of the cost: the adjoint differentiates it as it is
  const bool shared;                                     // the matrices are loaded once, for all problems
  bool kept = false;                                     // the memory has them already
  Stages<Matrix<T, 0, 0>> AB, AB_t, C, DE, F, Q, R, cross, G;  // [A B], [D E], S, [G_x G_u]
  Matrix<T, 0, 0> Q_final;
  // lam = scale * lam', s = s' / scale, chosen so that F' has a unit diagonal: contacts in any units converge alike. C,
  // [D E], F, c, lam and s are kept in these units; the product lam o s does not change.
  Steps<T> scale;
  // Rows of constraints have length one: [G g]' = row_scale [G g], and their multipliers are divided by it.
  Steps<T> row_scale;
  // The cost is kept in units of 1 / cost_unit: weights below 1e-3 are lifted to one, so that tolerances hold for them.
  T* cost_unit;
  Steps<T> rest;  // curvature of each action by the next stage's weights alone: the least scale of its gradient
  LowRank low_rank;  // of F
  Steps<Vec> d, c, q, r, u_min, u_max, g, price;
  Steps<Vec> per_width;  // reciprocal of each action's range, zero where that is zero or infinite
  Vec *q_final, *x0;
  Vec* product;  // of a matrix and a state
  Vec* reach;  // of each constraint: the least unit of its violation, a part of its largest change in a step
  Vec mu;      // weight of the barrier of the bounds: follows the homotopy down to batch.barrier
  Matrix<Vec, 0, 0> multiplier;  // of the constraints
  Vec rho, weight{};  // of the augmented Lagrangian, and the largest weight of the cost, its unit

  Mask* has_law;  // whether the law that the solver keeps (newton.hpp) is still that of the problem
  void (ProblemData::*load_rows)(int64_t element, int lane);  // `load_sized_rows` with the sizes that are known

  ProblemData(const MpcBatch& b, bool caller_units)
      : batch(b), n(b), caller_units(caller_units), shared(load_once<T>(b)), mu(all(b.barrier)), rho(all(1)) {}

  void layout(Arena& arena) {
    int64_t* version = arena.take<int64_t>(1);
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), nc = n.c(), h = n.h;
    const int64_t systems = by_stage(kA, kB, kC, kD, kE, kF) ? h : 1, costs = by_stage(kQ, kR, kS) ? h : 1;
    const int64_t bounds = by_stage(ku_min, ku_max) ? h : 1;
    const int64_t rows = nc && by_stage(kG_x, kG_u, kg, kprice) ? h + 1 : 1;
    arena.take(AB, systems, nx, nw);
    arena.take(AB_t, kLanes == 1 ? systems : 0, nw, nx);
    arena.take(C, systems, nx, nl);
    arena.take(DE, systems, nl, nw);
    arena.take(F, systems, nl, nl);
    arena.take(scale, systems, nl);
    low_rank.layout(arena, systems, nl, !batch.pivot);
    arena.take(Q, costs, nx, nx);
    arena.take(R, costs, nu, nu);
    arena.take(cross, costs, nx, nu);
    arena.take(Q_final, nx, nx);
    arena.take(cost_unit, 1);
    arena.take(rest, h, nu);
    arena.take(G, rows, nc, nw);
    arena.take(row_scale, rows, nc);
    arena.take(g, rows, nc);
    arena.take(price, rows, nc);
    arena.take(d, by_stage(kd) ? h : 1, nx);
    arena.take(c, systems > 1 || by_stage(kc) ? h : 1, nl);
    arena.take(q, by_stage(kq) ? h : 1, nx);
    arena.take(r, by_stage(kr) ? h : 1, nu);
    arena.take(u_min, bounds, nu);
    arena.take(u_max, bounds, nu);
    arena.take(per_width, bounds, nu);
    arena.take_all(nx, q_final, x0);
    arena.take(product, nw);
    arena.take(multiplier, h + 1, nc);
    arena.take(reach, nc);
    arena.take(has_law, 1);
    if (!arena.memory) return;
    const int64_t mine = shared && !caller_units && !batch.pivot ? batch.version * 16 + kLanes : 0;
    kept = batch.version > 0 && mine > 0 && *version == mine;
    *version = mine;
    if (!kept) *has_law = Mask{};
    if (shared && !kept) load_matrices(0, 0);
  }

  template <class S = AnySizes>
  StageData<T, S> stage(int64_t k) const {
    return {AB[k],        AB_t[k], C[k], DE[k], F[k], Q[k], R[k],     cross[k], G[k],         scale[k],
            row_scale[k], rest[k], d[k], c[k],  q[k], r[k], u_min[k], u_max[k], per_width[k], g[k],
            price[k]};
  }
  // Only the constraints mean something there.
  template <class S = AnySizes>
  StageData<T, S> last() const {
    StageData<T, S> data = stage<S>(0);
    data.G = G[n.h];
    data.row_scale = row_scale[n.h];
    data.g = g[n.h];
    data.price = price[n.h];
    return data;
  }

  // Whether the optimum is that of a quadratic program with bounds on the actions alone.
  bool linear() const { return n.l() == 0 && n.c() == 0 && batch.barrier == 0; }

  template <class... Inputs>
  bool by_stage(Inputs... which) const {
    return ((batch.step[which] > 0) || ...);
  }

  const double* input(Input which, int64_t element, int64_t k = 0) const { return batch.at(which, element, k); }

  void load_matrices(int64_t e, int lane) {
    const int64_t nl = n.l(), nw = n.w();
    const auto one = [](int64_t) { return 1.0; };
    auto matrix = [&](auto to, Input which, int64_t k, auto by_row, auto by_column) {
      const double* from = input(which, e, k);
      for (int64_t i = 0; i < to.rows; i++)
        for (int64_t j = 0; j < to.columns; j++)
          put(to[i], j, lane, from[i * to.columns + j] * (by_row(i) * by_column(j)));
    };
    put(cost_unit, 0, lane, caller_units ? 1.0 : unit_of(largest_weight(e)));
    const auto cost = [&](int64_t) { return lane_of(cost_unit[0], lane); };
    for (int64_t k = 0; k < scale.count; k++) {
      const double* diagonal = input(kF, e, k);
      for (int64_t i = 0; i < nl; i++) {
        const double f = diagonal[i * nl + i];
        put(scale[k], i, lane, f > 0 ? 1.0 / __builtin_sqrt(f) : 1.0);
      }
      const auto contact = [&](int64_t i) { return lane_of(scale[k][i], lane); };
      const StageData<T, AnySizes> to = stage(k);
      matrix(to.A(), kA, k, one, one);
      matrix(to.B(), kB, k, one, one);
      for (int64_t i = 0; i < nw && kLanes == 1; i++)
        for (int64_t j = 0; j < n.x(); j++) to.AB_t(i, j) = to.AB(j, i);
      matrix(to.C, kC, k, one, contact);
      matrix(to.D(), kD, k, contact, one);
      matrix(to.E(), kE, k, contact, one);
      matrix(to.F, kF, k, contact, contact);
      low_rank.find(k, to.F, to.C);
    }
    for (int64_t k = 0; k < Q.count; k++) {
      matrix(Q[k], kQ, k, one, cost);
      matrix(R[k], kR, k, one, cost);
      matrix(cross[k], kS, k, one, cost);
    }
    matrix(Q_final, kQ_final, 0, one, cost);
    curvature_at_rest(
        n, [&](int64_t k) { return stage(k).B().entries; }, nw, [&](int64_t k) { return Q[k].entries; },
        Q_final.entries, [&](int64_t k) { return R[k].entries; }, scale.count == 1 && Q.count == 1, rest, lane);
    if (n.c() > 0) (this->*load_rows)(e, lane);
  }

  // The rows of the constraints, made to have length one.
  template <class S>
  DIFFLCS_ROW_LENGTHS void load_sized_rows(int64_t e, int lane) {
    const S n(batch);
    const int64_t nx = n.x(), nw = n.w(), nc = n.c();
    for (int64_t k = 0; k < G.count; k++) {
      const StageData<T, AnySizes> to = k < n.h ? stage(k) : last();
      const double *G_x = input(kG_x, e, k), *G_u = input(kG_u, e, k);
      for (int64_t i = 0; i < nc; i++) {
        // The last stage has no actions.
        const auto entry = [&](int64_t j) {
          return j < nx ? G_x[i * nx + j] : k < n.h ? G_u[i * (nw - nx) + j - nx] : 0.0;
        };
        double square = 0;
        for (int64_t j = 0; j < nw; j++) square += entry(j) * entry(j);
        const double unit = square > kTiny ? 1.0 / __builtin_sqrt(square) : 1.0;
        for (int64_t j = 0; j < nw; j++) put(to.G[i], j, lane, entry(j) * unit);
        put(to.row_scale, i, lane, unit);
      }
    }
  }

  double largest_weight(int64_t e) const {
    double largest = 0;
    const Input weights[] = {kQ, kR, kQ_final};
    for (const Input which : weights)
      for (int64_t k = 0; k < (batch.step[which] ? n.h : 1); k++) {
        const int64_t size = extent(batch, kMpcFields[which]);
        const double* entries = input(which, e, k);
        for (int64_t i = 0; i < size; i++) {
          const double entry = __builtin_fabs(entries[i]);
          largest = entry > largest ? entry : largest;
        }
      }
    return largest;
  }

  // A power of two that brings the largest weight to about one where it is below 1e-3.
  static double unit_of(double largest) {
    if (!(largest > kTiny && largest < 1e-3)) return 1.0;
    int exponent;
    __builtin_frexp(largest, &exponent);
    return __builtin_ldexp(1.0, -exponent);
  }

  // Puts problem `e` into a lane.
  void load(int64_t e, int lane) {
    if (!shared) load_matrices(e, lane);
    bool same = shared;
    auto vector = [&](const Steps<Vec>& to, Input which, double unit = 1.0) {
      for (int64_t k = 0; k < to.count; k++) {
        const double* from = input(which, e, k);
        for (int64_t i = 0; i < to.size; i++) {
          same = same && to[k][i][lane] == from[i] * unit;
          put(to[k], i, lane, from[i] * unit);
        }
      }
    };
    const double cost = lane_of(cost_unit[0], lane);
    vector(d, kd);
    vector(c, kc);
    vector(q, kq, cost);
    vector(r, kr, cost);
    vector(u_min, ku_min);
    vector(u_max, ku_max);
    vector({q_final, n.x(), 1, 0}, kq_final, cost);
    for (int64_t i = 0; i < n.x(); i++) put(x0, i, lane, input(kx0, e)[i]);
    if (!same) (*has_law)[lane] = 0;
    for (int64_t k = 0; k < per_width.count; k++)
      for (int64_t i = 0; i < n.u(); i++) {
        const double width = u_max[k][i][lane] - u_min[k][i][lane];
        put(per_width[k], i, lane, width > kTiny && width < kHuge ? 1.0 / width : 0.0);
      }
    for (int64_t k = 0; k < c.count; k++)
      for (int64_t i = 0; i < n.l(); i++) put(c[k], i, lane, c[k][i][lane] * lane_of(scale[k][i], lane));
    for (int64_t k = 0; k < g.count; k++)
      for (int64_t i = 0; i < n.c(); i++) {
        const double unit = lane_of(row_scale[k][i], lane);
        put(g[k], i, lane, input(kg, e, k)[i] * unit);
        put(price[k], i, lane, input(kprice, e, k)[i] * (cost / unit));
      }
    double widest = 0;  // change of a constraint
    for (int64_t i = 0; i < n.c(); i++) {
      double most = 0;
      for (int64_t k = 0; k <= n.h; k++) {
        const StageData<T, AnySizes> to = k < n.h ? stage(k) : last(), before = stage(k > 0 ? k - 1 : 0);
        const auto range = [&](const StageData<T, AnySizes>& at, int64_t j) {
          return lane_of(at.per_width[j], lane) > 0 ? 1.0 / lane_of(at.per_width[j], lane) : 0.0;
        };
        double sum = 0;
        for (int64_t j = 0; j < n.u(); j++) {
          if (k < n.h) sum += __builtin_fabs(lane_of(to.G_u()(i, j), lane)) * range(to, j);
          for (int64_t m = 0; m < n.x() && k > 0; m++)
            sum += __builtin_fabs(lane_of(to.G_x()(i, m), lane) * lane_of(before.B()(m, j), lane)) * range(before, j);
        }
        most = sum > most && lane_of(to.g[i], lane) < kHuge ? sum : most;
      }
      put(reach, i, lane, kCancelled * most);
      widest = most > widest ? most : widest;
    }
    if (n.c() > 0) put(&weight, 0, lane, weight_of(e, lane, widest));
  }

  // The largest weight of the cost. A linear cost has none: there it is the one that makes as much of the largest
  // change of a constraint as the cost changes.
  double weight_of(int64_t e, int lane, double widest) const {
    const double largest = largest_weight(e);
    if (largest > kTiny) return largest * lane_of(cost_unit[0], lane);
    const StageData<T, AnySizes> at = stage(0);
    double change = 0;
    for (int64_t j = 0; j < n.u(); j++) {
      Vec slope = abs(at.r[j]);
      for (int64_t i = 0; i < n.x(); i++) slope += abs(at.B()(i, j) * (abs(at.q[i]) + abs(q_final[i])));
      change += at.per_width[j][lane] > 0 ? slope[lane] / at.per_width[j][lane] : 0.0;
    }
    const double balanced = change / (widest * widest);
    return balanced > kTiny && balanced < kHuge ? balanced : 1.0;
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
    for (int64_t k = 0; k < n.h; k++)
      for (int64_t i = 0; i < nl; i++) {
        const double unit = lane_of(scale[k][i], lane), value = from[k * nl + i];
        put(to, k * nl + i, lane, dual ? value * unit : value / unit);
      }
  }
  void store_lam(double* to, const Vec* from, int lane) const {
    const int64_t nl = n.l();
    for (int64_t k = 0; k < n.h; k++)
      for (int64_t i = 0; i < nl; i++) to[k * nl + i] = from[k * nl + i][lane] * lane_of(scale[k][i], lane);
  }
  // The same of the multipliers of constraints; null for none.
  void load_multipliers(const double* from, int lane) const {
    const int64_t nc = n.c();
    for (int64_t k = 0; k <= n.h; k++)
      for (int64_t i = 0; i < nc; i++) {
        const double unit = lane_of(row_scale[k][i], lane) / lane_of(cost_unit[0], lane);
        put(multiplier[k], i, lane, from ? from[k * nc + i] / unit : 0.0);
      }
  }
  void store_multipliers(double* to, const Vec* from, int64_t e, int lane) const {
    const int64_t nc = n.c();
    for (int64_t k = 0; k <= n.h; k++)
      for (int64_t i = 0; i < nc; i++) {
        const double unit = lane_of(row_scale[k][i], lane) / lane_of(cost_unit[0], lane);
        const double value = from[k * nc + i][lane] * unit, limit = input(kprice, e, k)[i];
        to[k * nc + i] = value < kAtPrice * limit ? value : limit;
      }
  }

  // ---- cost ----
  template <class S>
  Vec cost(const Trajectory<S>& at) const {
    Vec total = plain_cost(at);
    for (int64_t k = 0; k <= n.h && n.c() > 0; k++) {
      const StageData<T, S> here = k < n.h ? stage<S>(k) : last<S>();
      const Vec* before = multiplier[k];
      for (int64_t i = 0; i < n.c(); i++)
        total += Force::cost(here.constraint(i, at.x[k], k < n.h ? at.u[k] : nullptr), before[i], rho, here.price[i]);
    }
    return total;
  }

  // The objective, with the price of soft constraints in place of the augmented Lagrangian.
  Vec objective(const Trajectory<AnySizes>& at) const {
    Vec total = plain_cost(at);
    for (int64_t k = 0; k <= n.h; k++) {
      const StageData<T, AnySizes> here = k < n.h ? stage(k) : last();
      for (int64_t i = 0; i < n.c(); i++) {
        const Vec violation = max(here.constraint(i, at.x[k], k < n.h ? at.u[k] : nullptr), all(0));
        total += select((violation > 0) & (here.price[i] < kHuge), here.price[i] * violation, all(0));
      }
    }
    return total;
  }

 private:
  template <class S>
  Vec plain_cost(const Trajectory<S>& at) const {
    auto quadratic = [this](const auto& W, const Vec* linear, const Vec* z) {
      Vec total = all(0);
      for (int64_t i = 0; i < W.rows; i++) product[i] = all(0);
      multiply_symmetric(W, z, product, product);
      for (int64_t i = 0; i < W.rows; i++) total += z[i] * (0.5 * product[i] + linear[i]);
      return total;
    };
    Vec total = quadratic(Matrix<T, S::kX, S::kX>(Q_final), q_final, at.x[n.h]);
    for (int64_t k = 0; k < n.h; k++) {
      total += quadratic(Matrix<T, S::kX, S::kX>(Q[k]), q[k], at.x[k]) +
               quadratic(Matrix<T, S::kU, S::kU>(R[k]), r[k], at.u[k]);
      if (batch.crossed)
        for (int64_t i = 0; i < n.x(); i++) total += at.x(k, i) * (all(0) + cross[k].row(i) * at.u[k]);
    }
    if (batch.barrier > 0)
      for (int64_t k = 0; k < n.h; k++)
        for (int64_t j = 0; j < n.u(); j++) total -= mu * log((at.u(k, j) - u_min[k][j]) * (u_max[k][j] - at.u(k, j)));
    return total;
  }
};

// The same for sizes that are known when compiling.
template <class T, class S>
struct Problem : ProblemData<T> {
  const S n;
  StageData<T, S>* stages;

  Problem(const MpcBatch& b, bool caller_units) : ProblemData<T>(b, caller_units), n(b) {
    this->load_rows = &ProblemData<T>::template load_sized_rows<S>;
  }

  void layout(Arena& arena) {
    ProblemData<T>::layout(arena);
    arena.take(stages, n.h);
    for (int64_t k = 0; k < n.h && arena.memory; k++) stages[k] = ProblemData<T>::template stage<S>(k);
  }

  const StageData<T, S>& stage(int64_t k) const { return stages[k]; }
  StageData<T, S> last() const { return ProblemData<T>::template last<S>(); }
  Matrix<T, 0, S::kW> G(int64_t k) const { return ProblemData<T>::G[k]; }
  Matrix<T, S::kX, S::kX> Q_final() const { return ProblemData<T>::Q_final; }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
