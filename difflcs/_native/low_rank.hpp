// F = diag(rest) + W W^T with few columns in W, as contacts have it that act on few bodies: systems with
// diag(a) + diag(b) F are then solved in the size of W's columns, by the formula of Sherman, Morrison and Woodbury. For
// a large problem alone; others eliminate (lu.hpp).
//
// Forces move the state along C, and F - diag(rest) is what contacts feel of that: its rows are sums of rows of C. So
// what F does across the rows of C is rest alone.
//
// Between some forces, such as caps of friction, and the others F may be skew: the caps t and the others h then have
//   F = [diag(rest) + W W^T, B; -B^T, F_tt].
// With g = (g_h, g_t) and d_t = a_t + b_t diag(F_tt), a solution x of (diag(a) + diag(b) F) x = g has
//   x_h = (g_h - b_h (W y + B x_t)) / (a_h + b_h rest), and as unknowns remain y = W^T x_h and x_t, where
//   d_t x_t = g_t + b_t (B^T x_h - (F_tt - diag(F_tt)) x_t).
// So W has B as further columns, with zero in the rows t, and x_t as what these forces feel.
#pragma once
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"
#include "matrix.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// The least number of forces for which this is faster.
constexpr int64_t kLowRankFrom = 24;
// F has a unit diagonal: what is left of it up to the first number is rounding, F - diag(rest) - W W^T up to the second
// may be, and entries of rest from the third on are large enough to divide by.
constexpr double kLowRankRounding = 2e-14, kRoundingInSum = 1e-12, kLeastRest = 1e-6;
// Part of a force's direction that has to lie across the rows of C if its rest is read from that.
constexpr double kAcross = 0.01;
// The least part that is tried of what is left where nothing else tells the rest.
constexpr double kMostParts = 1024;
// Part of a row of C by which it has to differ from those before it to count.
constexpr double kAnotherRow = 1e-10;

class LowRank {
  static constexpr int64_t kRows = 4;
  int64_t n, most;  // W has room for so many columns; none where this is not looked for
  Stages<Matrix<Vec, 0, 0>> columns, rows;
  Steps<Vec> rests;
  Steps<int64_t> skews;
  Steps<LowRank> systems;  // each of them
  // Of the system in use: its numbers, 1 / (a + b rest), b, W scaled by b / (a + b rest), I + W^T that as factors.
  Matrix<Vec, 0, 0> W, W_t, scaled;
  Vec *rest, *inverse, *b, *capacitance, *left, *right;
  int64_t rank = 0;
  // The forces t, the first of their columns in W, and of each force whether it is one of them.
  int64_t *skew, skew_count = 0, skew_first = 0, *is_skew;
  const double* F;

 public:
  void layout(Arena& arena, int64_t count, int64_t forces, bool wanted) {
    n = forces;
    most = kLanes == 1 && wanted && n >= kLowRankFrom ? 5 * n / 8 / kRows * kRows : 0;
    if (most == 0) return;
    arena.take(columns, count, n, most);
    arena.take(rows, count, most, n);
    arena.take(rests, count, n);
    arena.take(skews, count, 2 * n);
    arena.take(systems, count, 1);
    arena.take(scaled, n, most);
    arena.take(capacitance, most * most);
    arena.take_all(n, inverse, b);
    arena.take_all(n * kColumns, left, right);
  }

  // That of stage k.
  const LowRank& operator[](int64_t k) const { return most > 0 ? *systems[k] : *this; }

  // Whether F is of this kind.
  explicit operator bool() const { return rank > 0; }
  // Whether it is not, of so many forces that they are always alone: some differ much in size from others.
  bool unlike() const { return most > 0 && (rank == 0 || skew_count > 0) && n >= kAloneForces; }

  // Looks whether system k is of this kind.
  template <class Square, class Wide>
  void find(int64_t k, const Square& F, const Wide& C) const {
    if constexpr (kLanes == 1) {
      if (most == 0) return;
      LowRank& one = *systems[k];
      one = *this;
      one.take(k, most);
      one.take(k, one.describe(F, C) ? one.rank : 0);
    }
  }

  // Row i of the matrix has a_i and b_i.
  void weigh(int64_t i, Vec a_i, Vec b_i) const {
    b[i] = b_i;
    inverse[i] = 1.0 / (a_i + b_i * rest[i]);
  }

  // After all rows are weighed.
  DIFFLCS_NOINLINE void factor() const {
    for (int64_t k = 0; k < n; k++) {
      const Vec weight = b[k] * inverse[k];
      by_columns(0, rank, [&](int64_t j, auto kind) {
        using V = decltype(kind);
        write<V>(scaled[k], j, weight * read<V>(W[k], j));
      });
    }
    for (int64_t i = 0; i < rank; i += kRows)
      by_columns(0, i + kRows, [&](int64_t j, auto kind) {
        using V = decltype(kind);
        V sum[kRows] = {};
        for (int64_t k = 0; k < n; k++)
          for (int64_t r = 0; r < kRows; r++) sum[r] += scaled(k, i + r) * read<V>(W[k], j);
        for (int64_t r = 0; r < kRows; r++) write<V>(capacitance + (i + r) * rank, j, sum[r]);
      });
    for (int64_t i = 0; i < rank; i++)
      for (int64_t j = 0; j < i; j++) capacitance[j * rank + i] = capacitance[i * rank + j];
    for (int64_t c = 0; c < skew_count; c++) {
      Vec* row = capacitance + (skew_first + c) * rank;
      for (int64_t m = 0; m < skew_count; m++) row[skew_first + m] += m == c ? 0.0 : F[skew[c] * n + skew[m]];
      for (int64_t j = 0; j < rank; j++) row[j] *= b[skew[c]] * inverse[skew[c]];
    }
    for (int64_t i = 0; i < rank; i++) capacitance[i * rank + i] += 1.0;
    lu_factor_by_panels(rank, capacitance);
  }

  // g becomes (diag(a) + diag(b) F)^-1 g.
  void solve(Vec* g) const {
    for (int64_t i = 0; i < n; i++) g[i] *= inverse[i];
    const Local<0> moved = feel(Local<0>(g));
    multiply(W, moved, [](int64_t) { return all(0); }, [&](int64_t i, Vec sum) { g[i] -= b[i] * inverse[i] * sum; });
    for (int64_t c = 0; c < skew_count; c++) g[skew[c]] = moved[skew_first + c];
  }

  // g becomes (diag(a) + F diag(b))^-1 g, where it has as many columns as V holds. With z for this, b z is the x of
  // diag(b) g above.
  template <class V = Vec>
  void solve_right(V* g) const {
    Local<0, V> forces(right);
    for (int64_t i = 0; i < n; i++) {
      g[i] *= inverse[i];
      forces[i] = b[i] * g[i];
    }
    const Local<0, V> moved = feel(forces);
    multiply(W, moved, [](int64_t) { return V{}; }, [&](int64_t i, V sum) { g[i] = g[i] - inverse[i] * sum; });
    if (skew_count > 0)
      for (int64_t i = 0; i < n; i++) forces[i] = b[i] * g[i];
    for (int64_t c = 0; c < skew_count; c++) {  // not x_t / b_t, as b_t may be tiny
      V sum = V{} + W_t.row(skew_first + c) * forces;
      for (int64_t m = 0; m < skew_count; m++)
        if (m != c) sum = sum - F[skew[c] * n + skew[m]] * moved[skew_first + m];
      g[skew[c]] += inverse[skew[c]] * sum;
    }
  }

  // g becomes (diag(a) + F^T diag(b))^-1 g.
  void solve_transposed(Vec* g) const {
    reverse(g);
    solve_right(g);
    reverse(g);
  }

  // to = q + F x, by columns.
  template <class Square>
  void slack(const Square& F, Vec* x, const Vec* q, Vec* to) const {
    reverse(x);
    multiply_columns(F, x, q, to);
    reverse(x);
    for (int64_t c = 0; c < skew_count; c++) to[skew[c]] = 2.0 * q[skew[c]] - to[skew[c]];
  }

 private:
  template <class V>
  Local<0, V> feel(const Local<0, V>& forces) const {
    Local<0, V> to(left);
    multiply(W_t, forces, [](int64_t) { return V{}; }, [&](int64_t i, V sum) { to[i] = sum; });
    for (int64_t c = 0; c < skew_count; c++) {
      const int64_t i = skew[c];
      to[skew_first + c] = b[i] * inverse[i] * to[skew_first + c] + forces[i];
    }
    lu_solve_by_rows(rank, capacitance, to.v);
    return to;
  }

  void reverse(Vec* g) const {
    for (int64_t c = 0; c < skew_count; c++) g[skew[c]] = -g[skew[c]];
  }

  void take(int64_t k, int64_t columns_of_W) {
    rank = columns_of_W;
    W = columns[k];
    W_t = rows[k];
    W_t.rows = {rank};
    W.columns = {rank};
    rest = rests[k];
    skew = skews[k];
    is_skew = skew + n;
  }

  // F without what couples the forces t with others.
  template <class Square>
  struct Within {
    const Square& F;
    const int64_t* is_skew;
    Vec operator()(int64_t i, int64_t j) const { return i == j || !(is_skew[i] || is_skew[j]) ? F(i, j) : 0.0; }
  };

  // Parts the forces such that F is symmetric within both parts and skew between them: t are the smaller part of each
  // group of coupled forces. Returns whether there is such a partition.
  template <class Square>
  bool part(const Square& F) {
    double* const side = reinterpret_cast<double*>(left);
    int64_t* const group = reinterpret_cast<int64_t*>(right);
    skew_count = 0;
    for (int64_t i = 0; i < n; i++) side[i] = is_skew[i] = 0;
    for (int64_t first = 0; first < n; first++) {
      if (side[first] != 0) continue;
      double balance = side[first] = 1;
      int64_t count = 1;
      group[0] = first;
      for (int64_t at = 0; at < count; at++)
        for (int64_t i = group[at], j = 0; j < n; j++) {
          const double there = F(i, j), back = F(j, i), rounding = kRoundingInSum * (1 + __builtin_fabs(there));
          const bool alike = __builtin_fabs(there - back) <= rounding, unlike = __builtin_fabs(there + back) <= rounding;
          if (i == j || (alike && unlike)) continue;  // not coupled
          const double other = alike ? side[i] : -side[i];
          if (!(alike || unlike) || side[j] == -other) return false;
          if (side[j] == 0) balance += side[group[count++] = j] = other;
        }
      for (int64_t at = 0; at < count; at++)
        if (side[group[at]] * (balance + 0.5) < 0) is_skew[skew[skew_count++] = group[at]] = 1;
    }
    return true;
  }

  // Finds rest, rank and W; returns whether they are F to rounding.
  template <class Square, class Wide>
  DIFFLCS_NOINLINE bool describe(const Square& whole, const Wide& C) {
    F = whole.entries;
    rank = 0;
    if (!part(whole)) return false;
    const Within<Square> F{whole, is_skew};
    if (!read_rest(F, C) || !decompose(F) || rank + skew_count > most) return false;
    skew_first = rank;
    for (int64_t c = 0; c < skew_count || rank % kRows; c++, rank++)
      for (int64_t i = 0; i < n; i++) W(i, rank) = c < skew_count && !is_skew[i] ? whole(i, skew[c]) : 0.0;
    for (int64_t i = 0; i < n; i++)
      for (int64_t m = 0; m < rank; m++) W_t(m, i) = W(i, m);
    Vec worst = all(0);
    auto rows = W_t;
    rows.rows = {skew_first};
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++) right[j] = (i == j ? rest[i] : all(0)) - F(i, j);
      multiply_columns(rows, W[i], right, left);
      for (int64_t j = 0; j < n; j++) worst = max(worst, abs(left[j]));
    }
    return !any(worst > kRoundingInSum);
  }

  // The rest of each row, from what F does across the rows of C; where nothing of a force is across, `b` is zero.
  template <class Square, class Wide>
  bool read_rest(const Square& F, const Wide& C) {
    auto basis = scaled;  // orthonormal columns, for the rows of C
    basis.columns = {0};
    Vec* none = capacitance;
    for (int64_t j = 0; j < most; j++) none[j] = all(0);
    int64_t count = 0;
    for (int64_t r = 0; r < C.rows; r++) {
      Vec before = all(0), after = all(0);
      for (int64_t i = 0; i < n; i++) {
        left[i] = F.is_skew[i] ? 0.0 : C(r, i);
        before += left[i] * left[i];
      }
      for (int pass = 0; pass < 2; pass++) {
        multiply_columns(basis, left, none, right);
        multiply(basis, right, [&](int64_t i) { return -left[i]; }, [&](int64_t i, Vec sum) { left[i] = -sum; });
      }
      for (int64_t i = 0; i < n; i++) after += left[i] * left[i];
      if (any(after <= kAnotherRow * kAnotherRow * before)) continue;
      if (count == most) return false;
      for (int64_t i = 0; i < n; i++) basis(i, count) = left[i] / sqrt(after);
      basis.columns = {++count};
    }
    for (int64_t i = 0; i < n; i++) {
      for (int64_t j = 0; j < n; j++) left[j] = F(i, j);
      multiply_columns(basis, left, none, right);
      const Vec across = all(1) - basis.row(i) * basis[i], own = all(0) + F(i, i) - basis.row(i) * right;
      b[i] = select(across > kAcross, across, all(0));
      rest[i] = select(b[i] > 0, own / across, all(0));
      if (any((b[i] > 0) & (rest[i] < kLeastRest))) return false;
    }
    return true;
  }

  // W by Cholesky's method with pivots, first those of the rows whose rest is known. The others have as much rest as
  // leaves what they share diagonally dominant, or where that is too little, positive definite.
  template <class Square>
  bool decompose(const Square& F) {
    Vec* remains = inverse;
    for (int64_t i = 0; i < n; i++) remains[i] = F(i, i) - rest[i];
    const auto eliminate = [&](bool whole) {
      for (;;) {
        int64_t p = -1;
        Vec largest = all(kLowRankRounding);
        for (int64_t i = 0; i < n; i++)
          if ((whole || any(b[i] > 0)) && any(remains[i] > largest)) largest = remains[p = i];
        if (p < 0 || rank == most) return p < 0;
        const Vec unit = 1.0 / sqrt(largest);
        W.columns = {rank};
        for (int64_t m = 0; m < rank; m++) right[m] = -W(p, m);
        multiply(
            W, right, [&](int64_t i) { return all(0) + F(i, p); },
            [&](int64_t i, Vec sum) {
              const Vec entry = i == p ? sqrt(largest) : unit * sum;
              W(i, rank) = entry;
              remains[i] -= entry * entry;
            });
        remains[p] = all(0);
        rank++;
      }
    };
    if (!eliminate(false) || !share_rest(F, remains)) return false;
    for (int64_t i = 0; i < n; i++) remains[i] = select(b[i] > 0, remains[i], remains[i] - rest[i]);
    if (!eliminate(true)) return false;
    for (int64_t i = 0; i < n; i++) rest[i] += remains[i];
    return true;
  }

  // The rest of the rows where it is not known: at most what remains of each.
  template <class Square>
  bool share_rest(const Square& F, const Vec* remains) {
    W.columns = {rank};
    int64_t* const unknown = reinterpret_cast<int64_t*>(left);
    int64_t count = 0;
    for (int64_t i = 0; i < n; i++)
      if (!any(b[i] > 0)) unknown[count++] = i;
    if (count > most) return false;
    const auto shared = [&](int64_t i, int64_t j) {
      return F(unknown[i], unknown[j]) - (all(0) + W.row(unknown[i]) * W[unknown[j]]);
    };
    bool dominant = true;
    for (int64_t i = 0; i < count; i++) {
      const Vec own = remains[unknown[i]];
      if (any(own < kLeastRest)) return false;
      right[i] = all(0);  // what it shares, in parts of its own
      for (int64_t j = 0; j < count; j++)
        if (j != i) right[i] += abs(shared(i, j));
      rest[unknown[i]] = own - right[i];
      dominant = dominant && !any(rest[unknown[i]] < kLeastRest);
      right[i] = right[i] / own;
    }
    auto L = scaled;  // by rows, Cholesky's factor of what they share
    for (double part = 1; !dominant && part <= kMostParts; part *= 2) {
      dominant = true;
      for (int64_t i = 0; i < count && dominant; i++) {
        const Vec own = remains[unknown[i]];
        rest[unknown[i]] = own / (1.0 + part * right[i]);
        for (int64_t j = 0; j <= i; j++) {
          Vec sum = i == j ? own - rest[unknown[i]] : shared(i, j);
          for (int64_t m = 0; m < j; m++) sum -= L(i, m) * L(j, m);
          if (i == j) dominant = !any((rest[unknown[i]] < kLeastRest) | ((sum <= 0) & (right[i] > kLowRankRounding)));
          L(i, j) = i == j ? sqrt(max(sum, all(0))) : select(L(j, j) > 0, sum / L(j, j), all(0));
        }
      }
    }
    return dominant;
  }
};

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
