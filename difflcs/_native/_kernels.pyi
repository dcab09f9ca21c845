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
