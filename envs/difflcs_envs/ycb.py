"""The YCB objects of the paper: published masses, measured sizes, and primitive stand-ins. Data only.

Masses: object table of the YCB Object and Model Set (Calli et al., IEEE Robotics & Automation Magazine, 2015). Sizes
and resting heights: measured on its google_16k meshes lying in their lowest rest pose, longest horizontal side along x.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np


@dataclass(frozen=True)
class Primitive:
    """A box, cylinder or capsule; z is measured from the table.

    Attributes:
        shape: "box", "cylinder" or "capsule".
        center: Centre [m], (x, y, z).
        size: Box: half sides [m] along x, y, z. Cylinder (axis z): radius, half height. Capsule (axis in the plane):
            radius, half length between the centres of its ends.
        yaw: Turn about z [rad]; a capsule with yaw 0 lies along x.
    """

    shape: str
    center: tuple[float, float, float]
    size: tuple[float, ...]
    yaw: float = 0.0

    @property
    def axis_quat(self) -> tuple[float, float, float, float]:
        """Orientation of the shape, (w, x, y, z); MuJoCo's capsules have their axis along z."""
        c, s = math.cos(self.yaw / 2), math.sin(self.yaw / 2)
        if self.shape != "capsule":
            return c, 0.0, 0.0, s
        h = math.sqrt(0.5)  # first a quarter turn about y: z to x
        return c * h, -s * h, c * h, s * h

    @property
    def volume(self) -> float:
        """Volume [m^3]."""
        if self.shape == "box":
            return 8 * math.prod(self.size)
        radius, half = self.size
        ends = 4 / 3 * math.pi * radius**3 if self.shape == "capsule" else 0.0
        return 2 * math.pi * radius**2 * half + ends

    def inertia(self, origin: np.ndarray) -> np.ndarray:
        """Second moment of the volume about a point, as a moment of inertia of density 1 [m^5], (3, 3).

        A capsule counts as a cylinder of its length: within 3 % for the slender ones used here.
        """
        if self.shape == "box":
            squares = np.square(self.size) / 3
        elif self.shape == "cylinder":
            radius, half = self.size
            squares = np.array([radius**2 / 4, radius**2 / 4, half**2 / 3])
        else:
            radius, half = self.size
            squares = np.array([(half + radius) ** 2 / 3, radius**2 / 4, radius**2 / 4])
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        arm = np.array(self.center) - origin
        spread = turn @ np.diag(squares) @ turn.T + np.outer(arm, arm)
        return self.volume * (np.trace(spread) * np.eye(3) - spread)

    def outline(self) -> np.ndarray:
        """Points [m] around it as seen from above, (K, 2)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        turn = np.array([[c, -s], [s, c]])
        circle = np.linspace(0, 2 * math.pi, 24, endpoint=False)
        ring = np.stack([np.cos(circle), np.sin(circle)], axis=1)
        if self.shape == "box":
            points = np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) * self.size[:2]
        elif self.shape == "cylinder":
            points = self.size[0] * ring
        else:
            radius, half = self.size
            points = np.concatenate([radius * ring + [half, 0], radius * ring - [half, 0]])
        return points @ turn.T + np.array(self.center[:2])


@dataclass(frozen=True)
class YcbObject:
    """One YCB object.

    Attributes:
        name: Name in this package.
        code: Its name in the YCB set.
        mass: Published mass [kg].
        size: Extent [m] along x, y, z at rest.
        rest_height: Height of the centre of mass at rest [m].
        parts: Convex parts of the collision mesh.
        stand_in: Primitives that take its place without a mesh.
        concavity: How far the convex parts may leave the mesh (CoACD's threshold).
    """

    name: str
    code: str
    mass: float
    size: tuple[float, float, float]
    rest_height: float
    parts: int
    stand_in: tuple[Primitive, ...]
    concavity: float = 0.1


def _box(x: tuple[float, float], y: tuple[float, float], height: float, yaw: float = 0.0) -> Primitive:
    """Make a box on the table between two x and two y [m]."""
    center = (sum(x) / 2, sum(y) / 2, height / 2)
    return Primitive("box", center, ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2, height / 2), yaw)


def _arc(size: tuple[float, float, float], pieces: int) -> tuple[Primitive, ...]:
    """Make capsules along a circular arc that fills a box of this size, its ends towards +y."""
    length, width, height = size
    radius = height / 2
    chord, rise = length - height, width - height
    bow = (chord**2 / 4 + rise**2) / (2 * rise)  # radius of the arc
    angles = math.asin(chord / 2 / bow) * np.linspace(-1, 1, pieces + 1)
    x, y = bow * np.sin(angles), bow - bow * np.cos(angles)
    return tuple(
        Primitive(
            "capsule",
            (float(x[i] + x[i + 1]) / 2, float(y[i] + y[i + 1]) / 2, radius),
            (radius, math.hypot(x[i + 1] - x[i], y[i + 1] - y[i]) / 2),
            math.atan2(y[i + 1] - y[i], x[i + 1] - x[i]),
        )
        for i in range(pieces)
    )


def _clamp(size: tuple[float, float, float]) -> tuple[Primitive, ...]:
    """Make a spring clamp as seen from above: two handles that spread to the left, two jaws that close to the right."""
    length, width, height = size
    for _ in range(8):  # the turned handles reach not quite as far as they are long: stretch until the size is right
        pieces = _clamp_pieces(length, width, height)
        extent = np.ptp(np.concatenate([piece.outline() for piece in pieces]), axis=0)
        length, width = length * size[0] / float(extent[0]), width * size[1] / float(extent[1])
    return pieces


def _clamp_pieces(length: float, width: float, height: float) -> tuple[Primitive, ...]:
    arm, thickness = 0.55 * length, 0.16 * width
    spread = math.atan2(width / 2 - thickness, arm)
    reach = math.cos(spread) * arm / 2
    aside = (width - thickness) / 4
    handles = tuple(
        Primitive(
            "box",
            (-length / 2 + reach + thickness / 2, side * aside, height / 2),
            (arm / 2, thickness / 2, height / 2),
            -side * spread,
        )
        for side in (-1, 1)
    )
    jaws = tuple(
        _box((0.0, length / 2), (min(a, b), max(a, b)), height)
        for a, b in ((0.06 * width, 0.3 * width), (-0.06 * width, -0.3 * width))
    )
    return (*handles, *jaws, _box((-0.1 * length, 0.15 * length), (-0.2 * width, 0.2 * width), height))


_SUGAR, _CAN, _BANANA = (0.1760, 0.0922, 0.0451), (0.0853, 0.0847, 0.0333), (0.1976, 0.0687, 0.0363)
_MUG, _WRENCH = (0.1050, 0.0925, 0.0811), (0.2028, 0.0583, 0.0133)
_MEDIUM, _LARGE, _EXTRA_LARGE = (0.0847, 0.0770, 0.0259), (0.1648, 0.1215, 0.0357), (0.2022, 0.1652, 0.0354)

_SUGAR_PARTS = (_box((-0.088, 0.088), (-0.0461, 0.0461), _SUGAR[2]),)
_CAN_PARTS = (Primitive("cylinder", (0.0, 0.0, _CAN[2] / 2), (0.0425, _CAN[2] / 2)),)
_MUG_PARTS = (
    Primitive("cylinder", (-0.00625, 0.0, _MUG[2] / 2), (0.04625, _MUG[2] / 2)),
    Primitive("box", (0.0445, 0.0, _MUG[2] / 2), (0.008, 0.006, 0.027)),  # the handle
)
_WRENCH_PARTS = (
    _box((-0.0550, 0.1014), (-0.0130, 0.0130), 0.010),
    _box((-0.1014, -0.0500), (-0.02915, 0.02915), _WRENCH[2]),
)
_OBJECTS = (
    YcbObject("sugar_box", "004_sugar_box", 0.514, _SUGAR, 0.02166, 1, _SUGAR_PARTS),
    YcbObject("fish_can", "007_tuna_fish_can", 0.171, _CAN, 0.01606, 1, _CAN_PARTS),
    YcbObject("banana", "011_banana", 0.066, _BANANA, 0.01727, 4, _arc(_BANANA, 6), 0.05),
    YcbObject("mug", "025_mug", 0.118, _MUG, 0.02710, 6, _MUG_PARTS),
    YcbObject("wrench", "042_adjustable_wrench", 0.252, _WRENCH, 0.00586, 9, _WRENCH_PARTS, 0.05),
    YcbObject("clamp", "050_medium_clamp", 0.059, _MEDIUM, 0.01252, 8, _clamp(_MEDIUM)),
    YcbObject("large_clamp", "051_large_clamp", 0.125, _LARGE, 0.01714, 8, _clamp(_LARGE)),
    YcbObject("extra_large_clamp", "052_extra_large_clamp", 0.202, _EXTRA_LARGE, 0.01837, 8, _clamp(_EXTRA_LARGE)),
)
YCB: Mapping[str, YcbObject] = MappingProxyType({entry.name: entry for entry in _OBJECTS})
"""Our name → object. The paper does not say which clamp it uses: `clamp` is the medium one."""
