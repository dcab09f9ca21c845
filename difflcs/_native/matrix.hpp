// Views of matrices, so that a formula reads as in difflcs/mpc/kkt.py: c[i] + D.row(i) * x + E.row(i) * u. Sums go from
// left to right, one product after the other. A view owns nothing; a size known when compiling costs nothing.
#pragma once
#include "lanes.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Calls f(j, V{}) for the columns [first, last) of a matrix. f deals with as many of them, from column j on, as V
// holds: with one where the lanes hold several problems, mostly with four of one problem alone. It reads them from a
// row and writes them there.
template <class Function>
DIFFLCS_INLINE void by_columns(int64_t first, int64_t last, Function f) {
  int64_t j = first;
#if DIFFLCS_LANES == 1
  for (; j + 4 <= last; j += 4) f(j, Four{});
  if (j + 2 <= last) f(j, Two{}), j += 2;
#endif
  for (; j < last; j++) f(j, Vec{});
}
// Numbers of scratch for an array of as many columns.
constexpr int64_t kColumns = kLanes == 1 ? 4 : 1;

// Typed, as a copy of bytes might change anything, also what a loop has in registers.
template <class V, class T>
DIFFLCS_INLINE auto read(const T* row, int64_t j) {
  if constexpr (sizeof(V) > sizeof(Vec)) {
    typedef V Unaligned __attribute__((aligned(8)));
    return V(*reinterpret_cast<const Unaligned*>(row + j));
  } else {
    return row[j];
  }
}
template <class V>
DIFFLCS_INLINE void write(Vec* row, int64_t j, V columns) {
  if constexpr (sizeof(V) > sizeof(Vec)) {
    typedef V Unaligned __attribute__((aligned(8)));
    *reinterpret_cast<Unaligned*>(row + j) = columns;
  } else {
    row[j] = columns;
  }
}

// A size: N where it is known when compiling, else the one given.
template <int64_t N>
struct Dim {
  int64_t given;
  operator int64_t() const { return N ? N : given; }
};

// A row or a column of a matrix, or as many neighbouring columns as V holds: entries at equal distances.
template <class T, int64_t N, int64_t Distance, class V = Vec>
struct Line {
  T* entries;
  Dim<N> size;
  Dim<Distance> distance;
  auto operator[](int64_t i) const { return read<V>(entries + i * distance, 0); }
};

// The inner product of a line and anything with entries, to be added to a number.
template <class L, class V>
struct Product {
  L line;
  V vector;
};

template <class T, int64_t N, int64_t D, class V>
DIFFLCS_INLINE Product<Line<T, N, D, V>, const Vec*> operator*(Line<T, N, D, V> line, const Vec* vector) {
  return {line, vector};
}
template <class T, int64_t N, int64_t D, class V, int64_t M, class W>
DIFFLCS_INLINE Product<Line<T, N, D, V>, const Local<M, W>&> operator*(Line<T, N, D, V> line,
                                                                       const Local<M, W>& vector) {
  return {line, vector};
}
template <class T, int64_t N, int64_t D, class V, class U, int64_t M, int64_t E, class W>
DIFFLCS_INLINE Product<Line<T, N, D, V>, Line<U, M, E, W>> operator*(Line<T, N, D, V> line, Line<U, M, E, W> other) {
  return {line, other};
}

template <class Number, class T, int64_t N, int64_t D, class V, class W>
DIFFLCS_INLINE Number operator+(Number sum, const Product<Line<T, N, D, V>, W>& p) {
  if constexpr (N > 0) {
    DIFFLCS_UNROLL
    for (int64_t i = 0; i < N; i++) sum += p.line[i] * p.vector[i];
  } else {
    for (int64_t i = 0; i < p.line.size; i++) sum += p.line[i] * p.vector[i];
  }
  return sum;
}
template <class Number, class T, int64_t N, int64_t D, class V, class W>
DIFFLCS_INLINE Number operator-(Number sum, const Product<Line<T, N, D, V>, W>& p) {
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
  template <class V = Vec>
  Line<T, Rows, Stride, V> column(int64_t j) const {
    return {entries + j, rows, stride};
  }
  int64_t size() const { return rows * stride; }
  // The same with sizes that are known when compiling.
  template <int64_t R, int64_t C, int64_t D>
  operator Matrix<T, R, C, D>() const {
    return {entries, {rows}, {columns}, {stride}};
  }
  // The columns from `first` on.
  template <int64_t Count>
  Matrix<T, Rows, Count, Stride> block(int64_t first, Dim<Count> count) const {
    return {entries + first, rows, count, stride};
  }
};

// Calls store(i, first(i) + matrix.row(i) * vector) for all rows; several at a time, so that none waits for the sum of
// another, where they are not unrolled.
template <class T, int64_t R, int64_t C, int64_t D, class W, class First, class Store>
DIFFLCS_INLINE void multiply(Matrix<T, R, C, D> matrix, const W& vector, First first, Store store) {
  constexpr int kRows = 4;
  int64_t i = 0;
  if constexpr (C == 0) {
    for (; i + kRows <= matrix.rows; i += kRows) {
      auto a = first(i), b = first(i + 1), c = first(i + 2), d = first(i + 3);
      for (int64_t j = 0; j < matrix.columns; j++) {
        a += matrix(i, j) * vector[j];
        b += matrix(i + 1, j) * vector[j];
        c += matrix(i + 2, j) * vector[j];
        d += matrix(i + 3, j) * vector[j];
      }
      store(i, a), store(i + 1, b), store(i + 2, c), store(i + 3, d);
    }
  }
  for (; i < matrix.rows; i++) store(i, first(i) + matrix.row(i) * vector);
}

// to = first + matrix^T vector, several columns at a time, none of which waits for the sum of another.
template <class M, class W>
DIFFLCS_INLINE void multiply_columns(const M& matrix, const W& vector, const Vec* first, Vec* to) {
  int64_t i = 0;
#if DIFFLCS_LANES == 1
  constexpr int kSums = 4;
  for (; i + 4 * kSums <= matrix.columns; i += 4 * kSums) {
    Four sum[kSums];
    for (int s = 0; s < kSums; s++) sum[s] = read<Four>(first, i + 4 * s);
    for (int64_t j = 0; j < matrix.rows; j++)
      for (int s = 0; s < kSums; s++) sum[s] += vector[j] * read<Four>(matrix[j], i + 4 * s);
    for (int s = 0; s < kSums; s++) write<Four>(to, i + 4 * s, sum[s]);
  }
#endif
  by_columns(i, matrix.columns, [&](int64_t i, auto kind) {
    using V = decltype(kind);
    auto sum = read<V>(first, i);
    for (int64_t j = 0; j < matrix.rows; j++) sum += vector[j] * read<V>(matrix[j], i);
    write<V>(to, i, sum);
  });
}

// The same of a symmetric matrix, whose rows are its columns.
template <class M, class W>
DIFFLCS_INLINE void multiply_symmetric(const M& matrix, const W& vector, const Vec* first, Vec* to) {
  if constexpr (kLanes == 1)
    multiply_columns(matrix, vector, first, to);
  else
    multiply(matrix, vector, [&](int64_t i) { return first[i]; }, [&](int64_t i, Vec sum) { to[i] = sum; });
}

// Calls store(i, j, first(i, j, V{}) + x.column(i) * y.column(j)) for the rows [from, to) and the columns
// [begin, end(i)), as many at a time as V holds. `end` does not fall with i. Of one problem alone four rows are summed
// side by side, so that no sum waits for itself.
template <class X, class Y, class End, class First, class Store>
DIFFLCS_INLINE void products(const X& x, const Y& y, int64_t from, int64_t to, int64_t begin, End end, First first,
                             Store store) {
  const auto row = [&](int64_t i, int64_t j) {
    by_columns(j, end(i), [&](int64_t j, auto kind) {
      using V = decltype(kind);
      store(i, j, V(first(i, j, V{}) + x.column(i) * y.template column<V>(j)));
    });
  };
  int64_t i = from;
#if DIFFLCS_LANES == 1
  constexpr int kRows = 4;
  for (; i + kRows <= to; i += kRows) {
    int64_t j = begin;
    for (; j + 4 <= end(i); j += 4) {
      Four sum[kRows];
      for (int r = 0; r < kRows; r++) sum[r] = first(i + r, j, Four{});
      for (int64_t m = 0; m < y.rows; m++) {
        const Four other = read<Four>(y[m], j);
        for (int r = 0; r < kRows; r++) sum[r] += x(m, i + r) * other;
      }
      for (int r = 0; r < kRows; r++) store(i + r, j, sum[r]);
    }
    for (int r = 0; r < kRows; r++) row(i + r, j);
  }
#endif
  for (; i < to; i++) row(i, begin);
}

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

  DIFFLCS_NOINLINE void* take_bytes(int64_t bytes) {
    void* at = memory ? static_cast<char*>(memory) + used : nullptr;
    used += (bytes + 63) / 64 * 64;
    return at;
  }
  template <class T>
  T* take(int64_t count) {
    return static_cast<T*>(take_bytes(count * int64_t(sizeof(T))));
  }
  template <class T>
  void take(T*& to, int64_t count) {
    to = take<T>(count);
  }
  template <class... T>
  void take_all(int64_t count, T*&... to) {
    (take(to, count), ...);
  }
  template <class T, int64_t R, int64_t C>
  void take(Matrix<T, R, C>& to, int64_t rows, int64_t columns) {
    to = {take<T>(rows * columns), {rows}, {columns}, {columns}};
  }
  template <class T, int64_t R, int64_t C>
  void take(Stages<Matrix<T, R, C>>& to, int64_t stages, int64_t rows, int64_t columns) {
    to.first = {take<T>(stages * rows * columns), {rows}, {columns}, {columns}};
    to.count = stages;
    to.step = stages > 1 ? to.first.size() : 0;
  }
  template <class T>
  void take(Steps<T>& to, int64_t stages, int64_t size) {
    to = {take<T>(stages * size), size, stages, stages > 1 ? size : 0};
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
