#include "search.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace difflcs {
namespace {

// Actions of a start: none; all at one bound for the first half of the horizon and at the other for
// the second; or a random pulse of each, see `pulse`.
enum class Actions { none, forth, back, pulse };

struct Start {
  Actions actions;
  bool released, gauss_newton;  // see MpcStart
  double first;                 // see MpcStart
  int64_t explore;              // Newton steps at the target of the homotopy after which it is compared
};

// The sequence of starts; docs/search.md says what each may find. A start at the target needs more steps before its
// objective can be compared. For a single problem these are free while its first start is under way.
constexpr int64_t kExplore = 2, kExploreFar = 6, kFixed = 4;
Start start_of(int64_t i) {
  constexpr Start first[] = {{Actions::none, true, false, 1.0, kExplore},
                             {Actions::none, true, true, 1e-3, kExplore},
                             {Actions::forth, false, false, 0.0, kExploreFar},
                             {Actions::back, false, false, 0.0, kExploreFar}};
  return i < kFixed ? first[i] : Start{Actions::pulse, false, false, 0.0, kExploreFar};
}

// The first starts, which have no large actions.
constexpr int64_t kNear = 2;
// If of half of the starts, kHalf for each action at least, one in kFound finds the best plan and at most one in kLone
// ends where no other does, to kEqual of their cost, the search is over: what many find is rarely not the best. Four
// that agree so are spared the local search. Starts after the first kFixed are left where they seem not to come below the
// best cost by this part of it. A start of problems solved one by one costs as much as the first: of theirs kBrief
// are enough, whatever the number of actions, and the local search ends with the first round in vain, unless contacts are
// sought for long at last.
constexpr int64_t kHalf = 8, kBrief = 6, kFound = 4, kLeastFound = 2, kLone = 8, kMostLone = 1;
constexpr double kEqual = 3e-4;
// Starts with large actions go to the bounds; without a bound, a few times as far as the best plan of earlier starts.
// A bound that is this many times farther than that plan counts as none.
constexpr double kReach = 3.0, kNone = 100.0;
// Directions of a cost's weights below this part of the largest count as flat. Equal to this part is rounding.
constexpr double kFlat = 1e-12, kRounded = 1e-9;
// Actions that differ by less than this part of their range lead to the same optimum.
constexpr double kSame = 0.02;
// Starts are searched in groups, each with a local search of its own: what one group ends in depends on where it began,
// and the best of several is better than one that goes on for longer. An element has no further group once so many
// groups end with its best plan.
constexpr int64_t kAgreed = 5;
// The homotopy makes one step per stage, and two if a problem is solved again along one that starts at this
// multiple of the relaxation.
constexpr int64_t kSteps = 1, kStepsAgain = 2;
constexpr double kLonger = 1000.0;
// Starts from the kSoftPulses-th of each kCycle on, which are pulses, follow a homotopy from contact so many powers of
// ten softer.
constexpr int64_t kCycle = 16, kSoftPulses = 8;
constexpr double kSoftened = 1.0, kSoftenedMore = 4.0;
// The search is at a relaxation of kSoft, but at most kSofter times the problem's, if that is harder; the plan that it
// finds is then solved at the problem's own, whose kinks keep a plan where it begins.
// Of a limited time the search has the part kSearched, once the first starts are compared; the rest is for that.
constexpr double kSoft = 1e-5, kSofter = 1000.0, kSearched = 0.6;
// An iteration with row exchanges takes ten times as long, and helps early if at all.
constexpr int64_t kMaxIterPivot = 60;
// Elements are searched in chunks, so that the memory for all starts stays small.
constexpr int64_t kJobs = 8192, kChunk = 64;

// Local search round the best plan of the starts. One round in kRounds makes these shifts: actions of the plan, or of
// one half of it, come some stages earlier or later, as do the contacts of an optimum next to a plan.
struct Shift {
  enum { all, begin, end } part;
  int64_t later;
};
constexpr int64_t kRounds = 4;
constexpr Shift kShifts[kVaried] = {{Shift::all, 1}, {Shift::all, -1}, {Shift::all, 2},  {Shift::begin, 1},
                                    {Shift::end, 1}, {Shift::end, -1}, {Shift::all, -2}, {Shift::begin, -1}};
// The other rounds draw. Half of their plans have a little noise, and begin at contact softer by ten to the power of
// kMelted to kMeltedMore; in the others kPart to kPartMore of it come up to kMostLater stages earlier or later, or an
// action is pushed for a while.
constexpr double kMelted = 2.0, kMeltedMore = 4.5, kNoise = 0.1, kPart = 0.1, kPartMore = 0.8, kMostLater = 3.0;
constexpr double kShortest = 0.05, kLongest = 0.6, kLeastPush = 0.25;  // a push, in parts of horizon and range
// It ends when kRounds have not made the cost smaller by the part kGain. Once one has, there is more to find: it ends
// after as many rounds in vain as there are starts. Plans of kLong stages get as many again, shorter ones fewer, and
// half as many at least where one start alone found the plan. Eight times the starts' number are the most. Fewer starts
// than kVaried have one round, of three shifts and kSoftest, which is solved anew from softer contact; fewer than kFixed
// none.
constexpr double kGain = 1e-3;
constexpr int64_t kLong = 48, kFewVaried = 4, kSoftest = kVaried + 1;

// After all groups contacts are sought round the best plan, kVaried at a time: the actions close a gap over at most
// the part kHeld of the horizon, and in kOpened of the cases they open it. The part kMeltedSeeks begins at softer
// contact, as pulses do. A gain of kGain begins the count of rounds in vain anew, up to kMostSeeks times as many in all.
// Round a plan that kRefined starts of a group have found the local search seeks contacts, too, instead of drawing.
constexpr double kHeld = 0.4, kOpened = 0.3, kMeltedSeeks = 0.7;
constexpr int64_t kMostSeeks = 4, kRefined = 2;
// A plan is suspect where other contacts cost much more: as the starts of a round cost more on average, each by at most
// the part kDearest, up to kSuspected rounds in vain end the search.
constexpr int64_t kSuspected = 6;
constexpr double kDearest = 0.3;

// A number in [0, 1) for every triple: splitmix64.
double uniform(uint64_t seed, int64_t start, int64_t position) {
  uint64_t z = seed * 0x9e3779b97f4a7c15u + uint64_t(start) * 0xbf58476d1ce4e5b9u + uint64_t(position);
  for (int i = 0; i < 2; i++) {
    z += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    z ^= z >> 31;
  }
  return double(z >> 11) * 0x1p-53;
}

double power_of_ten(double low, double high, double part) { return std::pow(10.0, low + (high - low) * part); }

// Action `j` of stage `k` in a random pulse, in parts of the way from none to a bound: one way for at most the first
// kPush of the horizon, the other way for at most kBrake of it, then none, as a mass that is far is pushed and stopped.
// Two starts in a row go opposite ways for as long, and the golden ratio spreads the lengths of pairs. From the second
// pair on every other one swings to and fro, kSwings to kMoreSwings times: so things bounce.
constexpr double kPush = 0.6, kBrake = 0.4, kLeastPulse = 0.5, kGolden = 0.6180339887498949;
constexpr double kSwings = 2.0, kMoreSwings = 8.0;
double pulse(uint64_t seed, int64_t start, int64_t j, int64_t k, int64_t horizon) {
  const auto random = [&](int64_t i) { return uniform(seed, start, 3 * j + i); };
  const int64_t pair = start / 2;
  const double spread = kGolden * double(pair) - std::floor(kGolden * double(pair)), h = double(horizon);
  const double way = (j == 0 || uniform(seed, -1 - pair, j) < 0.5) == (start % 2 == 0) ? 1.0 : -1.0;
  const double first = way * (kLeastPulse + (1.0 - kLeastPulse) * random(1));
  if (pair > 1 && pair % 2 == 1) {
    const double swings = kSwings + (kMoreSwings - kSwings) * spread;
    return int64_t(swings * double(k) / h + random(0)) % 2 == 0 ? first : -first;
  }
  const double push = kPush * (1.0 - spread) * h, brake = push + kBrake * random(0) * h;
  if (double(k) < push) return first;
  return double(k) < brake ? -way * (kLeastPulse + (1.0 - kLeastPulse) * random(2)) : 0.0;
}

void copy_plan(const Sizes& n, const MpcPlans& from, int64_t i, const MpcPlans& to, int64_t j) {
  std::copy_n(from.x + i * n.x, n.x, to.x + j * n.x);
  std::copy_n(from.u + i * n.u, n.u, to.u + j * n.u);
  std::copy_n(from.lam + i * n.lam, n.lam, to.lam + j * n.lam);
  std::copy_n(from.mu + i * n.mu, n.mu, to.mu + j * n.mu);
  to.objective[j] = from.objective[i];
  to.residual[j] = from.residual[i];
  to.status[j] = from.status[i];
  to.fragile[j] = from.fragile[i];
}

// Keeps plan `i` of some as plan `e` of others where that is the first one or a better one: solved if the other is not,
// or cheaper. Of those not solved the first says why, unless another is a better plan of the same kind.
void keep_better(const Sizes& n, const MpcPlans& from, int64_t i, const MpcPlans& to, int64_t e) {
  to.iterations[e] += from.iterations[i];
  if (from.status[i] == kUnreached) return;
  const bool done = solved(from.status[i]), before = solved(to.status[e]);
  const bool better = to.status[e] == kUnreached || done > before;
  const bool alike = done ? before : from.status[i] == to.status[e];
  if (better || (alike && from.objective[i] < to.objective[e])) copy_plan(n, from, i, to, e);
}

// Result of an element that was not begun in time: its first actions, the initial state, no forces.
void stay_at_start(const MpcBatch& b, const MpcGuess& guess, const MpcPlans& out, int64_t e) {
  const Sizes n(b);
  for (int64_t i = 0; i < n.u; i++) out.u[e * n.u + i] = Bound(b, e, i).clip(guess.u ? guess.u[e * n.u + i] : 0.0);
  for (int64_t i = 0; i < n.x; i++) out.x[e * n.x + i] = b.at(kx0, e)[i % b.n_x];
  std::fill_n(out.lam + e * n.lam, n.lam, 0.0);
  std::fill_n(out.mu + e * n.mu, n.mu, 0.0);
  out.objective[e] = out.residual[e] = std::numeric_limits<double>::max();
  out.status[e] = int8_t(Status::max_iter);
  out.fragile[e] = 0;
}

struct Solving {
  const Kernels& kernels;
  const MpcBatch& batch;
  const MpcSolve& solve;
  int64_t next;
};

MpcSolve solver_options(const MpcEffort& effort, const MpcPlans& out) {
  MpcSolve o{out};
  o.shrink = effort.shrink;
  o.steps = kSteps;
  o.tol = effort.tol;
  o.max_iter = effort.max_iter;
  o.certified = effort.certified;
  return o;
}

// A problem that begins where its homotopy ends, as a guess does.
MpcStart at_target(const MpcBatch& b) { return {false, false, 0.0, b.relaxation}; }

// The relaxation of the search.
double softer(const MpcBatch& b) {
  return b.n_lam == 0 ? b.relaxation : std::max(b.relaxation, std::min(kSoft, kSofter * b.relaxation));
}

MpcStart beginning(const Start& s, const MpcBatch& b, const MpcEffort& effort) {
  if (b.n_lam == 0 && b.barrier == 0) return {s.released, false, 0.0, b.relaxation};  // nothing is relaxed
  return {s.released, s.gauss_newton, effort.homotopy > 0 ? 0.0 : s.first,
          b.relaxation * std::max(effort.homotopy, 1.0)};
}

// `count` problems with the data of these elements.
MpcBatch part_of(MpcBatch batch, int64_t count, const int64_t* element) {
  batch.count = count;
  batch.element = element;
  return batch;
}

MpcPlans shifted(const MpcBatch& b, MpcPlans p, int64_t by) {
  const Sizes n(b);
  p.x += by * n.x;
  p.u += by * n.u;
  p.lam += by * n.lam;
  p.mu += by * n.mu;
  p.objective += by;
  p.residual += by;
  p.status += by;
  p.fragile += by;
  p.iterations += by;
  return p;
}

// How many of `count` starts, which reached these objectives, found one of them, of this size.
int64_t finders(const double* reached, int64_t count, double one, double size) {
  return std::count_if(reached, reached + count, [&](double v) { return std::abs(v - one) <= kEqual * size; });
}

// The least value of z'Wz / 2 + w'z where W is positive semidefinite, or minus infinity, as w may fall along a direction
// that is flat. The lower triangle of W and w are overwritten.
double least_value(int64_t n, double* W, double* w) {
  double value = 0.0, largest = 0.0, steepest = 0.0;
  for (int64_t i = 0; i < n; i++) largest = std::max(largest, W[i * n + i]);
  for (int64_t i = 0; i < n; i++) steepest = std::max(steepest, std::abs(w[i]));
  for (int64_t i = 0; i < n; i++) {
    const double pivot = W[i * n + i];
    const bool flat = !(pivot > kFlat * largest);
    if (flat && std::abs(w[i]) > kRounded * steepest) return -std::numeric_limits<double>::infinity();
    if (flat) continue;
    value -= 0.5 * w[i] * w[i] / pivot;
    for (int64_t j = i + 1; j < n; j++) {
      const double part = W[j * n + i] / pivot;
      w[j] -= part * w[i];
      for (int64_t l = i + 1; l <= j && part != 0; l++) W[j * n + l] -= part * W[l * n + i];
    }
  }
  return value;
}

// Rounds that the local search of a long plan has besides those in vain that end it.
int64_t longer(const MpcBatch& b, int64_t starts) { return starts * std::min(b.horizon, kLong) / kLong; }

// Whether `count` starts, which reached these objectives, the least of this size, make others unnecessary.
bool settled(const double* reached, int64_t count, double size) {
  const int64_t found = finders(reached, count, *std::min_element(reached, reached + count), size);
  int64_t lone = 0;
  for (int64_t i = 0; i < count; i++) lone += finders(reached, count, reached[i], size) == 1;
  return found >= std::max(kLeastFound, count / kFound) && lone <= std::max(kMostLone, count / kLone);
}

}  // namespace

void set_flags(MpcBatch& b, int64_t S, int64_t low, int64_t high) {
  const auto any = [&](Input which, int64_t count, auto test) {
    return std::any_of(b.input[which], b.input[which] + count, test);
  };
  b.crossed = any(kS, S, [](double v) { return v != 0; });
  b.unbounded =
      any(ku_min, low, [](double v) { return v < -kHuge; }) || any(ku_max, high, [](double v) { return v > kHuge; });
}

void MpcSearch::Store::resize(const MpcBatch& batch, int64_t count) {
  const Sizes n(batch);
  x.resize(count * n.x);
  u.resize(count * n.u);
  lam.resize(count * n.lam);
  mu.resize(count * n.mu);
  for (auto* v : {&objective, &residual, &gained}) v->resize(count);
  status.resize(count);
  fragile.resize(count);
  iterations.resize(count);
  element.resize(count);
  owner.resize(count);
  start.resize(count);
}

MpcPlans MpcSearch::Store::plans() {
  return {x.data(),        u.data(),      lam.data(),     mu.data(),        objective.data(),
          residual.data(), status.data(), fragile.data(), iterations.data()};
}

void MpcSearch::reserve(const MpcBatch& batch, const MpcEffort& effort) {
  const int64_t jobs = effort.jobs() * batch.count;
  tried.resize(batch, jobs);
  finished.resize(batch, jobs);
  reached.reserve(jobs);
  best.reserve(batch.count);
  live.reserve(batch.count);
  idle.reserve(batch.count);
  patience.reserve(batch.count);
  members.reserve(batch.count);
  for (auto* v : {&agreed, &found, &ended}) v->reserve(batch.count);
  grouped.resize(batch, batch.count);
  origin.reserve(jobs);
  dearer.reserve(batch.count);
  closing.reserve(2 * batch.n_x);
  lowest.reserve(batch.count);
  weight.reserve((batch.n_x + batch.n_u) * (batch.n_x + batch.n_u));
  slope.reserve(batch.n_x + batch.n_u);
}

// What the costs of the stages of element e sum to at least, whatever the dynamics.
double MpcSearch::least_cost(const MpcBatch& b, int64_t e) {
  const int64_t n_x = b.n_x, n_u = b.n_u, n = n_x + n_u;
  weight.resize(n * n);
  slope.resize(n);
  const bool same = b.step[kQ] + b.step[kR] + b.step[kS] + b.step[kq] + b.step[kr] == 0;
  double sum = 0.0;
  for (int64_t k = 0; k < (same ? 1 : b.horizon); k++) {
    const double *Q = b.at(kQ, e, k), *R = b.at(kR, e, k), *S = b.at(kS, e, k);
    for (int64_t i = 0; i < n_x; i++) std::copy_n(Q + i * n_x, n_x, weight.data() + i * n);
    for (int64_t i = 0; i < n_u; i++) {
      double* row = weight.data() + (n_x + i) * n;
      for (int64_t j = 0; j < n_x; j++) row[j] = S[j * n_u + i];
      std::copy_n(R + i * n_u, n_u, row + n_x);
    }
    std::copy_n(b.at(kq, e, k), n_x, slope.data());
    std::copy_n(b.at(kr, e, k), n_u, slope.data() + n_x);
    sum += least_value(n, weight.data(), slope.data());
  }
  std::copy_n(b.at(kQ_final, e), n_x * n_x, weight.data());
  std::copy_n(b.at(kq_final, e), n_x, slope.data());
  return (same ? double(b.horizon) : 1.0) * sum + least_value(n_x, weight.data(), slope.data());
}

double MpcSearch::size(int64_t e, double objective) const {
  return std::min(std::abs(objective), std::max(objective - lowest[e], kRounded * std::abs(objective)));
}

double MpcSearch::needed(int64_t e, double objective) const { return objective - kEqual * size(e, objective); }

// Calls the kernel for every problem of a batch.
void MpcSearch::run(const MpcBatch& batch, const MpcSolve& solve, Runner& runner) const {
  std::fill_n(solve.status, batch.count, kUnreached);
  std::fill_n(solve.iterations, batch.count, 0);
  Solving context{kernels, batch, solve, 0};
  runner.run(
      kernels, batch, solve.max_iter == 0,  // which takes no time
      [](void* context, void* workspace, Watch watch) {
        auto& c = *static_cast<Solving*>(context);
        const auto solve = c.batch.count == 1 || c.batch.large() ? c.kernels.mpc_solve_alone : c.kernels.mpc_solve;
        solve(c.batch, c.solve, &c.next, workspace, watch);
      },
      &context);
}

// Marks solved problems whose constraints make them degenerate.
void MpcSearch::judge_constraints(const MpcBatch& batch, const MpcSolve& results, Runner& runner) const {
  Solving context{kernels, batch, results, 0};
  runner.run(
      kernels, batch, true,
      [](void* context, void* workspace, Watch watch) {
        auto& c = *static_cast<Solving*>(context);
        constexpr int64_t block = 64;
        for (int64_t i; (i = __atomic_fetch_add(&c.next, block, __ATOMIC_RELAXED)) < c.batch.count;)
          c.kernels.mpc_constraints(c.batch, c.solve, i, std::min(c.batch.count, i + block), workspace, watch);
      },
      &context);
}

void MpcSearch::solve(const MpcBatch& batch, const MpcGuess& guess, const MpcEffort& asked, const MpcPlans& out,
                      Runner& runner) {
  if (batch.count == 0) return;
  MpcEffort effort = asked;
  if (batch.n_lam == 0) effort.starts = 1;  // without contact there is one optimum
  if (batch.large()) effort.shrink *= effort.shrink;  // as good, in .7 of the iterations
  const int64_t chunk = std::max(kChunk, kJobs / effort.jobs());
  MpcBatch searched = batch;
  const bool near = effort.starts == 1 && guess.lam;  // a plan with its forces, of the step before
  searched.relaxation = near ? batch.relaxation : softer(batch);
  const bool hard = searched.relaxation > batch.relaxation;
  for (int64_t first = 0; first < batch.count; first += chunk) {
    const int64_t count = std::min(chunk, batch.count - first);
    if (effort.starts == 1)
      solve_once(searched, guess, effort, out, runner, first, count, hard ? kExplore : 0);
    else
      search(searched, batch.relaxation, guess, effort, out, runner, first, count);
    if (hard) harden(batch, effort, out, runner, first, count);
  }
  for (const bool pivot : {false, true})
    if (!runner.stopped()) retry_failed(batch, effort, out, runner, pivot);
  if (batch.n_c > 0) judge_constraints(batch, solver_options(effort, out), runner);
}

// Sets the first actions of a job. `best`: the actions of the best plan of its element so far, if there is one.
void MpcSearch::begin(const MpcBatch& b, const MpcEffort& effort, int64_t start, int64_t job, const double* best) {
  const Sizes n(b);
  const Start s = start_of(start);
  tried.start[job] = beginning(s, b, effort);
  if (s.actions == Actions::pulse && start % kCycle >= kSoftPulses)
    tried.start[job].at_least *= power_of_ten(kSoftened, kSoftenedMore, uniform(effort.seed, start, -1));
  tried.start[job].explore = s.explore;
  double* u = tried.u.data() + job * n.u;
  double largest = 1.0;
  for (int64_t i = 0; best && i < n.u; i++) largest = std::max(largest, 1.0 + std::abs(best[i]));
  const double far = best ? kNone * largest : kHuge;
  const auto end = [&](double bound) { return std::abs(bound) < far ? bound : std::copysign(kReach * largest, bound); };
  for (int64_t i = 0; i < n.u; i++) {
    const Bound bound(b, tried.element[job], i);
    const double low = end(bound.low), high = end(bound.high);
    const int64_t k = i / b.n_u;
    if (s.actions == Actions::none || s.actions == Actions::pulse) {
      const double none = bound.clip(0.0);
      const bool pulsed = s.actions == Actions::pulse;
      const double part = pulsed ? pulse(effort.seed, start - kFixed, i % b.n_u, k, b.horizon) : 0.0;
      u[i] = none + part * (part > 0 ? high - none : none - low);
    } else {
      u[i] = (s.actions == Actions::forth) == (2 * k < b.horizon) ? high : low;
    }
  }
}

// Runs jobs [first, first + count) to the point where starts are compared.
void MpcSearch::explore(const MpcBatch& batch, const MpcEffort& effort, Runner& runner, int64_t first, int64_t count,
                        bool guessed) {
  const MpcBatch jobs = part_of(batch, count, tried.element.data() + first);
  MpcSolve o = solver_options(effort, shifted(batch, tried.plans(), first));
  o.u_start = o.u;
  o.start = tried.start.data() + first;
  if (guessed) {
    o.lam_start = o.lam;
    o.mu_start = o.mu;
  }
  o.gained = tried.gained.data() + first;
  run(jobs, o, runner);
}

// Solves elements [first, first + count) from one start, or makes the first `steps` steps of that.
void MpcSearch::solve_once(const MpcBatch& batch, const MpcGuess& guess, const MpcEffort& effort, const MpcPlans& out,
                           Runner& runner, int64_t first, int64_t count, int64_t steps) {
  const Sizes n(batch);
  const MpcPlans to = shifted(batch, out, first);
  tried.resize(batch, 0);
  tried.element.resize(count);
  MpcStart start = guess.u ? at_target(batch) : beginning(start_of(0), batch, effort);
  start.explore = steps;
  tried.start.assign(count, start);
  for (int64_t e = 0; e < count; e++) tried.element[e] = batch.element_of(first + e);
  const MpcBatch jobs = part_of(batch, count, tried.element.data());
  MpcSolve o = solver_options(effort, to);
  o.start = tried.start.data();
  if (guess.u) o.u_start = guess.u + first * n.u;
  if (guess.lam) {
    o.lam_start = guess.lam + first * n.lam;
    o.mu_start = guess.mu + first * n.mu;
  }
  run(jobs, o, runner);
  for (int64_t e = 0; e < count; e++)
    if (to.status[e] == kUnreached) stay_at_start(jobs, {o.u_start, nullptr, nullptr}, to, e);
}

// Solves them from several starts and keeps the best plan. `target`: the relaxation that is wanted.
void MpcSearch::search(const MpcBatch& batch, double target, const MpcGuess& guess, const MpcEffort& effort,
                       const MpcPlans& out, Runner& runner, int64_t first, int64_t count) {
  const Sizes n(batch);
  const int64_t groups = std::min(effort.groups, effort.starts);
  const MpcPlans to = shifted(batch, out, first);
  std::fill_n(to.status, count, kUnreached);
  std::fill_n(to.iterations, count, 0);
  std::fill_n(to.objective, count, std::numeric_limits<double>::max());
  for (auto* v : {&agreed, &found, &ended}) v->assign(count, 0);
  lowest.resize(count);
  for (int64_t e = 0; e < count; e++) lowest[e] = least_cost(batch, first + e);
  members.resize(count);
  std::iota(members.begin(), members.end(), 0);
  grouped.resize(batch, count);
  for (int64_t g = 0; g < groups && !members.empty() && (g == 0 || !runner.stopped()); g++) {
    const int64_t begin = g * effort.starts / groups;
    MpcEffort part = effort;
    part.starts = (g + 1) * effort.starts / groups - begin;
    part.seed += uint64_t(g) << 32;
    search_group(batch, target, guess, part, begin, to, runner, first, count);
    for (int64_t e : members) {
      const double now = grouped.objective[e], before = to.objective[e];
      if (now < needed(e, before)) agreed[e] = found[e] = 0;
      if (!(before < needed(e, now))) {
        agreed[e]++;
        found[e] += ended[e];
      }
      keep_better(n, grouped.plans(), e, to, e);
    }
    const auto done = [&](int64_t e) { return agreed[e] >= kAgreed || found[e] >= effort.sure; };
    members.erase(std::remove_if(members.begin(), members.end(), done), members.end());
  }
  live.clear();
  const int64_t sure = batch.large() ? effort.sure : std::max(effort.sure, kFixed);
  for (int64_t e = 0; e < count; e++) {
    patience[e] = std::min(effort.seeks, sure - found[e]);
    if (patience[e] > 0) live.push_back(e);
  }
  improve(batch, effort, to, runner, first, count, true);
}

// Solves the elements `members` from those of the starts that begin with this one, with a guess for the very first.
// The plans that it finds are `grouped`; those of earlier groups are `earlier`.
void MpcSearch::search_group(const MpcBatch& batch, double target, const MpcGuess& guess, const MpcEffort& effort,
                             int64_t start, const MpcPlans& earlier, Runner& runner, int64_t first, int64_t count) {
  const Sizes n(batch);
  const MpcPlans out = grouped.plans();
  const bool guessed = guess.u && start == 0, whole = guess.lam;  // by actions alone, or by forces too
  const bool brief = batch.large() && effort.seeks < kRounds;
  const int64_t starts = effort.starts, many = std::max(kHalf * batch.n_u, starts / 2);
  const int64_t half = starts < kVaried ? starts : brief ? kBrief : many;
  const int64_t shift = guess.u ? 1 : 0;

  tried.resize(batch, 0);
  reached.resize(count * starts);
  best.assign(count, -1);
  live = members;
  for (int64_t begun = 0; begun < starts && !live.empty() && !runner.stopped();) {
    const bool from_guess = guessed && begun == 0;
    // Starts with large actions and no bounds wait for those that show how far to go.
    const bool near = start == 0 && begun == shift && batch.unbounded;
    const int64_t wide = near ? begun + kNear : begun < kFixed ? kFixed : begun < half ? half : starts;
    const int64_t end = from_guess ? 1 : std::min(starts, wide);
    // Job before + s * elements + i is start begun + s of the i-th element that is not done.
    const int64_t before = tried.count(), elements = int64_t(live.size()), jobs = (end - begun) * elements;
    tried.resize(batch, before + jobs);
    for (int64_t j = before; j < before + jobs; j++) {
      const int64_t e = live[(j - before) % elements];
      tried.owner[j] = e;
      tried.element[j] = batch.element_of(first + e);
      tried.status[j] = kUnreached;
      tried.iterations[j] = 0;
      if (from_guess) {
        tried.start[j] = at_target(batch);
        tried.start[j].explore = kExplore;
        std::copy_n(guess.u + (first + e) * n.u, n.u, tried.u.data() + j * n.u);
        if (whole) std::copy_n(guess.lam + (first + e) * n.lam, n.lam, tried.lam.data() + j * n.lam);
        if (whole) std::copy_n(guess.mu + (first + e) * n.mu, n.mu, tried.mu.data() + j * n.mu);
      } else {
        const double* u = best[e] >= 0 ? tried.u.data() + best[e] * n.u : start > 0 ? earlier.u + e * n.u : nullptr;
        begin(batch, effort, start + begun + (j - before) / elements - shift, j, u);
      }
      if (begun >= kFixed) tried.start[j].needed = needed(e, tried.objective[best[e]]);
    }
    explore(batch, effort, runner, before, jobs, from_guess && whole);
    for (int64_t j = before; j < before + jobs; j++) {
      const int64_t e = tried.owner[j];
      int64_t& b = best[e];
      if (tried.status[j] == kUnreached) continue;
      reached[e * starts + begun + (j - before) / elements] = tried.objective[j];
      const bool sound = b >= 0 && tried.objective[b] < kHuge;  // it may be NaN after a breakdown
      if (!sound || tried.objective[j] < tried.objective[b]) b = j;
    }
    begun = end;
    if (batch.relaxation > target && begun >= std::min(kFixed, starts)) runner.allot(kSearched);
    if (begun < half || runner.stopped()) continue;
    const auto done = [&](int64_t e) {
      return settled(reached.data() + e * starts, begun, size(e, tried.objective[best[e]]));
    };
    live.erase(std::remove_if(live.begin(), live.end(), done), live.end());
  }

  finish(batch, guess, effort, out, runner, first);
  patience.assign(count, brief ? 1 : kRounds);
  for (int64_t e : live) {
    const double* own = reached.data() + e * starts;
    const double one = *std::min_element(own, own + starts);
    const bool lone = finders(own, starts, one, size(e, one)) == 1;
    if (lone) patience[e] = std::max(patience[e], longer(batch, starts) / 2);
  }
  if (starts >= kFixed) improve(batch, effort, out, runner, first, count, false);
}

// Solves those jobs to the end that are wanted. Returns their number: they are the first of `finished`, and `origin`
// says which jobs they were.
template <class Wanted>
int64_t MpcSearch::solve_tried(const MpcBatch& batch, const MpcEffort& effort, Runner& runner, Wanted wanted) {
  const Sizes n(batch);
  const int64_t all = tried.count();
  finished.resize(batch, all);
  origin.resize(all);
  int64_t kept = 0;
  for (int64_t j = 0; j < all; j++) {
    if (tried.status[j] == kUnreached || !wanted(j)) continue;
    copy_plan(n, tried.plans(), j, finished.plans(), kept);
    origin[kept] = j;
    finished.element[kept] = tried.element[j];
    finished.start[kept] = at_target(batch);
    kept++;
  }
  const MpcBatch jobs = part_of(batch, kept, finished.element.data());
  MpcSolve o = solver_options(effort, finished.plans());
  o.u_start = o.u;
  o.lam_start = o.lam;
  o.mu_start = o.mu;
  o.start = finished.start.data();
  if (kept) run(jobs, o, runner);
  return kept;
}

// Solves the jobs to the end that may still become the best of their element. A start whose last step gained less than
// it lies behind, or that approaches the same plan, is given up, unless all others of its element fail.
void MpcSearch::finish(const MpcBatch& batch, const MpcGuess& guess, const MpcEffort& effort, const MpcPlans& out,
                       Runner& runner, int64_t first) {
  const Sizes n(batch);
  const int64_t all = tried.count();
  for (int64_t e : members) {
    out.status[e] = kUnreached;
    out.iterations[e] = ended[e] = 0;
  }
  const auto promises = [&](int64_t j) {
    const int64_t b = best[tried.owner[j]];
    return j == b || promising(batch, j, tried.u.data() + b * n.u, tried.objective[b]);
  };
  const auto solve = [&](auto wanted) {
    const int64_t kept = solve_tried(batch, effort, runner, wanted);
    for (int64_t i = 0; i < kept; i++) {
      keep_better(n, finished.plans(), i, out, tried.owner[origin[i]]);
      if (solved(finished.status[i]) && !solved(tried.status[origin[i]]))
        copy_plan(n, finished.plans(), i, tried.plans(), origin[i]);
    }
  };
  if (!runner.stopped()) solve(promises);
  for (int64_t j = 0; j < all; j++) {  // some were solved before they were compared
    if (!solved(tried.status[j]))
      out.iterations[tried.owner[j]] += tried.iterations[j];
    else
      keep_better(n, tried.plans(), j, out, tried.owner[j]);
  }
  if (!runner.stopped())
    solve([&](int64_t j) { return !solved(out.status[tried.owner[j]]) && !promises(j); });
  for (int64_t j = 0; j < all; j++) {
    const int64_t e = tried.owner[j];
    const double there = tried.objective[j], least = out.objective[e];
    if (tried.status[j] == kUnreached || !(there < kHuge) || !solved(out.status[e])) continue;
    ended[e] += finders(&there, 1, least, size(e, least)) || !apart(batch, j, out.u + e * n.u);
  }
  for (int64_t e : members) {
    // Out of time after its starts were compared: one that was solved by chance need not be the best.
    const bool behind = best[e] >= 0 && batch.n_c == 0 && tried.objective[best[e]] < needed(e, out.objective[e]);
    if (out.status[e] != kUnreached && !(runner.stopped() && behind)) continue;
    if (best[e] >= 0) {
      copy_plan(n, tried.plans(), best[e], out, e);
      out.status[e] = int8_t(Status::max_iter);
    } else {
      const int64_t element = batch.element_of(first + e);
      stay_at_start(part_of(batch, 1, &element), {guess.u ? guess.u + (first + e) * n.u : nullptr, nullptr, nullptr},
                    shifted(batch, out, e), 0);
    }
  }
}

// Whether a job may become better than a plan, and does not approach the same one.
bool MpcSearch::promising(const MpcBatch& batch, int64_t job, const double* u, double objective) const {
  return tried.objective[job] - tried.gained[job] <= objective && apart(batch, job, u);
}

// Whether the actions of a job lead to another optimum than these.
bool MpcSearch::apart(const MpcBatch& batch, int64_t job, const double* u) const {
  const Sizes n(batch);
  for (int64_t i = 0; i < n.u; i++) {
    const Bound bound(batch, tried.element[job], i);
    const double here = tried.u[job * n.u + i];
    const double range = bound.finite() ? bound.high - bound.low : 1.0 + std::abs(u[i]);
    if (std::abs(here - u[i]) > kSame * range) return true;
  }
  return false;
}

// Solves the plans that were found with softer contact at the problem's own relaxation.
void MpcSearch::harden(const MpcBatch& batch, const MpcEffort& effort, const MpcPlans& out, Runner& runner,
                       int64_t first, int64_t count) {
  const MpcPlans to = shifted(batch, out, first);
  runner.allot(1.0);
  tried.resize(batch, count);
  for (int64_t e = 0; e < count; e++) {
    copy_plan(Sizes(batch), to, e, tried.plans(), e);
    tried.element[e] = batch.element_of(first + e);
  }
  const auto wanted = [&](int64_t e) {
    return tried.status[e] != int8_t(Status::infeasible) && tried.objective[e] < std::numeric_limits<double>::max();
  };
  for (const bool over : {false, true}) {  // without time they are only executed at the relaxation
    if (over && !runner.stopped()) break;
    MpcEffort left = effort;
    if (over) left.max_iter = 0;
    const int64_t kept = solve_tried(batch, left, runner, wanted);
    for (int64_t i = 0; i < kept; i++) {
      if (finished.status[i] == kUnreached) continue;
      const int64_t e = origin[i];
      to.iterations[e] += finished.iterations[i];
      copy_plan(Sizes(batch), finished.plans(), i, to, e);
      tried.status[e] = kUnreached;
    }
  }
}

// Sets the first actions of a job to those of a plan, shifted or varied otherwise.
void MpcSearch::vary(const MpcBatch& batch, const MpcEffort& effort, int64_t kind, bool shifted, const double* plan,
                     int64_t job) {
  const auto random = [&](int64_t i) { return uniform(effort.seed, -1 - kind, i); };
  const int64_t horizon = batch.horizon, n_u = batch.n_u, drawn = batch.horizon * batch.n_u;
  const bool melted = !shifted && kind % 2 == 1, moved = !shifted && kind % 4 == 2, pushed = !shifted && kind % 4 == 0;
  const Shift shift = shifted ? kShifts[kind % kVaried] : Shift{Shift::all, 0};
  int64_t begin = shift.part == Shift::end ? horizon / 2 : 0, later = shift.later;
  int64_t end = shift.part == Shift::begin ? horizon / 2 : horizon;
  const double h = double(horizon), middle = h * random(drawn), way = random(drawn + 2) < 0.5 ? 1.0 : -1.0;
  if (moved) {
    const double part = h * (kPart + (kPartMore - kPart) * random(drawn + 5));
    begin = int64_t((h - 0.5 * part) * random(drawn + 6));
    end = std::min(horizon, int64_t(std::ceil(double(begin) + part)));
    later = int64_t(way) * (1 + int64_t(kMostLater * std::pow(random(drawn + 7), 2)));
  }
  const double push = way * (kLeastPush + (1.0 - kLeastPush) * random(drawn + 3));
  const double length = std::max(1.0, h * kShortest * std::pow(kLongest / kShortest, random(drawn + 1)));
  const int64_t which = int64_t(double(n_u) * random(drawn + 4));
  for (int64_t i = 0; i < horizon * n_u; i++) {
    const Bound bound(batch, tried.element[job], i);
    const int64_t k = i / n_u, j = i % n_u;
    const int64_t from = begin <= k && k < end ? std::min(std::max(k + later, begin), end - 1) : k;
    double action = plan[from * n_u + j];
    const double range = bound.finite() ? bound.high - bound.low : 1.0 + std::abs(action);
    if (pushed && j == which && std::abs(double(k) - middle) <= 0.5 * length) action += push * range;
    if (melted) action += kNoise * range * (2.0 * random(i) - 1.0);
    tried.u[job * horizon * n_u + i] = bound.clip(action);
  }
  if (melted) tried.start[job].at_least *= power_of_ten(kMelted, kMeltedMore, random(drawn));
}

// Sets the first actions of a job to those of a plan, except that some of them close the gap of a random contact over a
// few stages as far as the bounds allow, or open it. The adjoint of that gap without contact says which way.
void MpcSearch::seek(const MpcBatch& batch, const MpcEffort& effort, int64_t kind, const double* plan, int64_t job) {
  const auto random = [&](int64_t i) { return uniform(effort.seed, -1 - kind, i); };
  const int64_t n_x = batch.n_x, n_u = batch.n_u, e = tried.element[job];
  const double h = double(batch.horizon), spread = kGolden * double(kind) - std::floor(kGolden * double(kind));
  const int64_t contact = int64_t(random(0) * double(batch.n_lam)), last = int64_t(spread * h);
  const int64_t held = last - int64_t(random(1) * std::max(1.0, kHeld * h));
  const int64_t begin = std::max(held - int64_t(random(2) * (h + 1.0)), int64_t{0});
  const double way = random(3) < kOpened ? 1.0 : -1.0;
  double* u = tried.u.data() + job * batch.horizon * n_u;
  std::copy_n(plan, batch.horizon * n_u, u);
  closing.assign(2 * n_x, 0.0);
  for (int64_t k = last; k >= begin; k--) {
    double *next = closing.data() + k % 2 * n_x, *now = closing.data() + (1 - k % 2) * n_x;
    const double counts = k >= held ? way : 0.0;
    for (int64_t j = 0; j < n_u; j++) {
      const Bound bound(batch, e, k * n_u + j);
      double slope = counts * batch.at(kE, e, k)[contact * n_u + j];
      for (int64_t i = 0; i < n_x; i++) slope += next[i] * batch.at(kB, e, k)[i * n_u + j];
      double& action = u[k * n_u + j];
      const double far = kReach * (1.0 + std::abs(action));
      if (slope > 0) action = bound.high < kHuge ? bound.high : action + far;
      if (slope < 0) action = bound.low > -kHuge ? bound.low : action - far;
    }
    for (int64_t i = 0; i < n_x; i++) {
      now[i] = counts * batch.at(kD, e, k)[contact * n_x + i];
      for (int64_t l = 0; l < n_x; l++) now[i] += next[l] * batch.at(kA, e, k)[l * n_x + i];
    }
  }
  if (random(4) < kMeltedSeeks) tried.start[job].at_least *= power_of_ten(kSoftened, kSoftenedMore, random(5));
}

// Varies the plans of the elements `live`, or seeks contacts round them, and keeps what is better, until that has
// gained nothing for as many rounds as their `patience`.
void MpcSearch::improve(const MpcBatch& batch, const MpcEffort& effort, const MpcPlans& out, Runner& runner,
                        int64_t first, int64_t count, bool seeking) {
  const Sizes n(batch);
  const int64_t starts = effort.starts;
  const bool few = !seeking && starts < kVaried;
  const int64_t varied = few ? kFewVaried : kVaried;
  const int64_t rounds = seeking ? kMostSeeks * std::max(effort.seeks, kSuspected) : few ? 1 : 8 * starts;
  idle.assign(count, 0);
  const auto done = [&](int64_t e) { return !solved(out.status[e]); };
  live.erase(std::remove_if(live.begin(), live.end(), done), live.end());
  for (int64_t round = 0; round < rounds && !live.empty() && !runner.stopped(); round++) {
    // Job v * elements + i is variation v of the plan of the i-th element that is not done.
    const int64_t elements = int64_t(live.size()), all = varied * elements;
    tried.resize(batch, all);
    std::fill(tried.status.begin(), tried.status.end(), kUnreached);
    std::fill(tried.iterations.begin(), tried.iterations.end(), 0);
    for (int64_t j = 0; j < all; j++) {
      const int64_t e = tried.owner[j] = live[j % elements];
      tried.element[j] = batch.element_of(first + e);
      tried.start[j] = at_target(batch);
      tried.start[j].explore = kExploreFar;
      tried.start[j].needed = needed(e, out.objective[e]);
      const int64_t v = j / elements;
      const int64_t kind = few && v == varied - 1 ? kSoftest : kVaried * round + v;
      const bool shifted = kind / kVaried % kRounds == 0 && idle[e] < kRounds;  // again, it would be in vain
      const bool refined = !few && !shifted && effort.seeks > 0 && ended[e] >= kRefined;
      if (seeking || refined)
        seek(batch, effort, kind, out.u + e * n.u, j);
      else
        vary(batch, effort, kind, shifted, out.u + e * n.u, j);
    }
    explore(batch, effort, runner, 0, all, false);
    dearer.assign(count, 0.0);
    for (int64_t j = 0; j < all && seeking && !batch.large(); j++) {
      const int64_t e = tried.owner[j];
      const double more = std::max(tried.objective[j] - out.objective[e], 0.0) / size(e, out.objective[e]);
      dearer[e] += std::min(kDearest, more) / (kDearest * double(varied));
      patience[e] = std::max(patience[e], int64_t(std::ceil(dearer[e] * double(kSuspected))));
    }
    const int64_t kept = solve_tried(batch, effort, runner, [&](int64_t j) {
      const int64_t e = tried.owner[j];
      return promising(batch, j, out.u + e * n.u, out.objective[e]);
    });
    for (int64_t i = 0; i < kept; i++) {
      const int64_t e = tried.owner[origin[i]];
      out.iterations[e] += finished.iterations[i];
      if (!solved(finished.status[i]) || !(finished.objective[i] < out.objective[e])) continue;
      if (finished.objective[i] < out.objective[e] - kGain * size(e, out.objective[e])) {
        idle[e] = -1;
        ended[e] = 0;  // no start found it
        if (!seeking && patience[e] > 1) patience[e] = std::max(kRounds, starts) + longer(batch, starts);
      }
      copy_plan(n, finished.plans(), i, out, e);
    }
    const auto over = [&](int64_t e) { return ++idle[e] >= patience[e]; };
    live.erase(std::remove_if(live.begin(), live.end(), over), live.end());
  }
}

// Solves the elements that failed (one in a thousand) once more, from no action along a longer homotopy; then, if
// the numbers broke down rather than the iterations ran out, with row exchanges in the elimination of the forces.
void MpcSearch::retry_failed(const MpcBatch& batch, const MpcEffort& effort, const MpcPlans& out, Runner& runner,
                             bool pivot) {
  const Sizes n(batch);
  origin.clear();
  for (int64_t e = 0; e < batch.count; e++) {
    const bool broken = out.status[e] == int8_t(Status::numerical) || out.fragile[e];
    if (!solved(out.status[e]) && (!pivot || broken)) origin.push_back(e);
  }
  const int64_t count = int64_t(origin.size());
  if (count == 0) return;
  tried.resize(batch, count);
  for (int64_t i = 0; i < count; i++) {
    tried.element[i] = batch.element_of(origin[i]);
    tried.start[i] = {false, false, 0.0, softer(batch) * kLonger * std::max(effort.homotopy / 100.0, 1.0)};
  }
  MpcBatch jobs = part_of(batch, count, tried.element.data());
  jobs.pivot = pivot;
  MpcSolve o = solver_options(effort, tried.plans());
  o.start = tried.start.data();
  o.steps = kStepsAgain;
  if (pivot) o.max_iter = std::min(o.max_iter, kMaxIterPivot);
  run(jobs, o, runner);
  for (int64_t i = 0; i < count; i++) {
    const int64_t e = origin[i];
    out.iterations[e] += tried.iterations[i];
    if (solved(tried.status[i])) copy_plan(n, tried.plans(), i, out, e);
  }
}

}  // namespace difflcs
