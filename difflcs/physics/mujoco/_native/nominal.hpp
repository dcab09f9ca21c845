// Contacts, limits and friction of a state at the nominal action, as nominal.py and limits.py say what they are.
#pragma once

#include <limits>

#include "matrices.hpp"

namespace difflcs::physics {

constexpr double kGains = 1.0;                         // of the speeds before and without contact: more is a jam
constexpr double kActsFrom = 0.6, kActsTo = 1.25;      // part of a step in which a force moves things; from .5 on an
                                                       // impact would bounce with its speed
constexpr double kPressedFrom = 0.4, kPressedTo = 10;  // the same of what drives press against a limit
constexpr double kSideways = 0.2, kDown = 0.05;        // of the motion without contact: more is no creep
constexpr double kLoad = 100.0, kDeepest = 5.0;        // acceleration [m/s²] of any load; depth by one, of the usual
constexpr double kPresses = 0.7;                       // of what friction may press back into its contact
constexpr double kExact = 0.03;                        // of the compliance: how exactly forces are computed
constexpr int kPasses = 2;      // each reduces what is left of compliance and opening by their parts of the motion
constexpr int kMostSteps = 10;  // in which a row is followed through a step

// What all states have in common, see `Situation` and `Recovery` in nominal.py.
struct Common {
  int nv, nx, columns, contacts, tangents, rows, bounded, steps;
  double seconds, give, compliance, least, usual;  // compliance in parts of `give`, and of a contact's own way at least
  bool opens;
  const bool *rough, *firm;
  const int64_t* tree;
  const double *time, *depth, *creep, *reach;

  int each() const { return tangents > 0 ? 2 * tangents : 1; }
  int limits() const { return rows - bounded; }
  double exact() const { return kExact * compliance; }
};

// Of a state: its contacts, rows with their softness, and the step.
struct Acting {
  const double *gap, *normal, *tangent, *friction, *row_gap, *row_normal, *bend, *stiffness, *damping, *impedance,
      *row_give, *most, *x, *step, *delayed, *response, *inverse_mass;
  const int64_t* geom;
};

// What is found: fields of `Nominal`, those of `ScaledRows` after `forces`.
struct Evaluated {
  double *soft, *opened, *turned, *forces, *scaled_gap, *scaled_normal, *impulse, *bound, *unit, *row_forces, *carried;
};

// How far a unit of force along a row moves it.
inline double give_way(const double* row, const double* R, int nv) {
  double sum = 0;
  for (int v = 0; v < nv; v++)
    if (row[v] != 0) sum += row[v] * dot(R + v * nv, row, nv);
  return sum;
}

// A soft row after a step, see limits.py; `part`: how far an impulse moves at the time in the step at which the row's
// force acts, of how far one at the beginning would.
struct Followed {
  double moved, speed, part;
  bool acts;   // there is a force
  bool holds;  // it acts all the time, within its bounds
  bool stops;  // it is within its bounds at the end of the step
};

// A row: motion without its own force has v̇ = acceleration − drag v, of which `turn` is J̇ ν, that MuJoCo's force does
// not resist; `mass` is A.
struct Load {
  double speed, acceleration, drag, turn, mass;
};

// MuJoCo's parameters of a row, see `Softness`.
struct Soft {
  double stiffness, damping, give, most;
  const double* impedance;

  static double raise(double x, double power) { return power == 1 ? x : power == 2 ? x * x : std::pow(x, power); }

  // d at a depth.
  double at(double depth) const {
    const double width = std::max(impedance[2], 1e-15), middle = std::clamp(impedance[3], 1e-4, 0.9999);
    const double power = std::max(impedance[4], 1.0), x = std::min(depth / width, 1.0);
    const double y = x <= middle ? raise(x, power) / raise(middle, power - 1)
                                 : 1 - raise(1 - x, power) / raise(1 - middle, power - 1);
    return std::clamp(impedance[0] + y * (impedance[1] - impedance[0]), 1e-4, 0.9999);
  }

  double firm(double depth) const { return (1 - at(depth)) / at(depth) * give; }

  // Follow a row of that gap through a step of so many of MuJoCo's.
  Followed follow(double gap, const Load& load, double seconds, int count) const {
    const bool coarse = count > kMostSteps, limit = std::isinf(most);
    count = std::min(count, kMostSteps);
    const double h = seconds / count, mass = std::max(load.mass, kTiny), slower = 1 / (1 + h * load.drag);
    const double upper = mass * most, lower = limit ? 0.0 : -upper, free = load.acceleration;
    double r = gap, v = load.speed, by_force = 0, by_load = 0, rate = 0, free_rate = 0, total = 0;
    bool held = true, holds = true;
    for (int i = 0; i < count; i++) {
      double force = 0;
      held = false;
      if (!(limit && r >= 0)) {
        const double d = at(limit ? std::fabs(r) : 0.0), share = mass / (mass + (1 - d) / d * give);
        const double spring = share * stiffness * d;
        double damps = share * (damping - load.drag);
        if (coarse) {  // steps that are longer than MuJoCo's are implicit
          damps += h * spring;
          const double then = damps * (v + h * free) * slower;
          force = -(share * (free - load.turn) + spring * r + then) / (1 + h * damps * slower);
        } else {
          force = -damps * v - spring * r - share * (free - load.turn);
        }
        held = lower < force && force < upper;
        force = std::min(std::max(force, lower), upper);
      }
      v = (v + h * (free + force)) * slower;
      rate = (rate + h * force) * slower;
      free_rate = (free_rate + h * free) * slower;
      r += h * v;
      by_force += h * rate;
      by_load += h * free_rate;
      total += h * std::fabs(force);
      holds = holds && (held || (i == 0 && count > 1));  // what begins to touch holds as well
    }
    const bool acts = total > 1e-12;
    // Where the load is carried, it acts at the beginning of the step as well.
    const double far = by_force - (holds ? seconds * free_rate - by_load : 0.0);
    const double part = acts ? far / (std::fabs(rate) > 1e-12 ? rate : 1.0) : seconds;
    return {r - gap, v, part / seconds, acts, holds, held};
  }
};

// The extreme rays of friction cones and rows, and the forces that keep them closed, as in `contact_lcs`.
class Rays {
 public:
  // Those of contacts along these tangents, and of rows (rows, nv) with their gaps and bounds.
  DIFFLCS_CLONES void set(const Common& c, const Acting& a, const double* tangent, const Evaluated& scaled,
                          const double* response) {
    const int nv = c.nv, each = c.each();
    common_ = &c;
    response_ = response;
    for (auto* numbers : {&rays_, &low_, &high_}) numbers->clear();
    number_.clear();
    near_.clear();
    for (int k = 0; k < c.contacts; k++) {
      for (int r = 0; r < (c.rough[k] ? each : 1); r++) {  // one where all are the same
        rays_.insert(rays_.end(), a.normal + k * nv, a.normal + (k + 1) * nv);
        number_.push_back(k * each + r);
        const double friction = r % 2 == 0 ? a.friction[k] : -a.friction[k];
        if (c.tangents > 0) add(friction, tangent + (k * c.tangents + r / 2) * nv, nv, &rays_[rays_.size() - nv]);
      }
    }
    rays_.insert(rays_.end(), scaled.scaled_normal, scaled.scaled_normal + c.rows * nv);
    for (int j = 0; j < c.rows; j++) number_.push_back(c.contacts * each + j);
    row_gap_ = scaled.scaled_gap;
    const int count = static_cast<int>(number_.size()), first = count - c.bounded;
    kind_.resize(count);
    for (auto* numbers : {&apart_, &q_, &lam_}) numbers->resize(count);
    for (int i = 0; i < count; i++) {
      low_.push_back(i < first ? 0.0 : -c.give * scaled.bound[i - first]);
      high_.push_back(i < first ? std::numeric_limits<double>::infinity() : c.give * scaled.bound[i - first]);
      kind_[i] = is_zero(&rays_[i * nv], nv) ? kStill : kFar;
    }
  }

  // Write where forces move ζ from `place`, with gaps of contacts, and the forces (of all rays of contacts, of rows),
  // about what they are. The compliance counts from them, or from none. False where rounding keeps it from finding them
  // exactly.
  bool press(const double* place, const double* gap, bool from_them, double* forces, double* moved) {
    const Common& c = *common_;
    const int nv = c.nv, of_contacts = c.contacts * c.each(), count = static_cast<int>(number_.size());
    double within = 0;
    for (int i = 0; i < count; i++) {
      const int at = number_[i];
      const double start = forces[at] * c.give, before = from_them ? start : 0.0;
      apart_[i] = (at < of_contacts ? gap[at / c.each()] : row_gap_[at - of_contacts]) - c.exact() * before;
      lam_[i] = kind_[i] == kStill ? std::clamp(-apart_[i] / c.exact(), low_[i], high_[i]) : start;
      if (kind_[i] == kStill) continue;
      q_[i] = apart_[i] + dot(&rays_[i * nv], place, nv);
      within = std::max(within, -q_[i]);
    }
    // What is far from closing has no force, if it does not close by the forces of the others.
    std::copy_n(place, nv, moved);
    bool found = true;
    for (bool first = true;; first = false, within = 0) {
      const size_t before = near_.size();
      for (int i = 0; i < count; i++) {
        if (kind_[i] != kFar ||
            !(lam_[i] != 0 || low_[i] < 0 || apart_[i] + dot(&rays_[i * nv], moved, nv) < within))
          continue;
        kind_[i] = kNear;
        near_.push_back(i);
      }
      if (near_.empty() || (!first && near_.size() == before)) break;
      found = solve(near_.size() > before);
      std::copy_n(place, nv, moved);
      for (size_t i = 0; i < near_.size(); i++) add(part_[i], &along_[i * nv], nv, moved);
    }
    for (int i = 0; i < count; i++) forces[number_[i]] = lam_[i] / c.give;
    return found;
  }

  // Add the impulse on the degrees of freedom by forces of contacts.
  void add_impulse(const double* forces, double* into) const {
    for (size_t i = 0; i < number_.size() - common_->rows; i++)
      add(forces[number_[i]], &rays_[i * common_->nv], common_->nv, into);
  }

 private:
  enum Kind : char { kStill, kFar, kNear };  // kStill: nothing moves along it

  // Find the forces of those that are near, which are `more` than before.
  bool solve(bool more) {
    const int nv = common_->nv, k = static_cast<int>(near_.size());
    for (auto* numbers : {&gap_, &least_, &largest_, &part_}) numbers->resize(k);
    for (int i = 0; i < k; i++) {
      gap_[i] = q_[near_[i]];
      least_[i] = low_[near_[i]];
      largest_[i] = high_[near_[i]];
      part_[i] = lam_[near_[i]];
    }
    if (more) {
      for (auto* numbers : {&rows_, &along_, &gives_}) numbers->resize(k * nv);
      F_.resize(k * k);
      for (int i = 0; i < k; i++) std::copy_n(&rays_[near_[i] * nv], nv, &rows_[i * nv]);
      multiply(rows_.data(), response_, k, nv, nv, along_.data());
      for (int i = 0; i < k * nv; i++) gives_[i % nv * k + i / nv] = along_[i] *= common_->seconds / common_->give;
      multiply(rows_.data(), gives_.data(), k, nv, k, F_.data());
      for (int i = 0; i < k; i++) F_[i * k + i] += common_->exact();
    }
    const bool found =
        solver_.solve(F_.data(), gap_.data(), least_.data(), largest_.data(), common_->exact(), k, part_.data());
    for (int i = 0; i < k; i++) lam_[near_[i]] = part_[i];
    return found;
  }

  const Common* common_ = nullptr;
  const double *row_gap_ = nullptr, *response_ = nullptr;
  std::vector<double> rays_, low_, high_, apart_, q_, lam_;
  // Of those that are near; `along_`: how forces move ζ, and `gives_`, transposed.
  std::vector<double> rows_, along_, gives_, F_, gap_, least_, largest_, part_;
  std::vector<Kind> kind_;
  std::vector<int> number_, near_;  // the force of each ray
  ActiveSet solver_;
};

// Memory for a state, and what is done there.
class Evaluation {
 public:
  // False where forces were not found exactly. Where contacts and limits jam each other, they act at the same time, as
  // they would else make things fast.
  bool run(const Common& c, const Acting& a, const Evaluated& into) {
    common_ = &c;
    acting_ = &a;
    into_ = &into;
    const int nv = c.nv;
    exact_ = true;
    velocity_ = a.x + nv;
    resize();
    soften_contacts();
    reach(nullptr, place_.data());
    evaluate(false);
    if (c.rows == 0 || c.contacts == 0) return exact_;
    const auto size = [&](const double* speed) {
      double sum = 0;
      for (int v = 0; v < nv; v++) sum += speed[v] * speed[v] / a.inverse_mass[v * nv + v];
      return std::sqrt(sum);
    };
    if (size(fast_.data()) > kGains * (size(velocity_) + size(&place_[nv]))) evaluate(true);
    return exact_;
  }

 private:
  void resize() {
    const Common& c = *common_;
    const int nv = c.nv, k = c.contacts;
    place_.resize(2 * nv);
    carried_place_.resize(2 * nv);
    for (auto* of_dofs : {&moved_, &ways_, &fast_, &drag_, &along_}) of_dofs->resize(nv);
    for (auto* of_contacts : {&closed_, &gap_, &norm_}) of_contacts->resize(k);
    closing_.resize(k);
    slides_.resize(k);
    slide_.resize(k * c.tangents);
    forces_.assign(k * c.each() + c.rows, 0.0);
    presses_.resize(2 * (c.columns - 1 - c.nx));
    speed_.resize(c.rows);
    held_.resize(c.rows * nv);
    pushed_.resize(nv * nv);
  }

  // Write the compliance of each contact of the system. One that is far stiffer than what it moves, as those of light
  // links are, makes plans creep.
  void soften_contacts() const {
    const Common& c = *common_;
    const Acting& a = *acting_;
    for (int i = 0; i < c.contacts; i++) {
      double along = 0;
      for (int r = 0; r < c.tangents; r++)
        along = std::max(along, give_way(a.tangent + (i * c.tangents + r) * c.nv, a.response, c.nv));
      const double own = give_way(a.normal + i * c.nv, a.response, c.nv) + a.friction[i] * a.friction[i] * along;
      into_->soft[i] = std::max(c.compliance, c.least * c.seconds * own / c.give);
    }
  }

  // Write ζ and ν afterwards with the nominal action, with `carried` added to motion without contact.
  void reach(const double* carried, double* into) const {
    const Common& c = *common_;
    for (int i = 0; i < 2 * c.nv; i++) {
      const double *step = acting_->step + i * c.columns,
                   *more = carried == nullptr ? nullptr : carried + i * c.columns;
      into[i] = step[c.columns - 1] + dot(step + c.nv, velocity_, c.nv);
      if (more != nullptr) into[i] += more[c.columns - 1] + dot(more + c.nv, velocity_, c.nv);
    }
  }

  void evaluate(bool at_once) {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv, each = c.each(), k = c.contacts, t = c.tangents;
    settle(at_once);
    find_closing();
    std::fill(slide_.begin(), slide_.end(), 0.0);
    std::copy_n(a.tangent, k * t * nv, into_->turned);
    carry();
    // First all that close hold.
    reach(into_->carried, carried_place_.data());
    for (int i = 0; i < k; i++) closed_[i] = std::max(a.gap[i], 0.0);
    find_slide(carried_place_.data());
    turn_tangents();
    press(a.response, carried_place_.data(), closed_.data(), true);
    find_slide(moved_.data());
    const bool some = find_sliding();
    // Accelerations by the normal forces say how deep a contact lies.
    for (int i = 0; i < k; i++) {
      double normal = 0;
      for (int r = 0; r < each; r++) normal += forces_[i * each + r];
      gap_[i] = settled(i, normal);
    }
    turn_tangents();
    find_slide(moved_.data());
    for (int i = 0; i < k * t; i++) slide_[i] *= slides_[i / t];
    if (some) carry();  // else it is as before: what holds does not depend on the directions of the tangents
    reach(into_->carried, carried_place_.data());
    if (t > 1 || pressed_ != a.response) rays_.set(c, a, into_->turned, *into_, a.response);
    for (int pass = 0; pass < kPasses; pass++) {
      // A contact that slides by s opens by μ s in Anitescu's model, as its gap is n·Δx − μ s.
      for (int i = 0; i < k; i++)
        into_->opened[i] =
            gap_[i] + (slides_[i] ? a.friction[i] * std::sqrt(dot(&slide_[i * t], &slide_[i * t], t)) : 0);
      exact_ &= rays_.press(carried_place_.data(), into_->opened, pass > 0, forces_.data(), moved_.data());
      find_slide(moved_.data());
    }
    std::copy_n(forces_.data(), k * each, into_->forces);
    std::copy_n(forces_.data() + k * each, c.rows, into_->row_forces);
    std::fill(drag_.begin(), drag_.end(), 0.0);
    rays_.add_impulse(forces_.data(), drag_.data());
    for (int j = 0; j < c.rows; j++) add(into_->row_forces[j], into_->impulse + j * nv, nv, drag_.data());
    for (int v = 0; v < nv; v++) fast_[v] = carried_place_[nv + v] + dot(a.response + v * nv, drag_.data(), nv);
    add_creep();
  }

  // Find where limits and friction hold, and rows `held_` of those that hold all the time. They act at the beginning of
  // the step, as contacts do, if `at_once`.
  void settle(bool at_once) {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv, nu = c.columns - 1 - c.nx, k = c.limits();
    const double h = c.seconds;
    if (c.rows == 0) return;
    // First a step with all loads at its beginning, as forces are: limits hold at zero, what creeps goes on creeping.
    for (int j = 0; j < c.rows; j++) {
      const Soft soft = soften(j);
      speed_[j] = dot(a.row_normal + j * nv, velocity_, nv);
      const bool creeps = j >= k && std::fabs(speed_[j]) < soft.most * soft.firm(0.0) / soft.damping;
      scale(j, j < k ? std::max(a.row_gap[j], 0.0) + 2 * a.bend[j] : -h * speed_[j] * creeps, 1.0);
    }
    reach(a.delayed, carried_place_.data());
    for (int i = 0; i < c.contacts; i++) closed_[i] = std::max(a.gap[i], 0.0);
    std::copy_n(a.tangent, c.contacts * c.tangents * nv, into_->turned);
    press(a.response, carried_place_.data(), closed_.data(), true);
    for (int j = 0; j < c.rows; j++) {
      const double *row = a.row_normal + j * nv, force = forces_[c.contacts * c.each() + j], bend = a.bend[j];
      const bool limit = j < k;
      const double after = (dot(row, moved_.data(), nv) + 2 * bend) / h;
      Load load{speed_[j], 0, 0, 2 * bend / (h * h), give_way(row, a.inverse_mass, nv)};
      const double gives = give_way(row, a.response, nv);
      load.drag = std::max(load.mass / std::max(gives, 1e-12 * load.mass + kTiny) - 1, 0.0) / h;
      load.acceleration = ((after - gives * force * into_->unit[j]) * (1 + h * load.drag) - speed_[j]) / h;
      // The same with the action that presses a limit most.
      double faster = 0, both = 0, squared = 0;
      std::fill(presses_.begin(), presses_.end(), 0.0);
      for (int i = 0; i < 2 * nv; i++)
        if (row[i % nv] != 0) add(row[i % nv], a.step + i * c.columns + c.nx, nu, presses_.data() + i / nv * nu);
      for (int u = 0; u < nu; u++) {
        const double far = presses_[u], fast = presses_[nu + u];
        faster += std::fabs(fast) * c.reach[u];
        both += far * fast;
        squared += fast * fast;
      }
      Load harder = load;
      harder.acceleration -= faster * (1 + h * load.drag) / h;
      const Soft soft = soften(j);
      const Followed then = soft.follow(a.row_gap[j], load, h, c.steps);
      const Followed most = soft.follow(a.row_gap[j], harder, h, c.steps);
      const bool holds = then.holds && (limit ? force > 0 : std::fabs(force) < 0.999 * into_->bound[j - k]);
      // A limit holds at the depth that it has after the step, friction after its creep.
      double gap = limit ? a.row_gap[j] + 2 * bend - std::min(a.row_gap[j] + then.moved, 0.0) : -then.moved * holds;
      double part = std::clamp(then.part, kActsFrom, kActsTo);
      if (limit && most.acts && faster > 0 && !at_once) {
        // Between the nominal action and the one that presses it most, a limit gives way as MuJoCo's does on average.
        const double late = holds ? 1.0 : both / std::max(h * squared, kTiny);
        const double rest = (then.speed - most.speed) / std::max(faster, kTiny);
        part = std::clamp(late / std::max(1 - rest, 0.05), kPressedFrom, kPressedTo);
        // What is reached in the step has its gap where the force stops it as at the nominal action.
        const double stopped = then.speed - (speed_[j] + h * load.acceleration) / (1 + h * load.drag);
        if (then.acts && a.row_gap[j] > 0) gap -= (part - then.part) * h * stopped;
      }
      scale(j, gap, (!limit && then.stops) || at_once ? 1.0 : part);
      for (int v = 0; v < nv; v++) held_[j * nv + v] = holds ? row[v] : 0.0;
    }
  }

  Soft soften(int j) const {
    const Acting& a = *acting_;
    return {a.stiffness[j], a.damping[j], a.row_give[j], a.most[j], a.impedance + 5 * j};
  }

  // Write a row as `scale` of limits.py does.
  void scale(int j, double gap, double part) {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv;
    const double *row = a.row_normal + j * nv, gives = c.seconds * give_way(row, a.response, nv);
    double trace = 0;
    for (int v = 0; v < nv; v++) trace += c.seconds * a.response[v * nv + v];
    const double unit = (gives > 1e-9 * dot(row, row, nv) * trace ? std::sqrt(c.give / gives) : 0.0) / part;
    into_->unit[j] = unit;
    into_->scaled_gap[j] = unit * part * gap;
    for (int v = 0; v < nv; v++) {
      into_->impulse[j * nv + v] = unit * row[v];
      into_->scaled_normal[j * nv + v] = unit * row[v] * part;
    }
    if (j >= c.limits()) into_->bound[j - c.limits()] = c.seconds * a.most[j] / (unit > 0 ? unit : 1.0);
  }

  // Find forces, none before, and where they move to.
  void press(const double* response, const double* place, const double* gap, bool writes) {
    rays_.set(*common_, *acting_, into_->turned, *into_, response);
    pressed_ = response;
    spare_ = forces_;
    exact_ &= rays_.press(place, gap, false, writes ? forces_.data() : spare_.data(), moved_.data());
  }

  // Find the contacts that close as bodies move to ζ, stacked bodies held up in turn. The rows `held_` do not move.
  void find_closing() {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv;
    rows_.resize(0, nv);
    by_.resize(0, 1);
    for (int j = 0; j < c.rows; j++) put(&held_[j * nv], -dot(&held_[j * nv], place_.data(), nv));
    push();
    for (int v = 0; v < nv; v++) ways_[v] += place_[v];
    int before = -1, count = 0;
    for (int i = 0; i < c.contacts; i++) {
      norm_[i] = a.gap[i] + dot(a.normal + i * nv, ways_.data(), nv);
      count += closing_[i] = norm_[i] < 0;
    }
    while (count > std::max(before, 0)) {
      before = count;
      rows_.resize(0, nv);
      by_.resize(0, 1);
      for (int i = 0; i < c.contacts; i++)
        if (closing_[i]) put(a.normal + i * nv, -norm_[i]);
      for (int j = 0; j < c.rows; j++) put(&held_[j * nv], 0.0);
      push();
      for (int i = 0; i < c.contacts; i++)
        if (!closing_[i]) count += closing_[i] = norm_[i] + dot(a.normal + i * nv, ways_.data(), nv) < 0;
    }
  }

  void put(const double* row, double by) {
    if (is_zero(row, common_->nv)) return;
    rows_.append(row);
    by_.append(&by);
  }

  // Move ζ along these rows by so much.
  void push() {
    push_of(acting_->response, rows_, rows_, by_, pushing_);
    ways_ = pushing_.numbers;
  }

  // Write the addition to the step where contacts slide by `slide_` or, with zeros, hold.
  void carry() {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv, t = c.tangents;
    rows_.resize(0, nv);
    by_.resize(0, nv);
    for (int side = 0; side < 2; side++) {
      for (int i = 0; i < c.contacts; i++) {
        // What touches without a load may have one with another action.
        if (!closing_[i] && !(a.gap[i] < 0)) continue;
        std::copy_n(a.normal + i * nv, nv, drag_.data());
        if (closing_[i] && slides(i)) subtract_drag(i);
        split(a.normal + i * nv, drag_.data(), side);
      }
      for (int r = 0; r < t; r++)
        for (int i = 0; i < c.contacts; i++)
          if (closing_[i] && !slides(i) && a.friction[i] > 0)
            split(into_->turned + (i * t + r) * nv, into_->turned + (i * t + r) * nv, side);
      for (int j = 0; j < c.rows; j++) split(&held_[j * nv], &held_[j * nv], side);
    }
    // As far along the rows as what is delayed.
    push_of(a.response, rows_, by_, rows_, pushing_);
    for (int i = 0, half = nv * c.columns; i < 2; i++)
      multiply(pushing_[0], a.delayed + i * half, nv, nv, c.columns, into_->carried + i * half);
  }

  bool slides(int i) const { return !is_zero(&slide_[i * common_->tangents], common_->tangents); }

  // Subtract from the normal in `drag_` the friction of a contact that slides, for a unit of normal force.
  void subtract_drag(int i) {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv, t = c.tangents;
    const double *slide = &slide_[i * t], size = std::sqrt(dot(slide, slide, t)), *normal = a.normal + i * nv;
    std::fill(ways_.begin(), ways_.end(), 0.0);
    for (int r = 0; r < t; r++)
      add(a.friction[i] * slide[r] / size, into_->turned + (i * t + r) * nv, nv, ways_.data());
    // Friction that presses what it holds back into the contact could jam it; so much of it is left out.
    multiply(normal, a.response, 1, nv, nv, along_.data());
    const double presses = dot(along_.data(), ways_.data(), nv), yields = dot(along_.data(), normal, nv);
    add(-std::min(1.0, kPresses * yields / std::max(presses, kTiny)), ways_.data(), nv, drag_.data());
  }

  // Add the part of a row, and of a force, that moves the first body of the pair, or the last, by the trees of degrees
  // of freedom.
  void split(const double* row, const double* force, int side) {
    append(row, side, rows_);
    if (is_zero(rows_[rows_.rows - 1], common_->nv)) return rows_.pop();
    append(force, side, by_);
  }

  void append(const double* row, int side, Matrix& into) const {
    const Common& c = *common_;
    int64_t first = std::numeric_limits<int64_t>::max(), last = std::numeric_limits<int64_t>::min();
    for (int v = 0; v < c.nv; v++) {
      if (row[v] == 0) continue;
      first = std::min(first, c.tree[v]);
      last = std::max(last, c.tree[v]);
    }
    into.append(row);
    for (int v = 0; v < c.nv; v++)
      if (c.tree[v] != (side == 0 ? first : last) || (side > 0 && last == first)) into[into.rows - 1][v] = 0;
  }

  // Write how far contacts slide as bodies move by ζ.
  void find_slide(const double* moved) {
    const int nv = common_->nv;
    for (size_t i = 0; i < slide_.size(); i++) slide_[i] = dot(into_->turned + i * nv, moved, nv);
  }

  // Find the contacts whose slides are more than creep; false: none.
  bool find_sliding() {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv, t = c.tangents;
    const auto size = [&](int i, const double* moved) {
      double sum = 0;
      for (int r = 0; r < t; r++) {
        const double along = dot(into_->turned + (i * t + r) * nv, moved, nv);
        sum += along * along;
      }
      return std::sqrt(sum);
    };
    double sideways = 0, down = 0;
    for (int i = 0; i < c.contacts; i++) {
      sideways = std::max(sideways, size(i, carried_place_.data()));
      down = std::max(down, std::fabs(dot(a.normal + i * nv, carried_place_.data(), nv)));
    }
    const double creep = std::max(kSideways * sideways, kDown * down);
    bool some = false;
    // The drag of Stewart and Trinkle's model holds what slides.
    for (int i = 0; i < c.contacts; i++) some |= slides_[i] = c.opens && size(i, moved_.data()) > creep;
    if (!some || is_zero(c.firm, nv)) return some;
    // What robots touch may hold with another action than the nominal one, with which they do not give way.
    for (int v = 0; v < nv; v++)
      for (int w = 0; w < nv; w++) pushed_[v * nv + w] = c.firm[v] || c.firm[w] ? 0.0 : a.response[v * nv + w];
    fast_ = moved_;
    press(pushed_.data(), carried_place_.data(), closed_.data(), false);
    some = false;
    for (int i = 0; i < c.contacts; i++) some |= slides_[i] = slides_[i] && size(i, moved_.data()) > creep;
    moved_ = fast_;
    return some;
  }

  // The gap of a contact after a step, by its normal force, see `Recovery`.
  double settled(int i, double force) const {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const double *normal = a.normal + i * c.nv, gap = a.gap[i];
    if (!(gap < 0)) return gap;
    const int64_t one = a.geom[2 * i], two = a.geom[2 * i + 1];
    const double time = std::max(c.time[one], c.time[two]), depth = std::max(c.depth[one], c.depth[two]);
    const double acceleration = give_way(normal, a.inverse_mass, c.nv) * force / c.seconds;
    const double usual = std::min(depth * kLoad, c.usual);
    const double explained = std::min(std::max(depth * acceleration, usual), kDeepest * c.usual);
    const double deeper = std::max(-gap - explained, 0.0), part = c.seconds / time, most = deeper / time;
    const double speed = std::min(std::max(dot(normal, velocity_, c.nv), -most), most);
    return -(deeper * (1 - (1 + part) * std::exp(-part)) + speed * c.seconds * std::exp(-part));
  }

  // Turn the first of tangents along the slide: there the cone is exact.
  void turn_tangents() {
    const int nv = common_->nv, t = common_->tangents;
    if (t < 2) return;
    std::vector<double> normal(t), turned(t * nv);
    for (int i = 0; i < common_->contacts; i++) {
      const double *slide = &slide_[i * t], far = std::sqrt(dot(slide, slide, t));
      for (int r = 0; r < t; r++) normal[r] = far > 1e-9 ? slide[r] / far : r == 0;
      // A reflection takes the first one there, or to the other side.
      normal[0] += normal[0] < 0 ? -1.0 : 1.0;
      const double squared = dot(normal.data(), normal.data(), t);
      double* tangent = into_->turned + i * t * nv;
      std::fill(turned.begin(), turned.end(), 0.0);
      for (int r = 0; r < t; r++)
        for (int s = 0; s < t; s++)
          add(2 * normal[r] * normal[s] / squared - (r == s), tangent + s * nv, nv, &turned[r * nv]);
      std::copy_n(turned.data(), t * nv, tangent);
    }
  }

  // Add the creep of contacts that hold along their rays: what creeps moves the point from which friction counts, which
  // is that of so much compliance.
  void add_creep() const {
    const Common& c = *common_;
    const Acting& a = *acting_;
    const int nv = c.nv, t = c.tangents;
    for (int i = 0; i < c.contacts; i++) {
      const double creep = std::max(c.creep[a.geom[2 * i]], c.creep[a.geom[2 * i + 1]]);
      for (int r = 0; r < t && !slides_[i]; r++) {
        const double* row = into_->turned + (i * t + r) * nv;
        double* force = into_->forces + (i * t + r) * 2;
        const double acceleration =
            give_way(row, a.inverse_mass, nv) * a.friction[i] * (force[0] - force[1]) / c.seconds;
        const double speed = dot(row, velocity_, nv), crept = -creep * acceleration;
        if (!(crept * speed > 0)) continue;
        const double far = std::copysign(std::min(std::fabs(speed), std::fabs(crept)), speed);
        const double more = c.seconds * a.friction[i] * far / (into_->soft[i] * c.give);
        force[0] += more;
        force[1] -= more;
      }
    }
  }

  const Common* common_ = nullptr;
  const Acting* acting_ = nullptr;
  const Evaluated* into_ = nullptr;
  const double *velocity_ = nullptr, *pressed_ = nullptr;  // pressed_: the response of the rays
  bool exact_ = true;
  std::vector<double> place_, carried_place_;  // ζ and ν afterwards: without contact, and as loads are carried
  std::vector<double> moved_, ways_, fast_, drag_, along_, closed_, gap_, norm_, slide_, forces_, held_, pushed_,
      spare_, presses_, speed_;
  Matrix rows_, by_, pushing_;
  std::vector<char> closing_, slides_;
  Rays rays_;
};

}  // namespace difflcs::physics
