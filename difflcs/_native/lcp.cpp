// The batched LCP kernels, compiled once per instruction set (cmake/kernels.cmake). One problem per SIMD lane: the code
// reads like the solver of a single problem, and a lane's result never depends on its neighbours.
#include "kernels.hpp"
#include "lanes.hpp"
#include "lcp_single.hpp"
#include "lu.hpp"
#include "matrix.hpp"
#include "relaxed_lcp.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// T is the type of an entry of F: double where the batch shares F, else Vec. N is the size where it is known when
// compiling, else zero.
template <class T, int N>
struct Lcp {
  const LcpBatch& batch;
  T *F, *scale, *inverse;  // inverse of scale
  Vec *M, *q, *lam, *w, *rhs, *bound, *newton;
  Mask *active, *rows;

  int64_t size() const { return N ? N : batch.n; }

  // Lays the arrays out in `memory`, or only counts them where it is null.
  int64_t layout(void* memory) {
    const int64_t n = size();
    Arena arena{memory};
    arena.take(F, n * n);
    arena.take_all(n, scale, inverse, q, lam, w, rhs, bound, active, rows);
    arena.take(newton, RelaxedLcp<T, N, false>::scratch(n));
    M = newton;  // of the exact solver, which is another's turn; n * n of them
    return arena.used;
  }

  Lcp(const LcpBatch& b, void* memory) : batch(b) {
    layout(memory);
    if constexpr (sizeof(T) == sizeof(double))
      if (memory) load_matrix(0, 0);
  }

  void load_matrix(int64_t e, int lane) {
    const int64_t n = size();
    const double* from = batch.F + e * batch.F_stride;
    for (int64_t i = 0; i < n; i++) {
      const double root = from[i * n + i] > 0 ? __builtin_sqrt(from[i * n + i]) : 1.0;
      put(scale, i, lane, 1.0 / root);
      put(inverse, i, lane, root);
    }
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < n; j++)
        put(F, i * n + j, lane, from[i * n + j] * (lane_of(scale[i], lane) * lane_of(scale[j], lane)));
  }

  // Read kLanes problems and scale them: F' = S F S with unit diagonal and q' = S q / unit, where unit is the larger of
  // max|S q| and sqrt(relaxation), so that tolerances are relative whatever the units. lam = unit * S lam',
  // w = unit * S^-1 w'. Lanes past `end` repeat the last problem.
  // Returns the unit; a non-positive diagonal (not a P-matrix) is left unscaled and fails the residual test later.
  Vec load(int64_t first, int64_t end) {
    const int64_t n = size();
    for (int l = 0; l < kLanes; l++) {
      const int64_t e = first + l < end ? first + l : end - 1;
      if constexpr (sizeof(T) != sizeof(double)) load_matrix(e, l);
      for (int64_t i = 0; i < n; i++) put(q, i, l, batch.q[e * n + i] * lane_of(scale[i], l));
    }
    Vec unit = all(__builtin_sqrt(batch.relaxation));
    for (int64_t i = 0; i < n; i++) unit = max(unit, abs(q[i]));
    unit = select(unit > 0, unit, all(1));
    for (int64_t i = 0; i < n; i++) q[i] /= unit;
    return unit;
  }

  void store(int64_t first, int64_t end, Vec unit, const Mask& solved) {
    const int64_t n = size();
    for (int l = 0; l < kLanes && first + l < end; l++) {
      const int64_t e = first + l;
      for (int64_t i = 0; i < n; i++) {
        const double entry = lane_of(scale[i], l);
        batch.lam[e * n + i] = lane_of(lam[i], l) * (unit[l] * entry);
        batch.w[e * n + i] = lane_of(w[i], l) * (unit[l] / entry);
      }
      batch.status[e] = static_cast<int8_t>(solved[l] ? Status::converged : Status::numerical);
    }
  }

  // Large problems check the watch in every iteration.
  bool halted(Watch watch) const { return size() > 32 && watch.stop(watch.context); }

  DIFFLCS_NOINLINE void slack() { lcp_slack(size(), F, q, lam, w, bound); }

  DIFFLCS_NOINLINE void solve(Vec* b) const {
    const int64_t n = size();
    Local<N> x(b);
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) x[i] = b[i];
    lu_solve(n, M, x);
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < n; i++) b[i] = x[i];
  }

  // Returns which lanes hold a solution, from lam, w and q - w + F lam by the bounds of kernels.hpp. `relaxation` is in
  // scaled units. Call after `slack` has found w and bound for this lam; `returned` is the w that the caller will get.
  Mask certified(const Vec* returned, Vec unit, Vec relaxation) const {
    const int64_t n = size();
    const Vec root = sqrt(relaxation);
    Vec largest = all(0);  // of q, in the caller's units over `unit`
    for (int64_t i = 0; i < n; i++) largest = max(largest, (abs(q[i]) + root) * inverse[i]);
    Mask ok = ~Mask{};
    for (int64_t i = 0; i < n; i++) {
      const Vec missed = abs(w[i] - returned[i]), one = all(0) + scale[i];
      const Vec total = missed + kRounding * bound[i];  // what a caller may get in another order of the sum
      ok &= (missed <= kLcpTerms * bound[i]) & (total <= kLcpData * (1.0 + root));
      ok &= (total * inverse[i] <= kLcpData * largest) & (lam[i] >= 0) & (returned[i] >= 0);
      ok &= (max(lam[i] * one, returned[i] * inverse[i]) * unit <= kLargest);
      ok &= (one * __builtin_sqrt(kSmallest) <= 1) & (one >= __builtin_sqrt(kSmallest));
    }
    return ok;
  }

  void exact(int64_t begin, int64_t end, Watch watch);
  void relaxed(int64_t begin, int64_t end, Watch watch);
};

// Exact LCP by block principal pivoting (Kostreva; Judice & Pires): guess the set of positive lam, solve for them,
// exchange every index whose lam or w came out negative. If ten exchanges do not lower the number of such indices,
// exchange only the last one until they do, which is finite for P-matrices (Murty).
template <class T, int N>
void Lcp<T, N>::exact(int64_t begin, int64_t end, Watch watch) {
  const int64_t n = size();
  for (int64_t first = begin; first < end && !watch.stop(watch.context); first += kLanes) {
    const Vec unit = load(first, end);
    Mask fewest = Mask{} + (n + 1), patience = Mask{} + 10;
    Mask done = Mask{}, solved = Mask{};
    for (int64_t i = 0; i < n; i++) active[i] = q[i] < 0;
    for (int64_t it = 0; it < batch.max_iter && !halted(watch); it++) {
      // Active rows of F, identity elsewhere: one LU serves every active set. Inactive lam stay exactly zero.
      for (int64_t i = 0; i < n; i++) {
        DIFFLCS_UNROLL
        for (int64_t j = 0; j < n; j++)
          M[i * n + j] = select(active[i] & active[j], all(0) + F[i * n + j], all(i == j ? 1 : 0));
        lam[i] = select(active[i], -q[i], all(0));
      }
      N == 0 ? lu_factor_by_panels(n, M) : lu_factor(n, M);
      solve(lam);
      // An active row has w = 0 up to rounding; refine where an ill-conditioned set leaves more.
      for (int refinement = 0;; refinement++) {
        slack();
        Mask poor = Mask{};
        for (int64_t i = 0; i < n; i++) poor |= active[i] & (abs(w[i]) > 1e-14 * bound[i]);
        if (refinement == 2 || !any(poor)) break;
        for (int64_t i = 0; i < n; i++) rhs[i] = select(active[i] & poor, -w[i], all(0));
        solve(rhs);
        for (int64_t i = 0; i < n; i++) lam[i] += rhs[i];
      }
      // Negative beyond rounding. The tolerance grows slowly so that ill-conditioned sets cannot cycle for ever.
      const double tolerance = 1e-13 * (it < 20 ? 1 : it < 40 ? 10 : it < 60 ? 100 : 1000);
      auto infeasible = [&](int64_t i) -> Mask {
        const Vec value = select(active[i], lam[i], w[i]);
        return (value < -tolerance * bound[i]) | (value != value);
      };
      Mask count = Mask{}, last = Mask{};
      for (int64_t i = 0; i < n; i++) {
        const Mask m = infeasible(i);
        count -= m;  // a true lane is -1
        last = m ? Mask{} + i : last;
      }
      solved |= ~done & (count == 0);
      done |= count == 0;
      if (!any(~done)) break;
      const Mask fewer = count < fewest, block = fewer | (patience > 0);
      patience = fewer ? Mask{} + 10 : patience - 1;
      fewest = fewer ? count : fewest;
      for (int64_t i = 0; i < n; i++) active[i] ^= (block ? infeasible(i) : (Mask)(last == i)) & ~done;
    }
    // Values that rounding left below zero become zero, and the slack is recomputed for that lam.
    Mask clipped = Mask{};
    for (int64_t i = 0; i < n; i++) {
      clipped |= lam[i] < 0;
      lam[i] = max(lam[i], all(0));
    }
    if (any(clipped)) slack();
    for (int64_t i = 0; i < n; i++) rhs[i] = select(active[i], all(0), max(w[i], all(0)));
    solved &= certified(rhs, unit, all(0));
    for (int64_t i = 0; i < n; i++) w[i] = rhs[i];
    store(first, end, unit, solved);
  }
}

template <class T, int N>
void Lcp<T, N>::relaxed(int64_t begin, int64_t end, Watch watch) {
  for (int64_t first = begin; first < end && !watch.stop(watch.context); first += kLanes) {
    const Vec unit = load(first, end);
    const Vec target = batch.relaxation / (unit * unit);
    RelaxedLcp<T, N, false> path(size(), F, q, newton, rows);
    Mask solved = path.follow(lam, rhs, bound, target, batch.max_iter, [&] { return halted(watch); });
    slack();
    solved &= certified(rhs, unit, target);
    for (int64_t i = 0; i < size(); i++) w[i] = rhs[i];
    store(first, end, unit, solved);
  }
}

// Calls f with the code that fits: F shared by the batch or per element, and compile-time sizes if there are any.
template <class T, int... N, class Function>
void with_size(const LcpBatch& batch, void* memory, Function f) {
  const bool sized = ((batch.n == N && (f(Lcp<T, N>(batch, memory)), true)) || ...);
  if (!sized) f(Lcp<T, 0>(batch, memory));
}
template <int... N, class Function>
void dispatch(const LcpBatch& batch, void* memory, Function f) {
  const bool shared = batch.F_stride == 0;
  if constexpr (DIFFLCS_SIZED > 1)
    shared ? with_size<double, N...>(batch, memory, f) : with_size<Vec, N...>(batch, memory, f);
  else
    shared ? with_size<double>(batch, memory, f) : with_size<Vec>(batch, memory, f);
}

}  // namespace

int64_t lcp_workspace(int64_t n) {
  LcpBatch batch{};
  batch.n = n;
  const int64_t lanes = n < kAloneRelaxed ? Lcp<Vec, 0>(batch, nullptr).layout(nullptr) : 0, one = LcpOne::scratch(n);
  return lanes > one ? lanes : one;
}

void lcp_solve(const LcpBatch& batch, int64_t begin, int64_t end, void* memory, Watch watch) {
  // The violation loss of the paper's tasks has twice their number of contacts.
  if (batch.relaxation == 0 && batch.n < kAloneExact)
    dispatch<10, 16>(batch, memory, [&](auto lcp) { lcp.exact(begin, end, watch); });
  // The number of contacts of the paper's tasks: a third faster than with a size that is known at run time only.
  if (batch.relaxation > 0 && batch.n < kAloneRelaxed)
    dispatch<5, 8>(batch, memory, [&](auto lcp) { lcp.relaxed(begin, end, watch); });
  for (int64_t e = begin; e < end; e++) {
    if (solved(batch.status[e])) continue;
    if (!watch.stop(watch.context))
      lcp_single(batch, e, memory, watch);
    else if (batch.status[e] != kUnreached)
      batch.status[e] = static_cast<int8_t>(Status::max_iter);
  }
}

}  // namespace difflcs::DIFFLCS_ISA
