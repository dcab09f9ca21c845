// A step of a state without contact, as motion.py says what it is: the linear motion in time steps, and what is not
// linear by the simulation.
#pragma once

#include "matrices.hpp"

namespace difflcs::physics {

constexpr double kMostMotion = 1e6;  // in a step [m, rad], and a velocity, that no model has
constexpr double kSame = 1e-12;      // square of a direction's part in rows, up to which they do not hold it
constexpr double kSlow = 1e-4;       // change of activation in a step, below which it is followed as if it were this

enum Way { kEuler, kImplicit, kRungeKutta, kDiscrete };  // the last: with forces at the position after the time step

// See `Steps` in motion.py; `durations` (na) by which the rate of an activation moves it in each time step.
struct TimeSteps {
  int count, way;
  std::vector<double> durations;
};

// What all states have in common, see `Dynamic` in motion.py.
struct Dynamics {
  int nv, na, nu;
  double seconds, most;                 // `most`: rate of a time step, above which what is explicit grows
  std::vector<double> damping, brakes;  // (nv)
  TimeSteps actual, simulated, finer;

  int nx() const { return 2 * nv + na; }
  int columns() const { return nx() + nu + 1; }
};

// Of a state: what was read, see `Linearised` in motion.py, and its `EqualityRows`.
struct Moving {
  const double *x, *middle, *acceleration, *rates, *inverse_mass, *reached, *secant, *normal, *damping, *firm;
  const bool* unstable;
};

// What is found, see `DynamicStep`.
struct Step {
  double *step, *delayed, *response, *inverse_mass, *place;
};

// Memory for a state, and what is done there.
class StepMaker {
 public:
  explicit StepMaker(const Dynamics& common) : c_(common), nv_(c_.nv), nx_(c_.nx()), columns_(c_.columns()) {}

  // Whether time steps of the simulation overshoot, each farther than the last: where h D + h²/2 K, as far as it is
  // explicit, has an eigenvalue below −`most`.
  bool overshoots(const double* rates, const double* inverse_mass) {
    const int way = c_.simulated.way;
    const double h = c_.seconds / c_.simulated.count;
    for (const bool brakes : {false, true}) {  // which overshoot without growing, and have no derivative
      if (way == kDiscrete || (brakes && is_zero(c_.brakes.data(), nv_))) break;
      one_.shape(nv_, nv_);
      two_.shape(nv_, nv_);
      for (int i = 0; i < nv_; i++) {
        const double *row = rates + i * (columns_ - 1), *moves = inverse_mass + i * nv_;
        for (int j = 0; j < nv_; j++) {
          const double damped = brakes ? -moves[j] * c_.brakes[j] : row[nv_ + j];
          one_[i][j] = h * (way == kEuler ? moves[j] * c_.damping[j] : -damped) + (i == j);
          two_[i][j] = h * damped + (brakes ? 0.0 : 0.5 * h * h * row[j]);
        }
      }
      if (way != kRungeKutta) solve(one_, two_);
      double squares = 0;  // of the eigenvalues
      for (int i = 0; i < nv_; i++)
        for (int j = 0; j < nv_; j++) squares += two_[i][j] * two_[j][i];
      if (!(squares > c_.most * c_.most)) continue;
      two_.add_identity(c_.most);
      if (has_negative(two_, one_)) return true;
    }
    return false;
  }

  // With so many rows of equality constraints. False where rounding leaves no factor of M⁻¹.
  bool make(const Moving& m, int equalities, const Step& into) {
    factor_.read(m.inverse_mass, nv_, nv_);
    if (!factor(factor_)) return false;
    invert_lower(factor_, back_);
    multiply_transposed(back_, back_, mass_);
    forces_.shape(nv_ + c_.na, columns_);
    for (int i = 0; i < forces_.rows; i++) {
      std::copy_n(m.rates + i * (columns_ - 1), columns_ - 1, forces_[i]);
      forces_[i][columns_ - 1] = m.acceleration[i];
    }
    heavier_ = mass_;
    slow_.resize(nv_, nv_);
    std::copy_n(m.inverse_mass, nv_ * nv_, into.inverse_mass);
    if (equalities > 0) hold(m, equalities, into.inverse_mass);
    for (int i = 0; i < forces_.rows; i++)  // with ν = 0, ζ = 0 and u = ū
      forces_[i][columns_ - 1] -= dot(forces_[i], m.middle, nx_);
    respond(c_.seconds, response_);
    std::copy_n(response_[0], nv_ * nv_, into.response);
    move_at_once();
    const bool unstable = *m.unstable, of_joints = !unstable && c_.actual.way == kEuler;
    follow(unstable ? c_.finer : c_.actual, !unstable && c_.actual.way == kDiscrete ? heavier_ : mass_, of_joints);
    // Of a step in which a motion grows beyond all bounds, what is linear and explicit says nothing.
    std::copy_n(is_motion(grown_[0], nx_ * columns_) ? grown_[0] : implicit_[0], nx_ * columns_, into.step);
    grown_.read(into.step, nx_, columns_);
    const bool others = c_.simulated.count != c_.actual.count || c_.simulated.way != c_.actual.way;
    if (!unstable && others) follow(c_.simulated, mass_, of_joints);
    add_curved(m, into.step);
    for (int i = 0; i < nv_; i++) into.place[i] = reached(into.step + i * columns_, m.x + nv_);
    for (int i = 0; i < 2 * nv_ * columns_; i++) into.delayed[i] = implicit_.numbers[i] - into.step[i];
    return true;
  }

 private:
  static bool is_motion(const double* numbers, int n) {
    return std::all_of(numbers, numbers + n, [](double x) { return std::fabs(x) < kMostMotion; });
  }

  // The change by a row of a step from a velocity, with u = ū.
  double reached(const double* row, const double* velocity) const {
    return row[columns_ - 1] + dot(row + nv_, velocity, nv_);
  }

  // Let other forces meet the mass and damping of equality constraints, which the rates have, and write M⁻¹ with them.
  void hold(const Moving& m, int equalities, double* inverse_mass) {
    rows_.read(m.normal, equalities, nv_);
    for (int k = 0; k < equalities; k++) {
      for (int i = 0; i < nv_; i++) add(-m.damping[k] * rows_[k][i] / m.firm[k], m.normal + k * nv_, nv_, slow_[i]);
      for (int i = 0; i < nv_; i++) rows_[k][i] /= std::sqrt(m.firm[k]);
      add_square(rows_[k], back_);
    }
    multiply_transposed(back_, back_, heavier_);
    invert_lower(back_, factor_);
    multiply_rows(factor_, factor_, one_);
    std::copy_n(one_[0], nv_ * nv_, inverse_mass);
    // An impedance that grows with the violation takes a larger part of a load there, though less of it is left: as far
    // as the derivative sees, the constraint pushes on. So K loses what drives the constraints apart.
    two_.read(m.normal, equalities, nv_);
    multiply(two_, factor_, one_);
    for (int k = 0; k < equalities; k++) {
      const double size = std::sqrt(std::max(dot(one_[k], one_[k], nv_), kTiny));
      for (int v = 0; v < nv_; v++) one_[k][v] /= size;
    }
    multiply_transposed(one_, one_, two_);
    diagonalise(two_, sizes_);
    rows_.resize(0, nv_);
    for (int i = 0; i < nv_; i++)
      if (sizes_[i] > kSame) rows_.append(two_[i]);
    one_.resize(nv_, nv_);
    for (int i = 0; i < nv_; i++) std::copy_n(forces_[i], nv_, one_[i]);
    relate();
    multiply(rows_, one_, two_);
    multiply_rows(two_, rows_, one_);
    diagonalise(one_, sizes_);
    multiply(one_, rows_, two_);
    for (int i = 0; i < rows_.rows; i++)
      for (int v = 0; v < nv_; v++) two_[i][v] *= std::sqrt(std::max(sizes_[i], 0.0));
    multiply_transposed(two_, two_, one_);
    multiply(factor_, one_, two_);
    multiply(two_, back_, one_);
    for (int i = 0; i < nv_; i++) add(-1.0, one_[i], nv_, forces_[i]);
  }

  // Overwrite K in `one_` by L⁻¹ K L, which is symmetric where M K is.
  void relate() {
    multiply(back_, one_, two_);
    multiply(two_, factor_, one_);
  }

  // Write S, the change of velocity by an impulse in a step of h, with forces that resist motion treated implicitly. It
  // takes L of M⁻¹ and L⁻¹, as M itself has lost the lightest bodies to rounding where some are 10¹⁰ times as heavy.
  void respond(double h, Matrix& response) {
    one_.shape(nv_, nv_);
    for (int i = 0; i < nv_; i++)
      for (int j = 0; j < nv_; j++) one_[i][j] = -h * (forces_[i][nv_ + j] + h * forces_[i][j]);
    relate();
    diagonalise(one_, sizes_);
    multiply_rows(one_, factor_, two_);
    for (int i = 0; i < nv_; i++)
      for (int v = 0; v < nv_; v++) two_[i][v] /= std::sqrt(1 + std::max(sizes_[i], 0.0));
    multiply_transposed(two_, two_, response);
  }

  // Write the matrix (n_x, columns) of a step by the state, u − ū and 1, as one implicit time step.
  void move_at_once() {
    const double h = c_.seconds;
    implicit_.resize(nx_, columns_);
    rates_.resize(nv_, columns_);
    for (int i = 0; i < nv_; i++) add(h, forces_[i], columns_, rates_[i]);
    for (int k = 2 * nv_; k < nx_; k++) {  // activation follows the action in this step, and drives in the mean of it
      const double* rate = forces_[k - nv_];
      const double decay = std::fabs(h * rate[k]) < kSlow ? kSlow : -h * rate[k], part = -std::expm1(-decay) / decay;
      add(h * part, rate, columns_, implicit_[k]);
      for (int i = 0; i < nv_; i++) add(h * h * forces_[i][k] * (1 - part) / decay, rate, columns_, rates_[i]);
    }
    for (int i = 0; i < nv_; i++)
      for (int j = 0; j < nv_; j++) rates_[i][nv_ + j] = i == j;
    multiply(response_, heavier_, one_);  // what is left of a change in velocity
    multiply(one_, rates_, two_);
    for (int i = 0; i < nv_; i++) {
      add(h, two_[i], columns_, implicit_[i]);
      add(1.0, two_[i], columns_, implicit_[nv_ + i]);
    }
    for (int i = 0; i < nx_; i++) implicit_[i][i] += i < nv_ || i >= 2 * nv_;
  }

  // Write to `grown_` the matrix of time steps, without the rows of u − ū and 1. Implicit damping is that of all forces,
  // or of joints alone.
  void follow(const TimeSteps& by, const Matrix& mass, bool of_joints) {
    const double h = c_.seconds / by.count;
    const auto grow = [&](Matrix& by, bool holds) {  // u − ū and 1, as in a step but not in its rates
      one_.shape(nx_, columns_);
      multiply(by[0], once_[0], nx_, nx_, columns_, one_[0], columns_);
      for (int i = 0; i < nx_ && holds; i++) add(1.0, by[i] + nx_, columns_ - nx_, one_[i] + nx_);
      std::swap(by, one_);
    };
    once_.resize(nx_, columns_);
    for (int k = 0; k < c_.na; k++) add(by.durations[k], forces_[nv_ + k], columns_, once_[2 * nv_ + k]);
    if (by.way == kRungeKutta) {
      for (int i = 0; i < nv_; i++) once_[i][nv_ + i] = h;
      for (int i = 0; i < nv_; i++) add(h, forces_[i], columns_, once_[nv_ + i]);
      grown_.resize(nx_, columns_, 1.0);
      for (int k = 4; k > 0; k--) {
        grow(grown_, false);
        for (double& number : grown_.numbers) number /= k;
        grown_.add_identity();
      }
      std::swap(once_, grown_);
    } else {
      once_.add_identity();
      take_rates(by.way, h, mass, of_joints);
      for (int i = 0; i < nv_; i++) add(h, rates_[i], columns_, once_[nv_ + i]);
      for (int i = 0; i < nv_; i++) add(h, once_[nv_ + i], columns_, once_[i]);
    }
    bool begun = false;
    for (int left = by.count; left > 0; left /= 2) {
      if (left % 2 > 0 && begun) grow(grown_, true);
      if (left % 2 > 0 && !begun) grown_ = once_;
      begun = begun || left % 2 > 0;
      if (left > 1) grow(once_, true);
    }
  }

  // Write the rates of velocities in a time step of h, with what is implicit in it.
  void take_rates(int way, double h, const Matrix& mass, bool of_joints) {
    rates_.read(forces_[0], nv_, columns_);
    if (way == kDiscrete) {
      for (int i = 0; i < nv_; i++) add(h, forces_[i], nv_, rates_[i] + nv_);
      respond(h, left_);
      one_.resize(nv_, nv_);
      two_.resize(nv_, nv_);
      for (int i = 0; i < nv_ * nv_; i++) add(0.5 * h * h * mass.numbers[i], forces_[i % nv_], nv_, one_[i / nv_]);
      for (int i = 0; i < nv_; i++)  // of stiff forces that turn with the bodies a part is skew
        for (int j = 0; j < nv_; j++) two_[i][j] = one_[j][i] - one_[i][j];
      multiply(left_, two_, one_);
      std::swap(one_, two_);
      two_.add_identity();
      multiply(left_, mass, one_);
    } else {
      if (of_joints && is_zero(c_.damping.data(), nv_)) return;
      one_ = two_ = mass;
      for (int i = 0; i < nv_ && of_joints; i++) two_[i][i] += h * c_.damping[i];
      for (int i = 0; i < nv_ && !of_joints; i++) {
        add(h, slow_[i], nv_, two_[i]);
        for (int j = 0; j < nv_; j++) add(-h * heavier_[i][j], forces_[j] + nv_, nv_, two_[i]);
      }
    }
    multiply(one_, rates_, left_);
    solve(two_, left_);
    std::swap(rates_, left_);
  }

  // Add to the step, and to the implicit one, what is not linear: the difference of the simulation to the same time
  // steps of the linear motion.
  void add_curved(const Moving& m, double* step) {
    more_.resize(nx_);
    for (int j = m.secant == nullptr ? columns_ - 1 : nx_; j < columns_; j++) {
      const bool acts = j < columns_ - 1;
      double before = 0, along = 0;
      for (int i = 0; i < nx_; i++) {
        const double linear = step[i * columns_ + j];
        more_[i] = acts ? m.secant[i * c_.nu + j - nx_] - grown_[i][j] : m.reached[i] - reached(grown_[i], m.x + nv_);
        before += linear * linear;
        along += linear * (linear + more_[i]);
      }
      if (!is_motion(more_.data(), nx_)) continue;
      const double kept = acts ? std::clamp(along / std::max(before, kTiny), 0.0, 1.0) : 1.0;
      for (int i = 0; i < nx_; i++) {
        step[i * columns_ + j] += more_[i];
        implicit_[i][j] *= kept;
      }
    }
  }

  const Dynamics& c_;
  const int nv_, nx_, columns_;
  // L of M⁻¹ and L⁻¹; M, M with what equality constraints add; damping that they add; S.
  Matrix factor_, back_, mass_, heavier_, slow_, response_;
  Matrix forces_, rates_;  // (nv + na, columns) rates by the state, u − ū and 1; (nv, columns) those of velocities
  Matrix implicit_, grown_, once_, one_, two_, left_, rows_;
  std::vector<double> sizes_, more_;
};

}  // namespace difflcs::physics
