"""StageBounds, LinearConstraints and ConstraintSequence: what they hold, and what they refuse."""

import pytest
import torch

from difflcs import ConstraintSequence, LinearConstraints, StageBounds
from difflcs.errors import BoundsError, DTypeError, InvalidInputError, NonFiniteError, ShapeError
from tests.conftest import refuse

F64, INF, NAN = torch.float64, float("inf"), float("nan")


def full(value, *shape):
    return torch.full(shape, value, dtype=F64)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((full(0.1, 3, 2), full(-0.1, 3, 2)), BoundsError, r"u_min <= u_max, got 0.1 and -0.1 at index \(0, 0\)"),
        ((full(0.1, 3, 2), 0.0), BoundsError, "u_min <= u_max, got 0.1 and 0"),
        ((full(INF, 3, 2), None), BoundsError, "u_min: expected at least one action that it allows"),
        ((full(-1, 2), full(1, 3, 2)), ShapeError, r"u_min: expected a dimension of stages.*got \(2,\)"),
        ((full(-1, 4, 2), full(1, 3, 2)), ShapeError, "u_min: expected 3 stages.*like u_max, got 4"),
        ((full(-1, 3, 2), full(1, 3, 3)), ShapeError, r"u_m..: expected shape \(\.\.\., H=3, n_u="),
        ((full(NAN, 3, 2), None), NonFiniteError, "u_min: expected numbers or infinity, got 6 NaN of 6"),
        ((-1.0, 1.0), InvalidInputError, "by_stage: expected at least one field by stage"),
        ((torch.zeros(3, 2, dtype=torch.int64), None), DTypeError, "u_min: expected float32 or float64"),
        ((full(-1, 3, 2), "1"), DTypeError, "u_max: expected a torch.Tensor, got str"),
    ],
)
def test_stage_bounds_refuse(arguments, error, message):
    refuse(error, message, StageBounds, *arguments)


def rows(build, **changes):
    n = build.normal(0)
    return {"G": n(3, 4), "g": n(3), "E": n(3, 2), "weight": full(2.0, 3), **changes}


BAD_ROWS = [
    ({"G": full(1.0, 4)}, ShapeError, r"G: expected shape \(\.\.\., n_c, n_x\), got \(4,\)"),
    ({"g": full(1.0, 2)}, ShapeError, r"g: expected shape \(\.\.\., n_c=3\), got \(2,\)"),
    ({"E": full(1.0, 2, 2)}, ShapeError, r"E: expected shape \(\.\.\., n_c=3, n_u\), got \(2, 2\)"),
    ({"weight": full(1.0, 4)}, ShapeError, r"weight: expected shape \(\.\.\., n_c=3\), got \(4,\)"),
    ({"g": full(-INF, 3)}, InvalidInputError, "g: expected limits above −∞, got −∞; "),
    ({"weight": 0.0}, InvalidInputError, "weight: expected a positive price .*got 0; leave out"),
    ({"weight": -1}, InvalidInputError, "weight: expected a positive price .*got -1"),
    ({"weight": NAN}, NonFiniteError, "weight: expected numbers or infinity, got 3 NaN"),
    ({"weight": True}, DTypeError, "weight: expected a torch.Tensor, got bool"),
    ({"G": full(NAN, 3, 4)}, NonFiniteError, "G: expected finite numbers, got 12"),
    ({"G": full(INF, 3, 4)}, NonFiniteError, "G: expected finite numbers, got 12"),
    ({"E": full(INF, 3, 2)}, NonFiniteError, "E: expected finite numbers, got 6"),
    ({"g": full(NAN, 3)}, NonFiniteError, "g: expected numbers or infinity, got 3 NaN"),
    ({"g": [1.0, [1.0], True]}, DTypeError, "g: expected a torch.Tensor, got list"),
    ({"G": torch.ones(3, 4, dtype=torch.int64)}, DTypeError, "G: expected float32 or float64"),
    ({"G": None}, DTypeError, "G: expected a torch.Tensor, got NoneType"),
]


@pytest.mark.parametrize(("change", "error", "message"), BAD_ROWS)
def test_constraints_refuse(build, change, error, message):
    with pytest.raises(error, match=message) as caught:
        LinearConstraints(**rows(build, **change))
    assert ";" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"g": full(1.0, 3)}, ShapeError, r"g: expected a dimension of stages .*got \(3,\)"),
        ({"g": full(1.0, 5, 3)}, ShapeError, r"g: expected 4 stages, for a horizon of 3 like G, got 5"),
        ({"E": full(1.0, 4, 3, 2)}, ShapeError, r"E: expected 3 stages, for a horizon of 3 like G, got 4"),
        ({"G": full(1.0, 1, 3, 4)}, ShapeError, "G: expected at least 2 stages, got 1"),
        ({"by_stage": ("h",)}, InvalidInputError, "by_stage: expected some of G, g, E, weight, got str 'h'"),
        ({"g": full(-INF, 4, 3)}, InvalidInputError, "g: expected limits above −∞"),
    ],
)
def test_sequences_refuse(change, error, message):
    arguments = {"G": full(1.0, 4, 3, 4), "g": full(1.0, 4, 3), "E": full(1.0, 3, 3, 2), "weight": 1.0}
    ConstraintSequence(**arguments)
    refuse(error, message, ConstraintSequence, **{**arguments, **change})
