// The violation loss around its inner QP, compiled once per instruction set (cmake/kernels.cmake); difflcs/losses.py
// has the mathematics, and lcp.cpp solves the QP. One transition per SIMD lane.
#include "kernels.hpp"
#include "lanes.hpp"
#include "lu.hpp"
#include "matrix.hpp"

namespace difflcs::DIFFLCS_ISA {
namespace {

// Returns the lanes whose symmetric matrix, which is overwritten, is positive definite: all pivots are positive.
template <class T>
Mask positive_definite(int64_t n, T* M) {
  lu_factor(n, M);
  Mask positive = ~Mask{};
  for (int64_t i = 0; i < n; i++) {
    const Vec pivot = all(0) + M[i * n + i];
    positive &= (pivot > 0) & (pivot < 1e300);
  }
  return positive;
}

// T is the type of an entry of the system: double where the batch shares it, else Vec.
template <class T>
struct Violation {
  static constexpr bool kShared = sizeof(T) == sizeof(double);
  const ViolationBatch& batch;
  const int64_t n_x, n_u, n_lam;
  const T *A, *B, *C, *d, *D, *E, *F, *c;
  T gamma, weight;  // 1 / (gamma xi)
  T *system, *Q_each, *matrix;
  Vec *x, *u, *x_next, *z, *r, *e, *out, *sum;

  // Lays the arrays out in `memory`, or only counts them where it is null.
  int64_t layout(void* memory) {
    Arena arena{memory};
    arena.take_all(n_x, x, x_next, r);
    arena.take(u, n_u);
    arena.take(z, 2 * n_lam);
    arena.take(e, n_lam);
    arena.take(out, n_x + n_u + 2 * n_lam);
    arena.take(sum, (n_x + n_lam) * (n_x + n_u + n_lam + 1));
    arena.take(matrix, 4 * n_lam * n_lam);
    arena.take(Q_each, kShared ? 0 : 4 * n_lam * n_lam);
    arena.take(system, kShared ? 0 : (n_x + n_lam) * (n_x + n_u + n_lam + 1));
    return arena.used;
  }

  Violation(const ViolationBatch& b, void* memory) : batch(b), n_x(b.n_x), n_u(b.n_u), n_lam(b.n_lam) {
    layout(memory);
    if (!memory) return;
    const T** const field[] = {&A, &B, &C, &d, &D, &E, &F, &c};
    T* next = system;
    for (int i = 0; i < vx; i++) {
      if constexpr (kShared)
        *field[i] = batch.input[i];
      else {
        *field[i] = next;
        next += extent(batch, kViolationFields[i]);
      }
    }
    if constexpr (kShared) {
      gamma = *batch.input[vgamma];
      weight = 1.0 / (gamma * batch.xi);
    }
  }

  // Whether to stop, asked every 1024 transitions.
  bool halted(int64_t first) const { return first % 1024 == 0 && batch.watch.stop(batch.watch.context); }

  // kLanes rows of an array with `stride` numbers from one to the next; lanes past the end repeat the last row and are
  // never written back.
  void load(Vec* to, const double* from, int64_t size, int64_t stride, int64_t first) const {
    for (int l = 0; l < kLanes; l++) {
      const int64_t row = first + l < batch.count ? first + l : batch.count - 1;
      for (int64_t i = 0; i < size; i++) put(to, i, l, from[row * stride + i]);
    }
  }
  void load(Vec* to, const double* from, int64_t size, int64_t first) const { load(to, from, size, size, first); }
  // The systems of kLanes transitions, where they are not shared.
  void load_system([[maybe_unused]] int64_t first) {
    if constexpr (!kShared) {
      T* to = system;
      for (int i = 0; i < vx; i++) {
        const int64_t size = extent(batch, kViolationFields[i]);
        load(to, batch.input[i], size, batch.stride[i], first);
        to += size;
      }
      load(&gamma, batch.input[vgamma], 1, batch.stride[vgamma], first);
      weight = 1.0 / (gamma * batch.xi);
    }
  }
  void store(double* to, const Vec* from, int64_t size, int64_t first) const {
    for (int l = 0; l < kLanes && first + l < batch.count; l++)
      for (int64_t i = 0; i < size; i++) to[(first + l) * size + i] = lane_of(from[i], l);
  }

  // to += M v, or M^T v, with M (rows, columns).
  static void add_product(Vec* to, const T* M, const Vec* v, int64_t rows, int64_t columns) {
    for (int64_t i = 0; i < rows; i++)
      for (int64_t j = 0; j < columns; j++) to[i] += M[i * columns + j] * v[j];
  }
  static void add_transposed(Vec* to, const T* M, const Vec* v, int64_t rows, int64_t columns) {
    for (int64_t i = 0; i < rows; i++)
      for (int64_t j = 0; j < columns; j++) to[j] += M[i * columns + j] * v[i];
  }

  // Q = [[C^T C + F^T F / (gamma xi), (I - F^T / gamma) / xi], [its transpose, I / (gamma xi)]].
  // Returns the lanes in which it is positive definite by a margin, and gamma is in its range.
  Mask hessian(T* Q) {
    const int64_t n = n_lam, m = 2 * n_lam;
    Vec largest = all(0);
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < n; j++) {
        T cc = T{}, ff = T{};
        for (int64_t k = 0; k < n_x; k++) cc += C[k * n + i] * C[k * n + j];
        for (int64_t k = 0; k < n; k++) ff += F[k * n + i] * F[k * n + j];
        Q[i * m + j] = cc + weight * ff;
        Q[i * m + n + j] = Q[(n + j) * m + i] = (i == j ? 1.0 / batch.xi : 0.0) - weight * F[j * n + i];
        Q[(n + i) * m + n + j] = i == j ? weight : T{};
      }
    for (int64_t i = 0; i < m; i++) largest = max(all(0) + Q[i * m + i], largest);
    // The margin is in units of each variable's curvature.
    for (int64_t i = 0; i < m * m; i++) matrix[i] = i % (m + 1) == 0 ? Q[i] - 1e-13 * Q[i] : Q[i];
    const Mask convex = (largest < 1e300) & positive_definite(m, matrix);
    auto above = [&](T smallest) {  // where sigma_min(F + F^T) exceeds it
      for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++) {
          matrix[i * n + j] = F[i * n + j] + F[j * n + i];
          if (i == j) matrix[i * n + j] -= smallest;
        }
      return positive_definite(n, matrix);
    };
    // F^T F / gamma stands beside F + F^T: their difference has to survive the rounding.
    T squares = T{};
    for (int64_t i = 0; i < n; i++) {
      T total = T{};
      for (int64_t k = 0; k < n; k++) total += F[k * n + i] * F[k * n + i];
      squares = total > squares ? total : squares;
    }
    return convex & above(gamma) & above(kGammaLeast * double(n) * squares / gamma);
  }

  // Q, and q = (C^T r + F^T e / (gamma xi), -e / (gamma xi)) with r and e at z = 0.
  bool qp(double* Q, double* q) {
    Vec invalid = all(0);
    Mask convex = ~Mask{};
    if constexpr (kShared) convex = hessian(Q);
    for (int64_t first = 0; first < batch.count && !halted(first); first += kLanes) {
      if constexpr (!kShared) {
        load_system(first);
        convex &= hessian(Q_each);
        store(Q, Q_each, 4 * n_lam * n_lam, first);
      }
      load(x, batch.input[vx], n_x, first);
      load(u, batch.input[vu], n_u, first);
      load(x_next, batch.input[vx_next], n_x, first);
      for (int64_t i = 0; i < n_x; i++) r[i] = d[i] - x_next[i];
      for (int64_t i = 0; i < n_lam; i++) {
        e[i] = all(0) + c[i];
        out[i] = all(0);
      }
      add_product(r, A, x, n_x, n_x);
      add_product(r, B, u, n_x, n_u);
      add_product(e, D, x, n_lam, n_x);
      add_product(e, E, u, n_lam, n_u);
      add_transposed(out, F, e, n_lam, n_lam);
      for (int64_t i = 0; i < n_lam; i++) {
        out[i] *= weight;
        out[n_lam + i] = -weight * e[i];
      }
      add_transposed(out, C, r, n_x, n_lam);
      for (int64_t i = 0; i < 2 * n_lam; i++) invalid += 0.0 * out[i];  // NaN where anything was not finite
      store(batch.r, r, n_x, first);
      store(batch.e, e, n_lam, first);
      store(q, out, 2 * n_lam, first);
    }
    return !any(invalid != 0) && !any(~convex);
  }

  // Also whether rounding e, which is divided by gamma xi, leaves its digits: as the dual variable of the contacts,
  // F^T e / (gamma xi) balances C^T r. Returns the first transition where it does not, or -1.
  int64_t value(const double* solution, double* loss) {
    const Vec *lam = z, *phi = z + n_lam;
    int64_t lost = -1;
    for (int64_t first = 0; first < batch.count && !halted(first); first += kLanes) {
      load_system(first);
      load(r, batch.r, n_x, first);
      load(e, batch.e, n_lam, first);
      load(z, solution, 2 * n_lam, first);
      Vec *r_terms = x, *e_terms = out, *balance = out + n_lam;
      for (int64_t i = 0; i < n_x; i++) {
        r_terms[i] = abs(r[i]);
        for (int64_t j = 0; j < n_lam; j++) r_terms[i] += abs(C[i * n_lam + j] * lam[j]);
      }
      for (int64_t i = 0; i < n_lam; i++) {
        e_terms[i] = abs(e[i]) + phi[i];
        balance[i] = all(0);
        for (int64_t j = 0; j < n_lam; j++) e_terms[i] += abs(F[i * n_lam + j] * lam[j]);
      }
      for (int64_t j = 0; j < n_x; j++)
        for (int64_t i = 0; i < n_lam; i++) balance[i] += abs(C[j * n_lam + i] * r_terms[j]);
      Vec noise = all(0), signal = all(0);
      for (int64_t i = 0; i < n_lam; i++) {
        Vec rounding = all(0);
        for (int64_t j = 0; j < n_lam; j++) rounding += select(phi[j] > 0, all(0), abs(F[j * n_lam + i] * e_terms[j]));
        noise = max(noise, select(lam[i] > 0, kRounding * weight * rounding, all(0)));
        signal = max(signal, balance[i]);
      }
      const Mask unsure = (noise > 1e-6 * signal) & (signal > 0);
      for (int l = 0; l < kLanes && lost < 0; l++)
        if (unsure[l]) lost = first + l;
      add_product(r, C, lam, n_x, n_lam);
      add_product(e, F, lam, n_lam, n_lam);
      Vec rr = all(0), ee = all(0), product = all(0);
      for (int64_t i = 0; i < n_x; i++) rr += r[i] * r[i];
      for (int64_t i = 0; i < n_lam; i++) {
        // Where phi is free, e = gamma lam by stationarity, without the rounding of a difference.
        e[i] = select(phi[i] > 0, gamma * lam[i], e[i] - phi[i]);
        ee += e[i] * e[i];
        product += lam[i] * phi[i];
      }
      const Vec total = 0.5 * rr + (product + ee / (2 * gamma)) / batch.xi;
      store(batch.r, r, n_x, first);
      store(batch.e, e, n_lam, first);
      store(loss, &total, 1, first);
    }
    return lost;
  }

  // r and e are linear in every input, and by the envelope theorem z does not move.
  void gradient(const double* solution, const double* upstream, double* const to[kViolationInputs]) {
    const int64_t n_w = n_x + n_u + n_lam, rows = n_x + n_lam;
    for (int64_t i = 0; i < rows * (n_w + 1); i++) sum[i] = all(0);
    // Rows and columns of the sums that belong to each matrix.
    auto each_matrix = [&](auto visit) {
      visit(vA, 0, n_x, 0, n_x);
      visit(vB, 0, n_x, n_x, n_u);
      visit(vC, 0, n_x, n_x + n_u, n_lam);
      visit(vd, 0, n_x, n_w, 1);
      visit(vD, n_x, n_lam, 0, n_x);
      visit(vE, n_x, n_lam, n_x, n_u);
      visit(vF, n_x, n_lam, n_x + n_u, n_lam);
      visit(vc, n_x, n_lam, n_w, 1);
    };
    for (int64_t first = 0; first < batch.count && !halted(first); first += kLanes) {
      load_system(first);
      Vec scale;
      load(&scale, upstream, 1, first);
      for (int l = 0; l < kLanes; l++)
        if (first + l >= batch.count) scale[l] = 0;
      load(r, batch.r, n_x, first);
      load(e, batch.e, n_lam, first);
      load(z, solution, 2 * n_lam, first);
      load(x, batch.input[vx], n_x, first);
      load(u, batch.input[vu], n_u, first);
      for (int64_t i = 0; i < n_x; i++) r[i] *= scale;
      for (int64_t i = 0; i < n_lam; i++) e[i] *= weight * scale;
      // One row per residual, one column for each of x, u, lam and 1.
      for (int64_t i = 0; i < rows; i++) {
        Vec *row = sum + i * (n_w + 1), residual = i < n_x ? r[i] : e[i - n_x];
        for (int64_t j = 0; j < n_x; j++) row[j] += residual * x[j];
        for (int64_t j = 0; j < n_u; j++) row[n_x + j] += residual * u[j];
        for (int64_t j = 0; j < n_lam; j++) row[n_x + n_u + j] += residual * z[j];
        row[n_w] += residual;
      }
      // What belongs to these transitions alone is no sum.
      if constexpr (!kShared)
        each_matrix([&](ViolationInput which, int64_t first_row, int64_t count, int64_t from, int64_t columns) {
          if (!batch.stride[which]) return;
          for (int64_t i = 0; i < count; i++)
            for (int64_t j = 0; j < columns; j++) {
              Vec& entry = sum[(first_row + i) * (n_w + 1) + from + j];
              for (int l = 0; l < kLanes && first + l < batch.count; l++)
                to[which][(first + l) * count * columns + i * columns + j] = entry[l];
              entry = all(0);
            }
        });
      auto datum = [&](ViolationInput which, const T* of_r, const T* of_e, int64_t size) {
        if (!to[which]) return;
        for (int64_t i = 0; i < size; i++) out[i] = all(0);
        add_transposed(out, of_r, r, n_x, size);
        add_transposed(out, of_e, e, n_lam, size);
        store(to[which], out, size, first);
      };
      datum(vx, A, D, n_x);
      datum(vu, B, E, n_u);
      if (to[vx_next]) {
        for (int64_t i = 0; i < n_x; i++) out[i] = -r[i];
        store(to[vx_next], out, n_x, first);
      }
    }
    each_matrix([&](ViolationInput which, int64_t first_row, int64_t count, int64_t from, int64_t columns) {
      if (batch.stride[which]) return;
      for (int64_t i = 0; i < count; i++)
        for (int64_t j = 0; j < columns; j++) {
          double total = 0;
          for (int l = 0; l < kLanes; l++) total += lane_of(sum[(first_row + i) * (n_w + 1) + from + j], l);
          to[which][i * columns + j] = total;
        }
    });
  }
};

// Calls f with the code that fits: the system shared by the batch, or not.
template <class Function>
auto dispatch(const ViolationBatch& batch, void* memory, Function f) {
  if (batch.shared) return f(Violation<double>(batch, memory));
  return f(Violation<Vec>(batch, memory));
}

}  // namespace

int64_t violation_workspace(const ViolationBatch& batch) {
  return dispatch(batch, nullptr, [](auto violation) { return violation.layout(nullptr); });
}

bool violation_qp(const ViolationBatch& batch, double* Q, double* q, void* workspace) {
  return dispatch(batch, workspace, [&](auto violation) { return violation.qp(Q, q); });
}

int64_t violation_value(const ViolationBatch& batch, const double* z, double* loss, void* workspace) {
  return dispatch(batch, workspace, [&](auto violation) { return violation.value(z, loss); });
}

void violation_gradient(const ViolationBatch& batch, const double* z, const double* upstream,
                        double* const gradient[kViolationInputs], void* workspace) {
  dispatch(batch, workspace, [&](auto violation) { violation.gradient(z, upstream, gradient); });
}

}  // namespace difflcs::DIFFLCS_ISA
