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
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Problem sizes: compile-time where the template argument is not zero.
template <int X, int U, int L>
struct Sizes {
  static constexpr int64_t kX = X, kU = U, kL = L;
  int64_t rx, ru, rl, h;
  explicit Sizes(const MpcBatch& b) : rx(b.n_x), ru(b.n_u), rl(b.n_lam), h(b.horizon) {}
  int64_t x() const { return X ? X : rx; }
  int64_t u() const { return U ? U : ru; }
  int64_t l() const { return L ? L : rl; }
  int64_t w() const { return x() + u(); }
};

constexpr double kTiny = 1e-300;
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
  Vec *d, *c, *q, *r, *qf, *lo, *hi, *x0;
  // Trajectory, trial trajectory, and the feedback law.
  Vec *x, *u, *lam, *s, *xt, *ut, *lamt, *st, *K, *kf, *grad;
  // Scratch of the backward sweep and of the LCP.
  Vec *P, *Pn, *v, *vn, *p, *pn, *M, *Mc, *Kl, *Tk, *Wk, *av, *bv, *Ah, *PA, *H, *lin, *Lc, *Kk, *y, *size, *gap, *res,
      *newton, *wt, *dl;
  // Kept per stage for the adjoint.
  Vec *Kl_s, *Ks_s, *Ah_s, *M_s, *size_s, *y_s, *P_s, *v_s, *p_s, *xb, *ub, *lb, *sum;
  Mask *act, *low, *upp;
  Vec jb;
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
    mat(Qf, nx * nx), mat(scale, nl);
    vec(d, nx), vec(c, nl), vec(q, nx), vec(r, nu), vec(qf, nx), vec(lo, nu), vec(hi, nu), vec(x0, nx);
    vec(x, (h + 1) * nx), vec(u, h * nu), vec(lam, h * nl), vec(s, h * nl);
    vec(xt, (h + 1) * nx), vec(ut, h * nu), vec(lamt, h * nl), vec(st, h * nl), vec(K, h * nu * nx), vec(kf, h * nu);
    vec(grad, h * nu);
    vec(P, nx * nx), vec(Pn, nx * nx), vec(v, nx), vec(vn, nx), vec(p, nx), vec(pn, nx), vec(M, nl * nl);
    vec(Mc, nl * nl), vec(Kl, nl * nw), vec(Tk, nl * nw), vec(Wk, nl * nw), vec(av, nl), vec(bv, nl);
    vec(Ah, nx * nw), vec(PA, nx * nw), vec(H, nw * nw), vec(lin, nw);
    vec(Lc, nu * nu), vec(Kk, nu * (nx + 1)), vec(y, nl), vec(size, nl), vec(gap, nl), vec(res, nl), vec(wt, nl);
    vec(dl, nl), vec(newton, 6 * nl), mask(act, h * nu), mask(low, h * nu), mask(upp, h * nu);
    if (adjoint) {
      vec(Kl_s, h * nl * nw), vec(Ks_s, h * nl * nw), vec(Ah_s, h * nx * nw), vec(M_s, h * nl * nl);
      vec(size_s, h * nl), vec(y_s, h * nl), vec(P_s, (h + 1) * nx * nx), vec(v_s, (h + 1) * nx);
      vec(p_s, (h + 1) * nx), vec(xb, (h + 1) * nx), vec(ub, h * nu), vec(lb, h * nl);
      vec(sum, 2 * nx * nx + nu * nu + nx * nx + nx * nw + nw * nl + nl * nl + nl * nx + 5 * nx + 3 * nu + nl);
    }
    return used;
  }

  Mpc(const MpcBatch& b, void* memory, bool adjoint) : batch(b), n(b) {
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
    block(Q, nx, 0, kQ, nx, nx, one, one), block(R, nu, 0, kR, nu, nu, one, one);
    block(Qf, nx, 0, kQfinal, nx, nx, one, one);
  }

  void load(int64_t e, int lane) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    if constexpr (sizeof(T) != sizeof(double)) load_matrices(e, lane);
    auto vector = [&](Vec* to, Input which, int64_t size) {
      const double* from = input(which, e);
      for (int64_t i = 0; i < size; i++) put(to, i, lane, from[i]);
    };
    vector(d, kd, nx), vector(c, kc, nl), vector(q, kq, nx), vector(r, kr, nu), vector(qf, kqfinal, nx);
    vector(lo, kumin, nu), vector(hi, kumax, nu), vector(x0, kx0, nx);
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
      lu_factor(nl, jacobian);
      lu_solve(nl, jacobian, step);
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
    Vec projected;  // projected gradient in units of the gradient, with the curvature as the scale of the bounds
    Vec rounding;   // level below which rounding hides it
    Vec residual;   // difflcs.mpc.kkt.residual
    Mask weak;      // a bound is weakly active, or the reduced Hessian is singular
  };

  template <bool kAdjoint>
  Sweep backward(Vec regularisation, Mask stubborn) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), nw = n.w(), h = n.h;
    Sweep out{all(0), all(0), all(0), Mask{}};
    Vec costate = all(1);
    for (int64_t i = 0; i < nx; i++) {
      Vec t = qf[i];
      for (int64_t j = 0; j < nx; j++) {
        P[i * nx + j] = all(0) + Qf[i * nx + j];
        t += Qf[i * nx + j] * x[h * nx + j];
      }
      p[i] = t;
      costate = max(costate, abs(t));
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
      auto factor = [&](auto& matrix, bool by_row) {  // diag(a) + diag(b) F, or diag(a) + F diag(b)
        DIFFLCS_UNROLL
        for (int64_t i = 0; i < nl; i++) {
          DIFFLCS_UNROLL
          for (int64_t j = 0; j < nl; j++) matrix[i * nl + j] = bv[by_row ? i : j] * F[i * nl + j];
          matrix[i * nl + i] += av[i];
        }
        lu_factor(nl, matrix);
      };
      factor(left, true);
      for (int64_t i = 0; i < nl * nl; i++) M[i] = left[i];
      factor(right, false);
      for (int64_t j = 0; j < nw; j++) {
        Local<S::kL> t(dl);
        DIFFLCS_UNROLL
        for (int64_t i = 0; i < nl; i++) t[i] = all(0) - DE[i * nw + j];
        lu_solve(nl, right, t);
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
        Vec t = all(0);
        for (int64_t j = 0; j < nx; j++) t -= C[j * nl + i] * p[j];
        y[i] = t;
      }
      lu_solve_transposed(nl, M, y);
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
        const Vec gauss_newton = max(max(abs(H[(nx + j) * nw + nx + j]), all(0) + R[j * nu + j]), all(kTiny));
        const Vec clipped = max(lo[j], min(hi[j], uk[j] - g));
        out.residual = max(out.residual, abs(clipped - uk[j]));
        const Vec scaled = max(lo[j], min(hi[j], uk[j] - g / gauss_newton));
        Vec projected = abs(scaled - uk[j]) * gauss_newton;
        // Next to a bound the barrier is so steep that rounding u alone moves g: a step below rounding counts as none.
        if (batch.barrier > 0) projected = select(abs(g) <= 1e-14 * width * gauss_newton, all(0), projected);
        out.projected = max(out.projected, projected);
        out.rounding = max(out.rounding, 1e-12 * terms);
        const Vec curved = max(H[(nx + j) * nw + nx + j] + curvature(nx + j, nx + j), all(kTiny));
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
        if (batch.barrier > 0) low[k * nu + j] = upp[k * nu + j] = Mask{};
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
        costate = max(costate, abs(a));
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
            if (i == j && !kAdjoint) t += regularisation * action_scale(j);
            Lc[i * nu + j] = select(active[i] | active[j], all(i == j), t);
          }
        for (int64_t j = 0; j < nu; j++) {
          Vec pivot = Lc[j * nu + j];
          for (int64_t m = 0; m < j; m++) pivot -= Lc[j * nu + m] * Lc[j * nu + m];
          const Vec lift = kAdjoint ? 1e-10 * abs(H[(nx + j) * nw + nx + j]) : 0.05 * action_scale(j);
          const Mask bad = ~(pivot >= lift) & ~active[j];
          failed |= bad;
          const Vec inverse = 1.0 / sqrt(select(bad, max(abs(pivot), lift), pivot));
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
    out.residual /= costate;
    return out;
  }

  // ---- solve ----
  // Roll u out at eps in the lanes of `wanted`; returns the cost of every lane.
  Vec rollout(Vec eps, Mask wanted) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    for (int64_t i = 0; i < nx; i++) x[i] = x0[i];
    for (int64_t k = 0; k < n.h; k++) {
      gap_at(x + k * nx, u + k * nu, gap);
      relaxed_lcp(lam + k * nl, s + k * nl, eps, ~wanted);
      next_state(x + k * nx, u + k * nu, lam + k * nl, x + (k + 1) * nx);
    }
    return cost(x, u);
  }

  // The trial trajectory with step length `step` along the feedback law; lanes in `frozen` stay where they are.
  Vec trial(Vec eps, Vec step, Mask frozen, Mask skip) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l();
    for (int64_t i = 0; i < nx; i++) xt[i] = x0[i];
    for (int64_t k = 0; k < n.h; k++) {
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

  void solve(const MpcSolve& o, int64_t* next) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    const double target = batch.relaxation;
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
      mu = batch.barrier * (eps / target);
      if (any(fresh & ~idle)) {
        const Vec rolled = rollout(eps, fresh & ~idle);
        J = select(fresh, rolled, J);
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
        const bool converged = sweep.projected[l] <= (a.failures < kFailures ? tol : 1e3 * tol);
        const bool broken = !(J[l] < 1e300 && J[l] > -1e300);
        if (!converged && !broken && a.iterations < o.max_iter && a.failures < kFailures) continue;
        const int64_t e = a.element;
        store_lane(o.x + e * (h + 1) * nx, x, (h + 1) * nx, l);
        store_lane(o.u + e * h * nu, u, h * nu, l);
        store_lam(o.lam + e * h * nl, l);
        o.objective[e] = J[l], o.residual[e] = sweep.residual[l], o.iterations[e] = int32_t(a.iterations);
        const Status status = converged && !broken         ? (sweep.weak[l] ? Status::degenerate : Status::converged)
                              : a.iterations >= o.max_iter ? Status::max_iter
                                                           : Status::numerical;
        o.status[e] = int8_t(status);
        frozen[l] = -1;
        if (!take(l)) live--;
      }
      if (live == 0) break;
      // Armijo search. An accepted lane keeps its trial while the others shorten their step.
      Vec step = all(1), J_trial = J;
      Mask accepted = frozen;
      for (int search = 0; search < 5; search++) {
        const Vec value = trial(eps, step, frozen, accepted);
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
  }

  // ---- adjoint ----
  void vjp(const MpcGradient& o, int64_t begin, int64_t end, int64_t block) {
    const int64_t nx = n.x(), nu = n.u(), nl = n.l(), h = n.h;
    for (int64_t i = 0; i < o.shared_size; i++) sum[i] = all(0);
    for (int64_t group = begin; group < end; group += kLanes) {
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
    lu_solve_transposed(nl, M_s + k * nl * nl, dy);
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
      if (batch.barrier > 0) {
        const Vec below = uk[j] - lo[j], above = hi[j] - uk[j], du = dw[nx + j];
        sink.add(kumin, j, mu * (du / (below * below) + jb / below));
        sink.add(kumax, j, mu * (du / (above * above) - jb / above));
        continue;
      }
      t += jb * g;
      sink.add(kumin, j, select(low[k * nu + j], t, all(0)));
      sink.add(kumax, j, select(upp[k * nu + j], t, all(0)));
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
  bool shared = true;
  const Input matrices[] = {kA, kB, kC, kD, kE, kF, kQ, kR, kQfinal};
  for (const Input which : matrices) shared = shared && b.stride[which] == 0;
  const bool paper = b.n_x == 9 && b.n_u == 6;
  if (!shared)
    f(Variant<Vec, Sizes<0, 0, 0>>());
  else if (paper && b.n_lam == 5)
    f(Variant<double, Sizes<9, 6, 5>>());
  else if (paper && b.n_lam == 8)
    f(Variant<double, Sizes<9, 6, 8>>());
  else
    f(Variant<double, Sizes<0, 0, 0>>());
}

}  // namespace

int64_t mpc_workspace(const MpcBatch& batch) {
  // The layout of the widest variant, adjoint included, serves all.
  Mpc<Vec, Sizes<0, 0, 0>> counter(batch, nullptr, true);
  return counter.layout(nullptr, true);
}

void mpc_solve(const MpcBatch& batch, const MpcSolve& solve, int64_t* next, void* workspace) {
  dispatch(batch, [&](auto type) { typename decltype(type)::Solver(batch, workspace, false).solve(solve, next); });
}

void mpc_vjp(const MpcBatch& batch, const MpcGradient& gradient, int64_t begin, int64_t end, int64_t block,
             void* workspace) {
  dispatch(batch, [&](auto type) {
    typename decltype(type)::Solver(batch, workspace, true).vjp(gradient, begin, end, block);
  });
}

}  // namespace difflcs::DIFFLCS_ISA
