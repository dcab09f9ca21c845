// The iterations of C3+ on its condensed problem: v = G t + h for v = (u, lambda, eta), then the projection of v + w onto
// the bounds of u and onto 0 <= lambda, 0 <= eta, lambda eta = 0, pair by pair. Returns the projected v in `delta`.
void admm(int iterations, int stages, int n_u, int n_pairs, const double* G, const double* h, const double* low,
          const double* high, double prefer, double growth, double* t, double* w, double* v, double* delta) {
  const int m = n_u + 2 * n_pairs;
  for (int i = 0; i < m; i++) t[i] = w[i] = 0;
  for (int k = 0; k < iterations; k++) {
    const int stage = k < stages ? k : stages - 1;
    const double* column = G + (long)stage * m * m;  // stored by columns
    for (int i = 0; i < m; i++) v[i] = h[stage * m + i];
    for (int j = 0; j < m; j++, column += m)
      if (t[j] != 0)
        for (int i = 0; i < m; i++) v[i] += column[i] * t[j];
    for (int i = 0; i < m; i++) w[i] += v[i];
    for (int i = 0; i < n_u; i++) delta[i] = w[i] < low[i] ? low[i] : w[i] > high[i] ? high[i] : w[i];
    for (int i = n_u; i < n_u + n_pairs; i++) {
      const double lam = w[i], eta = w[i + n_pairs];
      const int open = prefer * eta > lam;
      delta[i] = !open && lam > 0 ? lam : 0;
      delta[i + n_pairs] = open && eta > 0 ? eta : 0;
    }
    for (int i = 0; i < m; i++) {
      w[i] = (w[i] - delta[i]) / growth;
      t[i] = delta[i] - w[i];
    }
  }
}
