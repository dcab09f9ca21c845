import numpy as np

def isa() -> str: ...
def solve_lcp(
    F: np.ndarray,
    q: np.ndarray,
    relaxation: float,
    max_iter: int,
    threads: int,
    lam: np.ndarray,
    w: np.ndarray,
    status: np.ndarray,
    iterations: np.ndarray,
) -> None: ...
def solve_mpc(
    inputs: list[np.ndarray],
    horizon: int,
    relaxation: float,
    u_start: np.ndarray | None,
    lam_start: np.ndarray | None,
    first_relaxation: float,
    shrink: float,
    tol: float,
    max_iter: int,
    threads: int,
    x: np.ndarray,
    u: np.ndarray,
    lam: np.ndarray,
    objective: np.ndarray,
    residual: np.ndarray,
    status: np.ndarray,
    iterations: np.ndarray,
) -> None: ...
def vjp_mpc(
    inputs: list[np.ndarray],
    horizon: int,
    relaxation: float,
    x: np.ndarray,
    u: np.ndarray,
    lam: np.ndarray,
    x_bar: np.ndarray,
    u_bar: np.ndarray,
    lam_bar: np.ndarray,
    objective_bar: np.ndarray,
    solved: np.ndarray,
    threads: int,
    gradients: list[np.ndarray],
) -> None: ...
