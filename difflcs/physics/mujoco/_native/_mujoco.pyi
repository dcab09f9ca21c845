from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

class Library:
    def __init__(self, addresses: Mapping[str, Any], kinds: int, stride: int) -> None: ...

class Scene:
    def __init__(self, fields: Mapping[str, Any]) -> None: ...

class Place:
    def __init__(self, fields: Mapping[str, int]) -> None: ...

def find(
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
) -> tuple[int, str]: ...
