// The batched LCS-MPC solver and its adjoint, compiled once per instruction set (see CMakeLists.txt).
//
// For F + F^T positive definite the relaxed complementarity lam o s = eps has one solution, smooth in (x, u).
// Eliminating lam leaves a smooth optimal control problem in u alone with box bounds. It is solved by projected Newton:
// a Riccati backward sweep with the exact second derivative of lam, a feedback rollout clipped to the box with an
// Armijo search, and a homotopy in eps from `first_relaxation` down to `relaxation`. The adjoint is the same backward
// sweep with the upstream gradients as linear terms; difflcs/mpc/kkt.py derives it, and the names here are the names
// there.
//
// One problem per SIMD lane: the code reads like the solver of a single problem. A finished lane stores its result and
// takes the next problem. No lane's arithmetic depends on another lane: whatever iterates, iterates under a mask.
//
// What is stored is judged by certificate.hpp from the stored numbers alone, whatever the solver thinks of them.
#include "certificate.hpp"
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"
#include "sizes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

constexpr double kTiny = 1e-300;
// Projected gradient, in parts of its scale (see certificate.hpp), at which a problem is solved.
constexpr double kStationary = 1e-7;
// Smallest curvature of an action, in parts of what would move it across its whole range: bounds Newton's step where
// the cost is flat.
constexpr double kFlat = 1e-3;
// A reduced Hessian is singular below this part of an action's own curvature (difflcs.mpc.kkt has the same).
constexpr double kSingular = 1e-10;
// An action with a barrier is differentiated as one at its bound below this part of its range (kkt has the same).
constexpr double kClose = 1e-8;
// Failed searches in a row, each with 8 times the damping, before a problem is given up.
constexpr int64_t kFailures = 12;

// T is the type of a matrix entry: double where the batch shares all matrices, else Vec.
template <class T, class S>
struct Mpc {
  const MpcBatch& batch;
  const S n;
  // Problem: [A B], C, [D E], F, Q, R, Q_final and the vectors.
  T *AB, *C, *DE, *F, *Q, *R, *Qf;
  // lam = scale * lam', s = s' / scale, chosen so that F' has a unit diagonal: contacts in any units converge alike. C,
  // [D E], F, c, lam and s are kept in these units; the product lam o s does not change.
  T* scale;
  // The cost is kept in units of 1 / cost_unit: weights below 1e-3 are lifted to one, so that tolerances hold for them.
  T* cost_unit;
  T *rest, *rest_end;  // curvature of each action by the next stage's weights alone: the least scale of its gradient
  Vec *d, *c, *q, *r, *qf, *lo, *hi, *x0;
  Vec* per_width;  // reciprocal of each action's range, zero where that is zero
  // Trajectory, trial trajectory, and the feedback law.
  Vec *x, *u, *lam, *s, *xt, *ut, *lamt, *st, *K, *kf, *grad;
  // Scratch of the backward sweep and of the LCP.
  Vec *P, *Pn, *v, *vn, *p, *pn, *M, *Mc, *Kl, *Tk, *Wk, *av, *bv, *Ah, *PA, *H, *lin, *Lc, *Kk, *y, *size, *gap, *res,
      *newton, *wt, *dl, *flat;
  // Kept per stage for the adjoint.
  Vec *Kl_s, *Ks_s, *Ah_s, *M_s, *size_s, *y_s, *P_s, *v_s, *p_s, *xb, *ub, *lb, *sum;
  Mask *act, *low, *upp, *rows, *rows_s;
  Vec jb;
  const bool adjoint;
  Vec mu;  // weight of the barrier of the bounds: follows the homotopy down to batch.barrier

  // Lays the arrays out in `memory`, or only counts them where it is null.
  int64_t layout(void* memory, bool adjoint) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), h = n.h;
    int64_t used = 0;
    auto bytes = [&](int64_t amount) {
      void* at = memory ? static_cast<char*>(memory) + used : nullptr;
      used += (amount + 63) / 64 * 64;
      return at;
    };
    auto mat = [&](T*& a, int64_t k) { a = static_cast<T*>(bytes(k * int64_t(sizeof(T)))); };
    auto vec = [&](Vec*& a, int64_t k) { a = static_cast<Vec*>(bytes(k * int64_t(sizeof(Vec)))); };
    auto mask = [&](Mask*& a, int64_t k) { a = static_cast<Mask*>(bytes(k * int64_t(sizeof(Mask)))); };
    mat(AB, nx * nw), mat(C, nx * nl), mat(DE, nl * nw), mat(F, nl * nl), mat(Q, nx * nx), mat(R, nu * nu);
    mat(Qf, nx * nx), mat(scale, nl), mat(cost_unit, 1), mat(rest, nu), mat(rest_end, nu);
    vec(d, nx), vec(c, nl), vec(q, nx), vec(r, nu), vec(qf, nx), vec(lo, nu), vec(hi, nu), vec(x0, nx);
    vec(x, (h + 1) * nx), vec(u, h * nu), vec(lam, h * nl), vec(s, h * nl);
    vec(xt, (h + 1) * nx), vec(ut, h * nu), vec(lamt, h * nl), vec(st, h * nl), vec(K, h * nu * nx), vec(kf, h * nu);
    vec(grad, h * nu);
    vec(P, nx * nx), vec(Pn, nx * nx), vec(v, nx), vec(vn, nx), vec(p, nx), vec(pn, nx), vec(M, nl * nl);
    vec(Mc, nl * nl), vec(Kl, nl * nw), vec(Tk, nl * nw), vec(Wk, nl * nw), vec(av, nl), vec(bv, nl);
    vec(Ah, nx * nw), vec(PA, nx * nw), vec(H, nw * nw), vec(lin, nw);
    vec(Lc, nu * nu), vec(Kk, nu * (nx + 1)), vec(y, nl), vec(size, nl), vec(gap, nl), vec(res, nl), vec(wt, nl);
    vec(dl, nl), vec(newton, 6 * nl), mask(act, h * nu), mask(low, h * nu), mask(upp, h * nu), mask(rows, nl);
    vec(flat, nu), vec(per_width, nu);
    if (adjoint) {
      vec(Kl_s, h * nl * nw), vec(Ks_s, h * nl * nw), vec(Ah_s, h * nx * nw), vec(M_s, h * nl * nl);
      vec(size_s, h * nl), vec(y_s, h * nl), vec(P_s, (h + 1) * nx * nx), vec(v_s, (h + 1) * nx);
      vec(p_s, (h + 1) * nx), vec(xb, (h + 1) * nx), vec(ub, h * nu), vec(lb, h * nl), mask(rows_s, h * nl);
      vec(sum, 2 * nx * nx + nu * nu + nx * nx + nx * nw + nw * nl + nl * nl + nl * nx + 5 * nx + 3 * nu + nl);
    }
    return used;
  }

  Mpc(const MpcBatch& b, void* memory, bool adjoint) : batch(b), n(b), adjoint(adjoint) {
    layout(memory, adjoint);
    mu = all(b.barrier);
    if constexpr (sizeof(T) == sizeof(double))
      if (memory) load_matrices(0, 0);
  }

  // ---- loading ----
  const double* input(Input which, int64_t element) const { return batch.input[which] + element * batch.stride[which]; }

  void load_matrices(int64_t e, int lane) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w();
    const double* diagonal = input(kF, e);
    for (int64_t i = 0; i < nl; i++) {
      const double f = diagonal[i * nl + i];
      put(scale, i, lane, f > 0 ? 1.0 / __builtin_sqrt(f) : 1.0);
    }
    const auto one = [](int64_t) { return 1.0; };
    const auto contact = [&](int64_t i) { return lane_of(scale[i], lane); };
    auto block = [&](T* to, int64_t width, int64_t column, Input which, int64_t rows, int64_t columns, auto by_row,
                     auto by_column) {
      const double* from = input(which, e);
      for (int64_t i = 0; i < rows; i++)
        for (int64_t j = 0; j < columns; j++)
          put(to, i * width + column + j, lane, from[i * columns + j] * (by_row(i) * by_column(j)));
    };
    block(AB, nw, 0, kA, nx, nx, one, one), block(AB, nw, nx, kB, nx, nu, one, one);
    block(C, nl, 0, kC, nx, nl, one, contact), block(F, nl, 0, kF, nl, nl, contact, contact);
    block(DE, nw, 0, kD, nl, nx, contact, one), block(DE, nw, nx, kE, nl, nu, contact, one);
    put(cost_unit, 0, lane, adjoint ? 1.0 : unit_of_cost(e));
    const auto cost = [&](int64_t) { return lane_of(cost_unit[0], lane); };
    block(Q, nx, 0, kQ, nx, nx, one, cost), block(R, nu, 0, kR, nu, nu, one, cost);
    block(Qf, nx, 0, kQfinal, nx, nx, one, cost);
    curvature_at_rest(n, AB + nx, nw, Q, R, rest, lane), curvature_at_rest(n, AB + nx, nw, Qf, R, rest_end, lane);
  }

  // A power of two that brings the largest weight to about one where it is below 1e-3.
  double unit_of_cost(int64_t e) const {
    double largest = 0;
    const Input weights[] = {kQ, kR, kQfinal};
    for (const Input which : weights) {
      const int64_t size = which == kR ? n.u() : n.x();
      for (int64_t i = 0; i < size * size; i++) {
        const double weight = __builtin_fabs(input(which, e)[i]);
        largest = weight > largest ? weight : largest;
      }
    }
    if (!(largest > kTiny && largest < 1e-3)) return 1.0;
    int exponent;
    __builtin_frexp(largest, &exponent);
    return __builtin_ldexp(1.0, -exponent);
  }

  void load(int64_t e, int lane) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    if constexpr (sizeof(T) != sizeof(double)) load_matrices(e, lane);
    auto vector = [&](Vec* to, Input which, int64_t size, double unit = 1.0) {
      const double* from = input(which, e);
      for (int64_t i = 0; i < size; i++) put(to, i, lane, from[i] * unit);
    };
    const double cost = lane_of(cost_unit[0], lane);
    vector(d, kd, nx), vector(c, kc, nl), vector(q, kq, nx, cost), vector(r, kr, nu, cost);
    vector(qf, kqfinal, nx, cost), vector(lo, kumin, nu), vector(hi, kumax, nu), vector(x0, kx0, nx);
    for (int64_t i = 0; i < nu; i++) {
      const double width = hi[i][lane] - lo[i][lane];
      put(per_width, i, lane, width > kTiny ? 1.0 / width : 0.0);
    }
    for (int64_t i = 0; i < nl; i++) put(c, i, lane, c[i][lane] * lane_of(scale[i], lane));
  }

  // lam to and from the units of the caller.
  void load_lam(Vec* to, const double* from, int lane, bool dual = false) {
    const int64_t nl = n.l();
    for (int64_t i = 0; i < n.h * nl; i++) {
      const double unit = lane_of(scale[i % nl], lane);
      put(to, i, lane, dual ? from[i] * unit : from[i] / unit);
    }
  }
  void store_lam(double* to, int lane) const {
    const int64_t nl = n.l();
    for (int64_t i = 0; i < n.h * nl; i++) to[i] = lam[i][lane] * lane_of(scale[i % nl], lane);
  }

  static void load_lane(Vec* to, const double* from, int64_t size, int lane) {
    for (int64_t i = 0; i < size; i++) put(to, i, lane, from[i]);
  }
  static void store_lane(double* to, const Vec* from, int64_t size, int lane) {
    for (int64_t i = 0; i < size; i++) to[i] = reinterpret_cast<const double*>(from + i)[lane];
  }

  // ---- elimination of lam ----
  template <class Matrix>
  static void factor(int64_t size, Matrix& matrix, [[maybe_unused]] Mask* exchanged) {
    if constexpr (S::kPivot)
      lu_factor_pivoted(size, matrix.v, exchanged);
    else
      lu_factor(size, matrix);
  }
  template <class Matrix, class Vector>
  static void back(int64_t size, const Matrix& matrix, [[maybe_unused]] const Mask* exchanged, Vector& b) {
    if constexpr (S::kPivot)
      lu_solve_pivoted(size, matrix.v, exchanged, b.v);
    else
      lu_solve(size, matrix, b);
  }
  static void back_transposed(int64_t size, const Vec* matrix, [[maybe_unused]] const Mask* exchanged, Vec* b) {
    if constexpr (S::kPivot)
      lu_solve_transposed_pivoted(size, matrix, exchanged, b);
    else
      lu_solve_transposed(size, matrix, b);
  }

  // ---- dynamics ----
  void gap_at(const Vec* xk, const Vec* uk, Vec* out) const {  // D x + E u + c
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w();
    for (int64_t i = 0; i < nl; i++) {
      Vec t = c[i];
      for (int64_t j = 0; j < nx; j++) t += DE[i * nw + j] * xk[j];
      for (int64_t j = 0; j < nu; j++) t += DE[i * nw + nx + j] * uk[j];
      out[i] = t;
    }
  }

  void next_state(const Vec* xk, const Vec* uk, const Vec* lk, Vec* out) const {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w();
    for (int64_t i = 0; i < nx; i++) {
      Vec t = d[i];
      for (int64_t j = 0; j < nx; j++) t += AB[i * nw + j] * xk[j];
      for (int64_t j = 0; j < nu; j++) t += AB[i * nw + nx + j] * uk[j];
      for (int64_t j = 0; j < nl; j++) t += C[i * nl + j] * lk[j];
      out[i] = t;
    }
  }

  // lam o (F lam + gap) = eps by damped Newton on the CHKS function g = lam + w - root (see lcp.cpp) from the guess in
  // lk. Lanes in `skip` keep lk and sk.
  void relaxed_lcp(Vec* lk, Vec* sk, Vec eps, Mask skip) {
    const int64_t nl = n.l();
    const Vec eps4 = 4.0 * eps;
    Local<S::kL * S::kL> jacobian(M);
    Local<S::kL> at(newton), w(newton + nl), root(newton + 2 * nl), step(dl);
    Local<S::kL> next(newton + 3 * nl), w_next(newton + 4 * nl), root_next(newton + 5 * nl);
    // w, root and the squared norm of g at `next`; the next iterate starts from what the last trial computed.
    auto evaluate = [&] {
      Vec merit = all(0);
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) {
        Vec t = gap[i];
        DIFFLCS_UNROLL
        for (int64_t j = 0; j < nl; j++) t += F[i * nl + j] * next[j];
        const Vec diff = next[i] - t;
        w_next[i] = t, root_next[i] = sqrt(diff * diff + eps4);
        const Vec g = next[i] + t - root_next[i];
        merit += g * g;
      }
      return merit;
    };
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < nl; i++) at[i] = next[i] = lk[i];
    Vec merit = evaluate(), best = all(1e300);
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < nl; i++) w[i] = w_next[i], root[i] = root_next[i];
    Mask done = skip;
    for (int iteration = 0; iteration < 50; iteration++) {
      Vec magnitude = all(0);
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) magnitude = max(magnitude, abs(at[i]) + abs(w[i]) + abs(gap[i]));
      // Converged at rounding level, or stuck just above it.
      const Vec floor = 1e-15 * magnitude;
      done |= (merit <= floor * floor) | ((merit <= 1e-24 * magnitude * magnitude) & (merit > 0.25 * best)) |
              (merit != merit);
      best = min(best, merit);
      if (!any(~done)) break;
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) {
        const Vec ratio = (at[i] - w[i]) / root[i], b = 1.0 + ratio;
        DIFFLCS_UNROLL
        for (int64_t j = 0; j < nl; j++) jacobian[i * nl + j] = b * F[i * nl + j];
        jacobian[i * nl + i] += 1.0 - ratio;
        step[i] = root[i] - at[i] - w[i];
      }
      factor(nl, jacobian, rows);
      back(nl, jacobian, rows, step);
      Vec length = all(1), merit_next = merit;
      for (int search = 0; search < 8; search++) {
        DIFFLCS_UNROLL
        for (int64_t i = 0; i < nl; i++) next[i] = at[i] + length * step[i];
        merit_next = evaluate();
        const Mask poor = (merit_next > merit * (1.0 - 0.2 * length)) & (merit > 1e-24 * magnitude * magnitude) & ~done;
        if (!any(poor)) break;
        if (search < 7) length = select(poor, 0.4 * length, length);
      }
      DIFFLCS_UNROLL
      for (int64_t i = 0; i < nl; i++) {
        at[i] = select(done, at[i], next[i]);
        w[i] = select(done, w[i], w_next[i]);
        root[i] = select(done, root[i], root_next[i]);
      }
      merit = select(done, merit, merit_next);
    }
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < nl; i++) {
      const Vec diff = at[i] - w[i], larger = 0.5 * (abs(diff) + root[i]), smaller = eps / larger;
      lk[i] = select(skip, lk[i], select(diff > 0, larger, smaller));
      sk[i] = select(skip, sk[i], select(diff > 0, smaller, larger));
    }
    if constexpr (S::kPivot) polish_lcp(lk, sk, eps, skip);
  }

  // The root of the CHKS function loses the smaller of lam and s where they differ by 1e16, and a large entry of F
  // carries that into other rows. Newton on lam o (F lam + gap) = eps itself, from a point that is nearly there, does
  // not: (diag(s) + diag(lam) F) dlam = eps - lam o (F lam + gap).
  void polish_lcp(Vec* lk, Vec* sk, Vec eps, Mask skip) {
    const int64_t nl = n.l();
    Local<S::kL * S::kL> jacobian(M);
    Local<S::kL> step(dl);
    for (int iteration = 0; iteration < 4; iteration++) {
      for (int64_t i = 0; i < nl; i++) {
        Vec t = gap[i];
        for (int64_t j = 0; j < nl; j++) t += F[i * nl + j] * lk[j], jacobian[i * nl + j] = lk[i] * F[i * nl + j];
        jacobian[i * nl + i] += sk[i];
        step[i] = eps - lk[i] * t;
      }
      factor(nl, jacobian, rows);
      back(nl, jacobian, rows, step);
      Mask keep = skip;  // a step that would leave the interior, or is not a number
      for (int64_t i = 0; i < nl; i++) keep |= ~(abs(step[i]) <= 0.5 * lk[i]);
      for (int64_t i = 0; i < nl; i++) {
        lk[i] = select(keep, lk[i], lk[i] + step[i]);
        sk[i] = select(keep, sk[i], eps / lk[i]);
      }
    }
  }

  // Cost of a trajectory.
  Vec cost(const Vec* xs, const Vec* us) const {
    const int64_t nx = n.x(), nu = n.u();
    auto quadratic = [](const T* W, const Vec* linear, const Vec* z, int64_t size) {
      Vec total = all(0);
      for (int64_t i = 0; i < size; i++) {
        Vec t = all(0);
        for (int64_t j = 0; j < size; j++) t += W[i * size + j] * z[j];
        total += z[i] * (0.5 * t + linear[i]);
      }
      return total;
    };
    Vec total = quadratic(Qf, qf, xs + n.h * nx, nx);
    for (int64_t k = 0; k < n.h; k++) total += quadratic(Q, q, xs + k * nx, nx) + quadratic(R, r, us + k * nu, nu);
    if (batch.barrier > 0)
      for (int64_t k = 0; k < n.h; k++)
        for (int64_t j = 0; j < nu; j++) total -= mu * log((us[k * nu + j] - lo[j]) * (hi[j] - us[k * nu + j]));
    return total;
  }

  // ---- backward sweep ----
  struct Sweep {
    Vec projected;   // projected gradient in units of the gradient, with the curvature as the scale of the bounds
    Vec rounding;    // level below which rounding hides it
    Vec stationary;  // projected gradient in parts of its scale, which sees flat directions too (certificate.hpp)
    Mask weak;       // a bound is weakly active, or the reduced Hessian is singular
  };

  template <bool kAdjoint>
  Sweep backward(Vec regularisation, Mask stubborn) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), h = n.h;
    Sweep out{all(0), all(0), all(0), Mask{}};
    for (int64_t i = 0; i < nx; i++) {
      Vec t = qf[i];
      for (int64_t j = 0; j < nx; j++) {
        P[i * nx + j] = all(0) + Qf[i * nx + j];
        t += Qf[i * nx + j] * x[h * nx + j];
      }
      p[i] = t;
      v[i] = kAdjoint ? -xb[h * nx + i] : t;
    }
    for (int64_t k = h - 1; k >= 0; k--) {
      const Vec *xk = x + k * nx, *uk = u + k * nu, *lk = lam + k * nl, *sk = s + k * nl;
      if (kAdjoint) {
        for (int64_t i = 0; i < nx; i++) p_s[(k + 1) * nx + i] = p[i], v_s[(k + 1) * nx + i] = v[i];
        for (int64_t i = 0; i < nx * nx; i++) P_s[(k + 1) * nx * nx + i] = P[i];
      }
      // Linearised LCP: dlam = Kl (dx, du), ds = Ks (dx, du), dx+ = Ah (dx, du). Since a dlam + b ds = 0, both follow
      // from one T: Kl = b T, Ks = -a T with (diag(a) + F diag(b)) T = -[D E].
      for (int64_t i = 0; i < nl; i++) {
        size[i] = 1.0 / (lk[i] + sk[i]);
        av[i] = sk[i] * size[i], bv[i] = lk[i] * size[i];
      }
      Local<S::kL * S::kL> left(M), right(Mc);
      auto eliminate = [&](auto& matrix, bool by_row) {  // diag(a) + diag(b) F, or diag(a) + F diag(b)
        DIFFLCS_UNROLL
        for (int64_t i = 0; i < nl; i++) {
          DIFFLCS_UNROLL
          for (int64_t j = 0; j < nl; j++) matrix[i * nl + j] = bv[by_row ? i : j] * F[i * nl + j];
          matrix[i * nl + i] += av[i];
        }
        factor(nl, matrix, rows);
      };
      eliminate(left, true);
      for (int64_t i = 0; i < nl * nl; i++) M[i] = left[i];
      // y = (diag(s) + F^T diag(lam))^-1 (-C^T p), from the same factors.
      for (int64_t i = 0; i < nl; i++) {
        Vec t = all(0);
        for (int64_t j = 0; j < nx; j++) t -= C[j * nl + i] * p[j];
        y[i] = t;
      }
      back_transposed(nl, M, rows, y);
      if (kAdjoint)
        for (int64_t i = 0; i < nl; i++) rows_s[k * nl + i] = rows[i];
      eliminate(right, false);
      for (int64_t j = 0; j < nw; j++) {
        Local<S::kL> t(dl);
        DIFFLCS_UNROLL
        for (int64_t i = 0; i < nl; i++) t[i] = all(0) - DE[i * nw + j];
        back(nl, right, rows, t);
        DIFFLCS_UNROLL
        for (int64_t i = 0; i < nl; i++) Tk[i * nw + j] = t[i], Kl[i * nw + j] = t[i] = bv[i] * t[i];
        for (int64_t i = 0; i < nx; i++) {
          Vec sum = all(0) + AB[i * nw + j];
          DIFFLCS_UNROLL
          for (int64_t m = 0; m < nl; m++) sum += C[i * nl + m] * t[m];
          Ah[i * nw + j] = sum;
        }
      }
      for (int64_t i = 0; i < nl; i++) {
        y[i] *= size[i];
        for (int64_t j = 0; j < nw; j++) Wk[i * nw + j] = -2.0 * y[i] * av[i] * Kl[i * nw + j];
      }
      if (kAdjoint) {
        for (int64_t i = 0; i < nl; i++)
          for (int64_t j = 0; j < nw; j++) {
            Kl_s[(k * nl + i) * nw + j] = Kl[i * nw + j];
            Ks_s[(k * nl + i) * nw + j] = -av[i] * Tk[i * nw + j];
          }
        for (int64_t i = 0; i < nx * nw; i++) Ah_s[k * nx * nw + i] = Ah[i];
        for (int64_t i = 0; i < nl * nl; i++) M_s[k * nl * nl + i] = M[i];
        for (int64_t i = 0; i < nl; i++) size_s[k * nl + i] = size[i], y_s[k * nl + i] = y[i];
      }
      // Stage Hessian H = blkdiag(Q, R) + Ah^T P Ah, lower triangle; its second-derivative part Y is added below. The
      // first state is given: of stage 0 only the action block is needed.
      const int64_t first = k == 0 ? nx : 0;
      Local<S::kX> column(vn);
      for (int64_t j = first; j < nw; j++) {
        DIFFLCS_UNROLL
        for (int64_t m = 0; m < nx; m++) column[m] = Ah[m * nw + j];
        for (int64_t i = 0; i < nx; i++) {
          Vec t = all(0);
          DIFFLCS_UNROLL
          for (int64_t m = 0; m < nx; m++) t += P[i * nx + m] * column[m];
          PA[i * nw + j] = t;
        }
      }
      for (int64_t i = first; i < nw; i++) {
        DIFFLCS_UNROLL
        for (int64_t m = 0; m < nx; m++) column[m] = Ah[m * nw + i];
        for (int64_t j = first; j <= i; j++) {
          Vec t = all(0);
          if (i < nx)
            t += Q[i * nx + j];
          else if (j >= nx)
            t += R[(i - nx) * nu + j - nx];
          DIFFLCS_UNROLL
          for (int64_t m = 0; m < nx; m++) t += column[m] * PA[m * nw + j];
          H[i * nw + j] = t;
        }
      }
      auto curvature = [&](int64_t i, int64_t j) {  // Y_ij = sum_m y_m (Kl_mi Ks_mj + Ks_mi Kl_mj)
        Vec t = all(0);
        for (int64_t m = 0; m < nl; m++) t += Wk[m * nw + i] * Tk[m * nw + j];
        return t;
      };
      // Reduced gradient g, costate of the previous state, and the linear term of the stage.
      for (int64_t j = 0; j < nu; j++) {
        Vec t = r[j];
        for (int64_t m = 0; m < nu; m++) t += R[j * nu + m] * uk[m];
        const Vec below = uk[j] - lo[j], above = hi[j] - uk[j], width = hi[j] - lo[j];
        if (batch.barrier > 0) {
          t += mu * (1.0 / above - 1.0 / below);
          H[(nx + j) * nw + nx + j] += mu * (1.0 / (below * below) + 1.0 / (above * above));
        }
        Vec g = t, l = kAdjoint ? -ub[k * nu + j] : t, terms = abs(t);
        for (int64_t i = 0; i < nx; i++) {
          const Vec part = Ah[i * nw + nx + j] * p[i];
          g += part, terms += abs(part), l += Ah[i * nw + nx + j] * v[i];
        }
        if (kAdjoint)
          for (int64_t m = 0; m < nl; m++) l -= Kl[m * nw + nx + j] * lb[k * nl + m];
        lin[nx + j] = l, grad[k * nu + j] = g;
        // Away from an optimum P, and with it H, can be indefinite: |H| is still a scale for the distance to a bound.
        // Where the cost is flat, the range of the action is the scale: a descent leads across all of it.
        const Vec across = abs(g) * per_width[j];
        const Vec gauss_newton =
            max(max(abs(H[(nx + j) * nw + nx + j]), all(0) + R[j * nu + j]), max(across, all(kTiny)));
        const Vec scaled = max(lo[j], min(hi[j], uk[j] - g / gauss_newton));
        Vec projected = abs(scaled - uk[j]) * gauss_newton;
        // Next to a bound the barrier is so steep that rounding u alone moves g: a step below rounding counts as none.
        if (batch.barrier > 0) projected = select(abs(g) <= 1e-14 * width * gauss_newton, all(0), projected);
        out.projected = max(out.projected, projected);
        out.rounding = max(out.rounding, 1e-12 * terms);
        if (batch.barrier > 0)
          terms += mu * (1.0 / below + 1.0 / above) +
                   1e-8 * mu * width * (1.0 / (below * below) + 1.0 / (above * above));
        const Vec reference = max(terms, (k == h - 1 ? rest_end[j] : rest[j]) * width);
        Vec part = select(reference > 0, abs(g) / reference, all(0));
        part = min(part, select(g > 0, below, above) * per_width[j]);
        if (batch.barrier > 0) part = select(projected > 0, part, all(0));
        out.stationary = max(out.stationary, part);
        flat[j] = kFlat * across;
        const Vec least = 1e-10 * reference * per_width[j];
        const Vec curved = max(H[(nx + j) * nw + nx + j] + curvature(nx + j, nx + j), max(least, all(kTiny)));
        const Vec step = g / curved;
        if (batch.barrier == 0)
          out.weak |= (min(below, above) <= 1e-5 * width) & (abs(step) <= 1e-5 * width) & (width > 0);
        const Mask fixed = width <= 0;
        if (kAdjoint) {
          low[k * nu + j] = (step > below) | (fixed & (g >= 0));
          upp[k * nu + j] = (-step > above) | (fixed & (g < 0));
        } else {
          // Next to a bound that the action's own Newton step would cross it is put onto the bound (Bertsekas).
          // Not after a failed step: the jump is not damped, and in an unstable system it can cost more than it gains.
          const Vec reach = g / gauss_newton, near = select(regularisation > 0, all(1e-12), all(1e-2)) * width;
          low[k * nu + j] = (below <= near) & (reach >= below) & (g > 0);
          upp[k * nu + j] = (above <= near) & (-reach >= above) & (g < 0);
        }
        if (batch.barrier > 0) {
          // A barrier that keeps no distance to speak of is the bound itself; its steepness is then only rounding.
          const Vec close = max(kClose * width, 1e-3 * kClose * max(abs(lo[j]), abs(hi[j])));
          low[k * nu + j] = kAdjoint ? (below <= close) & (below <= above) : Mask{};
          upp[k * nu + j] = kAdjoint ? (above <= close) & (above < below) : Mask{};
        }
        act[k * nu + j] = low[k * nu + j] | upp[k * nu + j] | fixed;
      }
      for (int64_t i = 0; i < nx; i++) {
        Vec t = q[i];
        for (int64_t j = 0; j < nx; j++) t += Q[i * nx + j] * xk[j];
        Vec a = t, l = kAdjoint ? -xb[k * nx + i] : t;
        for (int64_t j = 0; j < nx; j++) a += Ah[j * nw + i] * p[j], l += Ah[j * nw + i] * v[j];
        if (kAdjoint)
          for (int64_t m = 0; m < nl; m++) l -= Kl[m * nw + i] * lb[k * nl + m];
        pn[i] = a, lin[i] = l;
      }
      // Curvature that action j has at least, whatever its units.
      auto action_scale = [&](int64_t j) {
        return max(R[j * nu + j] + 1e-6 * abs(H[(nx + j) * nw + nx + j]), all(kTiny));
      };
      // Cholesky of H_uu + Y_uu + regularisation with identity rows for active actions. An indefinite block first drops
      // Y at this stage (Gauss-Newton), then has its pivots lifted; lanes that are `stubborn` lift them at once.
      const Mask* active = act + k * nu;
      Vec use = all(1);
      for (int attempt = 0; attempt < 2; attempt++) {
        Mask failed = Mask{};
        for (int64_t i = 0; i < nu; i++)
          for (int64_t j = 0; j <= i; j++) {
            Vec t = H[(nx + i) * nw + nx + j] + use * curvature(nx + i, nx + j);
            if (i == j && !kAdjoint) t += regularisation * action_scale(j) + flat[j];
            Lc[i * nu + j] = select(active[i] | active[j], all(i == j), t);
          }
        for (int64_t j = 0; j < nu; j++) {
          Vec pivot = Lc[j * nu + j];
          for (int64_t m = 0; m < j; m++) pivot -= Lc[j * nu + m] * Lc[j * nu + m];
          const Vec singular = kSingular * abs(H[(nx + j) * nw + nx + j]);
          const Vec lift = kAdjoint ? singular : 0.05 * action_scale(j);
          const Mask bad = ~(pivot > lift) & ~active[j];
          failed |= bad;
          // What is added where the cost is flat vanishes with the gradient, and does not hide that it is.
          if (!kAdjoint && attempt == 0) out.weak |= ~(pivot - flat[j] > singular) & ~active[j];
          Vec inverse = 1.0 / sqrt(select(bad, max(abs(pivot), lift), pivot));
          // The adjoint holds an action that nothing moves, and takes a negative curvature by its size.
          if (kAdjoint) inverse = select(bad & (abs(pivot) <= lift), all(0), inverse);
          Lc[j * nu + j] = inverse;
          for (int64_t i = j + 1; i < nu; i++) {
            Vec t = Lc[i * nu + j];
            for (int64_t m = 0; m < j; m++) t -= Lc[i * nu + m] * Lc[j * nu + m];
            Lc[i * nu + j] = t * inverse;
          }
        }
        if (kAdjoint) {
          out.weak |= failed;
          break;
        }
        if (!any(failed) || attempt == 1) break;
        use = select(failed & ~stubborn, all(0), use);
      }
      for (int64_t i = first; i < nw; i++)
        for (int64_t j = first; j <= i; j++)
          if (i >= nx ? j < nx : true) H[i * nw + j] += use * curvature(i, j);
      // Feedback law: (K | kf) = -H_uu^-1 (H_ux | lin_u), rows of active actions zero.
      const int64_t columns = nx + 1;
      for (int64_t i = 0; i < nu; i++) {
        for (int64_t j = 0; j < nx; j++)
          Kk[i * columns + j] = k == 0 ? all(0) : select(active[i], all(0), -H[(nx + i) * nw + j]);
        Kk[i * columns + nx] = select(active[i], all(0), -lin[nx + i]);
      }
      const int64_t from = k == 0 ? nx : 0;
      for (int64_t i = 0; i < nu; i++) {
        for (int64_t m = 0; m < i; m++)
          for (int64_t j = from; j < columns; j++) Kk[i * columns + j] -= Lc[i * nu + m] * Kk[m * columns + j];
        for (int64_t j = from; j < columns; j++) Kk[i * columns + j] *= Lc[i * nu + i];
      }
      if (k > 0) {
        for (int64_t i = 0; i < nx; i++) {
          for (int64_t j = 0; j <= i; j++) {
            Vec t = H[i * nw + j];
            for (int64_t m = 0; m < nu; m++) t -= Kk[m * columns + i] * Kk[m * columns + j];
            Pn[i * nx + j] = t, Pn[j * nx + i] = t;
          }
          Vec t = lin[i];
          for (int64_t m = 0; m < nu; m++) t -= Kk[m * columns + i] * Kk[m * columns + nx];
          vn[i] = t;
        }
      }
      for (int64_t i = nu - 1; i >= 0; i--) {
        for (int64_t m = i + 1; m < nu; m++)
          for (int64_t j = from; j < columns; j++) Kk[i * columns + j] -= Lc[m * nu + i] * Kk[m * columns + j];
        for (int64_t j = from; j < columns; j++) Kk[i * columns + j] *= Lc[i * nu + i];
      }
      for (int64_t i = 0; i < nu; i++) {
        for (int64_t j = 0; j < nx; j++) K[(k * nu + i) * nx + j] = Kk[i * columns + j];
        // An action held at a bound goes onto it exactly.
        const Vec bound = select(low[k * nu + i], lo[i] - uk[i], select(upp[k * nu + i], hi[i] - uk[i], all(0)));
        kf[k * nu + i] = kAdjoint ? Kk[i * columns + nx] : select(active[i], bound, Kk[i * columns + nx]);
      }
      for (int64_t i = 0; i < nx; i++) p[i] = pn[i];
      if (k > 0) {
        for (int64_t i = 0; i < nx; i++) v[i] = vn[i];
        for (int64_t i = 0; i < nx * nx; i++) P[i] = Pn[i];
      }
    }
    return out;
  }

  // ---- solve ----
  // Large problems look at the watch at every stage, small ones once per iteration.
  bool halted(Watch watch) const { return n.l() > 16 && watch.stop(watch.context); }

  // Roll u out at eps in the lanes of `wanted`; returns the cost of every lane.
  Vec rollout(Vec eps, Mask wanted, Watch watch) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    for (int64_t i = 0; i < nx; i++) x[i] = x0[i];
    for (int64_t k = 0; k < n.h && !halted(watch); k++) {
      gap_at(x + k * nx, u + k * nu, gap);
      relaxed_lcp(lam + k * nl, s + k * nl, eps, ~wanted);
      next_state(x + k * nx, u + k * nu, lam + k * nl, x + (k + 1) * nx);
    }
    return cost(x, u);
  }

  // The trial trajectory with step length `step` along the feedback law; lanes in `frozen` stay where they are.
  Vec trial(Vec eps, Vec step, Mask frozen, Mask skip, Watch watch) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    for (int64_t i = 0; i < nx; i++) xt[i] = x0[i];
    for (int64_t k = 0; k < n.h && !halted(watch); k++) {
      Vec *xk = xt + k * nx, *uk = ut + k * nu, *lk = lamt + k * nl;
      for (int64_t j = 0; j < nu; j++) {
        Vec t = u[k * nu + j] + step * kf[k * nu + j];
        if (k > 0)
          for (int64_t i = 0; i < nx; i++) t += K[(k * nu + j) * nx + i] * (xk[i] - x[k * nx + i]);
        const Vec from = u[k * nu + j];
        Vec low_end = lo[j], high_end = hi[j];
        if (batch.barrier > 0)  // at most nine tenths of the way to a bound
          low_end = from - 0.9 * (from - low_end), high_end = from + 0.9 * (high_end - from);
        uk[j] = select(frozen, from, max(low_end, min(high_end, t)));
      }
      gap_at(xk, uk, gap);
      for (int64_t j = 0; j < nl; j++) lk[j] = select(skip, lk[j], lam[k * nl + j]);
      relaxed_lcp(lk, st + k * nl, eps, skip);
      next_state(xk, uk, lk, xt + (k + 1) * nx);
    }
    return cost(xt, ut);
  }

  struct Lane {
    int64_t element;  // -1: idle
    int64_t iterations, in_stage, failures;
  };

  void solve(const MpcSolve& o, int64_t* next, void* rest_of_workspace, Watch watch) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    const double target = batch.relaxation;
    Certificate<T, S> certificate(batch, rest_of_workspace);
    int64_t finished[kLanes];
    int waiting = 0;
    auto store = [&](int l, int64_t e, Status status, double J, int64_t iterations) {
      store_lane(o.x + e * (h + 1) * nx, x, (h + 1) * nx, l);
      store_lane(o.u + e * h * nu, u, h * nu, l);
      store_lam(o.lam + e * h * nl, l);
      o.objective[e] = J / lane_of(cost_unit[0], l), o.iterations[e] = int32_t(iterations);
      o.status[e] = int8_t(status);
      finished[waiting++] = e;
      if (waiting == kLanes) certificate.judge(o, finished, waiting), waiting = 0;
    };
    Lane lane[kLanes];
    Vec eps = all(target), regularisation = all(0), J = all(0);
    int live = 0;
    Mask fresh = Mask{};
    // Take the next problem into a lane; an exhausted queue leaves the lane idle with whatever it held.
    auto take = [&](int l) {
      const int64_t e = __atomic_fetch_add(next, int64_t{1}, __ATOMIC_RELAXED);
      lane[l] = {e < batch.count ? e : -1, 0, 0, 0};
      fresh[l] = -1;
      eps[l] = o.first_relaxation, regularisation[l] = 0;
      if (e >= batch.count) return false;
      load(e, l);
      if (o.u_start)
        load_lane(u, o.u_start + e * h * nu, h * nu, l);
      else
        for (int64_t i = 0; i < h * nu; i++) put(u, i, l, 0.0);
      for (int64_t k = 0; k < h; k++)
        for (int64_t j = 0; j < nu; j++) {
          const double margin = batch.barrier > 0 ? 0.01 * (hi[j][l] - lo[j][l]) : 0.0;
          const double a = lo[j][l] + margin, b = hi[j][l] - margin, value = u[k * nu + j][l];
          put(u, k * nu + j, l, value < a ? a : value > b ? b : value);
        }
      if (o.lam_start)
        load_lam(lam, o.lam_start + e * h * nl, l);
      else
        for (int64_t i = 0; i < h * nl; i++) put(lam, i, l, __builtin_sqrt(o.first_relaxation));
      return true;
    };
    for (int l = 0; l < kLanes; l++) {
      if (take(l))
        live++;
      else if (live)
        load(lane[0].element, l);  // harmless numbers for a lane that never gets a problem
    }
    while (live > 0) {
      Mask idle;
      for (int l = 0; l < kLanes; l++) idle[l] = lane[l].element < 0 ? -1 : 0;
      mu = batch.barrier * (eps / target) * cost_unit[0];
      if (any(fresh & ~idle)) {
        const Vec rolled = rollout(eps, fresh & ~idle, watch);
        J = select(fresh, rolled, J);
      }
      if (watch.stop(watch.context)) {
        // What has a trajectory is stored; what has none stays unreached.
        for (int l = 0; l < kLanes; l++)
          if (!idle[l] && !fresh[l]) store(l, lane[l].element, Status::max_iter, J[l], lane[l].iterations);
        break;
      }
      fresh = Mask{};
      // Gauss-Newton can creep along a curved valley: after 20 steps in one stage every other one keeps the curvature.
      Mask stubborn;
      for (int l = 0; l < kLanes; l++) stubborn[l] = lane[l].in_stage > 20 && lane[l].in_stage % 2 ? -1 : 0;
      const Sweep sweep = backward<false>(regularisation, stubborn);
      Mask frozen = idle;
      for (int l = 0; l < kLanes; l++) {
        if (idle[l] || eps[l] > target) continue;
        Lane& a = lane[l];
        const double tol = o.tol > sweep.rounding[l] ? o.tol : sweep.rounding[l];
        // A search that fails this close to the optimum has met the rounding of the cost.
        const double patience = a.failures < kFailures ? 1.0 : 1e3;
        const bool converged = sweep.projected[l] <= patience * tol && sweep.stationary[l] <= patience * kStationary;
        const bool broken = !(J[l] < 1e300 && J[l] > -1e300);
        if (!converged && !broken && a.iterations < o.max_iter && a.failures < kFailures) continue;
        if (converged && regularisation[l] > 0 && !broken) {  // once more without it: it hides a singular Hessian
          regularisation[l] = 0, frozen[l] = -1;
          continue;
        }
        const Status status = converged && !broken         ? (sweep.weak[l] ? Status::degenerate : Status::converged)
                              : a.iterations >= o.max_iter ? Status::max_iter
                                                           : Status::numerical;
        store(l, a.element, status, J[l], a.iterations);
        frozen[l] = -1;
        if (!take(l)) live--;
      }
      if (live == 0) break;
      // Armijo search. An accepted lane keeps its trial while the others shorten their step.
      Vec step = all(1), J_trial = J;
      Mask accepted = frozen;
      for (int search = 0; search < 5; search++) {
        const Vec value = trial(eps, step, frozen, accepted, watch);
        if (halted(watch)) break;
        // First-order change of the cost along the step as it was clipped: grad is dJ/du of the whole trajectory.
        Vec slope = all(0);
        for (int64_t i = 0; i < h * nu; i++) slope += grad[i] * (ut[i] - u[i]);
        const Mask good = (value <= J + 1e-4 * min(slope, all(0)) + 1e-13 * (1.0 + abs(J))) & ~accepted;
        J_trial = select(good, value, J_trial);
        accepted |= good;
        if (!any(~accepted)) break;
        step = select(accepted, step, step * (search < 2 ? 0.5 : 0.25));
      }
      const Mask moved = accepted & ~frozen;
      for (int64_t i = 0; i < h * nu; i++) u[i] = select(moved, ut[i], u[i]);
      for (int64_t i = 0; i < (h + 1) * nx; i++) x[i] = select(moved, xt[i], x[i]);
      for (int64_t i = 0; i < h * nl; i++) lam[i] = select(moved, lamt[i], lam[i]), s[i] = select(moved, st[i], s[i]);
      J = select(moved, J_trial, J);
      for (int l = 0; l < kLanes; l++) {
        if (frozen[l]) continue;
        Lane& a = lane[l];
        a.iterations++, a.in_stage++;
        a.failures = moved[l] ? 0 : a.failures + 1;
        // Levenberg-Marquardt, in units of each action's own curvature.
        double& reg = reinterpret_cast<double*>(&regularisation)[l];
        if (!moved[l])
          reg = reg * 8 > 1 ? reg * 8 : 1;
        else if (step[l] >= 0.3)
          reg = reg * 0.125 < 0.5 ? 0 : reg * 0.125;
        // Two steps per stage of the homotopy, fewer where the stage is solved.
        if (eps[l] > target && (a.in_stage >= 2 || sweep.projected[l] < 1e4 * o.tol || a.failures > 0)) {
          eps[l] = eps[l] * o.shrink > target ? eps[l] * o.shrink : target;
          a.in_stage = 0, a.failures = 0;
          fresh[l] = -1;
        }
      }
    }
    if (waiting) certificate.judge(o, finished, waiting);
  }

  // ---- adjoint ----
  void vjp(const MpcGradient& o, int64_t begin, int64_t end, int64_t block, Watch watch) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    for (int64_t i = 0; i < o.shared_size; i++) sum[i] = all(0);
    for (int64_t group = begin; group < end && !watch.stop(watch.context); group += kLanes) {
      Mask valid;
      for (int l = 0; l < kLanes; l++) {
        const int64_t e = group + l < end ? group + l : end - 1;
        load(e, l);
        load_lane(x, o.x + e * (h + 1) * nx, (h + 1) * nx, l), load_lane(u, o.u + e * h * nu, h * nu, l);
        load_lam(lam, o.lam + e * h * nl, l), load_lane(xb, o.x_bar + e * (h + 1) * nx, (h + 1) * nx, l);
        load_lane(ub, o.u_bar + e * h * nu, h * nu, l), load_lam(lb, o.lam_bar + e * h * nl, l, true);
        jb[l] = o.objective_bar[e];
        valid[l] = group + l < end && o.solved[e] ? -1 : 0;
      }
      for (int64_t k = 0; k < h; k++) {
        gap_at(x + k * nx, u + k * nu, gap);
        for (int64_t i = 0; i < nl; i++) {
          Vec t = gap[i];
          for (int64_t j = 0; j < nl; j++) t += F[i * nl + j] * lam[k * nl + j];
          s[k * nl + i] = t;
        }
      }
      backward<true>(all(0), Mask{});
      forward_adjoint(o, group, end, valid);
    }
    for (int64_t i = 0; i < o.shared_size; i++) {
      double total = 0;
      for (int l = 0; l < kLanes; l++) total += sum[i][l];
      o.partial[block * o.shared_size + i] = total;
    }
  }

  void forward_adjoint(const MpcGradient& o, int64_t group, int64_t end, Mask valid);
};

// Adds one product to a gradient: into the lanes' sums where the input is shared, else into each element's own.
struct Sink {
  const MpcGradient& o;
  int64_t group, end;
  Mask valid;
  Vec* sum;
  int64_t entries[kInputs];

  void add(Input which, int64_t at, Vec value) const {
    if (double* own = o.per_element[which]) {
      for (int l = 0; l < kLanes && group + l < end; l++)
        if (valid[l]) own[(group + l) * entries[which] + at] += value[l];
    } else {
      sum[o.offset[which] + at] += select(valid, value, all(0));
    }
  }
};

template <class T, class S>
void Mpc<T, S>::forward_adjoint(const MpcGradient& o, int64_t group, int64_t end, Mask valid) {
  const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), h = n.h;
  const Sink sink{
      o,
      group,
      end,
      valid,
      sum,
      {nx * nx, nx * nu, nx * nl, nx, nl * nx, nl * nu, nl * nl, nl, nx * nx, nu * nu, nx * nx, nx, nu, nx, nu, nu, nx}};
  // Directions: dw = (dx, du), dx of the next state, dlam, ds, dp, dy. The scratch of the sweep is free again.
  Vec *dw = lin, *dxn = pn, *dlam = dl, *ds = res, *dp = vn, *dy = wt, *rho = y, *drho = gap;
  for (int64_t i = 0; i < nx; i++) dw[i] = all(0);
  for (int64_t k = 0; k < h; k++) {
    const Vec *xk = x + k * nx, *uk = u + k * nu, *lk = lam + k * nl, *pk = p_s + (k + 1) * nx, *yk = y_s + k * nl;
    for (int64_t j = 0; j < nu; j++) {
      Vec t = kf[k * nu + j];
      if (k > 0)
        for (int64_t i = 0; i < nx; i++) t += K[(k * nu + j) * nx + i] * dw[i];
      dw[nx + j] = t;
    }
    for (int64_t i = 0; i < nl; i++) {
      Vec a = all(0), b = all(0);
      for (int64_t j = 0; j < nw; j++) {
        a += Kl_s[(k * nl + i) * nw + j] * dw[j];
        b += Ks_s[(k * nl + i) * nw + j] * dw[j];
      }
      dlam[i] = a, ds[i] = b;
    }
    for (int64_t i = 0; i < nx; i++) {
      Vec t = all(0);
      for (int64_t j = 0; j < nw; j++) t += Ah_s[(k * nx + i) * nw + j] * dw[j];
      dxn[i] = t;
    }
    for (int64_t i = 0; i < nx; i++) {
      Vec t = v_s[(k + 1) * nx + i];
      for (int64_t j = 0; j < nx; j++) t += P_s[((k + 1) * nx + i) * nx + j] * dxn[j];
      dp[i] = t;
    }
    for (int64_t i = 0; i < nl; i++) {
      Vec t = lb[k * nl + i] - yk[i] * ds[i];
      for (int64_t j = 0; j < nx; j++) t -= C[j * nl + i] * dp[j];
      for (int64_t j = 0; j < nl; j++) t -= F[j * nl + i] * (yk[j] * dlam[j]);
      dy[i] = t;
    }
    back_transposed(nl, M_s + k * nl * nl, rows_s + k * nl, dy);
    for (int64_t i = 0; i < nl; i++) {
      dy[i] *= size_s[k * nl + i];
      rho[i] = yk[i] * lk[i];
      drho[i] = dy[i] * lk[i] + yk[i] * dlam[i];
    }
    // Bounds, before dp and drho take up the objective's part.
    for (int64_t j = 0; j < nu; j++) {
      Vec t = ub[k * nu + j], g = r[j];
      for (int64_t i = 0; i < nu; i++) t -= R[j * nu + i] * dw[nx + i], g += R[j * nu + i] * uk[i];
      for (int64_t i = 0; i < nx; i++) t -= AB[i * nw + nx + j] * dp[i], g += AB[i * nw + nx + j] * pk[i];
      for (int64_t i = 0; i < nl; i++) t -= DE[i * nw + nx + j] * drho[i], g += DE[i * nw + nx + j] * rho[i];
      t += jb * g;
      Vec by_low = all(0), by_high = all(0);
      if (batch.barrier > 0) {
        const Vec below = uk[j] - lo[j], above = hi[j] - uk[j], du = dw[nx + j];
        by_low = mu * (du / (below * below) + jb / below), by_high = mu * (du / (above * above) - jb / above);
      }
      sink.add(kumin, j, select(low[k * nu + j], t, by_low));
      sink.add(kumax, j, select(upp[k * nu + j], t, by_high));
    }
    for (int64_t i = 0; i < nx; i++) dp[i] -= jb * pk[i];
    for (int64_t i = 0; i < nl; i++) drho[i] -= jb * rho[i];
    for (int64_t i = 0; i < nx; i++) {
      for (int64_t j = 0; j < nx; j++) sink.add(kA, i * nx + j, -(dp[i] * xk[j] + pk[i] * dw[j]));
      for (int64_t j = 0; j < nu; j++) sink.add(kB, i * nu + j, -(dp[i] * uk[j] + pk[i] * dw[nx + j]));
      for (int64_t j = 0; j < nl; j++) sink.add(kC, i * nl + j, -scale[j] * (dp[i] * lk[j] + pk[i] * dlam[j]));
      sink.add(kd, i, -dp[i]);
      for (int64_t j = 0; j < nx; j++)
        sink.add(kQ, i * nx + j, 0.5 * (jb * xk[i] * xk[j] - dw[i] * xk[j] - dw[j] * xk[i]));
      sink.add(kq, i, jb * xk[i] - dw[i]);
    }
    for (int64_t i = 0; i < nl; i++) {
      for (int64_t j = 0; j < nx; j++) sink.add(kD, i * nx + j, -scale[i] * (drho[i] * xk[j] + rho[i] * dw[j]));
      for (int64_t j = 0; j < nu; j++) sink.add(kE, i * nu + j, -scale[i] * (drho[i] * uk[j] + rho[i] * dw[nx + j]));
      for (int64_t j = 0; j < nl; j++)
        sink.add(kF, i * nl + j, -(scale[i] * scale[j]) * (drho[i] * lk[j] + rho[i] * dlam[j]));
      sink.add(kc, i, -scale[i] * drho[i]);
    }
    for (int64_t i = 0; i < nu; i++) {
      for (int64_t j = 0; j < nu; j++)
        sink.add(kR, i * nu + j, 0.5 * (jb * uk[i] * uk[j] - dw[nx + i] * uk[j] - dw[nx + j] * uk[i]));
      sink.add(kr, i, jb * uk[i] - dw[nx + i]);
    }
    if (k == 0)
      for (int64_t j = 0; j < nx; j++) {
        Vec t = xb[j] + jb * q[j];
        for (int64_t i = 0; i < nx; i++) t += jb * Q[j * nx + i] * xk[i] - AB[i * nw + j] * dp[i];
        for (int64_t i = 0; i < nl; i++) t -= DE[i * nw + j] * drho[i];
        sink.add(kx0, j, t);
      }
    for (int64_t i = 0; i < nx; i++) dw[i] = dxn[i];
  }
  const Vec* xh = x + h * nx;
  for (int64_t i = 0; i < nx; i++) {
    for (int64_t j = 0; j < nx; j++)
      sink.add(kQfinal, i * nx + j, 0.5 * (jb * xh[i] * xh[j] - dw[i] * xh[j] - dw[j] * xh[i]));
    sink.add(kqfinal, i, jb * xh[i] - dw[i]);
  }
}

template <class T, class S>
struct Variant {
  using Solver = Mpc<T, S>;
};

// Calls f with the variant that fits: compile-time sizes for the paper's tasks, matrices shared or per element.
template <class Function>
void dispatch(const MpcBatch& b, Function f) {
  const bool paper = b.n_x == 9 && b.n_u == 6;
  if (b.pivot)
    f(Variant<Vec, Pivoting>());
  else if (!shared_matrices(b))
    f(Variant<Vec, Sizes<0, 0, 0>>());
  else if (paper && b.n_lam == 5)
    f(Variant<double, Sizes<9, 6, 5>>());
  else if (paper && b.n_lam == 8)
    f(Variant<double, Sizes<9, 6, 8>>());
  else
    f(Variant<double, Sizes<0, 0, 0>>());
}

// The layout of the widest variant, adjoint included, serves all.
int64_t solver_workspace(const MpcBatch& batch) {
  return Mpc<Vec, Sizes<0, 0, 0>>(batch, nullptr, true).layout(nullptr, true);
}

}  // namespace

int64_t mpc_workspace(const MpcBatch& batch) {
  return solver_workspace(batch) + Certificate<Vec, Sizes<0, 0, 0>>(batch, nullptr).layout(nullptr);
}

void mpc_solve(const MpcBatch& batch, const MpcSolve& solve, int64_t* next, void* workspace, Watch watch) {
  dispatch(batch, [&](auto type) {
    void* rest = static_cast<char*>(workspace) + solver_workspace(batch);
    typename decltype(type)::Solver(batch, workspace, false).solve(solve, next, rest, watch);
  });
}

void mpc_vjp(const MpcBatch& batch, const MpcGradient& gradient, int64_t begin, int64_t end, int64_t block,
             void* workspace, Watch watch) {
  dispatch(batch, [&](auto type) {
    typename decltype(type)::Solver(batch, workspace, true).vjp(gradient, begin, end, block, watch);
  });
}

}  // namespace difflcs::DIFFLCS_ISA
