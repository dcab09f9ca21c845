// Controller of one robot: one problem with all its memory, the plan that it follows, and its fallback for a step that
// is not solved in time. It needs neither torch nor Python and is compiled once, for all instruction sets. Only its
// construction and `reserve` may throw; nothing else throws or allocates.
#pragma once
#include <chrono>
#include <cstdint>
#include <memory>

#include "controller_file.hpp"
#include "difflcs.h"
#include "kernels.hpp"
#include "search.hpp"

namespace difflcs {

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
  const difflcs_outcome& step(const double* x, const double* targets, bool follow, double* u);
  const difflcs_outcome& outcome() const { return outcome_; }

  // The solver's last result, even if it was not solved; zeros before.
  const Trace& plan() const { return found_; }

  // Makes memory for plans from up to `most` states at once.
  void reserve(int64_t most);
  // Plans from `count` states to one goal, each cold. `fields` are in the order of fields.hpp, (count, ...) each and
  // the same at all stages; null: the controller's own. The states, x0, must be given. Returns false, and plans
  // nothing, where a number is not finite, bounds cross, or there is no memory for so many.
  bool plan_many(int64_t count, const double* const* fields, const double* goal, MpcPlans& plans);

  // Forgets all plans: the next step begins as the first one did.
  void reset();

  // Seconds from the beginning of a step until the solver is stopped; infinity for none.
  void set_time_limit(double seconds) { time_limit_ = seconds; }

  // `action` (n_u), for DIFFLCS_GIVEN, is clipped into the bounds; it must be finite.
  void set_fallback(difflcs_fallback kind, const double* action);

  // Other numbers of `count` fields from `first` on, in the order of fields.hpp; by stage where those of the file are.
  void set_inputs(Input first, int count, const double* const* values);
  // Constant of the objective, besides that of a goal.
  void set_constant(double constant) { data_.constant = constant; }

 private:
  void aim(const double* targets, bool follow);
  void solve(std::chrono::steady_clock::time_point begun);
  void advance(const Trace& from);
  void fall_back(double* u);

  static constexpr difflcs_outcome kNone = {DIFFLCS_MAX_ITER, 0, 0, 0, 0, 0, 0};

  struct Many {
    MpcSearch search;
    MpcSearch::Store plans;
    Numbers workspace;
  };

  const Kernels& kernels_;
  ControllerData data_;
  MpcSearch search_;
  Numbers x0_, q_, q_final_, workspace_, fallback_action_;
  Trace found_, guess_;  // the guess is without states
  Numbers next_u_;
  int64_t planned_ = 0;      // steps that next_u_, the rest of the last plan that was solved, still lasts
  bool guessed_ = false;     // the guess is one
  bool unfinished_ = false;  // the result is a trajectory, but not solved
  double goal_constant_ = 0;
  double time_limit_;
  difflcs_fallback fallback_ = DIFFLCS_HOLD;
  difflcs_outcome outcome_ = kNone;
  std::unique_ptr<Many> many_;
};

}  // namespace difflcs
