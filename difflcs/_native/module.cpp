// Python bindings (nanobind). Arrays are checked here once more and the work is spread over threads, GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdlib>
#include <memory>
#include <new>
#include <stdexcept>
#include <thread>
#include <vector>

#include "kernels.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::device::cpu, nb::c_contig>;
template <class T> using Output = nb::ndarray<T, nb::device::cpu, nb::c_contig>;

struct AlignedDelete {
  void operator()(void* p) const { ::operator delete(p, std::align_val_t{64}); }
};

// Exact LCP of one problem by Murty's least-index method with a pivoted LU: slow, but finite for every P-matrix and
// indifferent to degeneracy and to growth in an unpivoted LU. Used only where the batched kernel gave up.
bool lcp_exact_one(int64_t n, const double* F, const double* q, double* lam, double* w, int64_t max_iter) {
  std::vector<char> active(n, 0);
  std::vector<double> M(n * n), x(n);
  for (int64_t it = 0; it < max_iter; it++) {
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++) M[i * n + j] = active[i] && active[j] ? F[i * n + j] : (i == j ? 1.0 : 0.0);
      x[i] = active[i] ? -q[i] : 0.0;
    }
    for (int64_t k = 0; k < n; k++) {
      int64_t pivot = k;
      for (int64_t i = k + 1; i < n; i++)
        if (std::fabs(M[i * n + k]) > std::fabs(M[pivot * n + k])) pivot = i;
      if (M[pivot * n + k] == 0.0) return false;
      if (pivot != k) {
        for (int64_t j = 0; j < n; j++) std::swap(M[k * n + j], M[pivot * n + j]);
        std::swap(x[k], x[pivot]);
      }
      for (int64_t i = k + 1; i < n; i++) {
        const double l = M[i * n + k] / M[k * n + k];
        for (int64_t j = k; j < n; j++) M[i * n + j] -= l * M[k * n + j];
        x[i] -= l * x[k];
      }
    }
    for (int64_t i = n - 1; i >= 0; i--) {
      for (int64_t j = i + 1; j < n; j++) x[i] -= M[i * n + j] * x[j];
      x[i] /= M[i * n + i];
    }
    int64_t wrong = -1;
    for (int64_t i = 0; i < n && wrong < 0; i++) {
      double value = q[i], bound = std::fabs(q[i]);
      for (int64_t j = 0; j < n; j++) value += F[i * n + j] * x[j], bound += std::fabs(F[i * n + j] * x[j]);
      if (active[i]) value = x[i] * F[i * n + i];
      if (!(value >= -1e-11 * bound)) wrong = i;
    }
    if (wrong < 0) {
      for (int64_t i = 0; i < n; i++) {
        double value = q[i];
        for (int64_t j = 0; j < n; j++) value += F[i * n + j] * x[j];
        lam[i] = std::max(x[i], 0.0);
        w[i] = active[i] ? 0.0 : std::max(value, 0.0);
      }
      return true;
    }
    active[wrong] ^= 1;
  }
  return false;
}

void solve(const difflcs::LcpBatch& batch, int64_t count, int threads) {
  const auto& kernels = difflcs::kernels();
  const auto run = batch.relaxation > 0 ? kernels.lcp_relaxed : kernels.lcp_exact;
  // Blocks small enough to balance the load; where a block begins does not change any result.
  const int64_t block = 16 * kernels.lanes;
  std::atomic<int64_t> next{0};
  std::atomic<bool> out_of_memory{false};
  auto work = [&] {
    std::unique_ptr<void, AlignedDelete> workspace(
        ::operator new(kernels.lcp_workspace(batch.n), std::align_val_t{64}, std::nothrow));
    if (!workspace) return out_of_memory.store(true);
    for (int64_t b; (b = next.fetch_add(block)) < count;) run(batch, b, std::min(b + block, count), workspace.get());
  };
  std::vector<std::thread> pool;
  for (int64_t t = 1; t < std::min<int64_t>(threads, (count + block - 1) / block); t++) pool.emplace_back(work);
  work();
  for (auto& t : pool) t.join();
  if (out_of_memory) throw std::bad_alloc();
  if (batch.relaxation > 0) return;
  for (int64_t e = 0; e < count; e++) {
    if (batch.status[e] == static_cast<int8_t>(difflcs::Status::converged)) continue;
    const int64_t limit = int64_t{1} << std::min<int64_t>(batch.n + 2, 16);
    const bool ok = lcp_exact_one(batch.n, batch.F + e * batch.F_stride, batch.q + e * batch.n,
                                  batch.lam + e * batch.n, batch.w + e * batch.n, limit);
    if (ok) batch.status[e] = static_cast<int8_t>(difflcs::Status::converged);
  }
}

void solve_lcp(Array F, Array q, double relaxation, int64_t max_iter, int threads, Output<double> lam,
               Output<double> w, Output<int8_t> status, Output<int32_t> iterations) {
  if (q.ndim() != 2) throw std::invalid_argument("q must be (batch, n)");
  const int64_t count = q.shape(0), n = q.shape(1);
  const bool shared = F.ndim() == 2;
  const bool F_ok = shared ? (int64_t(F.shape(0)) == n && int64_t(F.shape(1)) == n)
                           : (F.ndim() == 3 && int64_t(F.shape(0)) == count && int64_t(F.shape(1)) == n &&
                              int64_t(F.shape(2)) == n);
  if (!F_ok || n < 1) throw std::invalid_argument("F must be (n, n) or (batch, n, n) with n >= 1");
  if (int64_t(lam.size()) != count * n || int64_t(w.size()) != count * n || int64_t(status.size()) != count ||
      int64_t(iterations.size()) != count)
    throw std::invalid_argument("outputs must be (batch, n), (batch, n), (batch,), (batch,)");
  if (!(relaxation >= 0)) throw std::invalid_argument("relaxation must be >= 0");
  const difflcs::LcpBatch batch{n,        F.data(), shared ? 0 : n * n, q.data(),          relaxation,
                                max_iter, lam.data(), w.data(),         status.data(), iterations.data()};
  nb::gil_scoped_release release;
  solve(batch, count, threads);
}

}  // namespace

NB_MODULE(_kernels, m) {
  m.doc() = "Native kernels of difflcs. Private: use difflcs.solve_lcp and difflcs.violation_loss.";
  m.def("isa", [] { return difflcs::kernels().isa; }, "Instruction set in use.");
  m.def("solve_lcp", &solve_lcp, "F"_a, "q"_a, "relaxation"_a, "max_iter"_a, "threads"_a, "lam"_a, "w"_a, "status"_a,
        "iterations"_a, "Solve a batch of LCPs into the given arrays.");
}
