// The batched LCP kernels, compiled once per instruction set (see CMakeLists.txt). One problem per SIMD lane: the code
// reads like the solver of a single problem, and a lane's result never depends on its neighbours.
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

struct LcpWorkspace {
  Vec *F, *M, *q, *lam, *w, *rhs, *scale, *bound;
  Mask* active;
  LcpWorkspace(int64_t n, void* memory) {
    Vec* p = static_cast<Vec*>(memory);
    auto take = [&](int64_t count) {
      Vec* r = p;
      p += count;
      return r;
    };
    F = take(n * n), M = take(n * n), q = take(n), lam = take(n), w = take(n), rhs = take(n), scale = take(n);
    bound = take(n), active = reinterpret_cast<Mask*>(take(n));
  }
};

}  // namespace

int64_t lcp_workspace(int64_t n) { return static_cast<int64_t>(sizeof(Vec)) * (2 * n * n + 7 * n); }

namespace {

// Read kLanes problems and scale them: F' = S F S with unit diagonal and q' = S q / max|S q|, so that tolerances are
// relative whatever the units. lam = size * S lam', w = size * S^-1 w'. Lanes past `end` repeat the last problem.
// Returns the size; a non-positive diagonal (not a P-matrix) is left unscaled and fails the residual test later.
Vec load_scaled(const LcpBatch& batch, int64_t first, int64_t end, LcpWorkspace& ws) {
  const int64_t n = batch.n;
  for (int l = 0; l < kLanes; l++) {
    const int64_t e = first + l < end ? first + l : end - 1;
    const double *F = batch.F + e * batch.F_stride, *q = batch.q + e * n;
    for (int64_t i = 0; i < n; i++) ws.scale[i][l] = F[i * n + i] > 0 ? 1.0 / __builtin_sqrt(F[i * n + i]) : 1.0;
    for (int64_t i = 0; i < n; i++) ws.q[i][l] = q[i] * ws.scale[i][l];
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < n; j++) ws.F[i * n + j][l] = F[i * n + j] * (ws.scale[i][l] * ws.scale[j][l]);
  }
  Vec size = all(0);
  for (int64_t i = 0; i < n; i++) size = max(size, abs(ws.q[i]));
  size = select(size > 0, size, all(1));
  for (int64_t i = 0; i < n; i++) ws.q[i] /= size;
  return size;
}

void store(const LcpBatch& batch, int64_t first, int64_t end, const LcpWorkspace& ws, Vec size, const Mask& solved,
           const int32_t* iterations) {
  const int64_t n = batch.n;
  for (int l = 0; l < kLanes && first + l < end; l++) {
    const int64_t e = first + l;
    for (int64_t i = 0; i < n; i++) {
      batch.lam[e * n + i] = ws.lam[i][l] * (size[l] * ws.scale[i][l]);
      batch.w[e * n + i] = ws.w[i][l] * (size[l] / ws.scale[i][l]);
    }
    batch.status[e] = static_cast<int8_t>(solved[l] ? Status::converged : Status::numerical);
    batch.iterations[e] = iterations[l];
  }
}

// w = F lam + q, and bound_i = |q_i| + sum_j |F_ij lam_j|, the size of the terms whose rounding w_i carries.
void slack(int64_t n, const LcpWorkspace& ws) {
  for (int64_t i = 0; i < n; i++) {
    Vec w = ws.q[i], b = abs(w);
    for (int64_t j = 0; j < n; j++) {
      const Vec t = ws.F[i * n + j] * ws.lam[j];
      w += t;
      b += abs(t);
    }
    ws.w[i] = w;
    ws.bound[i] = b;
  }
}

}  // namespace

// Exact LCP by block principal pivoting (Kostreva; Judice & Pires): guess the set of positive lam, solve for them,
// exchange every index whose lam or w came out negative. If ten exchanges do not lower the number of such indices,
// exchange only the last one until they do, which is finite for P-matrices (Murty).
void lcp_exact(const LcpBatch& batch, int64_t begin, int64_t end, void* memory) {
  const int64_t n = batch.n;
  LcpWorkspace ws(n, memory);
  for (int64_t first = begin; first < end; first += kLanes) {
    const Vec size = load_scaled(batch, first, end, ws);
    int64_t fewest[kLanes], patience[kLanes];
    int32_t iterations[kLanes];
    Mask done = Mask{}, solved = Mask{};
    for (int l = 0; l < kLanes; l++) fewest[l] = n + 1, patience[l] = 10, iterations[l] = 0;
    for (int64_t i = 0; i < n; i++) ws.active[i] = ws.q[i] < 0;
    for (int64_t it = 0; it < batch.max_iter; it++) {
      // Active rows of F, identity elsewhere: one LU serves every active set. Inactive lam stay exactly zero.
      for (int64_t i = 0; i < n; i++) {
        for (int64_t j = 0; j < n; j++)
          ws.M[i * n + j] = select(ws.active[i] & ws.active[j], ws.F[i * n + j], all(i == j ? 1 : 0));
        ws.lam[i] = select(ws.active[i], -ws.q[i], all(0));
      }
      lu_factor(n, ws.M);
      lu_solve(n, ws.M, ws.lam);
      // An active row has w = 0 up to rounding; refine where an ill-conditioned set leaves more.
      for (int refinement = 0;; refinement++) {
        slack(n, ws);
        Mask poor = Mask{};
        for (int64_t i = 0; i < n; i++) poor |= ws.active[i] & (abs(ws.w[i]) > 1e-14 * ws.bound[i]);
        if (refinement == 2 || !any(poor)) break;
        for (int64_t i = 0; i < n; i++) ws.rhs[i] = select(ws.active[i] & poor, -ws.w[i], all(0));
        lu_solve(n, ws.M, ws.rhs);
        for (int64_t i = 0; i < n; i++) ws.lam[i] += ws.rhs[i];
      }
      // Negative beyond rounding. The tolerance grows slowly so that ill-conditioned sets cannot cycle for ever.
      const double tolerance = 1e-13 * (it < 20 ? 1 : it < 40 ? 10 : it < 60 ? 100 : 1000);
      auto infeasible = [&](int64_t i) -> Mask {
        const Vec value = select(ws.active[i], ws.lam[i], ws.w[i]);
        return (value < -tolerance * ws.bound[i]) | (value != value);
      };
      int64_t count[kLanes] = {}, last[kLanes] = {};
      for (int64_t i = 0; i < n; i++) {
        const Mask m = infeasible(i);
        for (int l = 0; l < kLanes; l++)
          if (m[l]) count[l]++, last[l] = i;
      }
      Mask block = Mask{};
      for (int l = 0; l < kLanes; l++) {
        if (done[l]) continue;
        iterations[l]++;
        if (count[l] == 0) {
          done[l] = solved[l] = -1;
        } else if (count[l] < fewest[l]) {
          fewest[l] = count[l], patience[l] = 10, block[l] = -1;
        } else if (patience[l] > 0) {
          patience[l]--, block[l] = -1;
        }
      }
      if (!any(~done)) break;
      for (int64_t i = 0; i < n; i++) {
        Mask flip = infeasible(i) & block;
        for (int l = 0; l < kLanes; l++)
          if (!block[l] && last[l] == i) flip[l] = -1;
        ws.active[i] ^= flip & ~done;
      }
    }
    for (int64_t i = 0; i < n; i++) {
      // A finished active row has w = 0 up to rounding; what is left there beyond 1e-10 is a failed factorisation.
      solved &= select(ws.active[i], abs(ws.w[i]), all(0)) <= 1e-10 * ws.bound[i];
      solved &= (ws.lam[i] == ws.lam[i]) & (abs(ws.lam[i]) < 1e300);
      ws.lam[i] = max(ws.lam[i], all(0));
      ws.w[i] = select(ws.active[i], all(0), max(ws.w[i], all(0)));
    }
    store(batch, first, end, ws, size, solved, iterations);
  }
}

// Relaxed LCP lam o w = eps by damped Newton on the smoothed complementarity function of Chen-Harker-Kanzow-Smale,
//   g_i = lam_i + w_i - sqrt((lam_i - w_i)^2 + 4 eps) = 0  <=>  lam_i > 0, w_i > 0, lam_i w_i = eps,
// following eps from 1 (in scaled units) down to its target.
void lcp_relaxed(const LcpBatch& batch, int64_t begin, int64_t end, void* memory) {
  const int64_t n = batch.n;
  LcpWorkspace ws(n, memory);
  for (int64_t first = begin; first < end; first += kLanes) {
    const Vec size = load_scaled(batch, first, end, ws);
    const Vec target = batch.relaxation / (size * size);
    Vec eps = max(target, all(1));
    for (int64_t i = 0; i < n; i++) ws.lam[i] = sqrt(eps);
    int32_t iterations[kLanes] = {};
    Mask solved = Mask{};
    Vec smallest = all(1e300);  // smallest residual met at the target
    int stalled[kLanes] = {};
    for (int64_t it = 0; it < batch.max_iter; it++) {
      // Residual and generalised Jacobian M = diag(a) + diag(b) F with a = 1 - d/r, b = 1 + d/r.
      slack(n, ws);
      Vec merit = all(0), magnitude = all(0);
      for (int64_t i = 0; i < n; i++) {
        const Vec d = ws.lam[i] - ws.w[i], r = sqrt(d * d + 4.0 * eps);
        const Vec b = 1.0 + d / r;
        ws.rhs[i] = r - ws.lam[i] - ws.w[i];
        merit += ws.rhs[i] * ws.rhs[i];
        magnitude = max(magnitude, max(ws.bound[i], abs(ws.lam[i])));
        for (int64_t j = 0; j < n; j++) ws.M[i * n + j] = b * ws.F[i * n + j];
        ws.M[i * n + i] += 1.0 - d / r;
      }
      const Vec residual = sqrt(merit);
      const Mask at_target = eps <= target;
      for (int l = 0; l < kLanes; l++) {
        if (solved[l]) continue;
        iterations[l]++;
        // Converged at 1e-14, or at the level where rounding stops progress, if that is below 1e-10.
        if (at_target[l]) {
          if (residual[l] <= 1e-14 * magnitude[l])
            solved[l] = -1;
          else if (residual[l] < 0.5 * smallest[l])
            smallest[l] = residual[l], stalled[l] = 0;
          else if (residual[l] <= 1e-10 * magnitude[l] && ++stalled[l] >= 2)
            solved[l] = -1;
        }
      }
      if (!any(~solved)) break;
      lu_factor(n, ws.M);
      lu_solve(n, ws.M, ws.rhs);
      Vec step = all(1);
      for (int search = 0; search < 8; search++) {
        Vec next = all(0);
        for (int64_t i = 0; i < n; i++) {
          Vec w = ws.q[i];
          for (int64_t j = 0; j < n; j++) w += ws.F[i * n + j] * (ws.lam[j] + step * ws.rhs[j]);
          const Vec lam = ws.lam[i] + step * ws.rhs[i], d = lam - w;
          const Vec g = lam + w - sqrt(d * d + 4.0 * eps);
          next += g * g;
        }
        // Near the rounding level the merit cannot fall further; the full step is right there.
        const Mask poor = (next > merit * (1.0 - 0.2 * step)) & (merit > 1e-24 * magnitude * magnitude);
        if (!any(poor)) break;
        step = select(poor, 0.4 * step, step);
      }
      for (int64_t i = 0; i < n; i++) ws.lam[i] = select(solved, ws.lam[i], ws.lam[i] + step * ws.rhs[i]);
      // Shrink eps once the current point is near the path.
      const Mask near = (residual <= 0.5 * sqrt(eps)) & ~solved;
      eps = select(near, max(target, 0.1 * eps), eps);
    }
    // Positive exactly: the larger of (lam, w) from the smoothed function, the smaller as eps / larger.
    slack(n, ws);
    for (int64_t i = 0; i < n; i++) {
      const Vec d = ws.lam[i] - ws.w[i], r = sqrt(d * d + 4.0 * target);
      const Vec larger = 0.5 * (abs(d) + r), smaller = target / larger;
      ws.lam[i] = select(d > 0, larger, smaller);
      ws.w[i] = select(d > 0, smaller, larger);
      solved &= ws.lam[i] == ws.lam[i];
    }
    store(batch, first, end, ws, size, solved, iterations);
  }
}

}  // namespace difflcs::DIFFLCS_ISA
