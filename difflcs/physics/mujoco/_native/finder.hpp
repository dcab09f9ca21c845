// Finds the contacts of a state: pairs by how near they can be, each measured, the nearest kept.
//
// Pairs of shapes that have a formula are MuJoCo's contacts. All others MuJoCo inflates by the distance up to which
// contacts matter, and then misjudges how deep they are. `mj_geomDistance` does not, if its tolerance is small beside
// the shapes. It finds one point on each shape; the faces around the two are cut with each other. Boxes are measured
// too, as what separates faces is not always the shortest way: where MuJoCo's contacts are not as near as the boxes
// are, or are missing, those of the faces count.
#pragma once

#include <array>
#include <cstring>

#include "faces.hpp"
#include "library.hpp"

namespace difflcs::physics {

// In parts of the smaller shape: tolerance of `mj_geomDistance`; the gap below which its two points give no direction;
// how far one of the shapes is then put aside.
constexpr double kTolerance = 1e-10, kTouching = 5e-6, kAside = 5e-5;
constexpr double kStill = 1e-9;  // what the normal of a contact moves at most, if nothing can move along it
constexpr int kEnough = 4;       // contacts that hold a face, where there is no room for all

struct Geom {
  double radius;            // of the sphere around it; infinite for a plane
  int kind, root;           // root: body whose centre its degrees of freedom count from
  Vector centre, half;      // box around it along its axes
  int solid;                // its faces; −1: none
  std::vector<char> moves;  // (nv,) degrees of freedom that move it
};

struct Pair {
  int first, second;
  bool formula, boxes, faces;
  double size, friction;
  double spin;  // of spinning about the normal, the radius at which friction acts as in sliding
  double rubs;  // the gap below which friction acts along a normal that nothing can move along
};

// Pairs that share a number of contacts.
struct Group {
  int begin, end;  // pairs
  int count;       // contacts
  double distance;
};

// The model's constants that matter.
struct Scene {
  int nq, nv, ngeom, plane, tangents;
  bool planar;
  Vector axis;  // of the plane of motion
  std::vector<Geom> geoms;
  std::vector<Solid> solids;
  std::vector<Pair> pairs;
  std::vector<Group> groups;

  int contacts() const {
    int count = 0;
    for (const Group& g : groups) count += g.count;
    return count;
  }
};

// What is found, one row for each state: gap (k), normal (k, nv), tangent (k, tangents, nv), friction (k), geom (k, 2).
struct Found {
  double *gap, *normal, *tangent, *friction;
  int64_t* geom;
  int64_t* near;  // contacts within `within` of each group
};

class Finder {
 public:
  Finder(const Library& library, const Scene& scene, const Place& place)
      : library_(library), scene_(scene), place_(place) {}

  // Set the positions and compute places, then find the contacts.
  void find(const double* qpos, const double* within, const Found& into) {
    std::memcpy(place_.qpos, qpos, scene_.nq * sizeof(double));
    library_.kinematics(place_.model, place_.data);
    library_.com_pos(place_.model, place_.data);
    int slot = 0;
    for (size_t g = 0; g < scene_.groups.size(); g++) {
      const Group& group = scene_.groups[g];
      choose(group, within[g], into.near + g);
      for (const Contact& c : chosen_) write(c, slot++, into);
      slot += group.count - static_cast<int>(chosen_.size());
    }
  }

 private:
  Pose pose(int geom) const { return {place_.geom_xpos, place_.geom_xmat, geom}; }

  // A lower bound of the gap, by spheres around the shapes.
  double at_least(const Pair& pair) const {
    const Vector apart = load(place_.geom_xpos + 3 * pair.second) - load(place_.geom_xpos + 3 * pair.first);
    return norm(apart) - scene_.geoms[pair.first].radius - scene_.geoms[pair.second].radius;
  }

  // One by boxes, which takes longer.
  double at_least_of_boxes(const Pair& pair) const {
    const Geom &a = scene_.geoms[pair.first], &b = scene_.geoms[pair.second];
    const Pose one = pose(pair.first), two = pose(pair.second);
    if (a.kind == scene_.plane) return separation(one.axis[2], one.place, b, two);
    if (b.kind == scene_.plane) return separation(two.axis[2], two.place, a, one);
    return std::max(outside(a, one, b, two), outside(b, two, a, one));
  }

  // How far a box is beyond a plane.
  static double separation(Vector normal, Vector on, const Geom& geom, const Pose& at) {
    const Vector n = at.inward(normal);
    return dot(normal, at.place - on) + dot(n, geom.centre) - std::fabs(n.x) * geom.half.x -
           std::fabs(n.y) * geom.half.y - std::fabs(n.z) * geom.half.z;
  }

  // How far the second is outside of the box around the first, at least; negative in an overlap.
  static double outside(const Geom& a, const Pose& one, const Geom& b, const Pose& two) {
    const double centre[] = {a.centre.x, a.centre.y, a.centre.z}, half[] = {a.half.x, a.half.y, a.half.z};
    double squared = 0, most = -kInfinity;
    for (int k = 0; k < 3; k++) {
      const Vector middle = one.place + centre[k] * one.axis[k];
      const double apart =
          std::max(separation(one.axis[k], middle, b, two), separation(-1.0 * one.axis[k], middle, b, two)) - half[k];
      most = std::max(most, apart);
      if (apart > 0) squared += apart * apart;
    }
    return most > 0 ? std::sqrt(squared) : most;
  }

  // Choose the nearest contacts of a group; `near`: how many there are within `within`.
  void choose(const Group& group, double within, int64_t* near) {
    candidates_.clear();
    found_.clear();
    nearest_.clear();
    chosen_.clear();
    *near = 0;
    if (group.count == 0) return;
    for (int p = group.begin; p < group.end; p++) {
      const double lower = at_least(scene_.pairs[p]);
      if (lower < group.distance) candidates_.push_back({-lower, ~p});
    }
    std::make_heap(candidates_.begin(), candidates_.end());
    while (!candidates_.empty()) {
      const auto [lower, pair] = candidates_.front();
      const bool enough = static_cast<int>(nearest_.size()) == group.count;
      if (enough && -lower > std::max(nearest_.front(), within)) break;
      std::pop_heap(candidates_.begin(), candidates_.end());
      candidates_.pop_back();
      if (pair >= 0) {
        add(pair, group);
        continue;
      }
      const double more = std::max(-lower, at_least_of_boxes(scene_.pairs[~pair]));
      if (!(more < group.distance)) continue;
      candidates_.push_back({-more, ~pair});
      std::push_heap(candidates_.begin(), candidates_.end());
    }
    const bool room = static_cast<int>(found_.size()) <= group.count;
    for (const Contact& c : found_) {
      if (!room && !c.spread) continue;
      chosen_.push_back(c);
      *near += c.gap <= within;
    }
    if (static_cast<int>(chosen_.size()) > group.count) {
      std::stable_sort(chosen_.begin(), chosen_.end(),
                       [](const Contact& a, const Contact& b) { return a.gap < b.gap; });
      chosen_.resize(group.count);
    }
    std::stable_sort(chosen_.begin(), chosen_.end(),
                     [](const Contact& a, const Contact& b) { return a.pair < b.pair; });
  }

  // Add the contacts of a pair.
  void add(int number, const Group& group) {
    const Pair& pair = scene_.pairs[number];
    of_pair_.clear();
    if (pair.formula) collide(number, group.distance);
    Contact nearest{};
    nearest.pair = number;
    if ((!pair.formula || pair.boxes) && measure(pair, group.distance, &nearest) &&
        (!pair.formula || !agree(pair, nearest))) {
      of_pair_.clear();
      const int one = scene_.geoms[pair.first].solid, two = scene_.geoms[pair.second].solid;
      if (pair.faces && nearest.gap < pair.size) {
        add_contacts(nearest, scene_.solids[one], pose(pair.first), scene_.solids[two], pose(pair.second), pair.size,
                     group.distance, of_pair_);
      } else {
        of_pair_.push_back(nearest);
      }
    }
    size_t kept = 0;
    for (const Contact& c : of_pair_)
      if (moves(c)) of_pair_[kept++] = c;
    of_pair_.resize(kept);
    spread();
    for (const Contact& c : of_pair_) {
      found_.push_back(c);
      if (!c.spread) continue;
      nearest_.push_back(c.gap);
      std::push_heap(nearest_.begin(), nearest_.end());
      if (static_cast<int>(nearest_.size()) > group.count) {
        std::pop_heap(nearest_.begin(), nearest_.end());
        nearest_.pop_back();
      }
    }
  }

  // MuJoCo's contacts of a pair.
  void collide(int number, double distance) {
    const Pair& pair = scene_.pairs[number];
    const int one = scene_.geoms[pair.first].kind, two = scene_.geoms[pair.second].kind;
    std::memset(contacts_.data(), 0, sizeof contacts_);
    const int count = library_.collide[one * library_.kinds + two](place_.model, place_.data, contacts_.data(),
                                                                   pair.first, pair.second, distance);
    for (int k = 0; k < count; k++) {
      const double* c = &contacts_[k * library_.stride];
      const double gap = c[0];
      const Vector middle = load(c + 1), normal = load(c + 4);
      bool again = false;  // boxes may have a contact twice
      for (int j = 0; j < k && pair.boxes; j++)
        again |= std::memcmp(c + 1, &contacts_[j * library_.stride + 1], 24) == 0;
      if (again || !(gap < distance)) continue;
      // The contact is in the middle of the gap; friction acts where the two bodies are.
      const Vector half = 0.5 * gap * normal;
      of_pair_.push_back({gap, normal, middle - half, middle + half, load(c + 7), number, true});
    }
  }

  // Measure a pair; false if it is not within the distance.
  bool measure(const Pair& pair, double distance, Contact* into) {
    const double size = pair.size;
    double ends[6], gap = 0;
    Vector way{};
    // Now and then a tolerance as small as the first leaves the points apart from the depth; a larger one does not.
    for (const double more : {1.0, 1e2, 1e4}) {
      *place_.ccd_tolerance = more * kTolerance * size;
      gap = library_.distance(place_.model, place_.data, pair.first, pair.second, distance, ends);
      if (gap >= distance) return false;
      way = load(ends + 3) - load(ends);
      if (std::fabs(norm(way) - std::fabs(gap)) < 1e-7 * size) break;
    }
    into->gap = gap;
    into->first = load(ends);
    into->second = load(ends + 3);
    if (std::fabs(gap) > kTouching * size) {
      into->normal = (1 / gap) * way;
    } else {
      touch(pair, distance, into);
    }
    Vector other;
    across(into->normal, &into->tangent, &other);
    return true;
  }

  // Measure a pair that as good as touches, where the two points give no direction; MuJoCo also says 0 where it failed.
  // The answer is that of the shape put a little aside, the way that parts them most.
  void touch(const Pair& pair, double distance, Contact* into) {
    into->normal = {1, 0, 0};
    double* here = place_.geom_xpos + 3 * pair.second;
    const double before[3] = {here[0], here[1], here[2]}, aside = kAside * pair.size;
    double best = -kInfinity, ends[6];
    for (int side = 0; side < 6 && !(best > 0.4 * aside); side++) {
      const double sign = side < 3 ? 1 : -1;
      here[side % 3] = before[side % 3] + sign * aside;
      const double apart = library_.distance(place_.model, place_.data, pair.first, pair.second, distance, ends);
      here[side % 3] = before[side % 3];
      if (!(apart > best && std::fabs(apart) > 0.1 * aside)) continue;
      best = apart;
      into->first = load(ends);
      into->normal = (1 / apart) * (load(ends + 3) - load(ends));
      const double along[] = {into->normal.x, into->normal.y, into->normal.z};
      into->gap = apart - aside * sign * along[side % 3];
      into->second = into->first + into->gap * into->normal;
    }
  }

  // Whether MuJoCo's contacts of two boxes are as near as the boxes are, and along directions that can be.
  bool agree(const Pair& pair, const Contact& measured) const {
    const double tolerance = 1e-5 * pair.size;
    double nearest = kInfinity;
    for (const Contact& c : of_pair_) nearest = std::min(nearest, c.gap);
    if (!(std::fabs(nearest - measured.gap) <= tolerance)) return false;
    const Geom& b = scene_.geoms[pair.second];
    const Pose one = pose(pair.first), two = pose(pair.second);
    for (const Contact& c : of_pair_) {
      if (std::fabs(dot(c.normal, measured.normal)) > 1 - 1e-10) continue;
      const Vector n = one.inward(c.normal), half = scene_.geoms[pair.first].half;
      const double wide = std::fabs(n.x) * half.x + std::fabs(n.y) * half.y + std::fabs(n.z) * half.z;
      if (separation(c.normal, one.place, b, two) - wide < measured.gap - tolerance) return false;
    }
    return true;
  }

  // Mark up to four contacts of the pair: the nearest, then each time the farthest from the others.
  void spread() {
    const size_t count = of_pair_.size();
    for (Contact& c : of_pair_) c.spread = count <= kEnough;
    if (count <= kEnough) return;
    double far[kMostPoints];
    std::fill(far, far + count, kInfinity);
    size_t chosen = 0;
    for (size_t k = 1; k < count; k++)
      if (of_pair_[k].gap < of_pair_[chosen].gap) chosen = k;
    for (int taken = 1;; taken++) {
      of_pair_[chosen].spread = true;
      if (taken == kEnough) return;
      const Vector here = of_pair_[chosen].first + of_pair_[chosen].second;
      size_t next = 0;
      for (size_t k = 0; k < count; k++) {
        far[k] = of_pair_[k].spread ? -1 : std::min(far[k], norm(of_pair_[k].first + of_pair_[k].second - here));
        if (far[k] > far[next]) next = k;
      }
      chosen = next;
    }
  }

  // How the second body moves from the first along a direction, by a degree of freedom.
  double rate(const Contact& c, Vector along, int v) const {
    const int geom[] = {scene_.pairs[c.pair].first, scene_.pairs[c.pair].second};
    const Vector turn = load(place_.cdof + 6 * v), shift = load(place_.cdof + 6 * v + 3);
    double rate = 0;
    for (int side = 0; side < 2; side++) {
      if (!scene_.geoms[geom[side]].moves[v]) continue;
      const Vector arm =
          (side == 0 ? c.first : c.second) - load(place_.subtree_com + 3 * scene_.geoms[geom[side]].root);
      rate += (side == 0 ? -1 : 1) * (dot(cross(arm, along), turn) + dot(along, shift));
    }
    return rate;
  }

  // How the second body spins about the normal of the contact, as the first one sees it.
  double spin(const Contact& c, int v) const {
    const auto moves = [&](int geom) { return scene_.geoms[geom].moves[v] ? 1 : 0; };
    const Pair& pair = scene_.pairs[c.pair];
    return (moves(pair.second) - moves(pair.first)) * dot(c.normal, load(place_.cdof + 6 * v));
  }

  // A normal that nothing can move along is that of a body resting on what is outside the plane of motion, or of one
  // that a geom presses against its rail: it has friction if the two overlap.
  bool moves(const Contact& c) const {
    Vector along[3] = {c.normal};
    const int count = c.gap < scene_.pairs[c.pair].rubs ? 3 : 1;
    if (count > 1) across(c.normal, along + 1, along + 2);
    for (int k = 0; k < count; k++)
      for (int v = 0; v < scene_.nv; v++)
        if (std::fabs(rate(c, along[k], v)) > kStill) return true;
    return false;
  }

  void write(const Contact& c, int slot, const Found& into) const {
    const Pair& pair = scene_.pairs[c.pair];
    const int nv = scene_.nv, count = scene_.tangents;
    Vector tangent[2];
    if (scene_.planar) {
      tangent[0] = cross(scene_.axis, c.normal);
      tangent[0] = (1 / std::max(norm(tangent[0]), 1e-12)) * tangent[0];
    } else {  // as MuJoCo makes a frame
      const auto across = [&](Vector v) { return v - dot(v, c.normal) * c.normal; };
      Vector one = across(c.tangent);  // that of a capsule on a plane is along it, and may be upright
      if (norm(one) < 1e-6) one = across(std::fabs(c.normal.y) < 0.5 ? Vector{0, 1, 0} : Vector{0, 0, 1});
      tangent[0] = (1 / norm(one)) * one;
      tangent[1] = cross(c.normal, tangent[0]);
    }
    into.gap[slot] = c.gap;
    into.friction[slot] = pair.friction;
    into.geom[2 * slot] = pair.first;
    into.geom[2 * slot + 1] = pair.second;
    for (int v = 0; v < nv; v++) {
      into.normal[slot * nv + v] = rate(c, c.normal, v);
      for (int t = 0; t < std::min(count, 2); t++) into.tangent[(slot * count + t) * nv + v] = rate(c, tangent[t], v);
      if (count > 2) into.tangent[(slot * count + 2) * nv + v] = pair.spin * spin(c, v);
    }
  }

  const Library& library_;
  const Scene& scene_;
  const Place& place_;
  std::vector<std::pair<double, int>> candidates_;  // minus the least gap, pair or, by spheres alone, ~pair: a heap
  std::vector<double> nearest_;                     // gaps of the nearest contacts so far: a heap
  std::vector<Contact> of_pair_, found_, chosen_;
  std::array<double, kMostPoints * kContactDoubles> contacts_;
};

}  // namespace difflcs::physics
