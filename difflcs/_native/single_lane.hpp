// The numbers of one problem alone, which look like vectors of one lane and compile to plain numbers; and several
// neighbouring columns of a matrix side by side, in place of several problems.
#pragma once
#include <cstdint>

namespace difflcs::DIFFLCS_ISA {

struct Mask {
  int64_t lane;  // 0 or -1
  int64_t& operator[](int) { return lane; }
  int64_t operator[](int) const { return lane; }
  friend Mask operator~(Mask m) { return {~m.lane}; }
  friend Mask operator&(Mask a, Mask b) { return {a.lane & b.lane}; }
  friend Mask operator|(Mask a, Mask b) { return {a.lane | b.lane}; }
  Mask& operator&=(Mask other) { return *this = *this & other; }
  Mask& operator|=(Mask other) { return *this = *this | other; }
};

struct Vec {
  double lane;
  Vec() = default;
  Vec(double number) : lane(number) {}
  double& operator[](int) { return lane; }
  double operator[](int) const { return lane; }
  friend Vec operator-(Vec a) { return -a.lane; }
  friend Vec operator+(Vec a, Vec b) { return a.lane + b.lane; }
  friend Vec operator-(Vec a, Vec b) { return a.lane - b.lane; }
  friend Vec operator*(Vec a, Vec b) { return a.lane * b.lane; }
  friend Vec operator/(Vec a, Vec b) { return a.lane / b.lane; }
  Vec& operator+=(Vec other) { return *this = *this + other; }
  Vec& operator-=(Vec other) { return *this = *this - other; }
  Vec& operator*=(Vec other) { return *this = *this * other; }
  friend Mask operator<(Vec a, Vec b) { return {-int64_t(a.lane < b.lane)}; }
  friend Mask operator>(Vec a, Vec b) { return {-int64_t(a.lane > b.lane)}; }
  friend Mask operator<=(Vec a, Vec b) { return {-int64_t(a.lane <= b.lane)}; }
  friend Mask operator>=(Vec a, Vec b) { return {-int64_t(a.lane >= b.lane)}; }
  friend Mask operator!=(Vec a, Vec b) { return {-int64_t(a.lane != b.lane)}; }
};

static inline Vec select(Mask m, Vec a, Vec b) { return m.lane ? a : b; }
static inline Vec max(Vec a, Vec b) { return a.lane > b.lane ? a : b; }
static inline Vec min(Vec a, Vec b) { return a.lane < b.lane ? a : b; }
static inline Vec abs(Vec a) { return __builtin_fabs(a.lane); }
static inline Vec sqrt(Vec a) { return __builtin_sqrt(a.lane); }

// Neighbouring columns.
typedef double Two __attribute__((vector_size(16)));
typedef double Four __attribute__((vector_size(32)));
static inline Two operator*(Vec a, Two b) { return a.lane * b; }
static inline Two operator*(Two a, Vec b) { return a * b.lane; }
static inline Four operator*(Vec a, Four b) { return a.lane * b; }
static inline Four operator*(Four a, Vec b) { return a * b.lane; }
static inline Two& operator*=(Two& a, Vec b) { return a *= b.lane; }
static inline Four& operator*=(Four& a, Vec b) { return a *= b.lane; }
static inline Two zero_where(Mask m, Two a) { return m.lane ? Two{} : a; }
static inline Four zero_where(Mask m, Four a) { return m.lane ? Four{} : a; }
static inline Two abs(Two a) { return (Two)((decltype(a < a))a & INT64_MAX); }
static inline Four abs(Four a) { return (Four)((decltype(a < a))a & INT64_MAX); }
static inline Two max(Two a, Two b) { return a > b ? a : b; }
static inline Four max(Four a, Four b) { return a > b ? a : b; }

}  // namespace difflcs::DIFFLCS_ISA
