from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

class Lane:
    @property
    def time(self) -> float: ...

def make_lane(functions: Mapping[str, int], fields: Mapping[str, Any], constants: Mapping[str, float]) -> Lane: ...
def step_lanes(
    lanes: Sequence[Lane], actions: np.ndarray, states: np.ndarray, stable: np.ndarray, threads: int
) -> None: ...
