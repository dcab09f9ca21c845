// The places where faces of two shapes meet.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "vector.hpp"

namespace difflcs::physics {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kCorners = 8;      // of a face, at most
constexpr int kMost = 4;         // contacts of a pair of faces
constexpr double kEdge = 1e-6;   // how far a corner may be outside of a face, in parts of the smaller shape
constexpr double kStrip = 3e-3;  // half the width of the line along which a round side touches, in parts of its radius

// Nearest or deepest points of two shapes; the normal points from the first to the second.
struct Contact {
  double gap;
  Vector normal, first, second;
  Vector tangent;  // a direction across, or zeros
  int pair;
  bool spread;  // one of those that hold the pair where there is no room for all
};

// Faces of a geom in its own frame.
struct Solid {
  bool round;                   // a capsule or a cylinder, whose side touches along a line
  double cap;                   // of the normal along the axis, from where on its end touches
  double radius, half;          // of a round one
  std::vector<int> counts;      // corners of each face
  std::vector<double> corners;  // (faces, kCorners, 3)
  std::vector<double> outward;  // (faces, 3)
};

// A face as it is seen along a normal: its corners across, and height = level + slope · place there.
struct Face {
  int count = 0;
  double corner[kCorners][2];
  double level, slope[2];
  bool line, flat;

  double height(const double* at) const { return level + slope[0] * at[0] + slope[1] * at[1]; }

  // The face of a solid that points most along sign · axes[0], seen from `origin` along the axes.
  Face(const Solid& solid, const Pose& pose, const Vector* axes, double sign, Vector origin) {
    const Vector toward = sign * pose.inward(axes[0]);
    Vector points[kCorners], outward{0, 0, 0};
    line = solid.round && std::fabs(toward.z) < solid.cap;
    if (line) {
      const double across = std::max(std::hypot(toward.x, toward.y), 1e-12);
      outward = {toward.x / across, toward.y / across, 0};
      const Vector aside = kStrip * solid.radius * Vector{-outward.y, outward.x, 0};
      for (const auto& [u, v] : {std::pair{1, 1}, {-1, 1}, {-1, -1}, {1, -1}})
        points[count++] = solid.radius * outward + u * Vector{0, 0, solid.half} + v * aside;
    } else {
      size_t best = 0;
      double most = -kInfinity;
      for (size_t f = 0; f < solid.counts.size(); f++) {
        const double along = dot(toward, load(&solid.outward[3 * f]));
        if (along > most) {
          most = along;
          best = f;
        }
      }
      outward = load(&solid.outward[3 * best]);
      count = solid.counts[best];
      for (int k = 0; k < count; k++) points[k] = load(&solid.corners[3 * (kCorners * best + k)]);
    }
    const Vector shift = pose.inward(pose.place - origin);
    Vector local[3];
    for (int k = 0; k < 3; k++) local[k] = pose.inward(axes[k]);
    const double along = dot(outward, local[0]);
    flat = std::fabs(along) > 0.05;  // else there is none, as at the end of a capsule
    for (int k = 0; k < 2; k++) slope[k] = -dot(outward, local[k + 1]) / (flat ? along : 1.0);
    for (int k = 0; k < count; k++)
      for (int j = 0; j < 2; j++) corner[k][j] = dot(points[k] + shift, local[j + 1]);
    level = dot(points[0] + shift, local[0]) - slope[0] * corner[0][0] - slope[1] * corner[0][1];
  }
};

// Corners of the overlap of two convex polygons.
class Overlap {
 public:
  static constexpr int kRoom = 2 * kCorners + kCorners * kCorners;

  int count = 0;
  double at[kRoom][2];

  Overlap(const Face& first, const Face& second, double tolerance) {
    const Sides one(first, tolerance), two(second, tolerance);
    for (int k = 0; k < first.count; k++)
      if (two.contain(first.corner[k])) add(first.corner[k]);
    for (int k = 0; k < second.count; k++)
      if (one.contain(second.corner[k])) add(second.corner[k]);
    for (int i = 0; i < first.count; i++)
      for (int j = 0; j < second.count; j++) {
        const double *a = one.side[i], *b = two.side[j];
        const double turn = a[0] * b[1] - a[1] * b[0];
        if (std::fabs(turn) <= 1e-9 * one.length[i] * two.length[j]) continue;
        const double between[] = {second.corner[j][0] - first.corner[i][0], second.corner[j][1] - first.corner[i][1]};
        const double s = (between[0] * b[1] - between[1] * b[0]) / turn;
        const double t = (between[0] * a[1] - between[1] * a[0]) / turn;
        const double place[] = {first.corner[i][0] + s * a[0], first.corner[i][1] + s * a[1]};
        if (s >= 0 && s <= 1 && t >= 0 && t <= 1) add(place);
      }
  }

 private:
  struct Sides {
    const Face& face;
    double tolerance, way;
    double side[kCorners][2], length[kCorners];

    Sides(const Face& face, double tolerance) : face(face), tolerance(tolerance) {
      double area = 0;
      for (int k = 0; k < face.count; k++) {
        const double *from = face.corner[k], *to = face.corner[(k + 1) % face.count];
        for (int j = 0; j < 2; j++) side[k][j] = to[j] - from[j];
        length[k] = std::hypot(side[k][0], side[k][1]);
        area += from[0] * side[k][1] - from[1] * side[k][0];
      }
      way = area > 0 ? 1 : area < 0 ? -1 : 0;
    }

    bool contain(const double* at) const {
      for (int k = 0; k < face.count; k++) {
        const double x = face.corner[k][0] - at[0], y = face.corner[k][1] - at[1];
        if ((x * side[k][1] - y * side[k][0]) * way < -tolerance * length[k]) return false;
      }
      return true;
    }
  };

  void add(const double* place) {
    at[count][0] = place[0];
    at[count][1] = place[1];
    count++;
  }
};

// Add to `into` the contact `of` two solids and, where faces meet, the corners of the common area within `distance`.
inline void add_contacts(const Contact& of, const Solid& a, const Pose& place_a, const Solid& b, const Pose& place_b,
                         double size, double distance, std::vector<Contact>& into) {
  Vector axes[3] = {of.normal, {}, {}};
  across(of.normal, &axes[1], &axes[2]);
  const Face low(a, place_a, axes, 1, of.first), high(b, place_b, axes, -1, of.first);
  // The witness comes first, or a corner that is as near stands for it.
  double at[1 + Overlap::kRoom][2] = {{0, 0}}, apart[1 + Overlap::kRoom] = {of.gap}, far[1 + Overlap::kRoom];
  int count = 1, chosen = 0;
  if (low.flat && high.flat) {
    const Overlap overlap(low, high, kEdge * size);
    for (int k = 0; k < overlap.count; k++) {
      const double gap = high.height(overlap.at[k]) - low.height(overlap.at[k]);
      if (!(gap < distance)) continue;
      std::copy(overlap.at[k], overlap.at[k] + 2, at[count]);
      apart[count++] = gap;
    }
  }
  for (int k = 1; k < count; k++)
    if (apart[k] < of.gap + 1e-5 * size && (chosen == 0 || apart[k] < apart[chosen])) chosen = k;
  std::fill(far, far + count, kInfinity);
  if (chosen > 0) far[0] = -1;
  const int most = low.line || high.line ? 2 : kMost;
  for (int taken = 0; taken < most; taken++) {
    Contact c = of;
    const double level = chosen > 0 ? low.height(at[chosen]) : 0;
    c.gap = apart[chosen];
    c.tangent = axes[1];
    c.first = of.first + level * axes[0] + at[chosen][0] * axes[1] + at[chosen][1] * axes[2];
    c.second = c.first + c.gap * of.normal;
    into.push_back(c);
    int next = 0;
    for (int k = 0; k < count; k++) {
      const double x = at[k][0] - at[chosen][0], y = at[k][1] - at[chosen][1];
      far[k] = std::min(far[k], x * x + y * y);
      if (far[k] > far[next]) next = k;
    }
    chosen = next;
    if (!(far[chosen] > 1e-6 * size * size)) break;
  }
}

}  // namespace difflcs::physics
