// Sizes of an MPC problem, and what the solver and its certificate both need of the problem's data.
#pragma once
#include <type_traits>

#include "kernels.hpp"
#include "lanes.hpp"
#include "matrix.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

constexpr double kTiny = 1e-300;

// n_x, n_u, n_lam, n_x + n_u, n_c and the horizon; compile-time where the template argument is not zero.
template <int X, int U, int L>
struct Sizes {
  static constexpr int64_t kX = X, kU = U, kL = L, kW = X && U ? X + U : 0;
  int64_t rx, ru, rl, rc, h;
  explicit Sizes(const MpcBatch& b) : rx(b.n_x), ru(b.n_u), rl(b.n_lam), rc(b.n_c), h(b.horizon) {}
  int64_t x() const { return X ? X : rx; }
  int64_t u() const { return U ? U : ru; }
  int64_t l() const { return L ? L : rl; }
  int64_t w() const { return x() + u(); }
  int64_t c() const { return rc; }
};

using AnySizes = Sizes<0, 0, 0>;

inline bool shared_matrices(const MpcBatch& b) {
  bool shared = true;
  for (int i = 0; i < kInputs; i++) shared = shared && (kMpcFields[i].columns == Size::one || b.stride[i] == 0);
  return shared;
}

// Whether matrices are loaded once for all problems: the type of an entry says so, except with one lane.
template <class T>
bool load_once(const MpcBatch& b) {
  return kLanes > 1 ? std::is_same_v<T, double> : shared_matrices(b);
}

// R_jj + B_j' Q B_j of each action at each stage: its curvature by the next state's weights Q alone, in one lane.
// B[k] and R[k] are those of stage k, `width` the distance between two rows of B; `alike`: all stages have the same.
template <class T, class S, class Effects, class Weights, class Prices>
void curvature_at_rest(const S& n, const Effects& B, int64_t width, const Weights& Q, const T* Q_final, const Prices& R,
                       bool alike, const Steps<T>& to, int lane) {
  for (int64_t k = 0; k < n.h; k++) {
    const bool last = k == n.h - 1;
    if (alike && k > 0 && !last) {
      for (int64_t j = 0; j < n.u(); j++) put(to[k], j, lane, lane_of(to[0][j], lane));
      continue;
    }
    const T *effect = B(k), *weight = last ? Q_final : Q(k + 1), *price = R(k);
    for (int64_t j = 0; j < n.u(); j++) {
      double sum = lane_of(price[j * n.u() + j], lane);
      for (int64_t i = 0; i < n.x(); i++)
        for (int64_t m = 0; m < n.x(); m++)
          sum += lane_of(effect[i * width + j], lane) * lane_of(weight[i * n.x() + m], lane) *
                 lane_of(effect[m * width + j], lane);
      put(to[k], j, lane, sum);
    }
  }
}

// The range of an action; where it has no end, the larger of the actions' size and of a finite bound's.
inline Vec range(Vec largest_action, Vec lo, Vec hi) {
  const Vec finite = max(select(lo > -kHuge, abs(lo), all(0)), select(hi < kHuge, abs(hi), all(0)));
  return select(hi - lo > kHuge, max(largest_action, finite), hi - lo);
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
