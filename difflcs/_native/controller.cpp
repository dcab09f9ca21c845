#include "controller.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

namespace difflcs {
namespace {

using Clock = std::chrono::steady_clock;

// Runs the work on this thread, in the controller's memory, until the time is over.
class Alone final : public Runner {
 public:
  Alone(void* workspace, Clock::time_point ends) : workspace_(workspace), ends_(ends) {}

  void run(int64_t, int64_t, bool to_the_end, Work work, void* context) override {
    work(context, workspace_, {to_the_end ? [](void*) { return false; } : &Alone::ask, this});
  }
  bool stopped() const override { return late_; }

 private:
  static bool ask(void* context) {
    Alone& self = *static_cast<Alone*>(context);
    if (!self.late_ && Clock::now() >= self.ends_) self.late_ = true;
    return self.late_;
  }

  void* workspace_;
  Clock::time_point ends_;
  bool late_ = false;
};

double seconds_since(Clock::time_point begun) { return std::chrono::duration<double>(Clock::now() - begun).count(); }

bool all_finite(const double* values, int64_t count) {
  bool finite = true;
  for (int64_t i = 0; i < count; i++) finite = finite && std::isfinite(values[i]);
  return finite;
}

// to = matrix (rows, columns) * vector
void multiply(const Numbers& matrix, const double* vector, int64_t rows, int64_t columns, double* to) {
  for (int64_t i = 0; i < rows; i++) {
    double sum = 0;
    for (int64_t j = 0; j < columns; j++) sum += matrix.get()[i * columns + j] * vector[j];
    to[i] = sum;
  }
}

// vector' * matrix * vector
double quadratic(const Numbers& matrix, const double* vector, int64_t size) {
  double total = 0;
  for (int64_t i = 0; i < size; i++) {
    double sum = 0;
    for (int64_t j = 0; j < size; j++) sum += matrix.get()[i * size + j] * vector[j];
    total += vector[i] * sum;
  }
  return total;
}

// Rows one step later, the last one repeated: MPCSolution.shift() of difflcs/mpc/solution.py.
void shift(const Numbers& from, int64_t rows, Numbers& to) {
  const int64_t width = from.count() / rows;
  std::memmove(to.get(), from.get() + width, sizeof(double) * size_t((rows - 1) * width));
  if (to.get() != from.get())
    std::memcpy(to.get() + (rows - 1) * width, from.get() + (rows - 1) * width, sizeof(double) * size_t(width));
}

}  // namespace

Controller::Controller(const void* bytes, size_t size)
    : kernels_(kernels_for(1)),
      data_(read_controller(bytes, size)),
      search_(kernels_),
      time_limit_(std::numeric_limits<double>::infinity()) {
  const int64_t nx = data_.n_x, nu = data_.n_u, nl = data_.n_lam, nc = data_.n_c, h = data_.horizon;
  x0_ = Numbers(nx);
  q_ = Numbers(h * nx);
  q_final_ = Numbers(nx);
  fallback_action_ = Numbers(nu);
  found_ = {Numbers((h + 1) * nx), Numbers(h * nu), Numbers(h * nl), Numbers((h + 1) * nc)};
  next_u_ = Numbers(h * nu);
  guess_u_ = Numbers(h * nu);
  guess_lam_ = Numbers(h * nl);
  guess_mu_ = Numbers((h + 1) * nc);
  batch_.count = 1;
  batch_.version = 1;
  batch_.n_x = nx;
  batch_.n_u = nu;
  batch_.n_lam = nl;
  batch_.n_c = nc;
  batch_.horizon = h;
  batch_.relaxation = data_.relaxation;
  batch_.barrier = data_.barrier;
  for (int i = 0; i < kInputs; i++) {
    batch_.input[i] = data_.field[i].get();
    batch_.step[i] = data_.by_stage[i] ? extent(batch_, kMpcFields[i]) : 0;
  }
  batch_.input[kx0] = x0_.get();
  set_flags(batch_, data_.field[kS].count(), data_.field[ku_min].count(), data_.field[ku_max].count());
  int64_t needed = kernels_.mpc_workspace(batch_);
  if (data_.n_goal > 0) {
    batch_.input[kq] = q_.get();
    batch_.input[kq_final] = q_final_.get();
    batch_.step[kq] = h > 1 ? nx : 0;
    needed = std::max(needed, kernels_.mpc_workspace(batch_));
  }
  search_.reserve(batch_, std::max(data_.starts, data_.starts_guessed));
  workspace_ = Numbers(needed / int64_t(sizeof(double)) + 1);
}

const Outcome& Controller::step(const double* x, const double* targets, bool follow, double* u) {
  const auto begun = Clock::now();
  const int64_t aims = data_.n_goal * (follow ? data_.horizon + 1 : 1);
  outcome_ = Outcome{};
  unfinished_ = false;
  if (all_finite(x, data_.n_x) && all_finite(targets, aims)) {
    std::copy_n(x, data_.n_x, x0_.get());
    if (data_.n_goal > 0) aim(targets, follow);
    solve(begun);
  } else {
    outcome_.status = Status::numerical;
    outcome_.objective = outcome_.residual = std::numeric_limits<double>::max();
    wait();
  }
  outcome_.fallback = !solved(int8_t(outcome_.status));
  if (!outcome_.fallback || (fallback_ == Fallback::unfinished && unfinished_)) {
    std::copy_n(found_.u.get(), data_.n_u, u);
    shift(found_.u, data_.horizon, next_u_);
    planned_ = data_.horizon - 1;
  } else {
    fall_back(u);
  }
  return outcome_;
}

// The linear terms of the cost for a goal, or for a goal of each state.
void Controller::aim(const double* targets, bool follow) {
  const int64_t nx = data_.n_x, ng = data_.n_goal, h = data_.horizon;
  const double* last = targets + (follow ? h * ng : 0);
  const int64_t stages = follow ? h : 1;
  for (int64_t k = 0; k < stages; k++) multiply(data_.goal_to_q, targets + k * ng, nx, ng, q_.get() + k * nx);
  multiply(data_.goal_to_q_final, last, nx, ng, q_final_.get());
  const int64_t step = follow && h > 1 ? nx : 0;
  if (step != batch_.step[kq]) batch_.version++;
  batch_.step[kq] = step;
  double tracked = 0;
  for (int64_t k = 0; k < stages; k++) tracked += quadratic(data_.goal_stage, targets + k * ng, ng);
  tracked *= double(follow ? 1 : h);
  goal_constant_ = 0.5 * (tracked + quadratic(data_.goal_final, last, ng));
}

// Calls the solver; its result is the guess of the next step.
void Controller::solve(Clock::time_point begun) {
  int8_t status = kUnreached, fragile = 0;
  const MpcGuess guess = guessed_ ? MpcGuess{guess_u_.get(), guess_lam_.get(), guess_mu_.get()} : MpcGuess{};
  const MpcEffort effort{guessed_ ? data_.starts_guessed : data_.starts,
                         data_.homotopy,
                         data_.shrink,
                         data_.tol,
                         data_.max_iter,
                         data_.certified,
                         uint64_t(data_.seed)};
  const MpcPlans out{found_.x.get(),     found_.u.get(), found_.lam.get(), found_.mu.get(),     &outcome_.objective,
                     &outcome_.residual, &status,        &fragile,         &outcome_.iterations};
  auto ends = Clock::time_point::max();
  if (time_limit_ < 1e9) ends = begun + std::chrono::nanoseconds(int64_t(1e9 * std::max(time_limit_, 0.0)));
  Alone runner(workspace_.get(), ends);
  const auto started = Clock::now();
  search_.solve(batch_, guess, effort, out, runner);
  outcome_.solve_seconds = seconds_since(started);
  outcome_.late = runner.stopped();
  outcome_.status = Status(status);
  // The search marks a problem that was not begun in time.
  const bool begun_at_all = outcome_.objective != std::numeric_limits<double>::max();
  if (begun_at_all) outcome_.objective += data_.constant + goal_constant_;
  for (double* value : {&outcome_.objective, &outcome_.residual})
    if (!std::isfinite(*value)) *value = std::numeric_limits<double>::max();
  if (!begun_at_all) return wait();
  const bool usable = make_finite();
  // The next step continues a solve that ran out of time or iterations. After any other failure it starts afresh.
  unfinished_ = usable && outcome_.status == Status::max_iter;
  guessed_ = solved(status) || unfinished_;
  if (!guessed_) return;
  const int64_t h = data_.horizon;
  shift(found_.u, h, guess_u_);
  shift(found_.lam, h, guess_lam_);
  shift(found_.mu, h + 1, guess_mu_);
}

// A step without a new plan: the guess is one for the next.
void Controller::wait() {
  const int64_t h = data_.horizon;
  shift(guess_u_, h, guess_u_);
  shift(guess_lam_, h, guess_lam_);
  shift(guess_mu_, h + 1, guess_mu_);
}

// Makes an unfinished plan finite; returns whether it was.
bool Controller::make_finite() {
  bool finite = true;
  for (const Numbers* values : {&found_.x, &found_.u, &found_.lam, &found_.mu})
    for (int64_t i = 0; i < values->count(); i++) {
      double& value = values->get()[i];
      if (std::isfinite(value)) continue;
      value = values == &found_.u ? clipped(i, 0.0) : 0.0;
      finite = false;
    }
  return finite;
}

void Controller::fall_back(double* u) {
  const bool holding = (fallback_ == Fallback::hold || fallback_ == Fallback::unfinished) && planned_ > 0;
  for (int64_t j = 0; j < data_.n_u; j++)
    u[j] = clipped(j, fallback_ == Fallback::action ? fallback_action_.get()[j] : holding ? next_u_.get()[j] : 0.0);
  shift(next_u_, data_.horizon, next_u_);
  planned_ = std::max<int64_t>(planned_ - 1, 0);
}

// Clips a value for action number i of a plan (H, n_u).
double Controller::clipped(int64_t i, double value) const {
  const auto bound = [&](Input which) { return data_.field[which].get()[data_.by_stage[which] ? i : i % data_.n_u]; };
  return std::min(std::max(value, bound(ku_min)), bound(ku_max));
}

void Controller::reset() {
  guessed_ = false;
  planned_ = 0;
  outcome_ = Outcome{};
  for (const Numbers* values : {&found_.x, &found_.u, &found_.lam, &found_.mu})
    std::fill_n(values->get(), values->count(), 0.0);
}

void Controller::set_fallback(Fallback kind, const double* action) {
  fallback_ = kind;
  if (kind == Fallback::action) std::copy_n(action, data_.n_u, fallback_action_.get());
}

void Controller::set_inputs(Input first, int count, const double* const* values) {
  for (int i = 0; i < count; i++) std::copy_n(values[i], data_.field[first + i].count(), data_.field[first + i].get());
  set_flags(batch_, data_.field[kS].count(), data_.field[ku_min].count(), data_.field[ku_max].count());
  batch_.version++;
}

}  // namespace difflcs
