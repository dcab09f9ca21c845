"""Model of the hand: a palm that faces up, four fingers of four servos, an object and its goal, by MjSpec, no files.

The places of the joints and their ranges are those of the Allegro hand (Wonik Robotics, right hand); its links are
capsules here. The palm is the body frame of the hand turned so that its fingers point along +x and its face up.
"""

from typing import Any

import mujoco
import numpy as np

from difflcs_envs.rendering import add_sky, look_at

TIMESTEP, SUBSTEPS = 0.002, 50  # [s], and of them in one action of 0.1 s
JOINT_DAMPING = 0.1  # [N m s/rad]
DENSITY = 800.0  # [kg/m^3] of the links
TIP_RADIUS = 0.012  # [m]
PALM_TOP = 0.011  # [m]
GOAL_HEIGHT = 0.15  # [m] at which the copy of the object shows the goal
ARENA_BYTES = 1024 * 1024

FINGERS = ("index", "middle", "ring", "thumb")
POSTURE = (0.125, 1.13, 1.45, 1.24, -0.02, 0.445, 1.17, 1.5, -0.459, 1.54, 1.11, 1.23, 0.638, 1.85, 1.5, 1.26)
"""Joint angles at the start [rad]: index, middle, ring finger, thumb, each from its base."""
LINKS = ("base", "proximal", "medial", "distal")
_FINGER = (  # place of each joint in the link before [m], its axis, range [rad], end of its capsule [m] and radius [m]
    ((0, 0, 0), (0, 0, 1), (-0.47, 0.47), (0, 0, 0.0164), 0.0095),
    ((0, 0, 0.0164), (0, 1, 0), (-0.196, 1.61), (0, 0, 0.054), 0.0115),
    ((0, 0, 0.054), (0, 1, 0), (-0.174, 1.709), (0, 0, 0.0384), 0.011),
    ((0, 0, 0.0384), (0, 1, 0), (-0.227, 1.618), (0, 0, 0.0267), TIP_RADIUS),
)
_THUMB = (
    ((0, 0, 0), (-1, 0, 0), (0.263, 1.396), (-0.027, 0.005, 0.0399), 0.0145),
    ((-0.027, 0.005, 0.0399), (0, 0, 1), (-0.105, 2.163), (0, 0, 0.0177), 0.0125),
    ((0, 0, 0.0177), (0, 1, 0), (-0.189, 1.644), (0, 0, 0.0514), 0.0115),
    ((0, 0, 0.0514), (0, 1, 0), (-0.162, 1.719), (0, 0, 0.0423), TIP_RADIUS),
)
_MOUNTS = {  # place [m] and orientation of the fingers on the hand
    "index": ((0, 0.0435, -0.001542), (0.999048, -0.0436194, 0, 0)),
    "middle": ((0, 0, 0.0007), (1, 0, 0, 0)),
    "ring": ((0, -0.0435, -0.001542), (0.999048, 0.0436194, 0, 0)),
    "thumb": ((-0.0182, 0.019333, -0.045987), (0.477714, -0.521334, -0.521334, -0.477714)),
}

_GEOM = mujoco.mjtGeom
_HOUSE = 0.025 * np.array(
    [[x, y, z] for x in (-1, 1) for y in (-0.8, 0.8) for z in (-1, 0.3)] + [[-1, 0, 1], [1, 0, 1]]
)
_ANGLES = np.arange(6) * np.pi / 3
_NUT = np.array([[0.03 * np.cos(a), 0.03 * np.sin(a), z] for a in _ANGLES for z in (-0.02, 0.02)])
OBJECTS: dict[str, tuple[Any, Any, float]] = {  # shape, its sizes or vertices [m], height of its centre on a plane [m]
    "cube": (_GEOM.mjGEOM_BOX, (0.025, 0.025, 0.025), 0.025),
    "box": (_GEOM.mjGEOM_BOX, (0.034, 0.024, 0.02), 0.02),
    "cylinder": (_GEOM.mjGEOM_CYLINDER, (0.028, 0.025, 0), 0.025),
    "ellipsoid": (_GEOM.mjGEOM_ELLIPSOID, (0.034, 0.028, 0.022), 0.022),
    "capsule": (_GEOM.mjGEOM_CAPSULE, (0.02, 0.022, 0), 0.02),
    "house": (_GEOM.mjGEOM_MESH, _HOUSE, 0.025),
    "nut": (_GEOM.mjGEOM_MESH, _NUT, 0.02),
}
_LYING = {"capsule": (0.5**0.5, 0, 0.5**0.5, 0)}  # orientation of the shape in its body, along x

LINK_COLOR, TIP_COLOR, PALM_COLOR = (0.22, 0.24, 0.28, 1), (0.93, 0.93, 0.95, 1), (0.30, 0.33, 0.38, 1)
OBJECT_COLORS = (0.98, 0.72, 0.20), (0.20, 0.45, 0.75)


def build_model(
    name: str, mass: float = 0.1, friction: float = 0.5, servo_gain: float = 1.0, picture: tuple[int, int] = (640, 480)
) -> Any:
    """Build the model: `qpos` has 16 joints, the place of the object and its quaternion; a mocap body shows the goal.

    Args:
        name: Of the object, one of `OBJECTS`.
        mass: Of the object [kg].
        friction: Sliding friction of everything.
        servo_gain: Of the joint servos [N m/rad].
        picture: Size of the largest picture that is drawn [pixel].
    """
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = "hand", False
    spec.option.timestep, spec.option.impratio = TIMESTEP, 10
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.memory = ARENA_BYTES
    spec.visual.global_.offwidth, spec.visual.global_.offheight = picture
    spec.visual.quality.offsamples = 4
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.35,) * 3, (0.45,) * 3
    world = spec.worldbody
    world.add_light(pos=(0.1, -0.3, 0.8), dir=(-0.1, 0.35, -1), diffuse=(0.5,) * 3)
    add_sky(spec, (0.86, 0.90, 0.95), (0.60, 0.66, 0.74), 64)
    world.add_geom(type=_GEOM.mjGEOM_PLANE, pos=(0, 0, -0.1), size=(0, 0, 0.05), rgba=(0.72, 0.76, 0.80, 1))
    world.add_camera(name="front", **look_at((0.17, -0.22, 0.24), (-0.005, 0.0, 0.07)))
    world.add_camera(name="top", pos=(-0.01, 0.0, 0.36), xyaxes=(1, 0, 0, 0, 1, 0))
    _add_hand(spec, friction, servo_gain)
    _add_object(spec, name, mass, friction)
    return spec.compile()


def _add_hand(spec: Any, friction: float, servo_gain: float) -> None:
    """Add palm, fingers and servos."""
    palm = spec.worldbody.add_body(name="palm", quat=(0, 1, 0, 1))
    touch = {"friction": (friction, 0.005, 0.0001), "density": DENSITY}
    palm.add_geom(
        name="palm", type=_GEOM.mjGEOM_BOX, size=(0.0204, 0.0565, 0.0475), pos=(-0.0093, 0, -0.0475), **touch,
        rgba=PALM_COLOR,
    )  # fmt: skip
    for finger, (place, quat) in _MOUNTS.items():
        links = _THUMB if finger == "thumb" else _FINGER
        body, frame = palm, {"pos": place, "quat": quat}
        for link, (pos, axis, limits, end, radius) in zip(LINKS, links, strict=True):
            name = f"{finger}_{link}"
            body = body.add_body(name=name, gravcomp=1.0, **(frame if link == "base" else {"pos": pos}))
            body.add_joint(name=name, axis=axis, range=limits, damping=(JOINT_DAMPING, 0, 0))
            color = TIP_COLOR if link == "distal" else LINK_COLOR
            line = (0, 0, 0, *end)
            body.add_geom(name=name, type=_GEOM.mjGEOM_CAPSULE, fromto=line, size=(radius, 0, 0), rgba=color, **touch)
            gain = {"gainprm": [servo_gain] + [0] * 9, "biasprm": [0, -servo_gain] + [0] * 8}
            spec.add_actuator(
                name=name,
                target=name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                ctrllimited=True,
                ctrlrange=limits,
                **gain,
            )
        body.add_site(name=f"{finger}_tip", pos=links[-1][3], size=(0.001,) * 3, group=4)
        for link in LINKS[:2]:  # capsules that overlap near the joints
            spec.add_exclude(bodyname1="palm", bodyname2=f"{finger}_{link}")
        spec.add_exclude(bodyname1=f"{finger}_base", bodyname2=f"{finger}_medial")


def _add_object(spec: Any, name: str, mass: float, friction: float) -> None:
    """Add the object and its goal, a copy above the hand."""
    shape, sizes, _ = OBJECTS[name]
    form: dict[str, Any] = {"type": shape, "quat": _LYING.get(name, (1, 0, 0, 0))}
    if shape == _GEOM.mjGEOM_MESH:
        spec.add_mesh(name=name, uservert=np.ravel(sizes).tolist())
        form["meshname"] = name
    else:
        form["size"] = sizes
    spec.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_CUBE,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=OBJECT_COLORS[0],
        rgb2=OBJECT_COLORS[1],
        width=64,
        height=64,
    )
    material = spec.add_material(name="object", specular=0.2, shininess=0.3)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    body = spec.worldbody.add_body(name="object", pos=(0, 0, PALM_TOP + 0.04))
    body.add_freejoint(name="object")
    body.add_geom(name="object", mass=mass, friction=(friction, 0.005, 0.0001), material="object", **form)
    goal = spec.worldbody.add_body(name="goal", mocap=True, pos=(0, 0, GOAL_HEIGHT))
    goal.add_geom(contype=0, conaffinity=0, mass=0, material="object", rgba=(1, 1, 1, 0.55), **form)
