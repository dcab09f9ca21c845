from typing import Any

import numpy as np

def isa() -> str: ...
def mpc_fields() -> dict[str, tuple[str, ...]]: ...
def mpc_stages() -> dict[str, str]: ...
def violation_fields() -> dict[str, tuple[str, ...]]: ...
def status_codes() -> dict[str, int]: ...
def tolerances() -> dict[str, float]: ...
def all_finite(arrays: list[np.ndarray]) -> bool: ...
def fingerprint(bytes: np.ndarray) -> int: ...
def solve_lcp(
    F: np.ndarray,
    q: np.ndarray,
    relaxation: float,
    max_iter: int,
    time_limit: float,
    threads: int,
    lam: np.ndarray,
    w: np.ndarray,
    status: np.ndarray,
) -> None: ...
def solve_mpc(
    inputs: list[np.ndarray],
    horizon: int,
    relaxation: float,
    barrier: float,
    u_start: np.ndarray | None,
    lam_start: np.ndarray | None,
    mu_start: np.ndarray | None,
    starts: int,
    groups: int,
    sure: int,
    seeks: int,
    seed: int,
    homotopy: float,
    shrink: float,
    tol: float,
    max_iter: int,
    certified: float,
    time_limit: float,
    threads: int,
    x: np.ndarray,
    u: np.ndarray,
    lam: np.ndarray,
    mu: np.ndarray,
    objective: np.ndarray,
    residual: np.ndarray,
    status: np.ndarray,
    fragile: np.ndarray,
    iterations: np.ndarray,
) -> bool: ...
def vjp_mpc(
    inputs: list[np.ndarray],
    horizon: int,
    relaxation: float,
    barrier: float,
    x: np.ndarray,
    u: np.ndarray,
    lam: np.ndarray,
    mu: np.ndarray,
    x_bar: np.ndarray,
    u_bar: np.ndarray,
    lam_bar: np.ndarray,
    objective_bar: np.ndarray,
    solved: np.ndarray,
    pivot: bool,
    threads: int,
    gradients: list[np.ndarray],
) -> None: ...
def violation_loss(
    inputs: list[np.ndarray],
    xi: float,
    max_iter: int,
    threads: int,
    Q: np.ndarray,
    q: np.ndarray,
    z: np.ndarray,
    r: np.ndarray,
    e: np.ndarray,
    loss: np.ndarray,
) -> int | None: ...
def violation_value(
    inputs: list[np.ndarray],
    xi: float,
    z: np.ndarray,
    r: np.ndarray,
    e: np.ndarray,
    loss: np.ndarray,
) -> int: ...
def violation_gradient(
    inputs: list[np.ndarray],
    xi: float,
    z: np.ndarray,
    r: np.ndarray,
    e: np.ndarray,
    upstream: np.ndarray,
    gradients: list[np.ndarray | None],
) -> None: ...

class Controller:
    def __init__(self, content: bytes) -> None: ...
    def sizes(self) -> dict[str, Any]: ...
    def step(self, x: np.ndarray, targets: np.ndarray | None, follow: bool, u: np.ndarray) -> int: ...
    def outcome(self) -> tuple[int, bool, bool, int, float, float, float]: ...
    def plan(self, x: np.ndarray, u: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> None: ...
    def reset(self) -> None: ...
    def set_time_limit(self, seconds: float) -> None: ...
    def set_fallback(self, kind: int, action: np.ndarray | None) -> None: ...
    def set_inputs(self, values: list[np.ndarray], constant: float) -> None: ...
