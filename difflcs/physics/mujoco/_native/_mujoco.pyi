from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

class Library:
    def __init__(self, addresses: Mapping[str, Any], kinds: int, stride: int) -> None: ...

class Scene:
    def __init__(self, fields: Mapping[str, Any]) -> None: ...

class Place:
    def __init__(self, fields: Mapping[str, Any]) -> None: ...

class Motion:
    def __init__(self, fields: Mapping[str, Any]) -> None: ...

class Dynamics:
    def __init__(self, fields: Mapping[str, Any]) -> None: ...

def find_contacts(
    library: Library,
    scene: Scene,
    places: Sequence[Place],
    qpos: np.ndarray,
    within: np.ndarray,
    gap: np.ndarray,
    normal: np.ndarray,
    tangent: np.ndarray,
    friction: np.ndarray,
    geom: np.ndarray,
    near: np.ndarray,
) -> tuple[int, int, str]: ...
def read_motion(
    library: Library,
    motion: Motion,
    dynamics: Dynamics,
    places: Sequence[Place],
    state: np.ndarray,
    ctrl: np.ndarray,
    found: Mapping[str, np.ndarray],
) -> tuple[int, int, str]: ...
def read_rest(
    library: Library,
    motion: Motion,
    places: Sequence[Place],
    state: np.ndarray,
    ctrl: np.ndarray,
    inverse_mass: np.ndarray,
    force: np.ndarray,
    nominal: np.ndarray,
    length: np.ndarray,
    moment: np.ndarray,
    tendon: np.ndarray,
) -> tuple[int, int, str]: ...
def read_tendons(
    library: Library, places: Sequence[Place], qpos: np.ndarray, length: np.ndarray, tendon: np.ndarray
) -> tuple[int, int, str]: ...
def simulate(
    library: Library,
    motion: Motion,
    places: Sequence[Place],
    state: np.ndarray,
    ctrl: np.ndarray,
    after: np.ndarray,
) -> tuple[int, int, str]: ...
def solve_forces(
    compliance: float,
    threads: int,
    system: Mapping[str, np.ndarray],
    x: np.ndarray,
    u: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    lam: np.ndarray,
    found: np.ndarray,
) -> None: ...
def assemble(
    threads: int,
    drag: float,
    length: float,
    force: float,
    given: Mapping[str, np.ndarray],
    found: Mapping[str, np.ndarray],
) -> bool: ...
def evaluate_nominal(threads: int, given: Mapping[str, Any], found: Mapping[str, np.ndarray]) -> int: ...
def make_steps(threads: int, dynamics: Dynamics, given: Mapping[str, Any], found: Mapping[str, np.ndarray]) -> bool: ...
def correct(threads: int, still: float, fields: Mapping[str, Any], doubtful: np.ndarray) -> None: ...
