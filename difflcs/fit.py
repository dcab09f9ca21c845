"""Transitions from episodes, and a report on how well a system predicts them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from difflcs import _checks
from difflcs._optional import require
from difflcs.errors import InvalidInputError, NonFiniteError, ShapeError
from difflcs.losses import params_of_transitions
from difflcs.records import SYSTEM, LCSModule, LCSParams, advance, system_at

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Transitions(NamedTuple):
    """Transitions of a system, in order within each episode; can be unpacked into a loss.

    Attributes:
        x: (N, n_x) states.
        u: (N, n_u) actions.
        x_next: (N, n_x) next states. Where x_next[k] is x[k + 1], the two belong to one episode.
    """

    x: Tensor
    u: Tensor
    x_next: Tensor

    @classmethod
    def from_episodes(
        cls, states: Iterable[ArrayLike], actions: Iterable[ArrayLike], episode: ArrayLike | None = None
    ) -> Transitions:
        """Pair states with actions and next states, never across the end of an episode.

        Args:
            states: for each episode (T+1, n_x), as an environment returns them; NumPy or torch.
            actions: for each episode (T, n_u).
            episode: None; or (N,) the number of the episode of each row of a log, such as a column of a CSV file.
                States are then (N, n_x) and actions (N, n_u), the action of a row being taken in its state. The last
                row of an episode has no next state, and its action is not used.

        Returns:
            Transitions in float64.

        Raises:
            ShapeError: an episode has not one state more than actions, or rows do not fit each other.
            NonFiniteError: a number is NaN or infinite; leave out the episode.
            InvalidInputError: there are no transitions.
        """
        if episode is None:
            each = [
                [_rows(name, v) for v in (value if isinstance(value, Iterable) else [value])]
                for name, value in (("states", states), ("actions", actions))
            ]
            if len(each[0]) != len(each[1]):
                raise ShapeError(f"actions: expected {len(each[0])} episodes, got {len(each[1])}; pair with states")
            pairs = list(zip(*each, strict=True))
        else:
            s, u, number = _rows("states", states), _rows("actions", actions), np.asarray(episode)
            if not len(s) == len(u) == number.size:
                raise ShapeError(
                    f"episode: expected one number for each row, got {number.size} for {len(s)} states and {len(u)} "
                    f"actions; pass columns of one log"
                )
            if bool((number != number).any()):
                raise NonFiniteError("episode: expected a number for each row, got NaN; leave out rows without one")
            ends = np.flatnonzero(number[1:] != number[:-1]) + 1
            cuts = [0, *ends.tolist(), len(s)]
            pairs = [(s[a:b], u[a : b - 1]) for a, b in itertools.pairwise(cuts)]
        for k, (s, u) in enumerate(pairs):
            for name, value, first in zip(("states", "actions"), (s, u), pairs[0], strict=True):
                _checks.check_tensor(f"{name}[{k}]", value, [("n", first.shape[1])])
            if len(s) != len(u) + 1:
                raise ShapeError(
                    f"states[{k}]: expected one state more than the {len(u)} actions, got {len(s)}; keep the first and "
                    f"the last state of each episode"
                )
        if not sum(len(u) for _, u in pairs):
            raise InvalidInputError("actions: expected at least one transition, got none; give episodes of some steps")
        return cls(*(torch.cat(v) for v in zip(*((s[:-1], u, s[1:]) for s, u in pairs), strict=True)))

    def split(self, share: float = 0.2, seed: int = 0) -> tuple[Transitions, Transitions]:
        """Split into transitions to fit to and to test on, by whole episodes drawn at random.

        Args:
            share: of the episodes that are to test on, at least one, above 0 and below 1.
            seed: of the drawing.
        """
        share = _checks.check_number("share", share, strict=True)
        number = (~_continues(self.x, self.x_next)).roll(1).cumsum(0) - 1
        number = number - number[0]
        count = int(number[-1]) + 1
        if share >= 1 or count < 2:
            raise InvalidInputError(
                f"share: expected less than 1 of at least two episodes, got {share:g} of {count}; "
                f"split one long episode by hand"
            )
        random = np.random.default_rng(_checks.check_positive_int("seed", seed, minimum=0))
        drawn = random.permutation(count)[: min(max(1, round(share * count)), count - 1)]
        test = torch.isin(number, torch.as_tensor(drawn, device=number.device))
        return Transitions(*(v[~test] for v in self)), Transitions(*(v[test] for v in self))


@dataclass(frozen=True)
class FitReport:
    """Errors of a system's predictions on transitions, by state, by contact and by number of steps.

    Errors are root mean squares. Those of single states are fractions of `step`: standing still has 1.

    Attributes:
        step: (n_x,) how far each state moves in a step [its unit].
        error: (n_x,) of one step of the system.
        linear: (n_x,) of an affine system by least squares, which has no contacts.
        acts: (n_lam,) share of the transitions in which a force is larger than its gap.
        without: (n_lam,) factor by which the error of all states together grows if this force is removed.
        gain: (N, n_lam) how much more squared error each transition has without a force: the data that it explains.
        rollout: (H, 3) error after 1 to H steps of the system, of the affine system and of standing still, in parts of
            the spread of the states; NaN where no episode is that long.
    """

    step: Tensor
    error: Tensor
    linear: Tensor
    acts: Tensor
    without: Tensor
    gain: Tensor
    rollout: Tensor

    def __str__(self) -> str:
        """Show three tables."""
        lines = ["state        step     error    affine   (standing still: 1)"]
        for i, row in enumerate(zip(self.step, self.error, self.linear, strict=True)):
            lines.append(f"{i:5d} {row[0]:11.3g} {row[1]:9.3f} {row[2]:9.3f}")
        lines.append("force     acts in   error without it")
        for i, (acts, factor) in enumerate(zip(self.acts, self.without, strict=True)):
            lines.append(f"{i:5d} {100 * acts:9.1f} %   × {factor:.2f}" if acts else f"{i:5d}     never")
        lines.append("steps     error    affine   still   (in parts of the spread of the states)")
        for h, row in enumerate(self.rollout, 1):
            if bool(row.isfinite().all()) and (h in (1, 2, 3, 5) or h % 10 == 0 or h == len(self.rollout)):
                lines.append(f"{h:5d} {row[0]:9.3f} {row[1]:9.3f} {row[2]:7.3f}")
        return "\n".join(lines)

    def plot(self) -> Figure:
        """Draw the three tables; needs matplotlib."""
        require("matplotlib")
        from difflcs._figure import page_figure

        with page_figure() as figure:
            panels = figure.subplot_mosaic([["states", "forces"], ["steps", "steps"]])
            states, forces, steps = panels["states"], panels["forces"], panels["steps"]
            place = np.arange(len(self.error))
            states.bar(place - 0.2, self.error.numpy(), 0.4, label="system")
            states.bar(place + 0.2, self.linear.numpy(), 0.4, label="affine")
            states.axhline(1, color="gray", lw=1)
            states.set(title="error of a step (standing still: 1)", xlabel="state", xticks=place)
            forces.bar(np.arange(len(self.acts)), 100 * self.acts.numpy())
            forces.set(title="acts in [%] of the steps", xlabel="force", xticks=np.arange(len(self.acts)))
            for column, name in enumerate(("system", "affine", "standing still")):
                colour = ("C0", "C1", "gray")[column]
                steps.plot(1 + np.arange(len(self.rollout)), self.rollout[:, column].numpy(), color=colour, label=name)
            steps.set(title="error after some steps, in parts of the spread of the states", xlabel="steps")
            steps.set_ylim(0, None)
            steps.legend(frameon=False)
        return figure


@_checks.takes_arrays
def fit_report(
    system: LCSModule | LCSParams,
    x: Tensor,
    u: Tensor,
    x_next: Tensor,
    *,
    train: Sequence[Tensor] | None = None,
    horizon: int = 10,
    context: Tensor | None = None,
) -> FitReport:
    """Measure how well a system predicts transitions that it was not fitted to.

    It predicts through the exact LCP, as it does in a plan, so reports of fits with different ξ or γ can be compared,
    which their losses cannot. Two others predict the same: an affine system by least squares, and standing still. A
    system whose contacts are of use beats both.

    Args:
        system: a learned model or any other `LCSModule`, or one system without batch dimensions.
        x: (N, n_x) states.
        u: (N, n_u) actions.
        x_next: (N, n_x) next states. Rollouts go from row to row as long as x_next[k] is x[k + 1], and so never across
            the end of an episode.
        train: x, u and x_next that the system was fitted to, and that the affine system is fitted to as well. Without
            them it is fitted to the transitions of the report, which flatters it.
        horizon: the largest number of steps of a rollout, ≥ 1.
        context: (N, n_context) passed on to the `params` of an `LCSModule`.

    Raises:
        ShapeError, DTypeError, DeviceError, NonFiniteError, InvalidInputError: the arguments do not fit.
    """
    horizon = _checks.check_positive_int("horizon", horizon)
    with torch.no_grad():
        params = params_of_transitions(system, x, u, x_next, context)
        if not x.ndim == u.ndim == x_next.ndim == 2 or not len(x) == len(u) == len(x_next) > 1:
            shapes = ", ".join(str(tuple(v.shape)) for v in (x, u, x_next))
            raise ShapeError(f"x, u, x_next: expected (N, n) of the same N > 1 transitions, got {shapes}")

        def at(rows: Tensor | slice, x: Tensor) -> LCSParams:
            if isinstance(system, LCSParams):
                return system
            return system_at(system, x, None if context is None else context[rows])  # pyright: ignore[reportReturnType]

        move = x_next - x
        # What never moves counts in its own unit.
        step, spread = (torch.where(v > 0, v, torch.ones_like(v)) for v in (_rms(move), x.std(0, correction=0)))
        prediction = advance(params, x, u)
        x_fit, u_fit, x_next_fit = _check_training(train or (x, u, x_next), x, u)
        solution = torch.linalg.lstsq(_regressors(x_fit, u_fit), x_next_fit - x_fit).solution

        squared = ((prediction.x_next - x_next) / step).square().sum(1)
        lam, without = prediction.lam, []
        for i in range(system.n_lam):
            others = [j for j in range(system.n_lam) if j != i]
            guess = advance(_keep_forces(params, others), x, u).x_next if others else params.next_state(x, u, 0 * lam)
            without.append(((guess - x_next) / step).square().sum(1) - squared)
        gain = torch.stack(without, 1) if without else x.new_zeros(len(x), 0)
        base = squared.mean().clamp_min(1e-300)
        linear, ends, rollout = _affine(solution, x, u), _continues(x, x_next), []
        rows = torch.arange(len(x), device=x.device)
        predictions = [prediction.x_next, linear, x]
        for h in range(horizon):
            if h:
                on = ends[rows + h - 1]
                rows, (reached, by_affine, still) = rows[on], (v[on] for v in predictions)
                now, action = rows + h, u[rows + h]
                moved = advance(at(now, reached), reached, action).x_next
                predictions = [moved, _affine(solution, by_affine, action), still]
            errors = [(v - x_next[rows + h]) / spread for v in predictions]
            rollout.append(torch.stack([_rms(error).square().mean().sqrt() for error in errors]))
        return FitReport(
            step=step,
            error=_rms(prediction.x_next - x_next) / step,
            linear=_rms(linear - x_next) / step,
            acts=(lam > params.gap(x, u) + (params.F @ lam.unsqueeze(-1)).squeeze(-1)).double().mean(0),
            without=((base + gain.mean(0)) / base).sqrt(),
            gain=gain,
            rollout=torch.stack(rollout),
        )


def _rows(name: str, value: Any) -> Tensor:
    """Convert rows of numbers to a finite matrix in float64."""
    rows = value.detach().double() if isinstance(value, Tensor) else torch.from_numpy(_checks.check_array(name, value))
    return _checks.check_shape(name, rows, "T n", remedy="give one row for each step")


def _continues(x: Tensor, x_next: Tensor) -> Tensor:
    """(N,) whether the next transition begins where this one ends; the last has none."""
    return torch.cat([(x[1:] == x_next[:-1]).all(1), x.new_zeros(1, dtype=torch.bool)])


def _keep_forces(params: LCSParams, kept: Sequence[int]) -> LCSParams:
    """Leave out all forces but some."""
    values = {}
    for name, dims in SYSTEM.items():
        value = getattr(params, name)
        for place, dim in enumerate(dims):
            if dim == "n_lam":
                value = value.index_select(value.ndim - len(dims) + place, torch.as_tensor(kept, device=value.device))
        values[name] = value
    return LCSParams(**values)


def _check_training(train: Any, x: Tensor, u: Tensor) -> Sequence[Tensor]:
    """Check transitions that something was fitted to, and convert them like these states and actions."""
    if not isinstance(train, Sequence) or len(train) != 3:
        raise InvalidInputError(f"train: expected x, u and x_next, got {_checks.describe(train)}; give three tensors")
    train = [_rows(f"train {name}", value).to(x) for name, value in zip(("x", "u", "x_next"), train, strict=True)]
    for name, value, like in zip(("x", "u", "x_next"), train, (x, u, x), strict=True):
        _checks.check_dims(f"train {name}", value, [("N", len(train[0])), ("n", like.shape[1])])
    return train


def _regressors(x: Tensor, u: Tensor) -> Tensor:
    return torch.cat([x, u, torch.ones_like(x[:, :1])], 1)


def _affine(solution: Tensor, x: Tensor, u: Tensor) -> Tensor:
    return x + _regressors(x, u) @ solution


def _rms(rows: Tensor) -> Tensor:
    return rows.square().mean(0).sqrt()
