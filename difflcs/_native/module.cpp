// Python bindings (nanobind). Arrays are checked here once more and the work is spread over threads, GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cctype>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "bind_controller.hpp"
#include "crew.hpp"
#include "kernels.hpp"
#include "search.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::device::cpu, nb::c_contig>;
template <class T>
using Output = nb::ndarray<T, nb::device::cpu, nb::c_contig>;

struct AlignedDelete {
  void operator()(void* p) const { ::operator delete(p, std::align_val_t{64}); }
};

// The first number is zero: a workspace that has kept nothing yet (MpcBatch::version).
struct AlignedBuffer {
  int64_t bytes = 0;
  std::unique_ptr<void, AlignedDelete> data;
  AlignedBuffer() = default;
  explicit AlignedBuffer(int64_t bytes) : bytes(bytes), data(::operator new(bytes, std::align_val_t{64})) {
    *static_cast<int64_t*>(data.get()) = 0;
  }
};

// Flag by which one thread ends the work of all threads of a call.
enum Ending { kGoOn, kOutOfTime, kInterrupted };

using Clock = std::chrono::steady_clock;

struct Stop {
  std::atomic<int> ending{kGoOn};
  const Clock::time_point begun = Clock::now();
  const double seconds;
  Clock::time_point deadline = Clock::time_point::max();
  explicit Stop(double seconds = std::numeric_limits<double>::infinity()) : seconds(std::max(seconds, 0.0)) {
    allot(1.0);
  }
  void allot(double part) {  // see Runner; of no thread that runs
    if (seconds < 1e9) deadline = begun + std::chrono::microseconds(int64_t(1e6 * part * seconds));
    if (ending == kOutOfTime && Clock::now() < deadline) ending = kGoOn;
  }
};

// One thread's view of it. The thread that Python called looks for signals (Ctrl-C) every 50 ms.
struct Lookout {
  Stop& stop;
  const bool caller;
  Clock::time_point next_look = Clock::now() + std::chrono::milliseconds(50);

  static bool ask(void* context) {
    Lookout& self = *static_cast<Lookout*>(context);
    if (self.stop.ending.load(std::memory_order_relaxed) != kGoOn) return true;
    const auto now = Clock::now();
    if (now >= self.stop.deadline) {
      self.stop.ending = kOutOfTime;
      return true;
    }
    if (!self.caller || now < self.next_look) return false;
    self.next_look = now + std::chrono::milliseconds(50);
    nb::gil_scoped_acquire gil;
    if (PyErr_CheckSignals() == 0) return false;
    self.stop.ending = kInterrupted;  // Python's error is set; `on_threads` raises it
    return true;
  }
};

// Runs work(workspace, watch) on at most `threads` threads, GIL released, on this one in the memory of `mine`. If a
// thread cannot be started, or has no memory, the others do its work. Raises the exception of a signal handler.
template <class Work>
void on_threads(int64_t threads, const AlignedBuffer& mine, Stop& stop, Work work) {
  {
    nb::gil_scoped_release release;
    std::vector<AlignedBuffer> others;
    try {
      others.reserve(threads);
      for (int64_t t = 1; t < threads; t++) others.emplace_back(mine.bytes);
    } catch (const std::bad_alloc&) {
    }
    difflcs::Crew::get().run(others.size() + 1, [&](size_t thread) {
      Lookout lookout{stop, thread == 0};
      work((thread > 0 ? others[thread - 1] : mine).data.get(), difflcs::Watch{&Lookout::ask, &lookout});
    });
  }
  if (stop.ending == kInterrupted) throw nb::python_error();
}

void solve(const difflcs::LcpBatch& batch, int64_t count, int threads, Stop& stop) {
  const auto& kernels = difflcs::kernels();
  // Blocks small enough to balance the load; where a block begins does not change any result.
  const int64_t block = batch.n < difflcs::kAloneExact ? 16 * kernels.lanes : kernels.lanes;
  std::atomic<int64_t> next{0};
  const int64_t used = std::max<int64_t>(1, std::min<int64_t>(threads, (count + block - 1) / block));
  std::fill_n(batch.status, count, difflcs::kUnreached);
  on_threads(used, AlignedBuffer(kernels.lcp_workspace(batch.n)), stop, [&](void* workspace, difflcs::Watch watch) {
    for (int64_t b; (b = next.fetch_add(block)) < count && !watch.stop(watch.context);)
      kernels.lcp_solve(batch, b, std::min(b + block, count), workspace, watch);
  });
  for (int64_t e = 0; e < count; e++) {
    if (batch.status[e] != difflcs::kUnreached) continue;
    batch.status[e] = static_cast<int8_t>(difflcs::Status::max_iter);
    for (int64_t i = e * batch.n; i < (e + 1) * batch.n; i++) {
      batch.lam[i] = 0;
      batch.w[i] = std::max(batch.q[i], 0.0);
    }
  }
}

void solve_lcp(Array F, Array q, double relaxation, int64_t max_iter, double time_limit, int threads,
               Output<double> lam, Output<double> w, Output<int8_t> status) {
  if (q.ndim() != 2) throw std::invalid_argument("q must be (batch, n)");
  const int64_t count = q.shape(0), n = q.shape(1);
  const bool shared = F.ndim() == 2;
  const bool F_ok =
      shared ? (int64_t(F.shape(0)) == n && int64_t(F.shape(1)) == n)
             : (F.ndim() == 3 && int64_t(F.shape(0)) == count && int64_t(F.shape(1)) == n && int64_t(F.shape(2)) == n);
  if (!F_ok || n < 1) throw std::invalid_argument("F must be (n, n) or (batch, n, n) with n >= 1");
  if (int64_t(lam.size()) != count * n || int64_t(w.size()) != count * n || int64_t(status.size()) != count)
    throw std::invalid_argument("outputs must be (batch, n), (batch, n), (batch,)");
  if (!(relaxation >= 0)) throw std::invalid_argument("relaxation must be >= 0");
  const difflcs::LcpBatch batch{n,        F.data(),   shared ? 0 : n * n, q.data(),     relaxation,
                                max_iter, lam.data(), w.data(),           status.data()};
  Stop stop(time_limit);
  solve(batch, count, threads, stop);
}

// ---- MPC ----

using Inputs = std::vector<Array>;

void check_size(const char* name, int64_t got, int64_t expected) {
  if (got != expected) throw std::invalid_argument(std::string(name) + " has the wrong size");
}

int64_t rank_of(const difflcs::Field& field) {
  return (field.rows != difflcs::Size::one) + (field.columns != difflcs::Size::one);
}

difflcs::MpcBatch mpc_batch(const Inputs& inputs, int64_t horizon, double relaxation, double barrier, bool pivot) {
  using namespace difflcs;
  check_size("inputs", inputs.size(), kInputs);
  for (const Array& a : inputs)
    if (a.ndim() < 1) throw std::invalid_argument("inputs must be vectors or matrices");
  const Array& x0 = inputs[kx0];
  auto last = [&](Input which) { return int64_t(inputs[which].shape(inputs[which].ndim() - 1)); };
  MpcBatch b{};
  b.count = int64_t(x0.shape(0));
  b.n_x = last(kA);
  b.n_u = last(kB);
  b.n_lam = last(kF);
  b.n_c = last(kg);
  b.horizon = horizon;
  b.relaxation = relaxation;
  b.barrier = barrier;
  if (b.n_x < 1 || b.n_u < 1 || horizon < 1 || !(relaxation > 0) || !(barrier >= 0))
    throw std::invalid_argument("sizes, horizon and relaxation must be positive, the barrier not negative");
  for (int i = 0; i < kInputs; i++) {
    const Array& a = inputs[i];
    const int64_t rank = rank_of(kMpcFields[i]), size = extent(b, kMpcFields[i]), leading = int64_t(a.ndim()) - rank;
    const int64_t stages = stages_of(b, kMpcFields[i]);
    const bool shared = leading == 0 || (leading == 2 && a.shape(0) == 1);
    const int64_t whole = (leading == 2 ? stages * size : size) * (shared ? 1 : b.count);
    if (leading < 0 || leading > (stages ? 2 : 1) || int64_t(a.size()) != whole || (i == kx0 && leading != 1))
      throw std::invalid_argument(std::string(kMpcFields[i].name) + " has the wrong shape");
    b.input[i] = a.data();
    b.step[i] = leading == 2 ? size : 0;
    b.stride[i] = shared ? 0 : leading == 2 ? stages * size : size;
  }
  b.pivot = pivot;
  set_flags(b, inputs[kS].size(), inputs[ku_min].size(), inputs[ku_max].size());
  return b;
}

// Workspace of a thread that Python calls from, with the problem that it was last used for: what it has prepared of the
// matrices is good for other calls with the same, as in the loop of a robot.
struct Kept {
  AlignedBuffer workspace;
  std::vector<double> problem;  // sizes and matrices
  int64_t version = 0;
};
thread_local Kept kept;
constexpr int64_t kMostKept = 1 << 22;  // bytes of the workspace

// The number that `kept` has for a problem, see MpcBatch::version.
int64_t version_of(const difflcs::MpcBatch& b) {
  std::vector<double> problem{double(b.n_x), double(b.n_u), double(b.n_lam), double(b.n_c), double(b.horizon), b.barrier};
  for (int i = 0; i < difflcs::kInputs; i++) {
    const difflcs::Field& field = difflcs::kMpcFields[i];
    problem.push_back(double(b.step[i]));
    if (field.columns == difflcs::Size::one) continue;
    if (b.stride[i]) return 0;
    const int64_t count = difflcs::extent(b, field) * (b.step[i] ? difflcs::stages_of(b, field) : 1);
    problem.insert(problem.end(), b.input[i], b.input[i] + count);
  }
  const size_t size = problem.size();
  if (size == kept.problem.size() && !std::memcmp(problem.data(), kept.problem.data(), size * sizeof(double)))
    return kept.version;
  kept.problem.swap(problem);
  return ++kept.version;
}

// The threads of one call.
struct Threads final : difflcs::Runner {
  const int64_t most;
  Stop stop;
  Threads(int64_t most, double time_limit) : most(most), stop(time_limit) {}
  void run(const difflcs::Kernels& kernels, const difflcs::MpcBatch& batch, bool to_the_end, Work work,
           void* context) override {
    Stop never;
    const int64_t used = std::max<int64_t>(1, std::min<int64_t>(most, batch.count / difflcs::kernels().lanes));
    const int64_t workspace_bytes = kernels.mpc_workspace(batch);
    AlignedBuffer mine;  // not in `kept` meanwhile: a signal handler may call, too
    if (workspace_bytes <= kMostKept) std::swap(mine, kept.workspace);
    if (mine.bytes < workspace_bytes) mine = AlignedBuffer(workspace_bytes);
    on_threads(used, mine, to_the_end ? never : stop,
               [&](void* workspace, difflcs::Watch watch) { work(context, workspace, watch); });
    if (mine.bytes <= kMostKept) std::swap(mine, kept.workspace);
  }
  bool stopped() const override { return stop.ending != kGoOn; }
  void allot(double part) override { stop.allot(part); }
};

void check_plans(const difflcs::MpcBatch& b, int64_t x, int64_t u, int64_t lam, int64_t mu) {
  check_size("x", x, b.count * (b.horizon + 1) * b.n_x);
  check_size("u", u, b.count * b.horizon * b.n_u);
  check_size("lam", lam, b.count * b.horizon * b.n_lam);
  check_size("mu", mu, b.count * (b.horizon + 1) * b.n_c);
}

// Returns whether every problem is CONVERGED, so that callers can skip further checks.
bool solve_mpc(Inputs inputs, int64_t horizon, double relaxation, double barrier, std::optional<Array> u_start,
               std::optional<Array> lam_start, std::optional<Array> mu_start, int64_t starts, int64_t groups,
               int64_t sure, int64_t seeks, uint64_t seed, double homotopy, double shrink, double tol, int64_t max_iter,
               double certified, double time_limit, int threads, Output<double> x, Output<double> u,
               Output<double> lam, Output<double> mu, Output<double> objective, Output<double> residual,
               Output<int8_t> status, Output<int8_t> fragile, Output<int32_t> iterations) {
  difflcs::MpcBatch b = mpc_batch(inputs, horizon, relaxation, barrier, false);
  b.version = version_of(b);
  check_plans(b, x.size(), u.size(), lam.size(), mu.size());
  check_size("objective", objective.size(), b.count);
  check_size("residual", residual.size(), b.count);
  check_size("status", status.size(), b.count);
  check_size("iterations", iterations.size(), b.count);
  check_size("fragile", fragile.size(), b.count);
  if (u_start) check_size("u_start", u_start->size(), u.size());
  if (lam_start) check_size("lam_start", lam_start->size(), lam.size());
  if (mu_start) check_size("mu_start", mu_start->size(), mu.size());
  if (!(starts >= 1 && groups >= 1 && homotopy >= 0 && shrink > 0 && shrink < 1))
    throw std::invalid_argument("starts and groups must be at least 1, the homotopy must fall");
  if (lam_start && !(u_start && mu_start)) throw std::invalid_argument("lam_start needs u_start and mu_start");
  if (b.count == 0) return true;
  const difflcs::MpcGuess guess{u_start ? u_start->data() : nullptr, lam_start ? lam_start->data() : nullptr,
                                mu_start ? mu_start->data() : nullptr};
  const difflcs::MpcEffort effort{starts, groups, sure, seeks, homotopy, shrink, tol, max_iter, certified, seed};
  const difflcs::MpcPlans out{x.data(),        u.data(),      lam.data(),     mu.data(),        objective.data(),
                              residual.data(), status.data(), fragile.data(), iterations.data()};
  Threads runner(threads, time_limit);
  difflcs::MpcSearch(difflcs::kernels_for(b.count * effort.jobs())).solve(b, guess, effort, out, runner);
  return std::all_of(status.data(), status.data() + b.count,
                     [](int8_t code) { return code == int8_t(difflcs::Status::converged); });
}

void vjp_mpc(Inputs inputs, int64_t horizon, double relaxation, double barrier, Array x, Array u, Array lam, Array mu,
             Array x_bar, Array u_bar, Array lam_bar, Array objective_bar,
             nb::ndarray<const int8_t, nb::device::cpu, nb::c_contig> solved, bool pivot, int threads,
             std::vector<Output<double>> gradients) {
  using namespace difflcs;
  const MpcBatch b = mpc_batch(inputs, horizon, relaxation, barrier, pivot);
  check_plans(b, x.size(), u.size(), lam.size(), mu.size());
  check_plans(b, x_bar.size(), u_bar.size(), lam_bar.size(), mu.size());
  check_size("objective_bar", objective_bar.size(), b.count);
  check_size("solved", solved.size(), b.count);
  check_size("gradients", gradients.size(), kInputs);
  MpcGradient o{x.data(),     u.data(),       lam.data(),           mu.data(),    x_bar.data(),
                u_bar.data(), lam_bar.data(), objective_bar.data(), solved.data()};
  for (int i = 0; i < kInputs; i++) {
    check_size("gradient", gradients[i].size(), inputs[i].size());
    std::fill_n(gradients[i].data(), gradients[i].size(), 0.0);
    if (b.stride[i])
      o.per_element[i] = gradients[i].data();
    else {
      o.offset[i] = o.shared_size;
      o.shared_size += int64_t(inputs[i].size());
    }
  }
  if (b.count == 0) return;
  const auto& kernels = difflcs::kernels();
  // Sums of shared inputs go block by block in a fixed order, so that they do not depend on the number of threads.
  const int64_t block = 64, blocks = (b.count + block - 1) / block;
  std::vector<double> partial(blocks * o.shared_size);
  o.partial = partial.data();
  std::atomic<int64_t> next{0};
  const int64_t used = std::max<int64_t>(1, std::min<int64_t>(threads, blocks));
  Stop stop;
  on_threads(used, AlignedBuffer(kernels.mpc_workspace(b)), stop, [&](void* workspace, Watch watch) {
    for (int64_t i; (i = next.fetch_add(1)) < blocks;)
      kernels.mpc_vjp(b, o, i * block, std::min(b.count, (i + 1) * block), i, workspace, watch);
  });
  for (int i = 0; i < kInputs; i++) {
    if (b.stride[i]) continue;
    double* to = gradients[i].data();
    for (int64_t k = 0; k < blocks; k++)
      for (int64_t j = 0; j < int64_t(inputs[i].size()); j++) to[j] += partial[k * o.shared_size + o.offset[i] + j];
  }
}

// ---- violation loss ----

difflcs::ViolationBatch violation_batch(const Inputs& inputs, double xi, Output<double>& r, Output<double>& e) {
  using namespace difflcs;
  check_size("inputs", inputs.size(), kViolationInputs);
  for (int i : {vA, vB, vF, vx})
    if (inputs[i].ndim() < 2) throw std::invalid_argument("A, B, F and x must be matrices");
  auto last = [&](ViolationInput which) { return int64_t(inputs[which].shape(inputs[which].ndim() - 1)); };
  ViolationBatch b{};
  b.count = int64_t(inputs[vx].shape(0));
  b.n_x = last(vA);
  b.n_u = last(vB);
  b.n_lam = last(vF);
  b.xi = xi;
  b.r = r.data();
  b.e = e.data();
  b.shared = true;
  for (int i = 0; i < kViolationInputs; i++) {
    const Array& a = inputs[i];
    const int64_t size = extent(b, kViolationFields[i]), leading = int64_t(a.ndim()) - rank_of(kViolationFields[i]);
    const bool datum = i == vx || i == vu || i == vx_next;
    if (leading < datum || leading > 1 || (leading && int64_t(a.shape(0)) != b.count) ||
        int64_t(a.size()) != (leading ? b.count * size : size))
      throw std::invalid_argument(std::string(kViolationFields[i].name) + " has the wrong shape");
    b.input[i] = a.data();
    b.stride[i] = leading ? size : 0;
    b.shared = b.shared && (datum || !leading);
  }
  if (b.n_x < 1 || b.n_u < 1 || b.n_lam < 1) throw std::invalid_argument("sizes must be positive");
  check_size("r", r.size(), b.count * b.n_x);
  check_size("e", e.size(), b.count * b.n_lam);
  return b;
}

// One pass over the transitions on this thread.
template <class Work>
void pass(difflcs::ViolationBatch& b, Work work) {
  Stop stop;
  const AlignedBuffer workspace(difflcs::kernels().violation_workspace(b));
  on_threads(1, workspace, stop, [&](void* workspace, difflcs::Watch watch) {
    b.watch = watch;
    work(workspace);
  });
}

// Computes the minimiser z and the values there. Returns none if the inputs are not finite, the QP is not convex by a
// margin, there are no transitions, or the solver failed: then r, e, Q and q are those at z = 0, and z and loss are not
// set. Else returns the first transition for which double precision does not suffice, or -1.
std::optional<int64_t> violation_loss(Inputs inputs, double xi, int64_t max_iter, int threads, Output<double> Q,
                                      Output<double> q, Output<double> z, Output<double> r, Output<double> e,
                                      Output<double> loss) {
  difflcs::ViolationBatch b = violation_batch(inputs, xi, r, e);
  const int64_t n = 2 * b.n_lam;
  check_size("Q", Q.size(), b.shared ? n * n : b.count * n * n);
  check_size("q", q.size(), b.count * n);
  check_size("z", z.size(), b.count * n);
  check_size("loss", loss.size(), b.count);
  bool convex = false;
  pass(b, [&](void* workspace) { convex = difflcs::kernels().violation_qp(b, Q.data(), q.data(), workspace); });
  if (!convex || b.count == 0) return std::nullopt;
  std::vector<double> w(b.count * n);
  std::vector<int8_t> status(b.count);
  const int64_t stride = b.shared ? 0 : n * n;
  const difflcs::LcpBatch lcp{n, Q.data(), stride, q.data(), 0.0, max_iter, z.data(), w.data(), status.data()};
  Stop stop;
  solve(lcp, b.count, threads, stop);
  for (const int8_t s : status)
    if (!difflcs::solved(s)) return std::nullopt;
  int64_t lost = -1;
  pass(b, [&](void* workspace) { lost = difflcs::kernels().violation_value(b, z.data(), loss.data(), workspace); });
  return lost;
}

int64_t violation_value(Inputs inputs, double xi, Array z, Output<double> r, Output<double> e, Output<double> loss) {
  difflcs::ViolationBatch b = violation_batch(inputs, xi, r, e);
  check_size("z", z.size(), 2 * b.n_lam * b.count);
  check_size("loss", loss.size(), b.count);
  int64_t lost = -1;
  if (b.count > 0)
    pass(b, [&](void* workspace) { lost = difflcs::kernels().violation_value(b, z.data(), loss.data(), workspace); });
  return lost;
}

void violation_gradient(Inputs inputs, double xi, Array z, Output<double> r, Output<double> e, Array upstream,
                        std::vector<std::optional<Output<double>>> gradients) {
  using namespace difflcs;
  ViolationBatch b = violation_batch(inputs, xi, r, e);
  check_size("z", z.size(), 2 * b.n_lam * b.count);
  std::vector<double> same;  // one number is that of all
  if (upstream.size() == 1)
    same.assign(b.count, *upstream.data());
  else
    check_size("upstream", upstream.size(), b.count);
  const double* each = upstream.size() == 1 ? same.data() : upstream.data();
  check_size("gradients", gradients.size(), kViolationInputs);
  double* to[kViolationInputs] = {};
  for (int i = 0; i < kViolationInputs; i++) {
    if (!gradients[i] && i < vx) throw std::invalid_argument("the system's gradients are always computed");
    if (gradients[i]) {
      check_size("gradient", gradients[i]->size(), inputs[i].size());
      to[i] = gradients[i]->data();
    }
  }
  pass(b, [&](void* workspace) { kernels().violation_gradient(b, z.data(), each, to, workspace); });
}

// ---- tables ----

// Fields of an MPC problem with the kinds of their dimensions, as difflcs.mpc.problem.INPUTS has them.
template <size_t N>
nb::dict fields(const difflcs::Field (&all)[N]) {
  nb::dict table;
  for (const difflcs::Field& f : all) {
    nb::list sizes;
    for (const difflcs::Size size : {f.rows, f.columns})
      if (size != difflcs::Size::one) sizes.append(nb::str(difflcs::kSizeNames[int(size)]));
    table[f.name] = nb::tuple(sizes);
  }
  return table;
}

// The stages of each: "" for none, H or H+1.
nb::dict stages() {
  nb::dict table;
  for (const difflcs::Field& f : difflcs::kMpcFields) table[f.name] = nb::str(difflcs::kGivenNames[int(f.stages)]);
  return table;
}

nb::dict status_codes() {
  nb::dict codes;
  int code = 0;
  for (std::string name : difflcs::kStatusNames) {
    for (char& c : name) c = char(std::toupper(c));
    codes[name.c_str()] = code++;
  }
  return codes;
}

nb::dict tolerances() {
  nb::dict table;
  for (const difflcs::Tolerance& tolerance : difflcs::kTolerances) table[tolerance.name] = tolerance.value;
  return table;
}

// Tests bits instead of `isfinite`, without an early end, so that the loop is vectorised.
bool all_finite(const std::vector<Array>& arrays) {
  constexpr uint64_t exponent = 0x7ff0000000000000u;
  return std::all_of(arrays.begin(), arrays.end(), [](const Array& a) {
    uint64_t invalid = 0;
    for (const double *v = a.data(), *end = v + a.size(); v != end; v++) {
      uint64_t bits;
      std::memcpy(&bits, v, sizeof bits);
      invalid |= (bits & exponent) == exponent;
    }
    return invalid == 0;
  });
}

// A number that says whether bytes have changed, by rounds of XXH64 (Y. Collet) of eight words side by side.
uint64_t fingerprint(const nb::ndarray<const uint8_t, nb::ndim<1>, nb::device::cpu, nb::c_contig>& bytes) {
  constexpr uint64_t first = 0x9E3779B185EBCA87u, second = 0xC2B2AE3D27D4EB4Fu;
  uint64_t lanes[8] = {first, second, 3, 4, 5, 6, 7, bytes.size()};
  const auto mix = [](uint64_t& lane, uint64_t word) {
    lane += word * second;
    lane = (lane << 31 | lane >> 33) * first;
  };
  const uint8_t *from = bytes.data(), *end = from + bytes.size();
  for (; end - from >= 64; from += 64) {
    uint64_t words[8];
    std::memcpy(words, from, sizeof words);
    for (int k = 0; k < 8; k++) mix(lanes[k], words[k]);
  }
  for (; from != end; from++) mix(lanes[0], *from);
  for (int k = 1; k < 8; k++) mix(lanes[0], lanes[k]);
  return lanes[0];
}

}  // namespace

NB_MODULE(_kernels, m) {
  m.doc() = "Native kernels of difflcs. Private: use the functions of difflcs.";
  m.def("isa", [] { return difflcs::kernels().isa; }, "Instruction set in use.");
  m.def("mpc_fields", [] { return fields(difflcs::kMpcFields); }, "Inputs of an MPC problem, with their dimensions.");
  m.def("mpc_stages", &stages, "How many stages each has where it is given by stage.");
  m.def("violation_fields", [] { return fields(difflcs::kViolationFields); }, "The same of the violation loss.");
  m.def("status_codes", &status_codes, "How a solve can end: name and code.");
  m.def("tolerances", &tolerances, "Tolerances that the reference in Python has too.");
  m.def("all_finite", &all_finite, "arrays"_a, "Whether no number of some arrays is NaN or infinite.");
  m.def("fingerprint", &fingerprint, "bytes"_a, "A number that says whether bytes have changed.");
  m.def("solve_lcp", &solve_lcp, "F"_a, "q"_a, "relaxation"_a, "max_iter"_a, "time_limit"_a, "threads"_a, "lam"_a,
        "w"_a, "status"_a, "Solve a batch of LCPs into the given arrays.");
  m.def("solve_mpc", &solve_mpc, "inputs"_a, "horizon"_a, "relaxation"_a, "barrier"_a, "u_start"_a.none(),
        "lam_start"_a.none(), "mu_start"_a.none(), "starts"_a, "groups"_a, "sure"_a, "seeks"_a, "seed"_a, "homotopy"_a,
        "shrink"_a, "tol"_a, "max_iter"_a, "certified"_a, "time_limit"_a, "threads"_a, "x"_a, "u"_a, "lam"_a, "mu"_a,
        "objective"_a, "residual"_a, "status"_a, "fragile"_a, "iterations"_a,
        "Solve a batch of LCS-MPC problems into the given arrays. Returns whether all are CONVERGED.");
  m.def("vjp_mpc", &vjp_mpc, "inputs"_a, "horizon"_a, "relaxation"_a, "barrier"_a, "x"_a, "u"_a, "lam"_a, "mu"_a,
        "x_bar"_a, "u_bar"_a, "lam_bar"_a, "objective_bar"_a, "solved"_a, "pivot"_a, "threads"_a, "gradients"_a,
        "Gradients of the inputs of solved LCS-MPC problems, into the given arrays.");
  m.def("violation_loss", &violation_loss, "inputs"_a, "xi"_a, "max_iter"_a, "threads"_a, "Q"_a, "q"_a, "z"_a, "r"_a,
        "e"_a, "loss"_a, "Violation loss of a batch and what its gradient needs, into the given arrays.");
  m.def("violation_value", &violation_value, "inputs"_a, "xi"_a, "z"_a, "r"_a, "e"_a, "loss"_a,
        "The same at a given z, from r and e at z = 0.");
  m.def("violation_gradient", &violation_gradient, "inputs"_a, "xi"_a, "z"_a, "r"_a, "e"_a, "upstream"_a, "gradients"_a,
        "Gradients of the inputs, into the given arrays; None where one is not wanted.");
  bind_controller(m);
}
