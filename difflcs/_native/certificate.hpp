// The certificate of an MPC solution: every optimality condition, recomputed from the numbers returned, in the caller's
// units. difflcs/mpc/conditions.py states the measure (`residual`), kkt.py derives it; the names here are the names
// there. It shares nothing with the solver but the elimination of one small matrix, whose result it checks.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"
#include "matrix.hpp"
#include "sizes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// A residual above this may be rounding of s, or hide behind it.
constexpr double kSure = 2e-7;
// Up to this residual a quadratic program with bounds alone is measured without the sizes of its states and costates:
// they only enlarge the scales, so that what is measured is at most this, and no less than the residual.
constexpr double kBrief = 1e-12;

// Its matrices have an entry for each lane also where the problems share them, so that it is compiled once.
struct Certificate {
  const MpcBatch& batch;
  const AnySizes n;
  Steps<Vec> field[kInputs], rest, transposed_A;  // in the caller's units
  Vec *at[kInputs], *A_t;                        // of the current stage
  Vec *&A = at[kA], *&B = at[kB], *&C = at[kC], *&D = at[kD], *&E = at[kE], *&F = at[kF], *&Q = at[kQ], *&R = at[kR],
      *&cross = at[kS], *&G_x = at[kG_x], *&G_u = at[kG_u], *&d = at[kd], *&c = at[kc], *&q = at[kq], *&r = at[kr],
      *&lo = at[ku_min], *&hi = at[ku_max];
  Vec *x, *u, *lam, *mu, *gap, *s, *p, *pn, *y, *rho, *error, *N, *largest_action;
  // Sizes of all states, and at one stage of the costates and of rho's response to them (conditions.py: `sizes`); terms
  // of both.
  Vec *x_size, *p_size, *rho_size, *p_terms, *rho_terms, *terms, *grown, *cost;
  Vec* moved;                         // change of each state by the ranges of the earlier actions
  Vec *row, *row_terms, *row_missed;  // values of the constraints; of each the largest over the stages
  Mask* rows;

  const bool shared;  // the matrices are loaded once, for all problems
  bool sized;         // the sizes are measured

  explicit Certificate(const MpcBatch& b) : batch(b), n(b), shared(shared_matrices(b)) {}

  // `kept`: the memory has the shared matrices already.
  void layout(Arena& arena, bool kept) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nc = n.c(), h = n.h;
    for (int i = 0; i < kInputs; i++) {
      const Field& kind = kMpcFields[i];
      arena.take(field[i], batch.step[i] == 0 ? 1 : stages_of(batch, kind), extent(batch, kind));
    }
    arena.take(rest, h, nu);
    arena.take(transposed_A, field[kA].count, nx * nx);
    arena.take_all((h + 1) * nx, x, x_size);
    arena.take(u, h * nu);
    arena.take_all(h * nl, lam, gap);
    arena.take_all((h + 1) * nc, mu, row);
    arena.take_all(nx, p, pn, p_size, p_terms, terms, grown, cost);
    arena.take_all(nl, y, rho, error, rows, rho_size, rho_terms);
    arena.take(N, nl * nl);
    arena.take(largest_action, nu);
    arena.take(moved, nc > 0 ? (h + 1) * nx : 0);
    arena.take_all(nc, row_terms, row_missed);
    for (int l = 0; l < kLanes && arena.memory && shared && !kept; l++) load_matrices(0, l);
  }

  void load(Vec* to, const double* from, int64_t count, int lane) {
    for (int64_t i = 0; i < count; i++) put(to, i, lane, from[i]);
  }
  void load(int which, int64_t e, int lane) {
    load(field[which].first, batch.at(which, e), field[which].count * field[which].size, lane);
  }

  void load_matrices(int64_t e, int lane) {
    for (int i = 0; i < kInputs; i++)
      if (kMpcFields[i].columns != Size::one) load(i, e, lane);
    for (int64_t k = 0; k < transposed_A.count; k++)
      for (int64_t i = 0; i < n.x() * n.x(); i++)
        put(transposed_A[k], i % n.x() * n.x() + i / n.x(), lane, lane_of(field[kA][k][i], lane));
    const bool alike = field[kB].count == 1 && field[kQ].count == 1 && field[kR].count == 1;
    const auto entries = [&](Input which) { return [this, which](int64_t k) { return field[which][k]; }; };
    curvature_at_rest(n, entries(kB), n.u(), entries(kQ), field[kQ_final][0], entries(kR), alike, rest, lane);
  }

  Matrix<Vec, 0, 0> square(Vec* entries) const { return {entries, {n.x()}, {n.x()}, {n.x()}}; }

  // Goes to stage k; at the last only the constraints mean something.
  void enter(int64_t k) {
    for (int i = 0; i < kInputs; i++) at[i] = field[i][k];
    A_t = transposed_A[k];
  }

  // Largest residual so far; NaN counts as infinite.
  Vec worst, poison;
  void met(Vec violation) {
    worst = max(worst, violation);
    poison += 0.0 * violation;
  }
  // A sum, and the sum of the sizes of its terms.
  template <class V>
  struct SumOf {
    V value, terms;
    void add(V term) {
      value += term;
      terms += abs(term);
    }
    Vec relative() const { return abs(value) / select(terms > 0, terms, all(1)); }
  };

  using Sum = SumOf<Vec>;

  // Stationarity in lam, C' p + s o y + F' rho = 0 with rho = y o lam: writes what is missing into `error`, returns it
  // in parts of the terms.
  Vec missing(const Vec* lk) {
    const int64_t nx = n.x(), nl = n.l();
    Vec largest = all(0), not_a_number = all(0);
    for (int64_t i = 0; i < nl; i++) rho[i] = y[i] * lk[i];
    for (int64_t i = 0; i < nl; i++) {
      Sum sum{s[i] * y[i], abs(s[i] * y[i])};
      for (int64_t j = 0; j < nx; j++) sum.add(C[j * nl + i] * p[j]);
      for (int64_t j = 0; j < nl; j++) sum.add(F[j * nl + i] * rho[j]);
      error[i] = -sum.value;
      const Vec part = sum.relative();
      largest = max(largest, part);
      not_a_number += 0.0 * part;
    }
    return largest + not_a_number;
  }

  // The multipliers y, rho of one stage from p; returns what they miss. Lanes where elimination without row exchanges
  // lost digits are done again with them.
  Vec multipliers(const Vec* lk, Mask& fragile) {
    const int64_t nx = n.x(), nl = n.l();
    auto form = [&] {  // diag(s) + F' diag(lam)
      for (int64_t i = 0; i < nl; i++) {
        for (int64_t j = 0; j < i; j++) N[i * nl + j] = F[j * nl + i] * lk[j];
        N[i * nl + i] = s[i] + F[i * nl + i] * lk[i];
        for (int64_t j = i + 1; j < nl; j++) N[i * nl + j] = F[j * nl + i] * lk[j];
      }
    };
    for (int64_t i = 0; i < nl; i++) {
      Vec t = all(0);
      for (int64_t j = 0; j < nx; j++) t -= C[j * nl + i] * p[j];
      y[i] = t;
    }
    form();
    lu_factor_by_panels(nl, N);
    lu_solve_by_rows(nl, N, y);
    Vec missed = missing(lk);
    const Mask poor = ~(missed <= 1e-11);
    if (!any(poor)) return missed;
    fragile |= poor;
    form();
    lu_factor_pivoted(nl, N, rows);
    for (int64_t i = 0; i < nl; i++) y[i] = select(poor, all(0), y[i]);
    for (int pass = 0; pass < 3; pass++) {
      missing(lk);
      lu_solve_pivoted(nl, N, rows, error);
      for (int64_t i = 0; i < nl; i++) y[i] = select(poor, y[i] + error[i], y[i]);
    }
    return select(poor, missing(lk), missed);
  }

  // Checks at most kLanes elements by their stored numbers; a solved one whose residual is too large becomes
  // numerical, and one with a weakly active constraint degenerate. One that was cut off, by time or the number of its
  // iterations, is solved if its residual says so; `flat`: which of these have a flat direction.
  void judge(const MpcSolve& o, const int64_t* elements, int count, const bool* flat = nullptr) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nc = n.c(), h = n.h;
    for (int l = 0; l < kLanes; l++) {
      const int64_t e = elements[l < count ? l : 0];
      if (!shared) load_matrices(e, l);
      for (int i = 0; i < kInputs; i++)
        if (kMpcFields[i].columns == Size::one) load(i, e, l);
      load(x, o.x + e * (h + 1) * nx, (h + 1) * nx, l);
      load(u, o.u + e * h * nu, h * nu, l);
      load(lam, o.lam + e * h * nl, h * nl, l);
      load(mu, o.mu + e * (h + 1) * nc, (h + 1) * nc, l);
    }
    for (int64_t j = 0; j < nu; j++) {
      largest_action[j] = all(0);
      for (int64_t k = 0; k < h; k++) largest_action[j] = max(largest_action[j], abs(u[k * nu + j]));
    }
    Mask fragile = Mask{}, weak = Mask{}, brief = Mask{};  // brief: the lanes that need no sizes
    for (sized = nl > 0 || nc > 0 || batch.barrier > 0;; sized = true) {
      const Vec before = worst;
      worst = poison = all(0);
      for (int64_t i = 0; i < nx; i++) met(Sum{x[i] - field[kx0][0][i], abs(field[kx0][0][i])}.relative());
      trajectory();
      weak = constraints();
      costates(fragile);
      worst = select(brief, before, worst);
      poison = zero_where(brief, poison);
      if (sized || !any(~(brief = worst + poison <= kBrief))) break;
    }
    // The rounding of s may be more than what is left: then it must also hold with the other reading of s.
    const Mask unsure = worst > kSure;
    if (any(unsure)) {
      for (int64_t i = 0; i < h * nl; i++) gap[i] = select(unsure, batch.relaxation / lam[i], gap[i]);
      costates(fragile);
    }
    for (int l = 0; l < count; l++) {
      const int64_t e = elements[l];
      const double residual = poison[l] == 0 ? worst[l] : __builtin_inf();
      o.residual[e] = residual;
      o.fragile[e] = fragile[l] != 0;
      if (solved(o.status[e]) && !(residual <= o.certified)) o.status[e] = int8_t(Status::numerical);
      if (flat && o.status[e] == int8_t(Status::max_iter) && residual <= o.certified)
        o.status[e] = int8_t(flat[l] ? Status::degenerate : Status::converged);
      if (weak[l] && o.status[e] == int8_t(Status::converged)) o.status[e] = int8_t(Status::degenerate);
    }
  }

 private:
  // Stationarity, by the costates from the last stage to the first, with s in `gap`.
  void costates(Mask& fragile) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nc = n.c(), h = n.h;
    enter(h);
    for (int64_t i = 0; i < nx; i++) {
      const Vec* weights = field[kQ_final][0];
      Vec t = field[kq_final][0][i], all_terms = abs(t);
      for (int64_t j = 0; j < nx; j++) t += weights[i * nx + j] * x[h * nx + j];
      for (int64_t j = 0; j < nx && sized; j++) all_terms += abs(weights[i * nx + j] * x_size[h * nx + j]);
      for (int64_t m = 0; m < nc; m++) {
        const Vec fine = G_x[m * nx + i] * mu[h * nc + m];
        t += fine;
        all_terms += abs(fine);
      }
      p[i] = t;
      p_size[i] = p_terms[i] = all_terms;
    }
    for (int64_t k = h - 1; k >= 0; k--) {
      enter(k);
      const Vec *xk = x + k * nx, *uk = u + k * nu, *lk = lam + k * nl, *mk = mu + k * nc, *size = x_size + k * nx;
      s = gap + k * nl;
      met(multipliers(lk, fragile));
      for (int64_t i = 0; i < nl; i++) {
        Vec row = all(0), by_size = all(0), by_terms = all(0);
        for (int64_t j = 0; j < nl; j++) row += abs(all(0) + F[i * nl + j]);
        for (int64_t j = 0; j < nx; j++) {
          by_size += abs(C[j * nl + i] * p_size[j]);
          by_terms += abs(C[j * nl + i] * p_terms[j]);
        }
        const Vec answer = kAnswered * abs(lk[i] / (s[i] + lk[i] * row));
        rho_size[i] = answer * by_size;
        rho_terms[i] = answer * by_terms;
      }
      for (int64_t j = 0; j < nu; j++) {
        Sum g{r[j], abs(r[j])};
        Vec whole = all(0);
        for (int64_t m = 0; m < nu; m++) g.add(R[j * nu + m] * uk[m]);
        if (batch.crossed)
          for (int64_t i = 0; i < nx; i++) {
            g.add(cross[i * nu + j] * xk[i]);
            if (sized) whole += abs(cross[i * nu + j] * size[i]);
          }
        for (int64_t i = 0; i < nx; i++) {
          g.add(B[i * nu + j] * p[i]);
          if (sized) whole += abs(B[i * nu + j] * p_size[i]);
        }
        for (int64_t i = 0; i < nl; i++) {
          g.add(E[i * nu + j] * rho[i]);
          whole += abs(E[i * nu + j] * rho_size[i]);
        }
        for (int64_t m = 0; m < nc; m++) g.add(G_u[m * nu + j] * mk[m]);
        g.terms = max(g.terms, kCancelled * whole);
        action(k, j, uk[j], g);
      }
      multiply_columns(square(A), p, q, pn);
      for (int64_t i = 0; i < nx; i++) cost[i] = all(0);
      multiply_symmetric(square(Q), xk, cost, cost);
      by_columns(0, nx, [&](int64_t i, auto kind) {
        using V = decltype(kind);
        SumOf<V> sum{read<V>(pn, i), abs(read<V>(q, i))};
        V along{}, through{}, cost_terms{};
        for (int64_t j = 0; j < nx && sized; j++) {
          const V size_of_a = abs(read<V>(A + j * nx, i));
          cost_terms += abs(read<V>(Q + j * nx, i)) * size[j];
          sum.terms += size_of_a * abs(p[j]);
          along += size_of_a * p_size[j];
        }
        for (int64_t j = 0; j < nl; j++) {
          const auto slope = read<V>(D + j * nx, i);
          sum.add(slope * rho[j]);
          through += abs(slope * rho_terms[j]);
        }
        for (int64_t m = 0; m < nc; m++) sum.add(read<V>(G_x + m * nx, i) * mk[m]);
        write<V>(pn, i, sum.value + read<V>(cost, i));
        write<V>(terms, i, sum.terms + cost_terms);
        write<V>(grown, i, max(along, through));
      });
      for (int64_t i = 0; i < nx; i++) {
        Sum sum{pn[i], terms[i]};
        for (int64_t j = 0; j < nu && batch.crossed; j++) sum.add(cross[i * nu + j] * uk[j]);
        pn[i] = sum.value;
        terms[i] = sum.terms;
        grown[i] = max(max(sum.terms, p_size[i]), kFurther * grown[i]);
      }
      for (int64_t i = 0; i < nx; i++) {
        p[i] = pn[i];
        p_size[i] = grown[i];
        p_terms[i] = terms[i];
      }
    }
  }

  // Dynamics and complementarity of all stages, and the sizes of the states.
  void trajectory() {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    for (int64_t i = 0; i < nx; i++) x_size[i] = abs(x[i]);
    for (int64_t i = 0; i < nx && n.c() > 0; i++) moved[i] = all(0);
    for (int64_t k = 0; k < h; k++) {
      enter(k);
      const Vec *xk = x + k * nx, *uk = u + k * nu, *lk = lam + k * nl, *next = x + (k + 1) * nx;
      const Vec* size = x_size + k * nx;
      multiply_columns(square(A_t), xk, d, pn);
      by_columns(0, sized ? nx : 0, [&](int64_t i, auto kind) {
        using V = decltype(kind);
        V all_terms = abs(read<V>(d, i)), along{};
        for (int64_t j = 0; j < nx; j++) {
          const V size_of_a = abs(read<V>(A_t + j * nx, i));
          all_terms += size_of_a * abs(xk[j]);
          along += size_of_a * size[j];
        }
        write<V>(terms, i, all_terms);
        write<V>(grown, i, along);
      });
      for (int64_t i = 0; i < nx; i++) {
        Sum sum{pn[i], terms[i]};
        Vec wide = all(0);
        for (int64_t j = 0; j < nu; j++) sum.add(B[i * nu + j] * uk[j]);
        for (int64_t j = 0; j < nu && n.c() > 0; j++) wide += abs(B[i * nu + j] * width(k, j));
        if (n.c() > 0) moved[(k + 1) * nx + i] = wide;
        for (int64_t j = 0; j < nl; j++) sum.add(C[i * nl + j] * lk[j]);
        if (sized)
          x_size[(k + 1) * nx + i] = max(max(sum.terms, size[i]), kFurther * grown[i]);
        else
          sum.terms = abs(sum.value);
        sum.value -= next[i];
        met(sum.relative());
      }
      s = gap + k * nl;
      for (int64_t i = 0; i < nl; i++) {
        Sum sum{c[i], abs(c[i])};
        for (int64_t j = 0; j < nx; j++) sum.add(D[i * nx + j] * xk[j]);
        for (int64_t j = 0; j < nu; j++) sum.add(E[i * nu + j] * uk[j]);
        for (int64_t j = 0; j < nl; j++) sum.add(F[i * nl + j] * lk[j]);
        s[i] = sum.value;
        met(abs(lk[i] * s[i] - batch.relaxation) / (batch.relaxation + 1e-7 * abs(lk[i]) * sum.terms));
        met(select(lk[i] > 0, all(0), all(1)));
      }
    }
  }

  Vec width(int64_t k, int64_t j) const { return range(largest_action[j], field[ku_min][k][j], field[ku_max][k][j]); }

  // Stationarity of one action with the reduced gradient g, and its bounds.
  void action(int64_t k, int64_t j, Vec at, Sum g) {
    const Vec below = at - lo[j], above = hi[j] - at;
    Vec width = hi[j] - lo[j];
    if (batch.barrier > 0) {
      g.add(-batch.barrier / below);
      g.add(batch.barrier / above);
      g.terms += 1e-8 * batch.barrier * width * (1.0 / (below * below) + 1.0 / (above * above));
    }
    const Mask fixed = width <= 0;
    width = range(largest_action[j], lo[j], hi[j]);
    const Vec per_width = select(width > kTiny, 1.0 / width, all(0));
    const Vec scale = max(g.terms, width * rest[k][j]);
    const Vec distance = select(g.value > 0, below, above);
    const Vec reach = select(distance > kHuge, distance, distance * per_width);
    const Vec part = min(abs(g.value) / select(scale > 0, scale, all(1)), reach);
    met(select(fixed, all(0), max(part, all(0))) + 0.0 * g.value);
    const Vec outside = max(max(-below, -above), all(0));
    met(select(width > kTiny, outside * per_width, outside));
  }

  // The constraints and their multipliers; returns where one is weakly active.
  Mask constraints() {
    const int64_t nx = n.x(), nu = n.u(), nc = n.c(), h = n.h;
    Mask weak = Mask{};
    for (int64_t i = 0; i < nc; i++) row_terms[i] = row_missed[i] = all(0);
    for (int64_t k = 0; k <= h && nc > 0; k++) {
      enter(k);
      const Vec *g = at[kg], *price = at[kprice];
      for (int64_t i = 0; i < nc; i++) {
        const Mask given = g[i] < kHuge;
        Sum sum{select(given, -g[i], all(0)), select(given, abs(g[i]), all(0))};
        for (int64_t j = 0; j < nx; j++) sum.add(G_x[i * nx + j] * x[k * nx + j]);
        for (int64_t j = 0; j < nu && k < h; j++) sum.add(G_u[i * nu + j] * u[k * nu + j]);
        const Vec m = mu[k * nc + i], value = select(given, sum.value, all(-kHuge));
        row[k * nc + i] = value;
        Vec size = all(0);
        for (int64_t j = 0; j < nx; j++)
          size += abs(G_x[i * nx + j] * (x_size[k * nx + j] + kCancelled * moved[k * nx + j]));
        for (int64_t j = 0; j < nu && k < h; j++) size += abs(G_u[i * nu + j] * (kCancelled * width(k, j)));
        row_terms[i] = max(row_terms[i], select(given, max(sum.terms, kCancelled * size), all(0)));
        const Vec held = select(m < kAtPrice * price[i], abs(value), max(-value, all(0)));
        row_missed[i] = max(row_missed[i], select(m > 0, held, max(value, all(0))));
        met(select((m >= 0) & (m * kAtPrice <= price[i]), all(0), all(1)) + 0.0 * m);
        poison += 0.0 * sum.value;
      }
    }
    for (int64_t i = 0; i < nc; i++) met(row_missed[i] / select(row_terms[i] > 0, row_terms[i], all(1)));
    for (int64_t k = 0; k <= h && nc > 0; k++) {
      enter(k);
      for (int64_t i = 0; i < nc; i++) {
        Vec acts = all(k > 0);  // a row that nothing moves is not weakly active
        for (int64_t j = 0; j < nu && k == 0; j++) acts += abs(all(0) + G_u[i * nu + j]);
        const Vec m = mu[k * nc + i], value = row[k * nc + i], close = kWeak * row_terms[i];
        const Mask at_zero = ~(m > 0) & (value >= -close),
                   at_price = (m >= kAtPrice * field[kprice][k][i]) & (value <= close);
        weak |= (at_zero | at_price) & (acts > 0);
      }
    }
    return weak;
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
