// Vectors in space, and where a geom is.
#pragma once

#include <cmath>

namespace difflcs::physics {

struct Vector {
  double x, y, z;
};

inline Vector operator+(Vector a, Vector b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator-(Vector a, Vector b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vector operator*(double s, Vector a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline double norm(Vector a) { return std::sqrt(dot(a, a)); }
inline Vector cross(Vector a, Vector b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vector load(const double* v) { return {v[0], v[1], v[2]}; }

// Place and axes of a geom: its matrix has the axes as columns.
struct Pose {
  Vector place;
  Vector axis[3];

  Pose(const double* places, const double* turns, int geom) : place(load(places + 3 * geom)) {
    const double* m = turns + 9 * geom;
    for (int k = 0; k < 3; k++) axis[k] = {m[k], m[3 + k], m[6 + k]};
  }

  // Turn a direction of the world into that along the axes.
  Vector inward(Vector v) const { return {dot(axis[0], v), dot(axis[1], v), dot(axis[2], v)}; }
};

// Two directions across a unit normal and each other.
inline void across(Vector normal, Vector* one, Vector* two) {
  const double x = std::fabs(normal.x), y = std::fabs(normal.y), z = std::fabs(normal.z);
  Vector least = {0, 0, 1};
  if (x <= y && x <= z) {
    least = {1, 0, 0};
  } else if (y <= z) {
    least = {0, 1, 0};
  }
  *one = cross(normal, least);
  *one = (1 / norm(*one)) * *one;
  *two = cross(normal, *one);
}

}  // namespace difflcs::physics
