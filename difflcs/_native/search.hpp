// Search for the optimum of an LCS-MPC problem: its starts, their comparison, and the attempts if all fail. Shared by
// the Python module and the C library, so that both give the same bits; independent of the instruction set.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "kernels.hpp"

namespace difflcs {

constexpr int64_t kVaried = 8;  // variations of a plan at a time

// Effort of the search.
struct MpcEffort {
  int64_t starts;   // at least one; search.cpp states their sequence. A guess is the first of them.
  int64_t groups;   // in which they are searched one after the other; at least one
  int64_t sure;     // an element has no further group once so many starts have found its best plan, and seeks nothing
                    // once as many have, of small problems kFixed at least
  int64_t seeks;    // rounds in vain that end the search for other contacts, or as many as starts are missing; 0: none
  double homotopy;  // first relaxation as a multiple of the problem's; 0: from the problem's scale
  double shrink;    // factor of the homotopy
  double tol;       // on the projected gradient
  int64_t max_iter;
  double certified;  // largest residual of a solved problem
  uint64_t seed;     // of the random starts
  // Most starts of an element at a time.
  int64_t jobs() const { return std::max((starts + groups - 1) / groups, seeks > 0 ? kVaried : 0); }
};

// The guess, (count, ...) each: actions alone, or with forces and multipliers. Null: nothing.
struct MpcGuess {
  const double *u, *lam, *mu;
};

// Numbers of one plan.
struct Sizes {
  int64_t x, u, lam, mu;
  explicit Sizes(const MpcBatch& b)
      : x((b.horizon + 1) * b.n_x), u(b.horizon * b.n_u), lam(b.horizon * b.n_lam), mu((b.horizon + 1) * b.n_c) {}
};

// Bounds of action number i of a plan (H, n_u).
struct Bound {
  double low, high;
  Bound(const MpcBatch& b, int64_t element, int64_t i)
      : low(b.at(ku_min, element, i / b.n_u)[i % b.n_u]), high(b.at(ku_max, element, i / b.n_u)[i % b.n_u]) {}
  bool finite() const { return low > -kHuge && high < kHuge; }
  double clip(double u) const { return std::min(std::max(u, low), high); }
};

// Runs work on one thread or on several, each with a separate workspace, until it is done or the time is over.
// `to_the_end`: whatever the time.
struct Runner {
  using Work = void (*)(void* context, void* workspace, Watch watch);
  virtual void run(const Kernels& kernels, const MpcBatch& batch, bool to_the_end, Work work, void* context) = 0;
  virtual bool stopped() const = 0;
  // What follows may last until this part of the time is over.
  virtual void allot(double part) = 0;

 protected:
  ~Runner() = default;
};

// Sets the flags of a batch: whether S, of `S` numbers, is zero, and whether the bounds of the actions, `low` and
// `high` numbers, are finite.
void set_flags(MpcBatch& batch, int64_t S, int64_t low, int64_t high);

class MpcSearch {
 public:
  explicit MpcSearch(const Kernels& kernels) : kernels(kernels) {}

  // Allocates all memory that a batch of this size can need: afterwards `solve` allocates nothing.
  void reserve(const MpcBatch& batch, const MpcEffort& effort);

  // Solves a batch.
  void solve(const MpcBatch& batch, const MpcGuess& guess, const MpcEffort& asked, const MpcPlans& out, Runner& runner);

  // The plans of several problems, and how each began.
  struct Store {
    std::vector<double> x, u, lam, mu, objective, residual, gained;
    std::vector<int8_t> status, fragile;
    std::vector<int32_t> iterations;
    std::vector<int64_t> element, owner;  // in the batch, and in the part of it that is being searched
    std::vector<MpcStart> start;
    void resize(const MpcBatch& batch, int64_t count);
    MpcPlans plans();
    int64_t count() const { return int64_t(element.size()); }
  };

 private:
  void run(const MpcBatch& batch, const MpcSolve& solve, Runner& runner) const;
  void judge_constraints(const MpcBatch& batch, const MpcSolve& results, Runner& runner) const;
  void solve_once(const MpcBatch& batch, const MpcGuess& guess, const MpcEffort& effort, const MpcPlans& out,
                  Runner& runner, int64_t first, int64_t count, int64_t steps);
  void search(const MpcBatch& batch, double target, const MpcGuess& guess, const MpcEffort& effort,
              const MpcPlans& out, Runner& runner, int64_t first, int64_t count);
  void search_group(const MpcBatch& batch, double target, const MpcGuess& guess, const MpcEffort& effort, int64_t start,
                    const MpcPlans& earlier, Runner& runner, int64_t first, int64_t count);
  void explore(const MpcBatch& batch, const MpcEffort& effort, Runner& runner, int64_t first, int64_t count,
               bool guessed);
  void begin(const MpcBatch& batch, const MpcEffort& effort, int64_t start, int64_t job, const double* best);
  void finish(const MpcBatch& batch, const MpcGuess& guess, const MpcEffort& effort, const MpcPlans& out,
              Runner& runner, int64_t first);
  template <class Wanted>
  int64_t solve_tried(const MpcBatch& batch, const MpcEffort& effort, Runner& runner, Wanted wanted);
  void harden(const MpcBatch& batch, const MpcEffort& effort, const MpcPlans& out, Runner& runner, int64_t first,
              int64_t count);
  double least_cost(const MpcBatch& batch, int64_t e);
  // What an objective of an element is compared in parts of: its size, or what it is above the least that its stages can
  // cost, if there is one and that is less. So another origin of the states changes nothing.
  double size(int64_t e, double objective) const;
  // The objective below which a job must come that is to be better than a plan of this one, by more than kEqual.
  double needed(int64_t e, double objective) const;
  bool apart(const MpcBatch& batch, int64_t job, const double* u) const;
  bool promising(const MpcBatch& batch, int64_t job, const double* u, double objective) const;
  void vary(const MpcBatch& batch, const MpcEffort& effort, int64_t kind, bool shifted, const double* plan, int64_t job);
  void seek(const MpcBatch& batch, const MpcEffort& effort, int64_t kind, const double* plan, int64_t job);
  void improve(const MpcBatch& batch, const MpcEffort& effort, const MpcPlans& out, Runner& runner, int64_t first,
               int64_t count, bool seeking);
  void retry_failed(const MpcBatch& batch, const MpcEffort& effort, const MpcPlans& out, Runner& runner, bool pivot);

  const Kernels& kernels;
  Store tried, finished, grouped;  // grouped: the best plans of one group
  std::vector<double> reached;  // objectives of the starts of each element
  std::vector<int64_t> best;    // of the jobs tried for each element
  std::vector<int64_t> members;               // the elements of a group
  std::vector<int64_t> agreed, found;         // how many groups and starts have found the best plan of each
  std::vector<int64_t> ended;                 // how many starts of one group have found the plan of the group
  std::vector<int64_t> live, idle, patience;  // elements still searched, rounds without gain, and how many are enough
  std::vector<double> dearer;                 // how much more the starts of a round cost than the plan of each
  std::vector<double> lowest, weight, slope;  // what the stages of each element cost at least; of the cost of a stage
  std::vector<double> closing;                // costates of a gap, at a stage and at the next
  std::vector<int64_t> origin;                // the job, or the element, that each of some problems comes from
};

}  // namespace difflcs
