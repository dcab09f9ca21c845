// Contacts and motion of many states of a MuJoCo model, on threads (nanobind). Python hands over addresses and checked
// arrays.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <atomic>
#include <stdexcept>

#include "assembly.hpp"
#include "correction.hpp"
#include "crew.hpp"
#include "finder.hpp"
#include "forces.hpp"
#include "motion.hpp"
#include "nominal.hpp"
#include "step.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using namespace difflcs::physics;

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

template <class T>
T at(const nb::dict& fields, const char* name) {
  return reinterpret_cast<T>(nb::cast<std::uintptr_t>(fields[name]));
}

template <class T>
T value(const nb::dict& fields, const char* name) {
  return nb::cast<T>(fields[name]);
}

// Numbers as they are: a copy would not outlive the call.
template <class T>
Array<T> array(const nb::dict& fields, const char* name) {
  return nb::cast<Array<T>>(fields[name], false);
}

Library make_library(const nb::dict& f, int kinds, int stride) {
  Library library{};
  library.kinematics = at<Act>(f, "mj_kinematics");
  library.com_pos = at<Act>(f, "mj_comPos");
  library.fwd_position = at<Act>(f, "mj_fwdPosition");
  library.check_pos = at<Act>(f, "mj_checkPos");
  library.check_vel = at<Act>(f, "mj_checkVel");
  library.check_acc = at<Act>(f, "mj_checkAcc");
  library.distance = at<Distance>(f, "mj_geomDistance");
  library.solve_mass = at<Solve>(f, "mj_solveM");
  library.forward = at<Forward>(f, "mj_forwardSkip");
  library.runge_kutta = at<RungeKutta>(f, "mj_RungeKutta");
  library.difference = at<Difference>(f, "mj_differentiatePos");
  library.integrate = at<Integrate>(f, "mj_integratePos");
  library.collide = at<const Collide*>(f, "mjCOLLISIONFUNC");
  library.kinds = kinds;
  library.stride = stride;
  library.on_error = at<OnError*>(f, "mju_user_error");
  library.clock = at<void**>(f, "mjcb_time");
  return library;
}

Scene make_scene(const nb::dict& f) {
  Scene s{};
  s.nq = value<int>(f, "nq");
  s.nv = value<int>(f, "nv");
  s.plane = value<int>(f, "plane");
  s.tangents = value<int>(f, "tangents");
  const auto axis = value<std::vector<double>>(f, "axis");
  s.planar = !axis.empty();
  if (s.planar) s.axis = load(axis.data());
  const auto box = array<const double>(f, "box");
  const auto moves = array<const bool>(f, "moves");
  for (const auto& [radius, kind, root, solid] : value<std::vector<std::tuple<double, int, int, int>>>(f, "geoms")) {
    const size_t g = s.geoms.size();
    const double* around = box.data() + 6 * g;
    const bool* row = moves.data() + s.nv * g;
    s.geoms.push_back({radius, kind, root, load(around), load(around + 3), solid, {row, row + s.nv}});
  }
  s.ngeom = static_cast<int>(s.geoms.size());
  for (nb::handle each : value<nb::list>(f, "solids")) {
    const auto fields = nb::cast<nb::dict>(each);
    s.solids.push_back({value<bool>(fields, "round"), value<double>(fields, "cap"), value<double>(fields, "radius"),
                        value<double>(fields, "half"), value<std::vector<int>>(fields, "counts"),
                        value<std::vector<double>>(fields, "corners"), value<std::vector<double>>(fields, "outward")});
  }
  using Constants = std::tuple<int, int, bool, bool, bool, double, double, double, double>;
  for (const auto& [first, second, formula, boxes, faces, size, friction, spin, rubs] :
       value<std::vector<Constants>>(f, "pairs"))
    s.pairs.push_back({first, second, formula, boxes, faces, size, friction, spin, rubs});
  for (const auto& [begin, end, count, distance] : value<std::vector<std::tuple<int, int, int, double>>>(f, "groups"))
    s.groups.push_back({begin, end, count, distance});
  return s;
}

Sparse make_sparse(const nb::dict& f) {
  return {value<int>(f, "rows"),           value<int>(f, "size"),           at<const double*>(f, "values"),
          at<const int32_t*>(f, "counts"), at<const int32_t*>(f, "starts"), at<const int32_t*>(f, "columns")};
}

Place make_place(const nb::dict& f) {
  Place p{};
  p.model = at<const void*>(f, "model");
  p.data = at<void*>(f, "data");
  for (auto [name, into] : {std::pair{"qpos", &p.qpos}, {"qvel", &p.qvel}, {"act", &p.act}, {"ctrl", &p.ctrl},
                            {"qacc_warmstart", &p.qacc_warmstart}, {"geom_xpos", &p.geom_xpos},
                            {"ccd_tolerance", &p.ccd_tolerance}, {"qfrc_applied", &p.qfrc_applied}})
    *into = at<double*>(f, name);
  for (auto [name, into] : {std::pair{"geom_xmat", &p.geom_xmat}, {"cdof", &p.cdof}, {"subtree_com", &p.subtree_com},
                            {"actuator_length", &p.actuator_length}, {"qacc", &p.qacc}, {"act_dot", &p.act_dot},
                            {"qfrc_smooth", &p.qfrc_smooth}, {"qfrc_constraint", &p.qfrc_constraint},
                            {"ten_length", &p.ten_length}})
    *into = at<const double*>(f, name);
  p.moment = make_sparse(value<nb::dict>(f, "moment"));
  p.tendon = make_sparse(value<nb::dict>(f, "tendon"));
  p.warnings = at<int32_t*>(f, "warnings");
  p.kinds = value<int>(f, "kinds");
  p.stride = value<int>(f, "stride");
  return p;
}

Motion make_motion(const nb::dict& f) {
  Motion m{};
  m.simulated = at<const void*>(f, "simulated");
  m.linearised = at<const void*>(f, "linearised");
  m.advance = at<Act>(f, "advance");
  m.held = value<bool>(f, "held");
  for (auto [name, into] : {std::pair{"nq", &m.nq}, {"nv", &m.nv}, {"nu", &m.nu}, {"na", &m.na}, {"steps", &m.steps}})
    *into = value<int>(f, name);
  for (auto [name, into] :
       {std::pair{"gain", &m.gain}, {"constant", &m.constant}, {"bias", &m.bias}, {"low", &m.low}, {"high", &m.high}})
    *into = value<std::vector<double>>(f, name);
  for (auto [name, into] : {std::pair{"holds", &m.holds}, {"relative", &m.relative}}) {
    const auto mask = value<std::vector<bool>>(f, name);
    into->assign(mask.begin(), mask.end());
  }
  m.activated = value<std::vector<int>>(f, "activated");
  m.tree = value<std::vector<int>>(f, "tree");
  m.together = value<std::vector<std::tuple<int, std::vector<int>>>>(f, "together");
  m.identity.assign(static_cast<size_t>(m.nv) * m.nv, 0.0);
  for (int v = 0; v < m.nv; v++) m.identity[v * m.nv + v] = 1.0;
  return m;
}

Dynamics make_dynamics(const nb::dict& f) {
  std::vector<TimeSteps> steps;
  for (const auto& [count, way, durations] : value<std::vector<std::tuple<int, int, std::vector<double>>>>(f, "steps"))
    steps.push_back({count, way, durations});
  return {value<int>(f, "nv"), value<int>(f, "na"), value<int>(f, "nu"), value<double>(f, "seconds"),
          value<double>(f, "most"), value<std::vector<double>>(f, "damping"), value<std::vector<double>>(f, "brakes"),
          steps.at(0), steps.at(1), steps.at(2)};
}

// Where MuJoCo said an error or warned: the first state, or −1, the place that it was at, and the error.
using Outcome = std::tuple<int64_t, int64_t, std::string>;

// Calls work(thread, i) for all i below count, the GIL released, until one of them says false.
template <class Work>
void on_threads(size_t threads, int64_t count, Work work) {
  nb::gil_scoped_release release;
  difflcs::Crew::get().each(threads, count, work);
}

// Calls work(place, state) for all states, a thread for each place.
template <class Work>
Outcome at_places(const Library& library, const std::vector<const Place*>& places, int64_t states, Work work) {
  const Errors errors(library);
  std::vector<std::string> said(states);
  std::vector<int64_t> failed(states, -1);
  on_threads(places.size(), states, [&](size_t p, int64_t i) {
    if (Errors::guarded([&] { work(p, i); }, &said[i]) && !places[p]->has_warned()) return true;
    failed[i] = static_cast<int64_t>(p);
    return false;
  });
  for (int64_t i = 0; i < states; i++)
    if (failed[i] >= 0) return {i, failed[i], said[i]};
  return {-1, 0, ""};
}

void check(bool fits) {
  if (!fits) throw std::invalid_argument("expected arrays of the sizes of the model, a row for each state");
}

// Of fields by their names the sizes, for each state.
template <class T, class Row>
using Fields = std::initializer_list<std::tuple<const char*, T* Row::*, int>>;

// Sizes of the dimensions of arrays by their names.
auto size_in(const nb::dict& f) {
  return [&f](const char* name, int axis) {
    return static_cast<int>(value<nb::ndarray<nb::device::cpu>>(f, name).shape(axis));
  };
}

// Points n rows at their numbers in arrays of each state or of all; what is empty is left out.
template <class T, class Row>
void bind(const nb::dict& f, Fields<T, Row> fields, std::vector<Row>& rows) {
  const size_t n = rows.size();
  for (const auto& [name, field, size] : fields) {
    const auto numbers = array<T>(f, name);
    const size_t step = numbers.size() == n * size ? size : 0;
    check(step > 0 || numbers.size() == static_cast<size_t>(size) || numbers.size() == 0);
    for (size_t i = 0; i < n && numbers.size() > 0; i++) rows[i].*field = numbers.data() + i * step;
  }
}

// Finds the contacts of states qpos (n, nq).
Outcome find_contacts(const Library& library, const Scene& scene, const std::vector<const Place*>& places,
                      Array<const double> qpos, Array<const double> within, Array<double> gap, Array<double> normal,
                      Array<double> tangent, Array<double> friction, Array<int64_t> geom, Array<int64_t> near) {
  const size_t n = qpos.shape(0), k = scene.contacts(), nv = scene.nv, groups = scene.groups.size();
  check(qpos.size() == n * scene.nq && gap.size() == n * k && normal.size() == n * k * nv &&
        tangent.size() == n * k * nv * scene.tangents && friction.size() == n * k && geom.size() == 2 * n * k &&
        near.size() == n * groups && within.size() == groups && !places.empty());
  std::vector<Finder> finders;
  for (const Place* place : places) finders.emplace_back(library, scene, *place);
  return at_places(library, places, n, [&](size_t p, int64_t i) {
    const Found into{gap.data() + i * k,      normal.data() + i * k * nv, tangent.data() + i * k * nv * scene.tangents,
                     friction.data() + i * k, geom.data() + 2 * i * k,    near.data() + i * groups};
    finders[p].find(qpos.data() + i * scene.nq, within.data(), into);
  });
}

// Reads the motion at states (n, nq + nv + na) with nominal controls ctrl (n, nu), and where it is unstable.
Outcome read_motion(const Library& library, const Motion& motion, const Dynamics& dynamics,
                    const std::vector<const Place*>& places, Array<const double> state, Array<const double> ctrl,
                    const nb::dict& found) {
  const size_t n = state.shape(0);
  const int nv = motion.nv, na = motion.na, nu = motion.nu, size = motion.size();
  check(state.size() == n * (motion.nq + nv + na) && ctrl.size() == n * nu && nv == dynamics.nv && !places.empty());
  std::vector<Linearised> into(n);
  bind<double, Linearised>(
      found, {{"middle", &Linearised::middle, size}, {"acceleration", &Linearised::acceleration, nv + na},
              {"rates", &Linearised::rates, (nv + na) * (size + nu)}, {"inverse_mass", &Linearised::inverse_mass, nv * nv},
              {"nominal", &Linearised::nominal, nu}, {"reached", &Linearised::reached, size}},
      into);
  bind<bool, Linearised>(found, {{"unstable", &Linearised::unstable, 1}}, into);
  const size_t each = size + motion.nq + 3 * nv + na + nu;
  std::vector<double> memory(places.size() * each);
  std::vector<StepMaker> makers(places.size(), StepMaker(dynamics));
  return at_places(library, places, n, [&](size_t p, int64_t i) {
    Reader(library, motion, *places[p])
        .read(state.data() + i * state.shape(1), ctrl.data() + i * nu, into[i], &memory[p * each]);
    *into[i].unstable = makers[p].overshoots(into[i].rates, into[i].inverse_mass);
  });
}

// Reads the inverse mass (n, nv, nv) at states and, unless `force` is empty, what acts at rest at nominal controls.
Outcome read_rest(const Library& library, const Motion& motion, const std::vector<const Place*>& places,
                  Array<const double> state, Array<const double> ctrl, Array<double> inverse_mass, Array<double> force,
                  Array<double> nominal, Array<double> length, Array<double> moment, Array<double> tendon) {
  const size_t n = state.shape(0), nv = motion.nv, nu = motion.nu, rest = force.size() > 0 ? n : 0;
  check(state.size() == n * (motion.nq + nv + motion.na) && ctrl.size() == n * nu && !places.empty() &&
        inverse_mass.size() == n * nv * nv && force.size() == rest * nv && nominal.size() == rest * nu &&
        length.size() == rest * nu && moment.size() == rest * nu * nv);
  const size_t each = places[0]->tendon.rows * nv;
  check(tendon.size() == rest * each);
  return at_places(library, places, n, [&](size_t p, int64_t i) {
    const Place& place = *places[p];
    const Reader reader(library, motion, place);
    reader.read_mass(state.data() + i * state.shape(1), inverse_mass.data() + i * nv * nv);
    if (rest == 0) return;
    reader.settle(ctrl.data() + i * nu);
    std::copy_n(place.qfrc_smooth, nv, force.data() + i * nv);
    std::copy_n(place.ctrl, nu, nominal.data() + i * nu);
    std::copy_n(place.actuator_length, nu, length.data() + i * nu);
    place.moment.write(moment.data() + i * nu * nv);
    place.tendon.write(tendon.data() + i * each);
  });
}

// Reads the lengths (n, ntendon) of tendons at positions qpos (n, nq), and their derivatives (n, ntendon, nv).
Outcome read_tendons(const Library& library, const std::vector<const Place*>& places, Array<const double> qpos,
                     Array<double> length, Array<double> tendon) {
  check(!places.empty() && length.size() == qpos.shape(0) * places[0]->tendon.rows &&
        tendon.size() == length.size() * places[0]->tendon.size);
  return at_places(library, places, qpos.shape(0), [&](size_t p, int64_t i) {
    const Place& place = *places[p];
    const Sparse& of = place.tendon;
    std::copy_n(qpos.data() + i * qpos.shape(1), qpos.shape(1), place.qpos);
    library.fwd_position(place.model, place.data);
    std::copy_n(place.ten_length, of.rows, length.data() + i * of.rows);
    of.write(tendon.data() + i * of.rows * of.size);
  });
}

// Simulates steps from states (n, nq + nv + na) at controls (n, nu): ζ, ν and the change of activation (n, 2 nv + na)
// after them, NaN where MuJoCo warns.
Outcome simulate(const Library& library, const Motion& motion, const std::vector<const Place*>& places,
                 Array<const double> state, Array<const double> ctrl, Array<double> after) {
  const size_t n = state.shape(0), nu = motion.nu, size = motion.size();
  check(state.size() == n * (motion.nq + motion.nv + motion.na) && ctrl.size() == n * nu && after.size() == n * size &&
        !places.empty());
  return at_places(library, places, n, [&](size_t p, int64_t i) {
    double* into = after.data() + i * size;
    Reader(library, motion, *places[p]).advance(state.data() + i * state.shape(1), ctrl.data() + i * nu, into);
    if (places[p]->has_warned()) std::fill_n(into, size, std::nan(""));
    places[p]->forget_warnings();
  });
}

// Forces lam (n, m) between bounds, from where they are, of systems taken in turn, at states x (n, n_x) and actions u. F is
// symmetric with a compliance on its diagonal, or that is zero. Of those that are not `found` (n) lam is the free gap.
void solve_forces(double compliance, int threads, const nb::dict& f, Array<const double> x, Array<const double> u,
                  Array<const double> low, Array<const double> high, Array<double> lam, Array<bool> found) {
  const auto D = array<const double>(f, "D"), E = array<const double>(f, "E"),
             F = array<const double>(f, "F"), c = array<const double>(f, "c");
  const size_t n = found.size(), m = lam.shape(1), nx = x.shape(1), nu = u.shape(1);
  check(lam.size() == n * m && x.size() == n * nx && u.size() == n * nu && D.size() % std::max<size_t>(m * nx, 1) == 0 &&
        E.size() % std::max<size_t>(m * nu, 1) == 0 && F.size() % (m * m) == 0 && c.size() % m == 0 &&
        low.size() % m == 0 && high.size() == low.size());
  const auto row = [](const auto& of, size_t i, size_t size) { return of.data() + (size > 0 ? i * size % of.size() : 0); };
  std::vector<ActiveSet> solvers(threads);
  on_threads(threads, n, [&](size_t thread, int64_t i) {
    double* forces = lam.data() + i * m;
    std::vector<double> gap(row(c, i, m), row(c, i, m) + m);
    for (size_t j = 0; j < m; j++)
      gap[j] += dot(row(D, i, m * nx) + j * nx, row(x, i, nx), nx) + dot(row(E, i, m * nu) + j * nu, row(u, i, nu), nu);
    found.data()[i] = solvers[thread].solve(row(F, i, m * m), gap.data(), row(low, i, m), row(high, i, m), compliance, m,
                                            forces);
    if (!found.data()[i]) std::copy(gap.begin(), gap.end(), forces);
    return true;
  });
}

// Makes the steps of n states from what was read. Returns false where a mass matrix has no factor.
bool make_steps(int threads, const Dynamics& s, const nb::dict& f, const nb::dict& found) {
  const int nv = s.nv, nx = s.nx(), k = size_in(f)("normal", 1);
  const size_t n = size_in(f)("x", 0);
  std::vector<Moving> given(n);
  bind<const bool, Moving>(f, {{"unstable", &Moving::unstable, 1}}, given);
  bind<const double, Moving>(
      f, {{"x", &Moving::x, nx}, {"middle", &Moving::middle, nx}, {"acceleration", &Moving::acceleration, nv + s.na},
          {"rates", &Moving::rates, (nv + s.na) * (nx + s.nu)}, {"inverse_mass", &Moving::inverse_mass, nv * nv},
          {"reached", &Moving::reached, nx}, {"secant", &Moving::secant, nx * s.nu}, {"normal", &Moving::normal, k * nv},
          {"damping", &Moving::damping, k}, {"firm", &Moving::firm, k}},
      given);
  std::vector<Step> into(n);
  bind<double, Step>(found, {{"step", &Step::step, nx * s.columns()}, {"delayed", &Step::delayed, 2 * nv * s.columns()},
                             {"response", &Step::response, nv * nv}, {"inverse_mass", &Step::inverse_mass, nv * nv},
                             {"place", &Step::place, nv}},
                     into);
  std::vector<StepMaker> makers(threads, StepMaker(s));
  std::atomic<bool> fine{true};
  on_threads(threads, n, [&](size_t thread, int64_t i) {
    if (!makers[thread].make(given[i], k, into[i])) fine = false;
    return true;
  });
  return fine;
}

// Evaluates n states at the nominal action. Returns in how many forces were not found exactly.
int evaluate_nominal(int threads, const nb::dict& f, const nb::dict& found) {
  const auto size = size_in(f);
  Common c{};
  c.nv = size("tangent", 3);
  c.nx = size("x", 1);
  c.columns = size("step", 2);
  c.contacts = size("tangent", 1);
  c.tangents = size("tangent", 2);
  c.rows = size("bend", 1);
  c.bounded = value<int>(f, "bounded");
  c.steps = value<int>(f, "steps");
  c.opens = value<bool>(f, "opens");
  for (auto [name, into] : {std::pair{"seconds", &c.seconds}, {"give", &c.give}, {"compliance", &c.compliance},
                            {"least", &c.least}, {"usual", &c.usual}})
    *into = value<double>(f, name);
  check(size("rough", 0) == c.contacts && size("firm", 0) == c.nv && size("tree", 0) == c.nv &&
        size("reach", 0) == c.columns - 1 - c.nx);
  for (auto [name, into] : {std::pair{"rough", &c.rough}, {"firm", &c.firm}})
    *into = array<const bool>(f, name).data();
  for (auto [name, into] : {std::pair{"time", &c.time}, {"depth", &c.depth}, {"creep", &c.creep}, {"reach", &c.reach}})
    *into = array<const double>(f, name).data();
  c.tree = array<const int64_t>(f, "tree").data();
  const size_t n = size("x", 0);
  const int k = c.contacts, r = c.rows, nv = c.nv, t = c.tangents, of_step = c.nx * c.columns;
  std::vector<Acting> given(n);
  bind<const double, Acting>(
      f, {{"gap", &Acting::gap, k}, {"normal", &Acting::normal, k * nv}, {"tangent", &Acting::tangent, k * t * nv},
          {"friction", &Acting::friction, k}, {"row_gap", &Acting::row_gap, r},
          {"row_normal", &Acting::row_normal, r * nv}, {"bend", &Acting::bend, r},
          {"stiffness", &Acting::stiffness, r}, {"damping", &Acting::damping, r},
          {"impedance", &Acting::impedance, 5 * r}, {"row_give", &Acting::row_give, r}, {"most", &Acting::most, r},
          {"x", &Acting::x, c.nx}, {"step", &Acting::step, of_step},
          {"delayed", &Acting::delayed, 2 * nv * c.columns}, {"response", &Acting::response, nv * nv},
          {"inverse_mass", &Acting::inverse_mass, nv * nv}},
      given);
  const auto geom = array<const int64_t>(f, "geom");
  check(geom.size() == 2 * n * k);
  for (size_t i = 0; i < n; i++) given[i].geom = geom.data() + 2 * k * i;
  std::vector<Evaluated> into(n);
  bind<double, Evaluated>(
      found,
      {{"soft", &Evaluated::soft, k}, {"opened", &Evaluated::opened, k}, {"turned", &Evaluated::turned, k * t * nv},
       {"forces", &Evaluated::forces, k * c.each()}, {"gap", &Evaluated::scaled_gap, r},
       {"normal", &Evaluated::scaled_normal, r * nv}, {"impulse", &Evaluated::impulse, r * nv},
       {"bound", &Evaluated::bound, c.bounded}, {"unit", &Evaluated::unit, r},
       {"row_forces", &Evaluated::row_forces, r}, {"carried", &Evaluated::carried, 2 * nv * c.columns}},
      into);
  std::vector<Evaluation> memory(threads);
  std::atomic<int> missed{0};
  on_threads(threads, n, [&](size_t thread, int64_t i) {
    missed += !memory[thread].run(c, given[i], into[i]);
    return true;
  });
  return missed;
}

// Assembles systems of n states, of arrays of each state or of all by the names of `Given`, into those of `Matrices`.
// Returns false where numbers have to say whether F + Fᵀ is positive definite.
bool assemble(int threads, double drag, double length, double force, const nb::dict& f, const nb::dict& found) {
  const auto size = size_in(f);
  const int k = size("tangent", 1), t = size("tangent", 2), nv = size("tangent", 3), nx = size("x", 1);
  const int others = size("other_gap", 1), held = size("bound", 1), caps = size("cap", 1);
  const int nu = static_cast<int>(array<double>(found, "E").shape(2));
  const Layout s{nv, nx, nu, k, t, caps, others, held, length, force, drag};
  const int all = s.forces();
  const size_t n = size("x", 0);
  std::vector<Given> given(n);
  bind<const double, Given>(
      f, {{"gap", &Given::gap, k}, {"normal", &Given::normal, k * nv}, {"tangent", &Given::tangent, k * t * nv},
          {"friction", &Given::friction, k}, {"turn", &Given::turn, nv * nv}, {"A", &Given::A, nx * nx},
          {"B", &Given::B, nx * nu}, {"d", &Given::d, nx}, {"response", &Given::response, nx * nx},
          {"x", &Given::x, nx}, {"soft", &Given::soft, k + others}, {"other_gap", &Given::other_gap, others},
          {"other_normal", &Given::other_normal, others * nv}, {"effect", &Given::effect, nx * others},
          {"bound", &Given::bound, held}, {"cap", &Given::cap, caps}, {"rest", &Given::rest, all}},
      given);
  std::vector<Matrices> into(n);
  bind<double, Matrices>(found, {{"C", &Matrices::C, nx * all}, {"d", &Matrices::d, nx}, {"D", &Matrices::D, all * nx},
                                 {"E", &Matrices::E, all * nu}, {"F", &Matrices::F, all * all}, {"c", &Matrices::c, all}},
                         into);
  std::atomic<bool> definite{true};
  on_threads(std::max(threads, 1), n, [&](size_t, int64_t i) {
    if (!assemble_state(s, given[i], into[i])) definite = false;
    return true;
  });
  return definite;
}

// Corrects C and d of systems at n states; `doubtful` (n) where more is corrected than moves.
void correct(int threads, double still, const nb::dict& f, Array<bool> doubtful) {
  const auto size = size_in(f);
  const auto tree = array<const int64_t>(f, "of_tree");
  const int nv = static_cast<int>(tree.size()), nx = size("x", 1), nu = size("idle", 1), all = size("lam", 1);
  const int bounded = size("bound", 1), rows = size("normal", 1), contacts = size("hard", 1);
  const Corrected s{nv, nx, nu, value<int>(f, "trees"), contacts, rows - bounded, bounded, value<int>(f, "forces"), all,
                    still, value<bool>(f, "presses"), tree.data(), array<const double>(f, "reach").data()};
  check(contacts + rows <= s.forces && s.forces <= all && size("reach", 0) == nu && nx >= 2 * nv);
  const size_t n = doubtful.size();
  std::vector<Known> given(n);
  bind<const bool, Known>(f, {{"hard", &Known::hard, contacts}}, given);
  bind<const double, Known>(
      f, {{"A", &Known::A, nx * nx}, {"B", &Known::B, nx * nu}, {"x", &Known::x, nx}, {"idle", &Known::idle, nu},
          {"lam", &Known::lam, all}, {"after", &Known::after, nx}, {"bound", &Known::bound, bounded},
          {"normal", &Known::normal, rows * nv}, {"step", &Known::step, nx * (nx + nu + 1)},
          {"inverse_mass", &Known::inverse_mass, nv * nv}},
      given);
  bind<double, Known>(f, {{"C", &Known::C, nx * all}, {"d", &Known::d, nx}}, given);
  on_threads(threads, n, [&](size_t, int64_t i) {
    doubtful.data()[i] = correct_state(s, given[i]);
    return true;
  });
}

}  // namespace

NB_MODULE(_mujoco, m) {
  // What a cache holds when Python ends is no leak.
  nb::set_leak_warnings(false);
  nb::class_<Library>(m, "Library", "Functions of MuJoCo.")
      .def(nb::new_(&make_library), "addresses"_a, "kinds"_a, "stride"_a);
  nb::class_<Scene>(m, "Scene", "Geoms that may touch.").def(nb::new_(&make_scene), "fields"_a);
  nb::class_<Place>(m, "Place", "A model and its data, by addresses. They must outlive it.")
      .def(nb::new_(&make_place), "fields"_a);
  nb::class_<Motion>(m, "Motion", "Models that are simulated and linearised, by addresses. They must outlive it.")
      .def(nb::new_(&make_motion), "fields"_a);
  nb::class_<Dynamics>(m, "Dynamics", "How steps without contact are made.").def(nb::new_(&make_dynamics), "fields"_a);
  m.def("find_contacts", &find_contacts, "library"_a, "scene"_a, "places"_a, "qpos"_a, "within"_a, "gap"_a, "normal"_a,
        "tangent"_a, "friction"_a, "geom"_a, "near"_a,
        "Contacts of many states. Returns where MuJoCo said an error or warned.");
  m.def("read_motion", &read_motion, "library"_a, "motion"_a, "dynamics"_a, "places"_a, "state"_a, "ctrl"_a,
        "found"_a, "Motion at many states. Returns where MuJoCo said an error or warned.");
  m.def("read_rest", &read_rest, "library"_a, "motion"_a, "places"_a, "state"_a, "ctrl"_a, "inverse_mass"_a, "force"_a,
        "nominal"_a, "length"_a, "moment"_a, "tendon"_a,
        "Motion at rest at many states. Returns where MuJoCo said an error or warned.");
  m.def("read_tendons", &read_tendons, "library"_a, "places"_a, "qpos"_a, "length"_a, "tendon"_a,
        "Tendons at many positions. Returns where MuJoCo said an error or warned.");
  m.def("simulate", &simulate, "library"_a, "motion"_a, "places"_a, "state"_a, "ctrl"_a, "after"_a,
        "Steps from many states. Returns where MuJoCo said an error.");
  m.def("solve_forces", &solve_forces, "compliance"_a, "threads"_a, "system"_a, "x"_a, "u"_a, "low"_a, "high"_a, "lam"_a,
        "found"_a, "Forces of systems between bounds.");
  m.def("assemble", &assemble, "threads"_a, "drag"_a, "length"_a, "force"_a, "given"_a, "found"_a,
        "Systems of many states. Returns whether F + Fᵀ is positive definite for certain.");
  m.def("make_steps", &make_steps, "threads"_a, "dynamics"_a, "given"_a, "found"_a,
        "Steps of many states. Returns false where a mass matrix has no factor.");
  m.def("correct", &correct, "threads"_a, "still"_a, "fields"_a, "doubtful"_a,
        "Corrects systems by MuJoCo's own step.");
  m.def("evaluate_nominal", &evaluate_nominal, "threads"_a, "given"_a, "found"_a,
        "Contacts and rows at the nominal action. Returns in how many states forces were not found exactly.");
}
