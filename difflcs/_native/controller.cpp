#include "controller.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <numeric>
#include <utility>

namespace difflcs {
namespace {

using Clock = std::chrono::steady_clock;

// Runs the work on this thread, in the controller's memory, until so many seconds after it began.
class Alone final : public Runner {
 public:
  Alone(void* workspace, Clock::time_point begun, double seconds)
      : workspace_(workspace), begun_(begun), seconds_(std::max(seconds, 0.0)) {
    allot(1.0);
  }

  void run(const Kernels&, const MpcBatch&, bool to_the_end, Work work, void* context) override {
    work(context, workspace_, {to_the_end ? [](void*) { return false; } : &Alone::ask, this});
  }
  bool stopped() const override { return late_; }
  void allot(double part) override {
    if (seconds_ < 1e9) ends_ = begun_ + std::chrono::nanoseconds(int64_t(1e9 * part * seconds_));
    late_ = late_ && Clock::now() >= ends_;
  }

 private:
  static bool ask(void* context) {
    Alone& self = *static_cast<Alone*>(context);
    if (!self.late_ && Clock::now() >= self.ends_) self.late_ = true;
    return self.late_;
  }

  void* workspace_;
  const Clock::time_point begun_;
  const double seconds_;
  Clock::time_point ends_ = Clock::time_point::max();
  bool late_ = false;
};

double seconds_since(Clock::time_point begun) { return std::chrono::duration<double>(Clock::now() - begun).count(); }

bool all_finite(const double* values, int64_t count) {
  return std::all_of(values, values + count, [](double v) { return std::isfinite(v); });
}

// to = matrix (rows, columns) * vector
void multiply(const Numbers& matrix, const double* vector, int64_t rows, int64_t columns, double* to) {
  const double* row = matrix.get();
  for (int64_t i = 0; i < rows; i++, row += columns) to[i] = std::inner_product(vector, vector + columns, row, 0.0);
}

// vector' * matrix * vector
double quadratic(const Numbers& matrix, const double* vector, int64_t size) {
  const double *row = matrix.get(), *end = vector + size;
  double total = 0;
  for (int64_t i = 0; i < size; i++, row += size) total += vector[i] * std::inner_product(vector, end, row, 0.0);
  return total;
}

// Rows one step later, the last one repeated: MPCSolution.shift() of difflcs/mpc/solution.py.
void shift(const Numbers& from, int64_t rows, Numbers& to) {
  const int64_t width = from.count() / rows;
  std::memmove(to.get(), from.get() + width, sizeof(double) * size_t((rows - 1) * width));
  std::memmove(to.get() + (rows - 1) * width, from.get() + (rows - 1) * width, sizeof(double) * size_t(width));
}

// Makes the numbers of unfinished plans finite, and adds a constant to the objectives, but for those of problems that
// were not begun in time, which the search has marked. Returns whether the plans were finite.
bool finish(const MpcBatch& batch, const MpcPlans& plans, double constant) {
  constexpr double kMost = std::numeric_limits<double>::max();
  const Sizes n(batch);
  bool finite = true;
  const auto mend = [&](double* values, int64_t count, auto instead) {
    for (int64_t i = 0; i < count * batch.count; i++) {
      if (std::isfinite(values[i])) continue;
      values[i] = instead(i);
      finite = false;
    }
  };
  mend(plans.u, n.u, [&](int64_t i) { return Bound(batch, i / n.u, i % n.u).clip(0.0); });
  for (const auto& [values, count] : {std::pair(plans.x, n.x), {plans.lam, n.lam}, {plans.mu, n.mu}})
    mend(values, count, [](int64_t) { return 0.0; });
  const bool usable = finite;
  for (int64_t e = 0; e < batch.count; e++) plans.objective[e] += plans.objective[e] == kMost ? 0.0 : constant;
  for (double* values : {plans.objective, plans.residual}) mend(values, 1, [](int64_t) { return kMost; });
  return usable;
}

}  // namespace

Controller::Controller(const void* bytes, size_t size)
    : kernels_(kernels_for(1)),
      data_(read_controller(bytes, size)),
      search_(kernels_),
      time_limit_(std::numeric_limits<double>::infinity()) {
  MpcBatch& batch = data_.batch;
  const Sizes n(batch);
  x0_ = Numbers(batch.n_x);
  q_ = Numbers(batch.horizon * batch.n_x);
  q_final_ = Numbers(batch.n_x);
  fallback_action_ = Numbers(batch.n_u);
  found_ = {Numbers(n.x), Numbers(n.u), Numbers(n.lam), Numbers(n.mu)};
  next_u_ = Numbers(n.u);
  guess_ = {{}, Numbers(n.u), Numbers(n.lam), Numbers(n.mu)};
  batch.input[kx0] = x0_.get();
  set_flags(batch, data_.field[kS].count(), data_.field[ku_min].count(), data_.field[ku_max].count());
  int64_t needed = kernels_.mpc_workspace(batch);
  if (data_.n_goal > 0) {
    batch.input[kq] = q_.get();
    batch.input[kq_final] = q_final_.get();
    batch.step[kq] = batch.horizon > 1 ? batch.n_x : 0;
    needed = std::max(needed, kernels_.mpc_workspace(batch));
  }
  search_.reserve(batch, data_.effort);
  workspace_ = Numbers(needed / int64_t(sizeof(double)) + 1);
}

const difflcs_outcome& Controller::step(const double* x, const double* targets, bool follow, double* u) {
  const auto begun = Clock::now();
  const int64_t aims = data_.n_goal * (follow ? data_.batch.horizon + 1 : 1);
  outcome_ = kNone;
  unfinished_ = false;
  if (all_finite(x, data_.batch.n_x) && all_finite(targets, aims)) {
    std::copy_n(x, data_.batch.n_x, x0_.get());
    if (data_.n_goal > 0) aim(targets, follow);
    solve(begun);
  } else {
    outcome_.status = DIFFLCS_NUMERICAL;
    outcome_.objective = outcome_.residual = std::numeric_limits<double>::max();
    advance(guess_);
  }
  outcome_.fallback = !solved(int8_t(outcome_.status));
  if (!outcome_.fallback || (fallback_ == DIFFLCS_UNFINISHED && unfinished_)) {
    std::copy_n(found_.u.get(), data_.batch.n_u, u);
    shift(found_.u, data_.batch.horizon, next_u_);
    planned_ = data_.batch.horizon - 1;
  } else {
    fall_back(u);
  }
  return outcome_;
}

// The linear terms of the cost for a goal, or for a goal of each state.
void Controller::aim(const double* targets, bool follow) {
  const int64_t nx = data_.batch.n_x, ng = data_.n_goal, h = data_.batch.horizon;
  const double* last = targets + (follow ? h * ng : 0);
  const int64_t stages = follow ? h : 1;
  for (int64_t k = 0; k < stages; k++) multiply(data_.goal_to_q, targets + k * ng, nx, ng, q_.get() + k * nx);
  multiply(data_.goal_to_q_final, last, nx, ng, q_final_.get());
  const int64_t step = follow && h > 1 ? nx : 0;
  if (step != data_.batch.step[kq]) data_.batch.version++;
  data_.batch.step[kq] = step;
  double tracked = 0;
  for (int64_t k = 0; k < stages; k++) tracked += quadratic(data_.goal_stage, targets + k * ng, ng);
  tracked *= double(follow ? 1 : h);
  goal_constant_ = 0.5 * (tracked + quadratic(data_.goal_final, last, ng));
}

// Calls the solver; its result is the guess of the next step.
void Controller::solve(Clock::time_point begun) {
  int8_t status = kUnreached, fragile = 0;
  const MpcGuess guess = guessed_ ? MpcGuess{guess_.u.get(), guess_.lam.get(), guess_.mu.get()} : MpcGuess{};
  const MpcPlans out{found_.x.get(),     found_.u.get(), found_.lam.get(), found_.mu.get(),     &outcome_.objective,
                     &outcome_.residual, &status,        &fragile,         &outcome_.iterations};
  MpcEffort effort = data_.effort;
  if (guessed_) effort.starts = data_.starts_guessed;
  if (effort.starts == 1) effort.seeks = 0;  // a plan that is followed
  Alone runner(workspace_.get(), begun, time_limit_);
  const auto started = Clock::now();
  search_.solve(data_.batch, guess, effort, out, runner);
  outcome_.solve_seconds = seconds_since(started);
  outcome_.late = runner.stopped();
  outcome_.status = difflcs_status(int(status));
  const bool begun_at_all = outcome_.objective != std::numeric_limits<double>::max();
  const bool usable = finish(data_.batch, out, data_.constant + goal_constant_);
  if (!begun_at_all) return advance(guess_);
  // The next step continues a solve that ran out of time or iterations. After any other failure it starts afresh.
  unfinished_ = usable && outcome_.status == DIFFLCS_MAX_ITER;
  guessed_ = solved(status) || unfinished_;
  if (guessed_) advance(found_);
}

// Makes the guess of the next step, from a plan or, in a step without a new one, from the guess.
void Controller::advance(const Trace& from) {
  shift(from.u, data_.batch.horizon, guess_.u);
  shift(from.lam, data_.batch.horizon, guess_.lam);
  shift(from.mu, data_.batch.horizon + 1, guess_.mu);
}

void Controller::fall_back(double* u) {
  const bool holding = (fallback_ == DIFFLCS_HOLD || fallback_ == DIFFLCS_UNFINISHED) && planned_ > 0;
  const double* held = holding ? next_u_.get() : nullptr;
  if (fallback_ == DIFFLCS_GIVEN) held = fallback_action_.get();
  for (int64_t j = 0; j < data_.batch.n_u; j++) u[j] = Bound(data_.batch, 0, j).clip(held ? held[j] : 0.0);
  shift(next_u_, data_.batch.horizon, next_u_);
  planned_ = std::max<int64_t>(planned_ - 1, 0);
}

void Controller::reserve(int64_t most) {
  const Kernels& kernels = kernels_for(most * data_.effort.jobs());
  MpcBatch batch = data_.batch;
  batch.count = most;
  std::unique_ptr<Many> many(new Many{MpcSearch(kernels), {}, {}});
  many->search.reserve(batch, data_.effort);
  many->plans.resize(batch, most);
  many->workspace = Numbers(kernels.mpc_workspace(batch) / int64_t(sizeof(double)) + 1);
  many_ = std::move(many);
}

bool Controller::plan_many(int64_t count, const double* const* fields, const double* goal, MpcPlans& plans) {
  const auto begun = Clock::now();
  if (!many_ || count < 1 || count > many_->plans.count() || !all_finite(goal, data_.n_goal)) return false;
  if (data_.n_goal > 0) aim(goal, false);
  MpcBatch batch = data_.batch;
  batch.count = count;
  batch.version = 0;
  for (int i = 0; i < kInputs; i++) {
    if (!fields[i]) continue;
    batch.input[i] = fields[i];
    batch.step[i] = 0;
    batch.stride[i] = extent(batch, kMpcFields[i]);
    if (!all_finite(fields[i], count * batch.stride[i])) return false;
  }
  const Sizes n(batch);
  for (int64_t i = 0; i < count * n.u; i++) {
    const Bound bound(batch, i / n.u, i % n.u);
    if (!(bound.low <= bound.high)) return false;
  }
  const auto size = [&](Input i) { return fields[i] ? count * batch.stride[i] : data_.field[i].count(); };
  set_flags(batch, size(kS), size(ku_min), size(ku_max));
  plans = many_->plans.plans();
  Alone runner(many_->workspace.get(), begun, time_limit_);
  many_->search.solve(batch, {}, data_.effort, plans, runner);
  finish(batch, plans, data_.constant + goal_constant_);
  return true;
}

void Controller::reset() {
  guessed_ = false;
  planned_ = 0;
  outcome_ = kNone;
  for (const Numbers* values : {&found_.x, &found_.u, &found_.lam, &found_.mu})
    std::fill_n(values->get(), values->count(), 0.0);
}

void Controller::set_fallback(difflcs_fallback kind, const double* action) {
  fallback_ = kind;
  if (kind == DIFFLCS_GIVEN) std::copy_n(action, data_.batch.n_u, fallback_action_.get());
}

void Controller::set_inputs(Input first, int count, const double* const* values) {
  for (int i = 0; i < count; i++) std::copy_n(values[i], data_.field[first + i].count(), data_.field[first + i].get());
  set_flags(data_.batch, data_.field[kS].count(), data_.field[ku_min].count(), data_.field[ku_max].count());
  data_.batch.version++;
}

}  // namespace difflcs
