// The certificate of an MPC solution: every optimality condition, recomputed from the numbers returned, in the caller's
// units. difflcs/mpc/kkt.py derives the conditions and states the measure (`residual`); the names here are the names
// there. It shares nothing with the solver but the elimination of one small matrix, whose result it checks.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"
#include "matrix.hpp"
#include "sizes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// T is the type of a matrix entry: double where the batch shares all matrices, else Vec.
template <class T, class S>
struct Certificate {
  const MpcBatch& batch;
  const S n;
  T *A, *B, *C, *D, *E, *F, *Q, *R, *Qf, *rest, *rest_end;
  Vec *d, *c, *q, *r, *qf, *lo, *hi, *x0, *per_width, *x, *u, *lam, *s, *size, *p, *pn, *y, *rho, *error, *N;
  Mask* rows;

  explicit Certificate(const MpcBatch& b) : batch(b), n(b) {}

  void layout(Arena& arena) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    auto take = [&](auto*& to, int64_t count) { arena.take(to, count); };
    take(A, nx * nx), take(B, nx * nu), take(C, nx * nl), take(D, nl * nx), take(E, nl * nu), take(F, nl * nl);
    take(Q, nx * nx), take(R, nu * nu), take(Qf, nx * nx), take(rest, nu), take(rest_end, nu);
    take(d, nx), take(c, nl), take(q, nx), take(r, nu), take(qf, nx), take(lo, nu), take(hi, nu), take(x0, nx);
    take(per_width, nu);
    take(x, (h + 1) * nx), take(u, h * nu), take(lam, h * nl), take(s, nl), take(size, nl), take(p, nx), take(pn, nx);
    take(y, nl), take(rho, nl), take(error, nl), take(N, nl * nl), take(rows, nl);
    if constexpr (sizeof(T) == sizeof(double))
      if (arena.memory) load_matrices(0, 0);
  }

  template <class Entry>
  void load(Entry* to, const double* from, int64_t count, int lane) {
    for (int64_t i = 0; i < count; i++) put(to, i, lane, from[i]);
  }
  template <class Entry>
  void load(Entry* to, Input which, int64_t e, int lane) {
    load(to, batch.input[which] + e * batch.stride[which], extent(batch, kMpcFields[which]), lane);
  }

  void load_matrices(int64_t e, int lane) {
    const int64_t nu = n.u();
    load(A, kA, e, lane), load(B, kB, e, lane), load(C, kC, e, lane), load(D, kD, e, lane), load(E, kE, e, lane);
    load(F, kF, e, lane), load(Q, kQ, e, lane), load(R, kR, e, lane), load(Qf, kQ_final, e, lane);
    curvature_at_rest(n, B, nu, Q, R, rest, lane), curvature_at_rest(n, B, nu, Qf, R, rest_end, lane);
  }

  // Largest residual so far; what is not a number is infinite.
  Vec worst, poison;
  void met(Vec violation) {
    worst = max(worst, violation);
    poison += 0.0 * violation;
  }
  // A sum, and the sum of the sizes of its terms.
  struct Sum {
    Vec value, terms;
    void add(Vec term) { value += term, terms += abs(term); }
    Vec relative() const { return abs(value) / select(terms > 0, terms, all(1)); }
  };

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
      largest = max(largest, part), not_a_number += 0.0 * part;
    }
    return largest + not_a_number;
  }

  // The multipliers y, rho of one stage from p; returns what they miss. Lanes where elimination without row exchanges
  // lost digits are done again with them.
  Vec multipliers(const Vec* lk, Mask& fragile) {
    const int64_t nx = n.x(), nl = n.l();
    auto form = [&] {  // diag(s) + F' diag(lam)
      for (int64_t i = 0; i < nl; i++) {
        for (int64_t j = 0; j < nl; j++) N[i * nl + j] = F[j * nl + i] * lk[j];
        N[i * nl + i] += s[i];
      }
    };
    for (int64_t i = 0; i < nl; i++) {
      Vec t = all(0);
      for (int64_t j = 0; j < nx; j++) t -= C[j * nl + i] * p[j];
      y[i] = t;
    }
    form();
    lu_factor(nl, N);
    lu_solve(nl, N, y);
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

  // Judges at most kLanes elements by what is stored of them; a solved one whose residual is too large becomes
  // numerical.
  void judge(const MpcSolve& o, const int64_t* elements, int count) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    for (int l = 0; l < kLanes; l++) {
      const int64_t e = elements[l < count ? l : 0];
      if constexpr (sizeof(T) != sizeof(double)) load_matrices(e, l);
      load(d, kd, e, l), load(c, kc, e, l), load(q, kq, e, l), load(r, kr, e, l), load(qf, kq_final, e, l);
      load(lo, ku_min, e, l), load(hi, ku_max, e, l), load(x0, kx0, e, l);
      load(x, o.x + e * (h + 1) * nx, (h + 1) * nx, l), load(u, o.u + e * h * nu, h * nu, l);
      load(lam, o.lam + e * h * nl, h * nl, l);
    }
    for (int64_t j = 0; j < nu; j++) {
      const Vec width = hi[j] - lo[j];
      per_width[j] = select(width > 1e-300, 1.0 / width, all(0));
    }
    worst = poison = all(0);
    Mask fragile = Mask{};
    for (int64_t i = 0; i < nx; i++) met(Sum{x[i] - x0[i], abs(x0[i])}.relative());
    for (int64_t i = 0; i < nx; i++) {
      Vec t = qf[i];
      for (int64_t j = 0; j < nx; j++) t += Qf[i * nx + j] * x[h * nx + j];
      p[i] = t;
    }
    for (int64_t k = h - 1; k >= 0; k--) {
      const Vec *xk = x + k * nx, *uk = u + k * nu, *lk = lam + k * nl, *next = x + (k + 1) * nx;
      for (int64_t i = 0; i < nx; i++) {
        Sum sum{d[i], abs(d[i])};
        for (int64_t j = 0; j < nx; j++) sum.add(A[i * nx + j] * xk[j]);
        for (int64_t j = 0; j < nu; j++) sum.add(B[i * nu + j] * uk[j]);
        for (int64_t j = 0; j < nl; j++) sum.add(C[i * nl + j] * lk[j]);
        sum.value -= next[i];
        met(sum.relative());
      }
      for (int64_t i = 0; i < nl; i++) {
        Sum sum{c[i], abs(c[i])};
        for (int64_t j = 0; j < nx; j++) sum.add(D[i * nx + j] * xk[j]);
        for (int64_t j = 0; j < nu; j++) sum.add(E[i * nu + j] * uk[j]);
        for (int64_t j = 0; j < nl; j++) sum.add(F[i * nl + j] * lk[j]);
        s[i] = sum.value;
        met(abs(lk[i] * s[i] - batch.relaxation) / (batch.relaxation + 1e-7 * abs(lk[i]) * sum.terms));
        met(select(lk[i] > 0, all(0), all(1)));
      }
      met(multipliers(lk, fragile));
      for (int64_t j = 0; j < nu; j++) {
        Sum g{r[j], abs(r[j])};
        for (int64_t m = 0; m < nu; m++) g.add(R[j * nu + m] * uk[m]);
        for (int64_t i = 0; i < nx; i++) g.add(B[i * nu + j] * p[i]);
        for (int64_t i = 0; i < nl; i++) g.add(E[i * nu + j] * rho[i]);
        const Vec below = uk[j] - lo[j], above = hi[j] - uk[j], width = hi[j] - lo[j];
        if (batch.barrier > 0) {
          g.add(-batch.barrier / below), g.add(batch.barrier / above);
          g.terms += 1e-8 * batch.barrier * width * (1.0 / (below * below) + 1.0 / (above * above));
        }
        const Vec scale = max(g.terms, width * (k == h - 1 ? rest_end[j] : rest[j]));
        const Vec reach = select(g.value > 0, below, above) * per_width[j];
        const Vec part = min(abs(g.value) / select(scale > 0, scale, all(1)), reach);
        met(select(width > 0, max(part, all(0)), all(0)) + 0.0 * g.value);
        const Vec outside = max(max(-below, -above), all(0));
        met(select(width > 0, outside * per_width[j], outside));
      }
      for (int64_t i = 0; i < nx; i++) {
        Vec t = q[i];
        for (int64_t j = 0; j < nx; j++) t += Q[i * nx + j] * xk[j] + A[j * nx + i] * p[j];
        for (int64_t j = 0; j < nl; j++) t += D[j * nx + i] * rho[j];
        pn[i] = t;
      }
      for (int64_t i = 0; i < nx; i++) p[i] = pn[i];
    }
    for (int l = 0; l < count; l++) {
      const int64_t e = elements[l];
      const double residual = poison[l] == 0 ? worst[l] : __builtin_inf();
      o.residual[e] = residual, o.fragile[e] = fragile[l] != 0;
      if (solved(o.status[e]) && !(residual <= o.certified)) o.status[e] = int8_t(Status::numerical);
    }
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
