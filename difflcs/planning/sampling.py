"""Sampling-based contact MPC: push from here, or go to where pushing is worth more.

An MPC that linearises contact at one state sees the surface next to it as an infinite plane: it pushes well, but finds
no way round a corner. So the same MPC is solved, as one batch, from the robot's place and from many other places of its
end effectors. The gain of a place is the cost that its plan saves compared with standing still there. While the gain at
the robot's place is near the best, the robot pushes from there. Else it travels, free of collision, to the place with
the best gain after the price of the way. A place from which pushes have not changed the cost of standing still is
barred until that cost changes: round a corner a plan can predict a gain for ever that no push achieves.

Source: S. Venkatesh, B. Bianchini, A. Aydinoglu, W. Yang, M. Posa, "Approximating Global Contact-Implicit MPC via
Sampling and Local Complementarity" (arXiv:2505.13350), called sampling C3. It compares whole costs, with the cost of
travelling added, by C3 as the local controller and re-decides at each step; here the local controller is an
`LCSMPCLayer`, gains are relative to the cost of standing still, and a journey that has begun is finished.

Limits: it looks one push ahead, not two: a detour whose first push costs more than standing still is found only within
the horizon. A place is judged as if the robot were there already. The body is assumed to rest while the robot travels,
and several end effectors are assumed not to collide with each other on the way.
"""

import enum
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from difflcs import _checks
from difflcs.constraints import LinearConstraints
from difflcs.errors import InvalidInputError, ShapeError, SolveWarning
from difflcs.mpc.layer import LCSMPCLayer
from difflcs.mpc.solution import MPCSolution
from difflcs.planning.places import Places
from difflcs.planning.travel import Travel

_IDLE = 3  # pushes in succession that have changed nothing, after which the robot looks for another place

Bounds = Callable[[Tensor], tuple[Tensor, Tensor]]
"""States (n, n_x) → u_min and u_max (n, n_u), where the bounds of an action depend on the state."""
Rows = Callable[[Tensor], LinearConstraints | None]
"""States (n, n_x) → constraints of the plans from them, such as `Obstacles.constraints`; None for none."""


class Mode(enum.StrEnum):
    """Activity of the robot."""

    PUSH = "push"
    TRAVEL = "travel"


@dataclass(frozen=True)
class SamplingSettings:
    """Choice between pushing and travelling. Gains and prices are fractions of the cost of standing still.

    Attributes:
        keep: the robot goes on pushing while its gain is at least this fraction of the best score, in [0, 1].
        smallest_gain: with a smaller gain at its place the robot looks for another one.
        switch_price: price of any journey.
        travel_price: price of a journey by its length [1/length].
        patience: steps after which a journey ends wherever it is.
    """

    keep: float = 0.6
    smallest_gain: float = 0.02
    switch_price: float = 0.02
    travel_price: float = 0.0
    patience: int = 40

    def __post_init__(self) -> None:
        _checks.make_plain(self)
        for field in fields(self):
            if field.name != "patience":
                _checks.check_number(field.name, getattr(self, field.name))
        if self.keep > 1:
            raise InvalidInputError(f"keep: expected at most 1, got {self.keep:g}; it is a part of the best score")
        _checks.check_positive_int("patience", self.patience)


@dataclass(frozen=True)
class Decision:
    """Decision of the policy in one step, with the numbers behind it.

    Row 0 is where the robot is, the others are the places. While it travels nothing is compared: the attributes after
    `target` are then those of the step in which the journey began.

    Attributes:
        mode: push or travel.
        began: True if it began a journey in this step.
        chosen: row of the target, or 0.
        target: (n_x,) state to which it travels, with the body where it is now; None where it pushes.
        states: (1 + n_places, n_x) the states that were compared.
        gains: (1 + n_places,) saving of each plan; −∞ where the place is not allowed or its problem was not solved.
        scores: (1 + n_places,) gains minus the price of the path; −∞ also where a place was barred.
        standing: cost of standing still where the robot is.
        solution: the plans of all states.
    """

    mode: Mode
    began: bool
    chosen: int
    target: Tensor | None
    states: Tensor
    gains: Tensor
    scores: Tensor
    standing: float
    solution: MPCSolution

    @property
    def gain(self) -> float:
        """Gain where the robot is, as a fraction of the cost of standing still."""
        return float(self.gains[0]) / max(self.standing, 1e-300)


class SamplingPolicy:
    """Sampling-based contact MPC, see `difflcs.planning.sampling`: `u = policy.act(x, goal)`.

        policy = SamplingPolicy(mpc, DiscPlaces(shape, radius), PlanarTravel(shape, radius, step=0.02), angles=(2,))
        policy.reset()
        while ...:
            u = policy.act(x, goal)

    It keeps its mode from step to step: use one policy for each robot, and `reset` at the start of an episode. An
    action must be relative to the robot: with u = 0 it stands still.

    Args:
        mpc: a layer around any `LCSModule`, which is asked for the system at a batch of states (1 + n_places, n_x);
            with on_failure="mask", as one place without a solution must not stop the others.
        places: where the end effectors could be, see `Places`.
        travel: how they get there, see `Travel`.
        settings: when to push and when to travel.
        bounds: bounds of the actions at some states, instead of the layer's; `Workspace.bounds`, for example.
        angles: components of the goal that are angles [rad]; the state has each at the same index. Of all equivalent
            angles, the one nearest to the state is the goal.
        constraints: of plans from some states, instead of the layer's; `Obstacles.constraints`, for example.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(
        self,
        mpc: LCSMPCLayer,
        places: Places,
        travel: Travel,
        settings: SamplingSettings | None = None,
        *,
        bounds: Bounds | None = None,
        angles: Sequence[int] = (),
        constraints: Rows | None = None,
    ):
        _checks.check_kind("mpc", mpc, LCSMPCLayer, "build one around your LCSModule")
        if mpc.on_failure != "mask":
            raise InvalidInputError(
                'mpc: expected a layer with on_failure="mask", got "raise"; one place without a solution must not stop '
                "the others"
            )
        for name, function in (("bounds", bounds), ("constraints", constraints)):
            _checks.check_kind(name, function, (Callable, type(None)), "give a function of states")
        self.mpc, self.bounds, self.constraints = mpc, bounds, constraints
        self.places = _checks.check_kind("places", places, Places, "give DiscPlaces, for example")
        self.travel = _checks.check_kind("travel", travel, Travel, "give PlanarTravel, for example")
        self.settings = _checks.check_kind(
            "settings", SamplingSettings() if settings is None else settings, SamplingSettings
        )
        angles = _checks.check_list("angles", angles, "give components of the goal, such as (2,)")
        self.angles = [_checks.check_positive_int("angles", index, minimum=0) for index in angles]
        self.reset()

    def reset(self) -> None:
        """Forget the mode, as at the start of an episode."""
        self._decision: Decision | None = None
        self._place: Tensor | None = None
        self._steps = 0
        self._last: Tensor | None = None
        self._barred: list[Tensor] = []
        self._reference = self._stood = 0.0
        self._idle = 0

    @property
    def decision(self) -> Decision | None:
        """The last decision; None before the first step."""
        return self._decision

    def act(self, x: ArrayLike, goal: ArrayLike | None = None, *, context: Tensor | None = None) -> NDArray[np.float64]:
        """Decide and plan from a state.

        Args:
            x: (n_x,) the state.
            goal: (n_goal,), with a `GoalCost` or a `CostModule`.
            context: (n_context,) of the module, if its system depends on more than x.

        Returns:
            (n_u,) the action, inside the bounds where it pushes; what `travel` says where it travels.

        Raises:
            InvalidInputError and its kinds: an argument does not fit.
        """
        state, target = self._inputs(x, goal)
        with torch.no_grad():
            place = self._place
            if place is not None:
                self._steps += 1
                towards = self.places.states(state, place.unsqueeze(0))[0]
                if self._steps <= self.settings.patience and not self.travel.arrived(state, towards):
                    return self._continue_journey(state, towards)
            return self._decide(state, target, context, stay=place is not None)

    def _inputs(self, x: ArrayLike, goal: ArrayLike | None) -> tuple[Tensor, Tensor | None]:
        n_x = str(self.mpc.lcs.n_x)
        state = _checks.check_shape("x", torch.from_numpy(_checks.check_array("x", x)), n_x, remedy="give one robot's")
        if goal is None:
            return state, None
        target = _checks.check_tensor("goal", torch.from_numpy(_checks.check_array("goal", goal)))
        if target.ndim != 1 or any(index >= len(target) for index in self.angles):
            raise ShapeError(
                f"goal: expected one vector that has the angles {self.angles}, got shape {tuple(target.shape)}; "
                f"give one robot's goal"
            )
        for index in self.angles:
            target[index] += 2 * math.pi * torch.round((state[index] - target[index]) / (2 * math.pi))
        return state, target

    def _continue_journey(self, state: Tensor, towards: Tensor) -> NDArray[np.float64]:
        """Take the next step of a journey."""
        assert self._decision is not None
        self._decision = replace(self._decision, mode=Mode.TRAVEL, began=False, target=towards)
        return self.travel.action(state, towards).numpy()

    def _decide(self, state: Tensor, goal: Tensor | None, context: Tensor | None, stay: bool) -> NDArray[np.float64]:
        """Compare all places. `stay`: a journey has just ended, and at least one push comes first."""
        places = self.places.sample(state)
        states = torch.cat([state.unsqueeze(0), self.places.states(state, places)])
        allowed = self.places.allowed(states)
        allowed[0] = True
        solution = self._solve(states, goal, context)
        gains, standing = _gains(solution)
        gains = torch.where(allowed & solution.converged, gains, -math.inf)
        scale, settings = max(standing, 0.0), self.settings
        price = settings.switch_price + settings.travel_price * self.travel.distance(state, states[1:])
        scores = torch.cat([gains[:1], gains[1:] - scale * price])
        best, here = float(scores.max()), float(gains[0])
        pushes = here > settings.smallest_gain * scale and here >= settings.keep * best
        pushes = pushes and self.places.near(state) and self._moves(standing)
        chosen = 0 if stay or pushes else self._choose(states, scores, standing)
        self._place, self._steps = (places[chosen - 1].clone(), 0) if chosen else (None, 0)
        target = states[chosen] if chosen else None
        self._last = self._last if target is None else target
        mode = Mode.TRAVEL if chosen else Mode.PUSH
        self._decision = Decision(mode, bool(chosen), chosen, target, states, gains, scores, standing, solution)
        if target is not None:
            return self.travel.action(state, target).numpy()
        return solution.action[0].numpy()

    def _moves(self, standing: float) -> bool:
        """Return False if a few pushes in succession have not changed the cost of standing still."""
        pushed = self._decision is not None and self._decision.mode is Mode.PUSH
        same = abs(standing - self._stood) <= self.settings.smallest_gain * self._stood
        self._idle = self._idle + 1 if pushed and same else 0
        if not same:
            self._stood = standing
        return self._idle < _IDLE

    def _choose(self, states: Tensor, scores: Tensor, standing: float) -> int:
        """Choose the row of the place to go to; 0 where none is worth the way. Barred places get a score of −∞."""
        if abs(standing - self._reference) > self.settings.smallest_gain * self._reference:
            self._barred, self._reference = [], standing
        elif self._last is not None:
            self._barred.append(self._last)
        while True:
            best = 1 + int(scores[1:].argmax()) if len(scores) > 1 else 0
            if not best or not float(scores[best]) > 0:
                self._barred, self._last = [], None
                return 0
            if not any(self.travel.arrived(states[best], place) for place in self._barred):
                return best
            scores[best] = -math.inf

    def _solve(self, states: Tensor, goal: Tensor | None, context: Tensor | None) -> MPCSolution:
        low, high = (None, None) if self.bounds is None else _checks.check_kind("bounds(x)", self.bounds(states), tuple)
        rows = None if self.constraints is None else self.constraints(states)
        with warnings.catch_warnings():  # what was not solved is in the decision
            warnings.simplefilter("ignore", SolveWarning)
            return self.mpc(states, goal, u_min=low, u_max=high, constraints=rows, context=context)


def _gains(solution: MPCSolution) -> tuple[Tensor, float]:
    """Saving of each plan (n,) against standing still, and the cost of standing still at the first state."""
    problem = solution.problem
    planned = problem.objective(solution.x, solution.u)
    standing = problem.objective(solution.x[:, :1].expand_as(solution.x), torch.zeros_like(solution.u))
    constant = solution.objective - planned
    return standing - planned, float(standing[0] + constant[0])
