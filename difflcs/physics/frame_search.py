"""Which columns of a state are the pose of a body and points that push it: found from transitions alone."""

from itertools import permutations
from typing import NamedTuple

import torch
from torch import Tensor

from difflcs._checks import check_shape

__all__ = ["Frame", "find_frame"]

Pair = tuple[int, int]

_DRIVEN = 0.5  # an input drives a column if it explains more than this part of the variance of its change
_ERRORS = 3.0  # standard errors by which a choice has to be better than each other one
_FLOOR = 0.01  # differences of motions below this do not count
_NEWEST = 2000  # transitions that are looked at
_MOST = 50_000  # choices of a pose and a point, ten seconds' worth, from which on none is looked for


class Frame(NamedTuple):
    """Columns of a state and of an action that have a meaning in a plane. All others are plain numbers.

    Attributes:
        yaw: the column with the angle of the body [rad], from the first axis of the plane to the second.
        place: columns of its place along both axes.
        points: the same of each point that moves in the plane.
        vectors: columns of an action that are vectors in the plane.
    """

    yaw: int
    place: Pair
    points: tuple[Pair, ...]
    vectors: tuple[Pair, ...]


def find_frame(x: Tensor, u: Tensor, x_next: Tensor) -> Frame | None:
    """Find the columns of a body on a plane and of the points that push it. No column is known beforehand.

    A point that touches the body moves with it: its motion is that of the body at this place, Δp + Δyaw × r. For the
    wrong columns it is not. So each choice of columns is scored by how much the motion of one of its points, the best
    in each transition, differs from that of the body there, in parts of both. Columns that an input drives are points,
    three of the others are the pose. Each choice has to be better than every other by three standard errors: there is
    no frame before all points have touched the body.

    Args:
        x: (N, n_x) states.
        u: (N, n_u) actions.
        x_next: (N, n_x) next states.

    Returns:
        The frame, or None if there is none, or the transitions do not tell it.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """
    sizes = {"N": len(check_shape("x", x, "N n_x")), "n_x": x.shape[1]}
    check_shape("u", u, "N n_u", sizes)
    check_shape("x_next", x_next, "N n_x", sizes)
    x, u, change = x[-_NEWEST:], u[-_NEWEST:], (x_next - x)[-_NEWEST:]
    gain = torch.corrcoef(torch.cat([u, change], -1).mT)[: u.shape[1], u.shape[1] :].nan_to_num()
    drive = {int(row.abs().argmax()): a for a, row in enumerate(gain) if float(row.square().max()) > _DRIVEN}
    pairs = [(i, j) for i, j in permutations(drive, 2) if float(gain[drive[i], i] * gain[drive[j], j]) > 0]
    moved = [k for k in range(x.shape[1]) if k not in drive and bool(change[:, k].any())]
    poses = [*permutations(moved, 3)]
    if not 0 < len(poses) * len(pairs) < _MOST:
        return None
    found = [(*_points(x, change, yaw, place, pairs), yaw, place) for yaw, *place in poses]
    found = sorted((one for one in found if _is_less(*one[0])), key=lambda one: float(one[0][0].mean()))
    if not found or not all(_is_less(found[0][0][0], losses[0]) for losses, *_ in found[1:]):
        return None
    _, points, yaw, place = found[0]
    if 2 * len(points) < len(drive):
        return None
    vectors = tuple(sorted((drive[i], drive[j]) for i, j in points))
    return Frame(yaw, (place[0], place[1]), tuple(sorted(points)), vectors)


def _points(x: Tensor, change: Tensor, yaw: int, place: list[int], pairs: list[Pair]) -> tuple[Tensor, list[Pair]]:
    """Choose points for a pose, the one that explains most first.

    Returns:
        (2, N) logarithms of the difference that is left, of motions with the body and against it, which are alike where
        nothing but chance makes points move as the body; and the points up to the first that is not certain.
    """
    columns = torch.tensor(pairs)
    own, away = change[:, columns], x[:, columns] - x[:, None, place]  # (N, pairs, 2)
    body = change[:, None, place] + change[:, yaw, None, None] * torch.stack([-away[..., 1], away[..., 0]], -1)
    both = (own.square() + body.square()).sum(-1)
    apart = torch.where(both > 0, (own - body).square().sum(-1) / both, 1.0)
    apart = torch.stack([apart, 2.0 - apart])
    best, chosen, certain = torch.ones_like(apart[..., 0]), [], True
    while pairs:
        losses = (torch.minimum(best[0, :, None], apart[0]) + _FLOOR).log()
        k = int(losses.mean(0).argmin())
        rivals = [n for n, pair in enumerate(pairs) if n != k and {*pair} & {*pairs[k]}]
        others = [*losses[:, rivals].unbind(1), (best[0] + _FLOOR).log()]
        certain = certain and all(_is_less(losses[:, k], other) for other in others)
        chosen += [pairs[k]] * certain
        best = torch.minimum(best, apart[..., k])
        left = [n for n in range(len(pairs)) if n != k and n not in rivals]
        pairs, apart = [pairs[n] for n in left], apart[..., left]
    return (best + _FLOOR).log(), chosen


def _is_less(one: Tensor, other: Tensor) -> bool:
    gain = other - one
    return bool(gain.mean() > _ERRORS * gain.std() / len(gain) ** 0.5)
