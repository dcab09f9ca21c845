"""Paths of poses of a body on a plane round what is in the way, by Dijkstra's algorithm on a grid of poses."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor


def _shortest(turns: Tensor) -> Tensor:
    """Return the same turns within half a turn to either side [rad]."""
    return torch.remainder(turns + math.pi, 2 * math.pi) - math.pi


class BodyPaths:
    """Paths of poses of a body to a goal: Dijkstra's algorithm on a grid of poses.

    Args:
        gap: poses (..., 3) to the distance (...) between the body there and what is in the way.
        side: of the square that the body should stay in.
        room: least gap on the way.
    """

    CELL, TURNS = 0.25, 16
    """Step of the grid, and steps in a turn."""
    GYRATION = 0.4
    """Length of a rad."""
    AHEAD = 0.5
    """Least way to a subgoal."""

    def __init__(self, gap: Callable[[Tensor], Tensor], side: float, room: float = 0.08):
        self.gap, self.room = gap, room
        axis = torch.arange(0.0, side + 1e-9, self.CELL, dtype=torch.float64)
        yaw = torch.arange(self.TURNS, dtype=torch.float64) * (2 * math.pi / self.TURNS)
        self.nodes = torch.stack(torch.meshgrid(axis, axis, yaw, indexing="ij"), -1)
        self._key: Tensor | None = None

    def free(self, start: Tensor, end: Tensor, margin: float) -> bool:
        """Return True if the straight motion between two poses (3,) keeps a margin, or what its ends have."""
        way = torch.cat([(end - start)[:2], _shortest(end - start)[2:]])
        count = 2 + math.ceil(float(way.abs().max()) / 0.1)
        poses = start + torch.linspace(0.0, 1.0, count, dtype=way.dtype)[:, None] * way
        gap = self.gap(poses)
        return bool((gap >= min(margin, float(gap[0]), float(gap[-1])) - 1e-9).all())

    def subgoal(self, start: Tensor, goal: Tensor, others: Tensor) -> Tensor | None:
        """Return the farthest pose on the way from a pose to a goal that the body can go to straight.

        None where there is no way. `others` (n, 3) are the poses of what is in the way: where one has changed, the ways
        to the goal are computed anew.
        """
        if self.free(start, goal, 0.15):
            return goal
        path = self._path(start, goal, others)
        if path is None:
            return None
        ahead = [pose for pose in path if float(self._difference(pose - start)) > self.AHEAD]
        return next(
            (pose for pose in reversed(ahead) if self.free(start, pose, self.room)), ahead[0] if ahead else goal
        )

    def _path(self, start: Tensor, goal: Tensor, others: Tensor) -> list[Tensor] | None:
        """Find the poses from start to goal."""
        key = torch.cat([goal[None], others])
        if self._key is None or key.shape != self._key.shape or bool((key - self._key).abs().max() > 0.02):
            self._key = key
            self._plan(goal)
        near = self._difference(self.nodes - start)
        near = near + torch.where(torch.isfinite(torch.from_numpy(self._length)).reshape(near.shape), 0.0, math.inf)
        at = int(near.argmin())
        if not math.isfinite(float(near.flatten()[at])):
            return None
        path = []
        nodes = self.nodes.reshape(-1, 3)
        while at >= 0:
            path.append(nodes[at])
            at = int(self._next[at])
        return [*path, goal]

    def _difference(self, difference: Tensor) -> Tensor:
        turn = self.GYRATION * _shortest(difference[..., 2])
        return (difference[..., :2].square().sum(-1) + turn.square()).sqrt()

    def _plan(self, goal: Tensor) -> None:
        """Compute the way to the goal from all poses of the grid."""
        gap = self.gap(self.nodes).numpy()
        valid = gap > self.room
        price = 1.0 + 4.0 * np.clip(0.45 - gap, 0.0, None)
        index = np.arange(gap.size).reshape(gap.shape)
        rows, columns, lengths = [], [], []
        turn = self.GYRATION * 2 * math.pi / self.TURNS
        for dx, dy, dt in itertools.product((-1, 0, 1), repeat=3):
            if (dx, dy, dt) <= (0, 0, 0):
                continue
            a = index[max(0, -dx) : gap.shape[0] - max(0, dx), max(0, -dy) : gap.shape[1] - max(0, dy)]
            b = np.roll(index, -dt, axis=2)[max(0, dx) :, max(0, dy) :]
            b = b[: a.shape[0], : a.shape[1]]
            a, b = a.ravel(), b.ravel()
            both = valid.ravel()[a] & valid.ravel()[b]
            a, b = a[both], b[both]
            length = math.sqrt(self.CELL**2 * (dx * dx + dy * dy) + (turn * dt) ** 2)
            rows.append(a)
            columns.append(b)
            lengths.append(length * np.maximum(price.ravel()[a], price.ravel()[b]))
        graph = csr_array(
            (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), shape=(gap.size, gap.size)
        )
        near = self._difference(self.nodes - goal).numpy()
        root = int(np.where(valid, near, np.inf).argmin())
        self._length, self._next = dijkstra(graph, directed=False, indices=root, return_predecessors=True)
