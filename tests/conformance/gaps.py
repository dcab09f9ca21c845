"""Gaps, normals and points of contact of random pairs of shapes, judged by support functions: no collision code.

The signed distance of two convex shapes is the largest separation min n·B − max n·A along any direction n: how far they
are apart, or minus the least way that parts them. It is searched for from directions all around, the normals of faces
and the products of edges among them. At a contact the gap is what is left between both shapes along its normal.

python -m tests.conformance.gaps --count 10000 --fill
python -m tests.conformance.gaps --first 17 --count 1
"""

import argparse
import itertools
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from difflcs.physics.mujoco import MujocoLCS
from tests.conformance.hostile.campaign import fill
from tests.conformance.scenes import judge_seeds

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
PAIRS = [pair for pair in itertools.combinations_with_replacement(KINDS, 2) if pair != ("plane", "plane")]
LIMIT = 1e-4  # of the width of the thinner shape
CUBE = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
ALIGNED = Rotation.create_group("O").as_matrix()
_k = (np.arange(1500) + 0.5) / 1500
_turn, _round = np.pi * (1 + 5**0.5) * 1500 * _k, 2 * np.sqrt(_k * (1 - _k))
AROUND = np.stack([np.cos(_turn) * _round, np.sin(_turn) * _round, 1 - 2 * _k], -1)  # directions, evenly


class Shape:
    """A convex geom as it is in a simulation; `local` directions and places are along its own axes."""

    def __init__(self, model: Any, data: Any, geom: int):
        self.kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
        self.size, self.place = model.geom_size[geom].copy(), data.geom_xpos[geom].copy()
        self.turn = data.geom_xmat[geom].reshape(3, 3).copy()
        normals, edges = {"box": (3, 3), "cylinder": (1, 0), "plane": (1, 0)}.get(self.kind, (0, 0))
        axes = self.turn.T[::-1]
        self.normals, self.edges = np.concatenate([axes[:normals], -axes[:normals]]), axes[:edges]
        self.facets = np.concatenate([np.c_[sign * np.eye(3), -self.size] for sign in (1, -1)])  # of a box
        if self.kind == "mesh":
            start, count = (v[model.geom_dataid[geom]] for v in (model.mesh_vertadr, model.mesh_vertnum))
            hull = ConvexHull(model.mesh_vert[start : start + count].astype(float))
            self.vertices, self.facets = hull.points[hull.vertices], hull.equations
            self.normals = np.unique(hull.equations[:, :3].round(9), axis=0) @ self.turn.T
            sides = hull.points[hull.simplices] - hull.points[np.roll(hull.simplices, 1, 1)]
            sides = sides.reshape(-1, 3) / np.linalg.norm(sides.reshape(-1, 3), axis=-1, keepdims=True)
            self.edges = np.unique(sides.round(9), axis=0) @ self.turn.T
        if self.kind != "plane":
            self.width = float((self.support(AROUND[::15]) + self.support(-AROUND[::15])).min())
        else:
            self.width = np.inf

    def support(self, n: np.ndarray) -> np.ndarray:
        """max n·x over the shape, for directions n (m, 3)."""
        local, size = n @ self.turn, self.size
        across, along = np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])
        far = {
            "plane": lambda: np.where(across < 1e-9, 0.0, np.inf),
            "sphere": lambda: size[0],
            "capsule": lambda: size[0] + size[1] * along,
            "ellipsoid": lambda: np.linalg.norm(local * size, axis=-1),
            "cylinder": lambda: size[0] * across + size[1] * along,
            "box": lambda: np.abs(local) @ size,
            "mesh": lambda: (local @ self.vertices.T).max(-1),
        }[self.kind]()
        return n @ self.place + far

    def end(self, at: np.ndarray, n: np.ndarray) -> float:
        """The largest t with at + t n in the shape; `at` is first moved inwards a little, as it may be on an edge."""
        inwards = self.place - at
        at, n = (at + 1e-7 * (inwards - (inwards @ n) * n) - self.place) @ self.turn, n @ self.turn

        def of_ball(at: np.ndarray, n: np.ndarray, radius: float) -> float:
            a, b, c = n @ n, at @ n, at @ at - radius**2
            return float((-b + np.sqrt(max(b * b - a * c, 0.0))) / a) if a > 1e-20 else np.inf

        if self.kind in ("sphere", "ellipsoid"):
            size = self.size if self.kind == "ellipsoid" else self.size[0]
            return of_ball(at / size, n / size, 1.0)
        if self.kind in ("box", "mesh"):
            slope = self.facets[:, :3] @ n
            left = -(self.facets[:, :3] @ at + self.facets[:, 3])
            return float((left[slope > 1e-12] / slope[slope > 1e-12]).min())
        if self.kind == "plane":
            return -at[2] / n[2]
        radius, half = self.size[:2]
        cap = (half - np.sign(n[2]) * at[2]) / max(abs(n[2]), 1e-12)
        side = of_ball(at[:2], n[:2], radius)
        if self.kind == "cylinder":
            return min(cap, side)
        balls = [of_ball(at - [0, 0, z], n, radius) for z in (half, -half) if self._meets(at - [0, 0, z], n, radius)]
        return max([side] * bool(abs(at[2] + side * n[2]) <= half) + balls, default=side)

    @staticmethod
    def _meets(at: np.ndarray, n: np.ndarray, radius: float) -> bool:
        return bool(at @ at - (at @ n) ** 2 <= radius**2)


def separation(a: Shape, b: Shape, n: np.ndarray) -> np.ndarray:
    """How far b is beyond a along directions n (m, 3)."""
    return -a.support(n) - b.support(-n)


def signed_distance(a: Shape, b: Shape, shrinks: int = 120) -> float:
    """The largest separation: of many directions the best, each improved by steps that shrink."""
    if a.kind == "plane":
        return float(separation(a, b, a.turn[:, 2][None])[0])
    random = np.random.default_rng(0)
    products = np.cross(a.edges[:, None], b.edges[None]).reshape(-1, 3)
    size = np.linalg.norm(products, axis=-1)
    products = products[size > 1e-7] / size[size > 1e-7, None]
    n = np.concatenate([AROUND, a.normals, -b.normals, products, -products])
    value = separation(a, b, n)
    starts, left = [], value.copy()
    for _ in range(12):
        starts.append(int(left.argmax()))
        left[n @ n[starts[-1]] > 0.99] = -np.inf
    n, value = n[starts], value[starts]
    near = np.array([0, 0.01, 0.01, 0.03, 0.03, 0.1, 0.1, 0.3, 0.3, 0.3])[:, None]
    reach, radius, before = np.sqrt(3) * 2 * max(a.width, b.width), np.full(len(n), 0.08), np.zeros_like(n)
    for shrink in range(shrinks):
        # Steps anywhere, and near the last one that was good, which follow a ridge.
        step = np.concatenate(
            [random.normal(size=(len(n), 10, 3)), before[:, None] + near * random.normal(size=(10, 3))], 1
        )
        step -= (step @ n[:, :, None]) * n[:, None]
        step /= np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-300)
        tried = n[:, None] + radius[:, None, None] * step
        tried /= np.linalg.norm(tried, axis=-1, keepdims=True)
        values = separation(a, b, tried.reshape(-1, 3)).reshape(tried.shape[:2])
        each, best = np.arange(len(n)), values.argmax(-1)
        better = values[each, best] > value
        before = np.where(better[:, None], step[each, best], before)
        n = np.where(better[:, None], tried[each, best], n)
        value = np.where(better, values[each, best], value)
        radius = np.where(better, radius * 1.3, radius * 0.7)
        if radius.max() < 1e-6:
            break
        if shrink % 5 == 4:  # those that are left behind
            on = value + 30 * radius * reach >= value.max()
            n, value, radius, before = n[on], value[on], radius[on], before[on]
    return float(value.max())


def random_turn(random: np.random.Generator) -> np.ndarray:
    """Along the axes, turned about one of them, nearly so, on an edge, or any."""
    aligned, any_turn = ALIGNED[random.integers(24)], Rotation.random(rng=random).as_matrix()
    vector = random.normal(size=3) * 10 ** random.uniform(-8, -0.7)
    about = Rotation.from_rotvec([0, 0, random.uniform(0, 2 * np.pi)]).as_matrix()
    edge = Rotation.from_rotvec([0, 0, np.pi / 4]).as_matrix() @ ALIGNED[random.integers(24)]
    nearly = Rotation.from_rotvec(vector).as_matrix()
    return (aligned, aligned @ about, aligned @ nearly, aligned @ edge, any_turn)[random.integers(5)]


def random_geom(kind: str, random: np.random.Generator, scale: float, mesh: str) -> tuple[str, str]:
    """XML of a geom, and of its mesh."""
    size = " ".join(f"{s:.9g}" for s in random.uniform(0.3, 1, 3) * scale)
    if kind != "mesh":
        return f'type="{kind}" size="{size}"', ""
    n = random.normal(size=(random.integers(20, 61), 3))
    hull = n / np.linalg.norm(n, axis=-1, keepdims=True)
    vertices = (CUBE, CUBE[[0, 3, 5, 6]], hull)[random.integers(3)] * random.uniform(0.4, 1, 3) * scale
    listed = " ".join(f"{v:.9g}" for v in vertices.ravel())
    return f'type="mesh" mesh="{mesh}"', f'<mesh name="{mesh}" inertia="shell" vertex="{listed}"/>'


def random_scene(seed: int) -> tuple[Any, Any, Shape, Shape]:
    """Two geoms, sizes of millimetres to metres, a tenth of the thinner one inside to twice its width apart."""
    random = np.random.default_rng(seed)
    pair = PAIRS[seed % len(PAIRS)]
    if pair[0] != "plane" and random.random() < 0.5:
        pair = pair[::-1]
    scale = 10 ** random.uniform(-3, 1)
    ratio = random.choice([1.0, 1.0, 0.2, 5.0])
    (one, mesh_1), (two, mesh_2) = (
        random_geom(kind, random, by * scale, mesh)
        for kind, by, mesh in zip(pair, (1.0, ratio), ("m", "n"), strict=True)
    )
    free = "" if pair[0] == "plane" or random.random() < 0.5 else "<freejoint/>"
    quat = Rotation.random(rng=random).as_quat(scalar_first=True) if random.random() < 0.5 else [1, 0, 0, 0]
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><asset>{mesh_1}{mesh_2}</asset><worldbody>
        <body pos="{scale} {-scale} 0" quat="{" ".join(map(str, quat))}">{free}<geom {one} mass="1"/></body>
        <body><freejoint/><geom {two} mass="1"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    of_geom = Rotation.from_quat(model.geom_quat[1], scalar_first=True).as_matrix()
    turn = data.geom_xmat[0].reshape(3, 3) @ random_turn(random) @ of_geom.T
    data.qpos[-4:] = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    mujoco.mj_kinematics(model, data)
    a, b = Shape(model, data, 0), Shape(model, data, 1)
    width = min(a.width, b.width)
    normals = np.concatenate([a.normals[:1]] if a.kind == "plane" else [a.normals, -b.normals])
    anywhere = a.kind != "plane" and (not len(normals) or random.random() < 0.4)
    n = AROUND[random.integers(len(AROUND))] if anywhere else normals[random.integers(len(normals))]
    exactly = random.choice([0, 1e-9, -1e-9, 1e-7, -1e-7, 1e-5, -1e-5, 1e-4, -1e-4, -1e-3, 1e-2, -1e-2])
    gap = (random.uniform(-0.1, 0), exactly, random.uniform(0, 2))[random.choice(3, p=[0.45, 0.25, 0.3])]
    beside = np.cross(n, random.normal(size=3)) * width * random.choice([0, 0.2, 0.5])
    b.place = a.place + beside
    b.place = b.place + (gap * width - separation(a, b, n[None])[0]) * n
    data.qpos[-7:-4] += b.place - data.geom_xpos[1]
    mujoco.mj_fwdPosition(model, data)
    return model, data, Shape(model, data, 0), Shape(model, data, 1)


class Judged(NamedTuple):
    """Errors of a scene, in parts of the width of the thinner shape; `tilt`: of rates that must be those of a point."""

    pair: tuple[str, str]
    distance: float
    gap: float
    normal: float
    points: float
    tilt: float
    contacts: int

    def wrong(self) -> bool:
        """Whether an error is above the limit."""
        return not max(self.gap, self.normal, self.points, self.tilt) <= LIMIT


def judge(seed: int) -> Judged | None:
    """One scene at the default settings; None where the shapes are deeper in each other, or farther apart."""
    model, data, a, b = random_scene(seed)
    width = min(a.width, b.width)
    true = signed_distance(a, b)
    if not -0.1001 <= true / width <= 2:
        return None
    module = MujocoLCS(model, data, motion="dynamic")
    found = module.contacts(module.state.to_state(data.qpos, data.qvel))
    here = found.normal.abs().sum(-1) > 0
    gap, rows = found.gap[here].numpy(), found.normal[here].numpy()
    turn = data.xmat[2].reshape(3, 3)
    first = model.nv - 6
    pair = PAIRS[seed % len(PAIRS)]
    if not len(gap):
        return Judged(pair, true / width, np.inf, np.inf, np.inf, 0.0, 0)
    n = rows[:, first : first + 3]
    nearest = gap.argmin()
    best = separation(a, b, n[nearest][None])[0]
    points = tilt = 0.0
    for g, normal, row in zip(gap, n, rows, strict=True):
        at = data.xpos[2] + np.cross(normal, turn @ row[first + 3 : first + 6])
        low = high = -b.end(at, -normal) - a.end(at, normal)
        # MuJoCo's own contacts are also of other points, those of a capsule and those on a plane.
        if a.kind == "plane" or (a.kind, b.kind) == ("box", "capsule"):
            high = b.end(at, normal) - a.end(at, normal)
        elif (a.kind, b.kind) == ("capsule", "box"):
            high = a.end(at, -normal) - b.end(at, -normal)
        points = max(points, (low - g) / width, (g - high) / width)
        tilt = max(tilt, abs(np.linalg.norm(normal) - 1), np.abs(row[:3] + normal).max() if first else 0.0)
    return Judged(pair, true / width, abs(gap[nearest] - true) / width, (true - best) / width, points, tilt, len(gap))


def table(judged: list[Judged]) -> str:
    """Markdown: what was tried between which shapes, and the largest errors."""
    lines = ["| of a pair | tried | overlapping | gap | normal | point | silent |", "|---|---|---|---|---|---|---|"]
    for kind in (*KINDS, "all"):
        some = [j for j in judged if kind in (*j.pair, "all")]
        worst = (max(getattr(j, name) for j in some) for name in ("gap", "normal", "points"))
        overlap, silent = sum(j.distance < 0 for j in some), sum(j.wrong() for j in some)
        lines.append(f"| {kind} | {len(some)} | {overlap} | {' | '.join(f'{w:.0e}' for w in worst)} | {silent} |")
    return "\n".join(lines)


def main() -> None:
    """Judge pairs of shapes, and put the table into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--fill", type=Path, nargs="?", const=Path("docs/promises.md"), help="page to put the table into"
    )
    options, text = judge_seeds(parser, judge, table, Judged)
    if options.fill:
        fill(options.fill, "gaps", text)


if __name__ == "__main__":
    main()
