"""The scoreboard of gymnasium-robotics' Fetch tasks, on what needs no third-party model."""

from types import SimpleNamespace

import fetch_policies as fetch
import numpy as np
import pytest


def test_a_puck_that_is_hit_slides_as_far_as_friction_lets_it():
    geoms = SimpleNamespace(friction=np.array([0.1])), SimpleNamespace(friction=np.array([0.05]))
    model = SimpleNamespace(
        eq_solref=np.array([[0.02, 1.0]]),
        body=lambda name: SimpleNamespace(geomadr=[1]),
        geom=lambda of: geoms[of if of == 1 else 0],
    )
    system = fetch.sliding_system(model)
    x = system.A.new_zeros(5)
    x[4] = 0.8
    x[:3] = -1.0  # the gripper is far
    for k in range(system.horizon):
        x = system.stage(k).step(x, x.new_zeros(1)).x_next
    start, velocity = np.zeros(3), np.array([0.8, 0.0, 0.0])
    assert x[3] == pytest.approx(0.8**2 / (2 * 9.81 * 0.1), abs=2e-3)
    assert fetch.place_of_rest(start, velocity, 0.1)[0] == pytest.approx(0.8**2 / (2 * 9.81 * 0.1))
    assert fetch.place_of_rest(start, velocity, 0.1, 0.2)[0] == pytest.approx(0.16 - 0.2**2 * 0.981 / 2)
    assert abs(x[4]) < 1e-3
