// Sizes of an MPC problem, and what the solver and its certificate both need of the problem's data.
#pragma once
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
  static constexpr bool kPivot = false;
  int64_t rx, ru, rl, rc, h;
  explicit Sizes(const MpcBatch& b) : rx(b.n_x), ru(b.n_u), rl(b.n_lam), rc(b.n_c), h(b.horizon) {}
  int64_t x() const { return X ? X : rx; }
  int64_t u() const { return U ? U : ru; }
  int64_t l() const { return L ? L : rl; }
  int64_t w() const { return x() + u(); }
  int64_t c() const { return rc; }
};

// Any sizes, and elimination with row exchanges.
struct Pivoting : Sizes<0, 0, 0> {
  static constexpr bool kPivot = true;
  using Sizes::Sizes;
};

inline bool shared_matrices(const MpcBatch& b) {
  bool shared = true;
  for (int i = 0; i < kInputs; i++) shared = shared && (kMpcFields[i].columns == Size::one || b.stride[i] == 0);
  return shared;
}

// R_jj + B_j' Q B_j of each action: its curvature by the next state's weights Q alone, in one lane. `width` is the
// distance between two rows of B.
template <class T, class S>
void curvature_at_rest(const S& n, const T* B, int64_t width, const T* Q, const T* R, T* to, int lane) {
  for (int64_t j = 0; j < n.u(); j++) {
    double sum = lane_of(R[j * n.u() + j], lane);
    for (int64_t i = 0; i < n.x(); i++)
      for (int64_t m = 0; m < n.x(); m++)
        sum += lane_of(B[i * width + j], lane) * lane_of(Q[i * n.x() + m], lane) * lane_of(B[m * width + j], lane);
    put(to, j, lane, sum);
  }
}

}  // namespace
}  // namespace difflcs::DIFFLCS_ISA
