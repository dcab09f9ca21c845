"""The terms of an LCS-MPC problem, written out as sums and products, for NumPy and for torch.

Inputs are given by the names of `MPCProblem`, and of any leading dimensions, those of stages included; `absolute` gives
the sizes of the terms.
"""


def mul(M, v):
    """M v."""
    return (M @ v[..., None])[..., 0]


def absolute(t):
    """Inputs with which a sum becomes that of the sizes of its terms."""
    return {k: -abs(v) if k == "g" else abs(v) for k, v in t.items()}


def affine(t, names, x, u, lam):
    """Left x + middle u + right λ + constant, by four names."""
    A, B, C, d = (t[name] for name in names)
    return mul(A, x) + mul(B, u) + mul(C, lam) + d


def rows(t, x, u):
    """G_x x + G_u u − g (..., H+1, n_c)."""
    value = mul(t["G_x"], x) - t["g"]
    value[..., :-1, :] += mul(t["G_u"], u)
    return value


def cost(t, x, u):
    """The objective (...) without a barrier and the price of violations."""
    now, last = x[..., :-1, :], x[..., -1:, :]
    quadratics = ((now, "Q", "q"), (u, "R", "r"), (last, "Q_final", "q_final"))
    total = sum((v * (0.5 * mul(t[M], v) + t[m])).sum((-2, -1)) for v, M, m in quadratics)
    return total + (now * mul(t["S"], u)).sum((-2, -1)) if "S" in t else total
