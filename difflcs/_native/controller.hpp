// Controller of one robot: one problem with all its memory, the plan that it follows, and its fallback for a step that
// is not solved in time. It needs neither torch nor Python and is compiled once, for all instruction sets. Only its
// construction may throw; a step throws nothing and allocates nothing.
#pragma once
#include <chrono>
#include <cstdint>

#include "controller_file.hpp"
#include "kernels.hpp"
#include "search.hpp"

namespace difflcs {

// The action of a step that is not solved.
enum class Fallback {
  hold,        // that of the last plan for this time, while it lasts; then zero
  zero,        // zero
  action,      // one that the caller has set
  unfinished,  // that of the plan which the solver had reached when the time or the iterations were over; else `hold`
};

// Outcome of a step.
struct Outcome {
  Status status = Status::max_iter;
  bool fallback = false;  // the action is not that of a plan for this state
  bool late = false;      // the time was over before the solver had finished
  int32_t iterations = 0;
  double objective = 0;
  double residual = 0;
  double solve_seconds = 0;  // in the solver
};

// States, actions, forces and multipliers of a plan: (H + 1, n_x), (H, n_u), (H, n_lam), (H + 1, n_c).
struct Trace {
  Numbers x, u, lam, mu;
};

class Controller {
 public:
  // From the bytes of a controller file; see read_controller. Throws std::runtime_error, std::bad_alloc.
  Controller(const void* bytes, size_t size);
  Controller(const Controller&) = delete;
  Controller& operator=(const Controller&) = delete;

  const ControllerData& data() const { return data_; }
  const Kernels& kernels() const { return kernels_; }

  // Plans from the state x (n_x) and writes the action u (n_u), which is always finite and inside the bounds of the
  // first stage. With a goal, `targets` is (n_goal), or (H + 1, n_goal) where `follow`; else it is ignored. A
  // state or a target that is not finite makes the step `numerical`.
  const Outcome& step(const double* x, const double* targets, bool follow, double* u);
  const Outcome& outcome() const { return outcome_; }

  // The solver's last result, even if it was not solved; zeros before.
  const Trace& plan() const { return found_; }

  // Forgets all plans: the next step begins as the first one did.
  void reset();

  // Seconds from the beginning of a step until the solver is stopped; infinity for none.
  void set_time_limit(double seconds) { time_limit_ = seconds; }

  // `action` (n_u), for Fallback::action, is clipped into the bounds; it must be finite.
  void set_fallback(Fallback kind, const double* action);

  // Other numbers of `count` fields from `first` on, in the order of fields.hpp; by stage where those of the file are.
  void set_inputs(Input first, int count, const double* const* values);
  // Constant of the objective, besides that of a goal.
  void set_constant(double constant) { data_.constant = constant; }

 private:
  void aim(const double* targets, bool follow);
  void solve(std::chrono::steady_clock::time_point begun);
  void wait();
  bool make_finite();
  void fall_back(double* u);
  double clipped(int64_t i, double value) const;

  const Kernels& kernels_;
  ControllerData data_;
  MpcSearch search_;
  MpcBatch batch_{};  // its version is that of the matrices and of the fields given by stage
  Numbers x0_, q_, q_final_, workspace_, fallback_action_;
  Trace found_;
  Numbers next_u_, guess_u_, guess_lam_, guess_mu_;
  int64_t planned_ = 0;      // steps that next_u_, the rest of the last plan that was solved, still lasts
  bool guessed_ = false;     // the guess is one
  bool unfinished_ = false;  // the result is a trajectory, but not solved
  double goal_constant_ = 0;
  double time_limit_;
  Fallback fallback_ = Fallback::hold;
  Outcome outcome_;
};

}  // namespace difflcs
