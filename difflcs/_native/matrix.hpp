// Views of matrices, so that a formula reads as in difflcs/mpc/kkt.py: c[i] + D.row(i) * x + E.row(i) * u. Sums go from
// left to right, one product after the other. A view owns nothing; a size known when compiling costs nothing.
#pragma once
#include "lanes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// A size: N where it is known when compiling, else the one given.
template <int64_t N>
struct Dim {
  int64_t given;
  operator int64_t() const { return N ? N : given; }
};

// A row or a column of a matrix: entries at equal distances.
template <class T, int64_t N, int64_t Distance>
struct Line {
  T* entries;
  Dim<N> size;
  Dim<Distance> distance;
  T& operator[](int64_t i) const { return entries[i * distance]; }
};

// The inner product of a line and anything with entries, to be added to a number.
template <class L, class V>
struct Product {
  L line;
  V vector;
};

template <class T, int64_t N, int64_t D>
DIFFLCS_INLINE Product<Line<T, N, D>, const Vec*> operator*(Line<T, N, D> line, const Vec* vector) {
  return {line, vector};
}
template <class T, int64_t N, int64_t D, int64_t M>
DIFFLCS_INLINE Product<Line<T, N, D>, const Local<M>&> operator*(Line<T, N, D> line, const Local<M>& vector) {
  return {line, vector};
}
template <class T, int64_t N, int64_t D, class U, int64_t M, int64_t E>
DIFFLCS_INLINE Product<Line<T, N, D>, Line<U, M, E>> operator*(Line<T, N, D> line, Line<U, M, E> other) {
  return {line, other};
}

template <class T, int64_t N, int64_t D, class V>
DIFFLCS_INLINE Vec operator+(Vec sum, const Product<Line<T, N, D>, V>& p) {
  if constexpr (N > 0) {
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < N; i++) sum += p.line[i] * p.vector[i];
  } else {
    for (int64_t i = 0; i < p.line.size; i++) sum += p.line[i] * p.vector[i];
  }
  return sum;
}
template <class T, int64_t N, int64_t D, class V>
DIFFLCS_INLINE Vec operator-(Vec sum, const Product<Line<T, N, D>, V>& p) {
  if constexpr (N > 0) {
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < N; i++) sum -= p.line[i] * p.vector[i];
  } else {
    for (int64_t i = 0; i < p.line.size; i++) sum -= p.line[i] * p.vector[i];
  }
  return sum;
}

// Row-major; `stride` is the distance between two rows, which exceeds the number of columns in a block of a matrix.
template <class T, int64_t Rows, int64_t Columns, int64_t Stride = Columns>
struct Matrix {
  T* entries;
  Dim<Rows> rows;
  Dim<Columns> columns;
  Dim<Stride> stride;
  T& operator()(int64_t i, int64_t j) const { return entries[i * stride + j]; }
  T* operator[](int64_t i) const { return entries + i * stride; }
  Line<T, Columns, 1> row(int64_t i) const { return {entries + i * stride, columns, {1}}; }
  Line<T, Rows, Stride> column(int64_t j) const { return {entries + j, rows, stride}; }
  int64_t size() const { return rows * stride; }
  // The columns from `first` on.
  template <int64_t Count>
  Matrix<T, Rows, Count, Stride> block(int64_t first, Dim<Count> count) const {
    return {entries + first, rows, count, stride};
  }
};

// Matrices of one size, one per stage, or one for all stages.
template <class M>
struct Stages {
  M first;
  int64_t count, step;
  M operator[](int64_t k) const {
    M matrix = first;
    matrix.entries += k * step;
    return matrix;
  }
};

// The same of vectors.
template <class T>
struct Steps {
  T* first;
  int64_t size, count, step;
  T* operator[](int64_t k) const { return first + k * step; }
};

// Hands out the memory of a workspace piece by piece, or only counts it where there is none.
struct Arena {
  void* memory;
  int64_t used = 0;

  template <class T>
  T* take(int64_t count) {
    void* at = memory ? static_cast<char*>(memory) + used : nullptr;
    used += (count * int64_t(sizeof(T)) + 63) / 64 * 64;
    return static_cast<T*>(at);
  }
  template <class T>
  void take(T*& to, int64_t count) {
    to = take<T>(count);
  }
  template <class T, int64_t R, int64_t C>
  void take(Matrix<T, R, C>& to, int64_t rows, int64_t columns) {
    to = {take<T>(rows * columns), {rows}, {columns}, {columns}};
  }
  template <class T, int64_t R, int64_t C>
  void take(Stages<Matrix<T, R, C>>& to, int64_t stages, int64_t rows, int64_t columns) {
    to.first = {take<T>(stages * rows * columns), {rows}, {columns}, {columns}};
    to.count = stages, to.step = stages > 1 ? to.first.size() : 0;
  }
  template <class T>
  void take(Steps<T>& to, int64_t stages, int64_t size) {
    to = {take<T>(stages * size), size, stages, stages > 1 ? size : 0};
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
