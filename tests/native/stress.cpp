// Drives every kernel over many sizes, shared and per-element inputs, several threads and broken numbers, to be built
// with sanitizers (`make sanitize`). It checks memory and arithmetic, not mathematics: the Python tests do that.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <new>
#include <random>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "controller.hpp"
#include "driver.hpp"
#include "kernels.hpp"

using namespace difflcs;

namespace {

std::mt19937_64 generator(0);

std::vector<double> normal(int64_t count, double scale) {
  std::normal_distribution<double> draw(0.0, scale);
  std::vector<double> v(count);
  for (double& x : v) x = draw(generator);
  return v;
}

struct Workspace {
  void* data;
  explicit Workspace(int64_t bytes) : data(::operator new(bytes, std::align_val_t{64})) {}
  ~Workspace() { ::operator delete(data, std::align_val_t{64}); }
};

// Diagonally dominant on average, with a skew part.
std::vector<double> lcp_matrices(int64_t count, int64_t n) {
  std::vector<double> F(count * n * n);
  for (int64_t e = 0; e < count; e++) {
    const auto G = normal(n * n, 1.0);
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < n; j++) {
        double t = i == j ? 0.1 : 0.0;
        for (int64_t m = 0; m < n; m++) t += G[i * n + m] * G[j * n + m];
        F[(e * n + i) * n + j] = t + 0.5 * (G[i * n + j] - G[j * n + i]);
      }
  }
  return F;
}

const Watch kNever{[](void*) { return false; }, nullptr};

// Several threads, whose work is stopped when it has asked whether to stop so many times.
struct Pool final : Runner {
  const int threads;
  std::atomic<int> left;
  Pool(int threads, int left) : threads(threads), left(left) {}
  static bool counts_down(void* context) { return --*static_cast<std::atomic<int>*>(context) < 0; }
  void run(int64_t, int64_t workspace_bytes, bool to_the_end, Work work, void* context) override {
    std::vector<std::thread> pool;
    for (int t = 0; t < threads; t++)
      pool.emplace_back([&] {
        const Workspace workspace(workspace_bytes);
        work(context, workspace.data, to_the_end ? kNever : Watch{counts_down, &left});
      });
    for (auto& t : pool) t.join();
  }
  bool stopped() const override { return left < 0; }
};

int failures = 0;
void expect(bool ok, const char* what) {
  if (!ok) {
    std::printf("FAILED: %s\n", what);
    failures++;
  }
}

void lcp(int64_t n, int64_t count, bool shared, double relaxation, double broken) {
  const auto F = lcp_matrices(shared ? 1 : count, n);
  auto q = normal(count * n, 1.0);
  if (broken != 0) q[0] = broken;
  std::vector<double> lam(count * n), w(count * n);
  std::vector<int8_t> status(count, kUnreached);
  const LcpBatch batch{n, F.data(), shared ? 0 : n * n, q.data(), relaxation, 80, lam.data(), w.data(), status.data()};
  const Workspace workspace(kernels().lcp_workspace(n));
  for (int64_t begin = 0; begin < count; begin += 5)
    kernels().lcp_solve(batch, begin, std::min(count, begin + 5), workspace.data, kNever);
  expect(std::count_if(status.begin(), status.end(), solved) >= count - (broken != 0), "every sound LCP is solved");
}

void mpc(int64_t n_x, int64_t n_u, int64_t n_lam, int64_t horizon, int64_t count, bool shared, double barrier,
         double broken, int threads, bool pivot) {
  MpcBatch b{};
  b.count = count;
  b.n_x = n_x;
  b.n_u = n_u;
  b.n_lam = n_lam;
  b.horizon = horizon;
  b.relaxation = 1e-5;
  b.barrier = barrier;
  b.pivot = pivot;
  int64_t sizes[kInputs];
  for (int i = 0; i < kInputs; i++) sizes[i] = extent(b, kMpcFields[i]);
  std::vector<double> data[kInputs];
  for (int i = 0; i < kInputs; i++) {
    const bool own = i == kx0 || !shared;
    const int64_t copies = own ? count : 1;
    data[i] = i == kF ? lcp_matrices(copies, n_lam) : normal(copies * sizes[i], 0.2);
    if (i == kQ || i == kR || i == kQ_final) {
      const int64_t n = i == kR ? n_u : n_x;
      for (int64_t e = 0; e < copies; e++)
        for (int64_t r = 0; r < n; r++)
          for (int64_t c = 0; c < n; c++) data[i][(e * n + r) * n + c] = r == c ? 1.0 : 0.0;
    }
    if (i == ku_min || i == ku_max)
      for (double& v : data[i]) v = (i == ku_min ? -1 : 1) * (0.1 + std::fabs(v));
    b.stride[i] = own ? sizes[i] : 0;
  }
  if (broken != 0) data[kx0][0] = broken;
  for (int i = 0; i < kInputs; i++) b.input[i] = data[i].data();
  std::vector<double> x(count * (horizon + 1) * n_x), u(count * horizon * n_u), lam(count * horizon * n_lam), mu(1);
  std::vector<double> objective(count), residual(count);
  std::vector<int8_t> status(count), fragile(count), all_solved(count, 1);
  std::vector<int32_t> iterations(count);
  const MpcPlans out{x.data(),        u.data(),      lam.data(),     mu.data(),        objective.data(),
                     residual.data(), status.data(), fragile.data(), iterations.data()};
  MpcDriver driver(kernels());
  for (const int64_t starts : {1, 6}) {  // each cold, from its own solution, and stopped on the way
    const MpcEffort effort{starts, 0, 0.3, 1e-8, 100, 1e-6, 0};
    std::vector<double> u_start, lam_start;
    for (const int left : {1 << 30, 1 << 30, 7}) {
      Pool pool(threads, left);
      const MpcGuess guess{u_start.empty() ? nullptr : u_start.data(), lam_start.empty() ? nullptr : lam_start.data(),
                           u_start.empty() ? nullptr : mu.data()};
      driver.solve(b, guess, effort, out, pool);
      for (const int8_t s : status) expect(s >= 0 && s <= int8_t(Status::degenerate), "every problem has a status");
      if (broken != 0) continue;
      if (left > 7)
        expect(std::count_if(status.begin(), status.end(), solved) * 10 >= count * 9,
               "nine of ten MPC problems are solved");
      u_start = u;
      lam_start = lam;
    }
  }
  MpcGradient g{};
  const auto x_bar = normal(x.size(), 1.0), u_bar = normal(u.size(), 1.0), lam_bar = normal(lam.size(), 1.0);
  const auto objective_bar = normal(count, 1.0);
  g.x = x.data();
  g.u = u.data();
  g.lam = lam.data();
  g.mu = mu.data();
  g.x_bar = x_bar.data();
  g.u_bar = u_bar.data();
  g.lam_bar = lam_bar.data();
  g.objective_bar = objective_bar.data();
  g.solved = all_solved.data();
  std::vector<double> own[kInputs];
  for (int i = 0; i < kInputs; i++) {
    if (b.stride[i]) {
      own[i].resize(count * sizes[i]);
      g.per_element[i] = own[i].data();
    } else {
      g.offset[i] = g.shared_size;
      g.shared_size += sizes[i];
    }
  }
  const int64_t block = 7, blocks = (count + block - 1) / block;
  std::vector<double> partial(blocks * g.shared_size);
  g.partial = partial.data();
  const Workspace workspace(kernels().mpc_workspace(b));
  for (int64_t i = 0; i < blocks; i++)
    kernels().mpc_vjp(b, g, i * block, std::min(count, (i + 1) * block), i, workspace.data, kNever);
}

void violation(int64_t n_x, int64_t n_u, int64_t n_lam, int64_t count, double broken, bool shared) {
  std::vector<double> data[kViolationInputs], gradient[kViolationInputs];
  ViolationBatch b{};
  b.count = count;
  b.n_x = n_x;
  b.n_u = n_u;
  b.n_lam = n_lam;
  double* to[kViolationInputs];
  for (int i = 0; i < kViolationInputs; i++) {
    const int64_t size = extent(b, kViolationFields[i]);
    const bool each = !shared || i == vx || i == vu || i == vx_next;
    const int64_t systems = each ? count : 1;
    data[i] = i == vF ? lcp_matrices(systems, n_lam) : normal(systems * size, 0.5);
    if (i == vgamma) data[i].assign(systems, 0.1);
    gradient[i].resize(systems * size);
    b.input[i] = data[i].data();
    b.stride[i] = each ? size : 0;
    to[i] = i == vgamma ? nullptr : gradient[i].data();
  }
  if (broken != 0) data[vx][0] = broken;
  const int64_t n = 2 * n_lam;
  std::vector<double> Q((shared ? 1 : count) * n * n), q(count * n), r(count * n_x), e(count * n_lam), loss(count);
  b.shared = shared;
  b.xi = 0.1;
  b.r = r.data();
  b.e = e.data();
  b.watch = kNever;
  const Workspace workspace(kernels().violation_workspace(b));
  const bool convex = kernels().violation_qp(b, Q.data(), q.data(), workspace.data);
  expect(convex || std::isnan(broken), "the inner QP is convex");
  const auto z = normal(count * n, 1.0), upstream = normal(count, 1.0);
  kernels().violation_value(b, z.data(), loss.data(), workspace.data);
  for (int pass = 0; pass < 2; pass++) {
    kernels().violation_gradient(b, z.data(), upstream.data(), to, workspace.data);
    to[vx] = to[vu] = to[vx_next] = nullptr;
  }
}

// The bytes of a controller file, see controller_file.hpp.
class File {
 public:
  void put(const char* name, std::vector<double> values) {
    char padded[16] = {};
    std::strncpy(padded, name, sizeof padded);
    const uint64_t count = values.size();
    append(padded, sizeof padded);
    append(&count, sizeof count);
    append(values.data(), count * sizeof(double));
  }
  std::string bytes() const {
    const uint64_t size = 24 + body_.size();
    const std::string tail = std::string(reinterpret_cast<const char*>(&size), 8) + body_;
    uint32_t crc = 0xffffffff;
    for (const unsigned char c : tail) {
      crc ^= c;
      for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320 : 0);
    }
    const uint32_t head[2] = {kControllerVersion, ~crc};
    return std::string("\x89LCS\r\n\x1a\n") + std::string(reinterpret_cast<const char*>(head), 8) + tail;
  }

 private:
  void append(const void* from, size_t size) { body_.append(static_cast<const char*>(from), size); }
  std::string body_;
};

void controller(int64_t n_x, int64_t n_u, int64_t n_lam, int64_t h, int64_t n_c, int64_t n_goal, bool staged,
                double broken) {
  MpcBatch b{};
  b.count = 1;
  b.n_x = n_x;
  b.n_u = n_u;
  b.n_lam = n_lam;
  b.n_c = n_c;
  b.horizon = h;
  File file;
  const std::pair<const char*, double> numbers[] = {{"n_x", n_x},
                                                    {"n_u", n_u},
                                                    {"n_lam", n_lam},
                                                    {"n_c", n_c},
                                                    {"horizon", h},
                                                    {"n_goal", n_goal},
                                                    {"relaxation", 1e-5},
                                                    {"barrier", 0},
                                                    {"tol", 1e-8},
                                                    {"certified", 1e-6},
                                                    {"homotopy", 0},
                                                    {"shrink", 0.3},
                                                    {"max_iter", 150},
                                                    {"seed", 0},
                                                    {"starts", staged ? 16 : 3},
                                                    {"starts_guessed", staged ? 16 : 1},
                                                    {"step_seconds", 0}};
  for (const auto& number : numbers) file.put(number.first, {double(number.second)});
  for (int i = 0; i < kx0; i++) {
    const int64_t copies = staged && stages_of(b, kMpcFields[i]) ? stages_of(b, kMpcFields[i]) : 1;
    std::vector<double> values;
    for (int64_t k = 0; k < copies; k++) {
      const int64_t size = extent(b, kMpcFields[i]);
      auto own = i == kF ? lcp_matrices(1, n_lam) : normal(size, 0.3);
      for (int64_t j = 0; j < size; j++) {
        if (i == ku_min) own[j] = -0.5;
        if (i == ku_max || i == kprice) own[j] = 0.5;
        if (i == kQ || i == kQ_final) own[j] = j % (n_x + 1) == 0;
        if (i == kR) own[j] = j % (n_u + 1) == 0;
        if (i == kS) own[j] *= 0.1;
      }
      values.insert(values.end(), own.begin(), own.end());
    }
    file.put(kMpcFields[i].name, values);
  }
  file.put("goal_to_q", normal(n_x * n_goal, 1));
  file.put("goal_to_q_final", normal(n_x * n_goal, 1));
  file.put("goal_stage", normal(n_goal * n_goal, 1));
  file.put("goal_final", normal(n_goal * n_goal, 1));
  file.put("constant", {1.0});
  const std::string bytes = file.bytes();
  Controller own(bytes.data(), bytes.size());
  std::vector<double> u(n_u);
  const auto given = normal(n_u, 1);
  for (int i = 0; i < 12; i++) {
    const bool follow = i % 2 && n_goal > 0;
    auto x = normal(n_x, 0.3), targets = normal((follow ? h + 1 : 1) * n_goal, 0.3);
    if (i % 4 == 3) x[0] = broken;
    own.set_time_limit(i % 5 == 4 ? 1e-9 : std::numeric_limits<double>::infinity());
    own.set_fallback(Fallback(i % 4), given.data());
    own.step(x.data(), targets.data(), follow, u.data());
    for (const double a : u) expect(a >= -0.5 && a <= 0.5, "every action is inside the bounds");
  }
  // What is damaged is refused, in whatever way.
  int refused = 0;
  const int tries = 40;
  for (int i = 0; i < tries; i++) {
    std::string damaged = bytes.substr(0, i % 2 ? bytes.size() : generator() % bytes.size());
    if (i % 2) damaged[generator() % damaged.size()] ^= char(1 << generator() % 8);
    try {
      Controller(damaged.data(), damaged.size());
    } catch (const std::runtime_error&) {
      refused++;
    }
  }
  expect(refused == tries, "a damaged file is refused");
}

}  // namespace

int main() {
  const double huge = 1e200, nan = std::numeric_limits<double>::quiet_NaN();
  for (const int64_t n : {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 16, 70})
    for (const bool shared : {true, false})
      for (const double relaxation : {0.0, 1e-5})
        for (const double broken : {0.0, huge, nan}) lcp(n, 23, shared, relaxation, broken);
  const int64_t shapes[][4] = {{9, 6, 5, 5}, {9, 6, 8, 5}, {9, 6, 7, 5}, {2, 1, 1, 1}, {4, 2, 3, 7}, {1, 1, 1, 3}};
  for (const auto& s : shapes)
    for (const bool shared : {true, false})
      for (const double barrier : {0.0, 1e-2})
        for (const double broken : {0.0, huge, nan})
          for (const int threads : {1, 3})
            for (const int64_t count : {1, 29})
              mpc(s[0], s[1], s[2], s[3], count, shared, barrier, broken, threads,
                  broken == 0 && !shared && threads == 1);
  for (const auto& s : shapes)
    for (const double broken : {0.0, huge, nan})
      for (const int64_t count : {1, 29}) {
        violation(s[0], s[1], s[2], count, broken, true);
        violation(s[0], s[1], s[2], count, broken, false);
      }
  for (const auto& s : shapes)
    for (const int64_t n_c : {0, 2})
      for (const int64_t n_goal : {0, 3})
        for (const double broken : {0.0, huge, nan})
          controller(s[0], s[1], s[2], s[3], n_c, n_goal, n_goal > 0, broken);
  controller(3, 2, 0, 1, 1, 2, false, nan);
  std::printf("%s kernels, %d lanes: %s\n", kernels().isa, kernels().lanes, failures ? "FAILED" : "clean");
  return failures != 0;
}
