"""Numbers of the paper (Bui & Posa, LCS-RL), in percent of 1000 goals over 10 seeds."""

from __future__ import annotations

from collections.abc import Mapping

TABLE1: Mapping[str, Mapping[tuple[str, str], tuple[float, float]]] = {
    "sugar_box": {
        ("violation", "peak"): (87.5, 9.2),
        ("lcs-rl", "peak"): (95.9, 2.4),
        ("violation", "final"): (44.3, 26.2),
        ("lcs-rl", "final"): (95.9, 2.4),
    },
    "fish_can": {
        ("violation", "peak"): (59.1, 7.3),
        ("lcs-rl", "peak"): (69.9, 8.1),
        ("violation", "final"): (38.8, 13.1),
        ("lcs-rl", "final"): (69.9, 8.1),
    },
    "mug": {
        ("violation", "peak"): (32.5, 8.4),
        ("lcs-rl", "peak"): (44.6, 3.9),
        ("violation", "final"): (10.0, 6.3),
        ("lcs-rl", "final"): (44.6, 3.9),
    },
    "wrench": {
        ("violation", "peak"): (45.5, 8.7),
        ("lcs-rl", "peak"): (60.0, 6.5),
        ("violation", "final"): (11.5, 8.6),
        ("lcs-rl", "final"): (59.5, 6.6),
    },
    "clamp": {
        ("violation", "peak"): (24.7, 5.3),
        ("lcs-rl", "peak"): (39.3, 9.7),
        ("violation", "final"): (6.1, 5.6),
        ("lcs-rl", "final"): (38.7, 10.2),
    },
    "banana": {
        ("violation", "peak"): (28.4, 5.8),
        ("lcs-rl", "peak"): (35.5, 5.3),
        ("violation", "final"): (7.5, 6.6),
        ("lcs-rl", "final"): (35.5, 5.3),
    },
}
"""Table I: object → (method, when) → mean, standard deviation."""

CURVES: Mapping[str, Mapping[float, float]] = {
    "lcs-rl": {6.0: 55.0, 25.0: 65.0, 30.0: 71.4},
    "violation": {7.0: 55.0, 30.0: 30.0},
    "ppo": {30.0: 10.0},
    "pddm": {30.0: 20.0},
}
"""The cube (section "Results of the TriFinger Moving Cube Task"): method → minutes of data → success.

What the text says; the curves themselves were not read off the figure. Violation-only peaks at 55 % after 7 minutes and
stops at about 30 %; LCS-RL has the same success at 6 minutes, reaches 65 % after 25 minutes and 71.4 % at the end; PPO
without warm-up and PDDM end at 10 and 20 %. At 6 minutes 55 % is therefore a little too high.
"""

TRANSFER = "higher final success from the cube's model in all objects except the sugar box"
"""Fig. transfer_learning, as the text sums it up; it gives no numbers."""
