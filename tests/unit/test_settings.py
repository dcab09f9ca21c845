"""Settings: types, bounds and groups; what `difflcs train` takes, all of it bounded."""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any, Literal, get_args, get_type_hints

import pytest

from difflcs.errors import CheckpointError, DTypeError, InvalidInputError
from difflcs.rl.methods import DEFAULT_METHOD, LCSMethod, get_method, method_names
from difflcs.rl.runs.training import TrainConfig, count_episodes, count_goals_due
from difflcs.rl.settings import Rollouts, Settings, bounded, from_json, group
from difflcs.rl.tasks import get_task
from tests.conftest import refuse


@dataclass(frozen=True)
class Inner(Settings):
    count: int = bounded(3, minimum=1, maximum=9)
    share: float = bounded(0.5, above=0, below=1)


@dataclass(frozen=True)
class Outer(Settings):
    inner: Inner = group(Inner, count=4)
    pair: tuple[float, float] = bounded((0.1, 0.2), minimum=0, below=1)
    many: tuple[int, ...] = bounded((), minimum=1)
    maybe: int | None = bounded(None, minimum=1)
    kind: Literal["a", "b"] = "a"
    flag: bool = False
    text: str = ""
    size: int = bounded(0, minimum=0)


def test_the_defaults_of_a_group_can_be_others():
    assert Outer().inner == Inner(count=4)
    assert Inner().count == 3


@pytest.mark.parametrize("values", [{"count": 1}, {"count": 9}, {"share": 1e-9}, {"share": 0.999}])
def test_bounds_that_are_reached(values):
    assert asdict(Inner(**values)).items() >= values.items()


OUTSIDE = {  # numbers outside their bounds
    (Inner, "count"): (0, 10, 10**5000),
    (Inner, "share"): (0.0, 1.0, math.nan, math.inf),
    (Outer, "pair"): ((0.5, 1.0), (-0.1, 0.5)),
    (Outer, "many"): ((1, 0),),
    (Outer, "maybe"): (0,),
    (Outer, "size"): (2**63,),
}
OTHERS = {  # values of another type
    (Outer, "inner"): (3, {"count": 3}),
    (Outer, "pair"): ((0.1,), (0.1, 0.2, 0.3), 0.1, ("a", "b")),
    (Outer, "many"): ((1.5,),),
    (Outer, "maybe"): (1.5, True),
    (Outer, "kind"): ("c", None),
    (Outer, "flag"): (1,),
    (Outer, "text"): (1,),
    (Outer, "size"): (1.0, True, "1"),
}


@pytest.mark.parametrize(("kind", "name"), dict.fromkeys([*OUTSIDE, *OTHERS]))
def test_values_that_do_not_fit_are_refused_by_name(kind, name):
    for value in OUTSIDE.get((kind, name), ()):
        refuse(InvalidInputError, rf"{name}: expected a finite .*{name}", kind, **{name: value})
    for value in OTHERS.get((kind, name), ()):
        refuse(DTypeError, name, kind, **{name: value})


def test_integers_stand_for_floats_and_none_where_it_is_declared():
    assert Outer(pair=(0, 0)).pair == (0, 0)
    assert Outer(maybe=None).maybe is None
    assert Outer(maybe=2**63 - 1, size=2**63 - 1).size == 2**63 - 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inner": {"count": 3}}, "fields"),
        ({"inner": {"count": 3, "share": 0.5, "more": 1}}, "fields"),
        ({"inner": {"count": 0, "share": 0.5}}, "count"),
        *(({"inner": wrong}, "inner") for wrong in [[3, 0.5], None]),
        ({"another": 1}, "fields"),
        ({"pair": [0.1, 2.0]}, "pair"),
        ({"kind": "c"}, "kind"),
        ({"size": "5"}, "size"),
    ],
)
def test_json_that_does_not_fit_is_refused(change, message):
    plain = json.loads(json.dumps(asdict(Outer())))
    refuse(CheckpointError, message, from_json, {**plain, **change}, Outer)
    del plain["size"]
    refuse(CheckpointError, "fields", from_json, plain, Outer)


def groups(kind: type[Any]) -> Iterator[type[Any]]:
    """A dataclass of settings and those in it."""
    yield kind
    for hint in get_type_hints(kind).values():
        if is_dataclass(hint) and isinstance(hint, type) and hint is not kind:
            yield from groups(hint)


def all_groups() -> list[type[Any]]:
    """Those of difflcs: other tests of the same process may have registered methods of their own."""
    methods = [method for method in map(get_method, method_names()) if method.__module__.startswith("difflcs.")]
    found = dict.fromkeys(one for method in methods for one in groups(method))
    return [TrainConfig, *found]


def numbers_in(hint: Any) -> bool:
    return hint in (int, float) or any(numbers_in(part) for part in get_args(hint) if not isinstance(part, str))


@pytest.mark.parametrize("kind", all_groups(), ids=lambda kind: kind.__name__)
def test_every_setting_that_is_a_number_has_bounds(kind):
    """That each says what it is, docs/generated.py asks for."""
    assert issubclass(kind, Settings)
    hints = get_type_hints(kind)
    for f in fields(kind):
        if numbers_in(hints[f.name]):
            assert any(bound is not None for bound in f.metadata.values()), f"{kind.__name__}.{f.name} has no bounds"
        if f.name in ("n_lam", "width", "networks", "samples", "minutes") or kind is Rollouts:  # what needs memory
            assert f.metadata["maximum"] is not None, f"{kind.__name__}.{f.name} has no maximum"


def test_a_method_stands_for_its_name():
    assert TrainConfig(method="ppo") == TrainConfig(method=get_method("ppo")())  # pyright: ignore[reportArgumentType]
    assert TrainConfig().method == get_method(DEFAULT_METHOD)()
    assert isinstance(TrainConfig().method, LCSMethod)


def test_evaluations_fall_due_once():
    config = TrainConfig(minutes=2.0, evaluate_at=(0.0, 0.5, 1.0, 1.1), evaluate_goals=60, final_goals=300)
    due = {now: count_goals_due(config, now - 100, now, get_task("cube")) for now in range(0, 1300, 100)}
    assert {k: v for k, v in due.items() if v} == {0: 300, 300: 60, 600: 60, 700: 60, 1200: 300}


@pytest.mark.parametrize("minutes", [0.01, 0.75, 1.01, 3.75, 6.7, 12.75, 30.0])
def test_the_last_evaluation_is_never_left_out(minutes):
    """Also where the minutes are no whole number of episodes."""
    task, config = get_task("cube"), TrainConfig(minutes=minutes, evaluate_at=(), final_goals=300)
    last = count_episodes(minutes, task) * task.episode_steps
    assert count_goals_due(config, last - 20, last, task) == 300
    assert count_goals_due(config, last - 40, last - 20, task) == 0
