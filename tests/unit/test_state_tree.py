"""States as trees: flattened and put together again, compared, and taken back where they do not fit."""

import json
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difflcs.errors import CheckpointError
from difflcs.rl.learning.state_tree import check_state, copy_state, flatten, restore, unflatten
from tests.conftest import refuse

NAMES = st.text("abcxyz_.0 é", min_size=1, max_size=5)
NUMBERS = st.integers(-(2**200), 2**200) | st.floats(allow_nan=False) | st.booleans() | st.none() | st.text(max_size=5)
TENSORS = st.lists(st.floats(allow_nan=False, width=32), max_size=4).map(torch.tensor) | st.integers(0, 9).map(
    torch.tensor
)
TREES = st.recursive(
    st.dictionaries(NAMES, NUMBERS | TENSORS, max_size=4),
    lambda inner: st.dictionaries(NAMES, NUMBERS | TENSORS | inner, max_size=4),
    max_leaves=12,
)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(value, other[name]) for name, value in one.items())
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and one == other


@settings(max_examples=50, deadline=None)
@given(TREES)
def test_a_tree_comes_back(tree):
    tensors, rest = flatten(tree)
    assert all(isinstance(value, torch.Tensor) for value in tensors.values())
    assert same(unflatten(tensors, json.loads(json.dumps(rest))), tree)
    assert same(copy_state(tree), tree)


def test_a_tensor_whose_path_leads_nowhere_stays_at_the_top():
    tree = unflatten({"a/b/c": torch.zeros(1)}, {"a": 3})
    assert set(tree) == {"a", "a/b/c"}
    refuse(CheckpointError, "a/b/c", check_state, {"a": 3}, tree)


def make_state() -> dict[str, Any]:
    return {
        "iteration": 3,
        "step_size": 0.25,
        "phase": "main",
        "models": None,
        "on": True,
        "learned": {
            "settings": {"n_x": 2, "widths": [1, 2]},
            "parameters": {"A": torch.zeros(2, 3), "count": torch.tensor(4)},
        },
        "episodes": {"state": torch.zeros(5, 3, 2), "action": torch.zeros(5, 2, 1)},
        "random": {"noise": np.random.default_rng(0).bit_generator.state},
    }


CHANGES: dict[str, Any] = {
    "iteration": [None, True, -1, 3.0, "3", 2**63, [3], torch.tensor(3), {}],
    "step_size": [None, 1, math.nan, math.inf, "0.25", torch.tensor(0.25)],
    "phase": [None, "warmup", 3],
    "models": [3, {}, torch.zeros(1)],
    "on": [1, None, "True"],
    "learned": [None, 3, {}, {"settings": {}}, []],
    "learned.settings": [None, {}, {"n_x": 3, "widths": [1, 2]}, {"n_x": 2, "widths": [1]}],
    "learned.parameters.A": [
        None, 0.0, torch.zeros(3, 2), torch.zeros(2, 3, 1), torch.zeros(2, 3).double(), torch.zeros(2, 3).long(),
        torch.full((2, 3), math.nan), torch.full((2, 3), math.inf),
    ],
    "learned.parameters.count": [4, torch.tensor(4.0), torch.tensor([4])],
    "episodes.state": [
        torch.zeros(4, 3, 2), torch.zeros(5, 3, 1), torch.zeros(5, 3), torch.zeros(5, 3, 2, 1),
        torch.full((5, 3, 2), math.nan), None,
    ],
    "episodes": [{"state": torch.zeros(5, 3, 2)}, None],
    "random.noise.state.state": [None, -1, 0.5, "1"],
    "random.noise.bit_generator": ["MT19937", None],
}  # fmt: skip


def changed(path: str, value: Any) -> dict[str, Any]:
    state = copy_state(make_state())
    *folders, name = path.split(".")
    place = state
    for folder in folders:
        place = place[folder]
    place[name] = value
    return state


@pytest.mark.parametrize(
    ("path", "number"), [(path, n) for path, values in CHANGES.items() for n in range(len(values))]
)
def test_every_single_change_is_refused_by_name(path, number):
    value = CHANGES[path][number]
    refuse(CheckpointError, path.split(".")[0], check_state, make_state(), changed(path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("iteration", 7),
        ("iteration", 0),
        ("step_size", 0.5),
        ("on", False),
        ("learned.parameters.A", torch.ones(2, 3)),
        ("random.noise.state.state", 2**127),
    ],
)
def test_values_that_may_differ_do(path, value):
    check_state(make_state(), changed(path, value))


def test_episodes_are_any_number_of_rows_as_many_in_each():
    more = changed("episodes", {"state": torch.ones(9, 3, 2), "action": torch.ones(9, 2, 1)})
    check_state(make_state(), more)
    none = changed("episodes", {"state": torch.ones(0, 3, 2), "action": torch.ones(0, 2, 1)})
    check_state(make_state(), none)


@pytest.mark.parametrize("found", [None, 3, [], "x"])
def test_what_is_no_tree_is_refused(found):
    refuse(CheckpointError, "expected", check_state, make_state(), found)


class Part:
    """Refuses a negative size, after it has taken the rest."""

    def __init__(self, error: type[Exception] = ValueError) -> None:
        self.weights, self.size, self.error = torch.zeros(3), 1.0, error

    def state_dict(self) -> dict[str, Any]:
        return {"weights": self.weights, "size": self.size}

    def load_state_dict(self, state: Any) -> None:
        self.weights.copy_(state["weights"])
        if state["size"] < 0:
            raise self.error("negative")
        self.size = state["size"]


@pytest.mark.parametrize("error", [ValueError, TypeError, OverflowError, CheckpointError])
def test_a_part_that_refuses_a_state_stays_as_it_was(error):
    part = Part(error)
    refuse(CheckpointError, ".", restore, part, {"weights": torch.ones(3), "size": -1.0})
    assert torch.equal(part.weights, torch.zeros(3))
    assert part.size == 1.0
    refuse(CheckpointError, r"mine\.weights", restore, part, {"weights": torch.ones(4), "size": 2.0}, "mine")
    assert torch.equal(part.weights, torch.zeros(3))
    restore(part, {"weights": torch.ones(3), "size": 2.0})
    assert torch.equal(part.weights, torch.ones(3))
    assert part.size == 2.0
