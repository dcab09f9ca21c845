// Contacts of many states of a MuJoCo model, on threads (nanobind). Python hands over addresses and checked arrays.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <atomic>
#include <stdexcept>
#include <system_error>
#include <thread>

#include "finder.hpp"

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

Library make_library(const nb::dict& addresses, int kinds, int stride) {
  return {at<Act>(addresses, "mj_kinematics"),
          at<Act>(addresses, "mj_comPos"),
          at<Distance>(addresses, "mj_geomDistance"),
          at<const Collide*>(addresses, "mjCOLLISIONFUNC"),
          kinds,
          stride,
          at<OnError*>(addresses, "mju_user_error")};
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
  const auto radius = value<Array<const double>>(f, "radius"), box = value<Array<const double>>(f, "box");
  const auto kind = value<Array<const int64_t>>(f, "kind"), root = value<Array<const int64_t>>(f, "root");
  const auto solid = value<Array<const int64_t>>(f, "solid");
  const auto moves = value<Array<const bool>>(f, "moves");
  s.ngeom = static_cast<int>(radius.shape(0));
  for (int g = 0; g < s.ngeom; g++) {
    const double* around = box.data() + 6 * g;
    const bool* row = moves.data() + static_cast<int64_t>(s.nv) * g;
    s.geoms.push_back({radius.data()[g],
                       static_cast<int>(kind.data()[g]),
                       static_cast<int>(root.data()[g]),
                       load(around),
                       load(around + 3),
                       static_cast<int>(solid.data()[g]),
                       {row, row + s.nv}});
  }
  for (nb::handle each : value<nb::list>(f, "solids")) {
    const auto fields = nb::cast<nb::dict>(each);
    s.solids.push_back({value<bool>(fields, "round"), value<double>(fields, "cap"), value<double>(fields, "radius"),
                        value<double>(fields, "half"), value<std::vector<int>>(fields, "counts"),
                        value<std::vector<double>>(fields, "corners"), value<std::vector<double>>(fields, "outward")});
  }
  const auto geoms = value<Array<const int64_t>>(f, "geoms");
  const auto flags = value<Array<const bool>>(f, "flags");
  const auto numbers = value<Array<const double>>(f, "numbers");
  for (size_t p = 0; p < geoms.shape(0); p++) {
    const int64_t* of = geoms.data() + 2 * p;
    const bool* flag = flags.data() + 3 * p;
    s.pairs.push_back({static_cast<int>(of[0]), static_cast<int>(of[1]), flag[0], flag[1], flag[2],
                       numbers.data()[2 * p], numbers.data()[2 * p + 1]});
  }
  for (const auto& [begin, end, count, distance] : value<std::vector<std::tuple<int, int, int, double>>>(f, "groups"))
    s.groups.push_back({begin, end, count, distance});
  return s;
}

Place make_place(const nb::dict& f) {
  return {at<const void*>(f, "model"),     at<void*>(f, "data"),
          at<double*>(f, "qpos"),          at<double*>(f, "geom_xpos"),
          at<double*>(f, "ccd_tolerance"), at<const double*>(f, "geom_xmat"),
          at<const double*>(f, "cdof"),    at<const double*>(f, "subtree_com")};
}

// Calls work(thread, state) for all states, on as many threads as there are places.
template <class Work>
void on_threads(size_t threads, int64_t states, Work work) {
  std::atomic<int64_t> next{0};
  auto take = [&](size_t thread) {
    for (int64_t i; (i = next.fetch_add(1)) < states;) work(thread, i);
  };
  std::vector<std::thread> pool;
  try {
    pool.reserve(threads);
    for (size_t t = 1; t < threads; t++) pool.emplace_back(take, t);
  } catch (const std::system_error&) {  // the work is shared by those that run
  }
  take(0);
  for (auto& t : pool) t.join();
}

// Finds the contacts of states qpos (n, nq). Returns the first state at which MuJoCo said an error, or −1, and the
// error.
std::tuple<int64_t, std::string> find(const Library& library, const Scene& scene,
                                      const std::vector<const Place*>& places, Array<const double> qpos,
                                      Array<const double> within, Array<double> gap, Array<double> normal,
                                      Array<double> tangent, Array<double> friction, Array<int64_t> geom,
                                      Array<int64_t> near) {
  const int64_t n = qpos.shape(0), k = scene.contacts(), nv = scene.nv, groups = scene.groups.size();
  if (qpos.size() != static_cast<size_t>(n * scene.nq) || gap.size() != static_cast<size_t>(n * k) ||
      normal.size() != gap.size() * nv || tangent.size() != normal.size() * scene.tangents ||
      friction.size() != gap.size() || geom.size() != 2 * gap.size() ||
      near.size() != static_cast<size_t>(n * groups) || within.size() != static_cast<size_t>(groups) || places.empty())
    throw std::invalid_argument("expected arrays of the sizes of the scene, a row for each state");
  nb::gil_scoped_release release;
  const Errors errors(library.on_error);
  std::vector<Finder> finders;
  for (const Place* place : places) finders.emplace_back(library, scene, *place);
  std::vector<std::string> said(n);
  std::atomic<bool> failed{false};
  on_threads(std::min<size_t>(places.size(), n), n, [&](size_t thread, int64_t i) {
    const Found into{gap.data() + i * k,      normal.data() + i * k * nv, tangent.data() + i * k * nv * scene.tangents,
                     friction.data() + i * k, geom.data() + 2 * i * k,    near.data() + i * groups};
    const double* here = qpos.data() + i * scene.nq;
    if (!failed && !Errors::guarded([&] { finders[thread].find(here, within.data(), into); }, &said[i])) failed = true;
  });
  for (int64_t i = 0; failed && i < n; i++)
    if (!said[i].empty()) return {i, said[i]};
  return {-1, ""};
}

}  // namespace

NB_MODULE(_mujoco, m) {
  nb::class_<Library>(m, "Library", "Functions of MuJoCo.")
      .def(
          "__init__",
          [](Library* self, const nb::dict& addresses, int kinds, int stride) {
            new (self) Library(make_library(addresses, kinds, stride));
          },
          "addresses"_a, "kinds"_a, "stride"_a);
  nb::class_<Scene>(m, "Scene", "Geoms that may touch.")
      .def("__init__", [](Scene* self, const nb::dict& fields) { new (self) Scene(make_scene(fields)); }, "fields"_a);
  nb::class_<Place>(m, "Place", "A model and its data, by addresses. They must outlive it.")
      .def("__init__", [](Place* self, const nb::dict& fields) { new (self) Place(make_place(fields)); }, "fields"_a);
  m.def("find", &find, "library"_a, "scene"_a, "places"_a, "qpos"_a, "within"_a, "gap"_a, "normal"_a, "tangent"_a,
        "friction"_a, "geom"_a, "near"_a,
        "Contacts of many states, on a thread for each place. Returns the state at which MuJoCo said an error, or -1.");
}
