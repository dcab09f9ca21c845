"""The TriFinger scene: three fingers above a table, one object, one transparent goal. Built with MjSpec, no files.

The robot is made of capsules and spheres; its kinematics, masses and inertias are those of the three-fingered hand in
Jin & Posa (2024) and Bui & Posa (LCS-RL). Every finger has its own frame at its mount: +y points radially outward,
+z up, and with all joints at zero the leg hangs straight down.

    joint 0  about +y at the mount                        (swings the leg sideways)
    joint 1  about -x at the mount                        (lifts the middle link)
    joint 2  about +x, LINK_LENGTH below, middle link     (bends the knee)
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from difflcs_envs.rendering import add_sky, look_at

NUM_FINGERS = 3
JOINTS_PER_FINGER = 3

# --- time -----------------------------------------------------------------------------------------
TIMESTEP = 0.002  # [s]
SUBSTEPS = 50  # substeps of one action: 0.1 s

# --- robot ----------------------------------------------------------------------------------------
MOUNT_RADIUS = 0.04  # [m] distance of the mounts from the vertical axis
MOUNT_HEIGHT = 0.29  # [m]
LINK_LENGTH = 0.16  # [m] mount to knee, and knee to tip
TIP_RADIUS = 0.0095  # [m]
FINGER_YAWS = np.deg2rad([0.0, -120.0, -240.0])  # [rad] of the finger frames; finger 0 sits on the +y axis
JOINT_RANGES = np.array([[-1.5708, 1.5708], [-1.35263, 4.49422], [-3.00197, 3.00197]])  # [rad]
JOINT_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
# The controller keeps the tips at half the height of the object, between these bounds: above the table, and low enough
# not to topple tall objects.
MIN_TIP_HEIGHT, MAX_TIP_HEIGHT = 0.0105, 0.04  # [m]

LINK_NAMES = ("upper", "middle", "lower")
LINK_MASSES = (0.2, 0.2, 0.03)  # [kg]; the lower link includes the tip
LINK_CENTERS = ((0.0, 0.06, 0.0), (0.028, 0.0, -0.08), (0.0, 0.0, -0.126667))  # [m] centres of mass
LINK_INERTIAS = (  # [kg m^2] principal moments; the principal axes are those of the link frames
    (3.533e-4, 5.333e-5, 3.533e-4),
    (3.533e-4, 3.533e-4, 5.333e-5),
    (8.36667e-5, 8.36667e-5, 1e-6),
)

# --- pinned objects: the pivot of Jin & Posa's turning task -----------------------------------------
PIVOT_DAMPING = 0.01  # [N m s/rad]
PIVOT_RANGE = 1.5008  # [rad]
# Three fingers can jam a pinned cube, which cannot give way: contacts and stops are stiffer, or tips sink in by up to
# 6 mm. Having priority, the cube brings the friction of the tips with it; the table carries none of its weight.
PIVOT_SOLREF, PIVOT_SOLIMP = (0.004, 1.0), (0.99, 0.999, 0.001, 0.5, 2.0)

# --- contact --------------------------------------------------------------------------------------
# Time constant [s] and damping ratio of contacts. Under noisy commands of up to 15 mm MuJoCo's 0.02 s lets tips sink
# into the cube by up to 2.6 mm, this by less than 0.5 mm.
CONTACT_SOLREF = (0.009, 1.0)
TIP_FRICTION = 0.9  # sliding friction of the fingers
TORSIONAL_FRICTION = 0.005  # [m]
ROLLING_FRICTION = 0.0001  # [m]
# Collision bits. Fingers touch the object and each other, never the table; the object touches everything.
TABLE_BIT, OBJECT_BIT, FINGER_BIT = 1, 2, 4

# --- memory ---------------------------------------------------------------------------------------
# Contacts and constraints. Random extreme actions with the cube use up to 24 kB; MuJoCo's own choice would be 13 MB in
# every environment. Meshes of several convex parts touch in more points.
ARENA_BYTES = 512 * 1024
MESH_ARENA_BYTES = 4 * 1024 * 1024

# --- looks ----------------------------------------------------------------------------------------
TABLE_HALF_SIZE = 0.8  # [m] drawn; the plane that carries the object has no edge
FINGER_COLORS = ((0.86, 0.33, 0.31, 1.0), (0.30, 0.69, 0.49, 1.0), (0.27, 0.52, 0.85, 1.0))
LINK_COLOR = (0.25, 0.27, 0.31, 1.0)
CUBE_COLOR = (0.98, 0.76, 0.25, 1.0)
GOAL_COLOR = (0.90, 0.16, 0.20, 0.35)
GOAL_GROUP = 1  # pictures mark the goal by an outline, so that it never hides the object; viewers draw these geoms
SMALL_PICTURE = 320 * 240  # [pixel] larger pictures get smooth edges
GOAL_MARGIN = 0.0004  # [m]
HAND_GROUP = 2  # geoms that hide the table from above; the camera "top" does not show them
COLLISION_GROUP = 3  # geoms that collide but are not drawn


@dataclass(frozen=True, kw_only=True)
class SceneObject(ABC):
    """Base of the objects in the scene, which the fingers push.

    Attributes:
        name: Name of the object.
        source: Source of its shape: "built_in", "ycb_mesh", "mesh" or "stand_in".
        mass: Mass [kg].
        friction: Sliding friction between object and table.
        pinned: True if it only turns, about a vertical axis through its origin.
    """

    name: str
    source: str
    mass: float
    friction: float
    pinned: bool = False

    @property
    @abstractmethod
    def rest_height(self) -> float:
        """Height [m] of the centre of mass above the table when the object rests on it."""

    @property
    @abstractmethod
    def height(self) -> float:
        """Height [m] of the top above the table."""

    @property
    def tip_height(self) -> float:
        """Height [m] at which the fingertips push."""
        return min(max(self.height / 2, MIN_TIP_HEIGHT), MAX_TIP_HEIGHT)

    @property
    @abstractmethod
    def outline(self) -> np.ndarray:
        """Points [m] around the object as seen from above, relative to its centre of mass, (K, 2)."""

    def describe(self) -> dict[str, Any]:
        """Describe the object in JSON types, for records of results. Subclasses add to it."""
        return {"name": self.name, "source": self.source, "mass": self.mass, "friction": self.friction}

    @abstractmethod
    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, contact: dict[str, Any]) -> None:
        """Add the colliding geoms and the mass; `contact` holds the contact keywords for `add_geom`."""

    @abstractmethod
    def add_goal_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, appearance: dict[str, Any]) -> None:
        """Add the transparent copy that marks the goal; `appearance` holds the keywords for `add_geom`."""


@dataclass(frozen=True, kw_only=True)
class CubeObject(SceneObject):
    """A solid cube.

    Attributes:
        half_size: Half of the edge [m].
    """

    half_size: float = 0.03
    mass: float = 0.01
    friction: float = 0.5
    name: str = "cube"
    source: str = "built_in"

    @property
    def rest_height(self) -> float:
        """See `SceneObject`."""
        return self.half_size

    @property
    def height(self) -> float:
        """See `SceneObject`."""
        return 2 * self.half_size

    @property
    def outline(self) -> np.ndarray:
        """See `SceneObject`: the corners, (4, 2)."""
        return self.half_size * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])

    def describe(self) -> dict[str, Any]:
        """See `SceneObject`."""
        return {**super().describe(), "edge": 2 * self.half_size, "pinned": self.pinned}

    def add_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, contact: dict[str, Any]) -> None:
        """See `SceneObject`."""
        body.add_geom(
            name="object",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[self.half_size] * 3,
            mass=self.mass,
            rgba=CUBE_COLOR,
            **contact,
        )

    def add_goal_geoms(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, appearance: dict[str, Any]) -> None:
        """See `SceneObject`."""
        # A hair larger than the cube: faces in one plane would flicker.
        size = self.half_size + GOAL_MARGIN
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[size] * 3, **appearance)


def build_spec(scene_object: SceneObject, max_picture_size: tuple[int, int]) -> mujoco.MjSpec:
    """Build the scene. Bodies in order: goal (mocap), object (free or pinned), then the three links of each finger.

    Args:
        scene_object: The object to push.
        max_picture_size: Largest width and height [pixel] that will be rendered off screen.

    Returns:
        The spec; `spec.compile()` makes the model. Degrees of freedom: the object's 6 (1 if pinned), then the 9 of the
        fingers.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "trifinger"
    spec.compiler.degree = False
    spec.memory = ARENA_BYTES
    spec.option.timestep = TIMESTEP
    spec.default.geom.solref[:] = CONTACT_SOLREF
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # The sparse Cholesky factor of the Newton solver is wrong in MuJoCo 4.0.0 (mended in 4.0.1).
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    width, height = max_picture_size
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    # Smooth edges double the time of a picture in software (320 x 240: 4 ms without, 7 to 11 ms with).
    spec.visual.quality.offsamples = 4 if width * height > SMALL_PICTURE else 0
    _add_scenery(spec, scene_object.friction)
    _add_object(spec, scene_object)
    if spec.meshes:
        spec.memory = MESH_ARENA_BYTES
    for finger in range(NUM_FINGERS):
        _add_finger(spec, finger)
    return spec


def _friction(sliding: float) -> list[float]:
    return [sliding, TORSIONAL_FRICTION, ROLLING_FRICTION]


def _add_scenery(spec: mujoco.MjSpec, table_friction: float) -> None:
    """Add table, sky, lights, cameras and the (purely visual) base of the robot."""
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    spec.visual.headlight.diffuse = [0.30, 0.30, 0.30]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.visual.map.znear = 0.05
    # The scale of the near and far planes. Left to itself MuJoCo takes it from the table.
    spec.stat.extent = 0.6
    spec.stat.center = [0.0, 0.0, 0.1]
    add_sky(spec, [0.93, 0.95, 0.98], [0.70, 0.76, 0.84], 16)
    spec.add_texture(
        name="table",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.83, 0.85, 0.88],
        markrgb=[0.72, 0.75, 0.79],
        width=64,
        height=64,
    )
    table_material = spec.add_material(name="table", texrepeat=[20, 20], texuniform=True, specular=0.1, shininess=0.1)
    table_material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "table"
    world = spec.worldbody
    world.add_light(pos=[0.4, -0.5, 1.0], dir=[-0.4, 0.5, -1.0], diffuse=[0.42, 0.42, 0.40], specular=[0.2, 0.2, 0.2])
    world.add_light(pos=[-0.6, -0.3, 0.8], dir=[0.6, 0.3, -0.8], diffuse=[0.15, 0.15, 0.18], castshadow=False)
    world.add_camera(name="front", fovy=40.0, **look_at((0.0, -0.47, 0.48), (0.0, 0.0, 0.13)))
    world.add_camera(name="top", fovy=40.0, pos=[0.0, 0.0, 0.55], xyaxes=[1, 0, 0, 0, 1, 0])
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[TABLE_HALF_SIZE, TABLE_HALF_SIZE, 0.01],
        material="table",
        # MuJoCo takes the larger friction of two geoms, so the table must not have more than the object.
        friction=_friction(table_friction),
        contype=TABLE_BIT,
        conaffinity=0,
    )


def _add_object(spec: mujoco.MjSpec, scene_object: SceneObject) -> None:
    position = [0.0, 0.0, scene_object.rest_height]
    goal = spec.worldbody.add_body(name="goal", mocap=True, pos=position)
    scene_object.add_goal_geoms(spec, goal, {"rgba": GOAL_COLOR, "contype": 0, "conaffinity": 0, "group": GOAL_GROUP})
    body = spec.worldbody.add_body(name="object", pos=position)
    if scene_object.pinned:
        body.add_joint(
            name="object",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0.0, 0.0, 1.0],
            damping=PIVOT_DAMPING,
            range=[-PIVOT_RANGE, PIVOT_RANGE],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            solref_limit=PIVOT_SOLREF,
        )
        contact = {"friction": _friction(TIP_FRICTION), "priority": 1, "solref": PIVOT_SOLREF, "solimp": PIVOT_SOLIMP}
    else:
        body.add_freejoint(name="object")
        contact = {"friction": _friction(scene_object.friction)}
    scene_object.add_geoms(spec, body, {**contact, "contype": OBJECT_BIT, "conaffinity": TABLE_BIT | FINGER_BIT})


def _add_finger(spec: mujoco.MjSpec, finger: int) -> None:
    yaw = float(FINGER_YAWS[finger])
    mount = [-MOUNT_RADIUS * np.sin(yaw), MOUNT_RADIUS * np.cos(yaw), MOUNT_HEIGHT]
    placements = (
        {"pos": mount, "quat": [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]},
        {"pos": [0.0, 0.0, 0.0]},
        {"pos": [0.0, 0.0, -LINK_LENGTH]},
    )
    parent, links = spec.worldbody, []
    for joint, placement in enumerate(placements):
        link = parent.add_body(
            name=f"{LINK_NAMES[joint]}_{finger}",
            mass=LINK_MASSES[joint],
            ipos=LINK_CENTERS[joint],
            inertia=LINK_INERTIAS[joint],
            explicitinertial=True,
            **placement,
        )
        link.add_joint(
            name=f"joint_{finger}_{joint}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=JOINT_AXES[joint],
            range=JOINT_RANGES[joint],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )
        spec.add_actuator(
            name=f"motor_{finger}_{joint}", target=f"joint_{finger}_{joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        links.append(link)
        parent = link
    upper, middle, lower = links

    # Only the lower link collides. Its capsule ends in the fingertip, a hemisphere around the site.
    lower.add_geom(
        name=f"finger_{finger}",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0.0, 0.0, 0.0, 0.0, 0.0, -LINK_LENGTH],
        size=[TIP_RADIUS, 0.0, 0.0],
        rgba=LINK_COLOR,
        friction=_friction(TIP_FRICTION),
        contype=FINGER_BIT,
        conaffinity=OBJECT_BIT | FINGER_BIT,
    )
    lower.add_site(name=f"tip_{finger}", pos=[0.0, 0.0, -LINK_LENGTH], size=[0.004] * 3, rgba=[0, 0, 0, 0])

    color = FINGER_COLORS[finger]
    for body, start, end, radius, rgba, group in (
        (upper, (0.0, -0.02, 0.0), (0.0, 0.07, 0.0), 0.0165, LINK_COLOR, HAND_GROUP),
        (middle, (0.0, 0.0, 0.0), (0.0, 0.0, -LINK_LENGTH), 0.0125, color, HAND_GROUP),
        (lower, (0.0, 0.0, 0.02 - LINK_LENGTH), (0.0, 0.0, -LINK_LENGTH), TIP_RADIUS + GOAL_MARGIN, color, 0),
    ):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[*start, *end],
            size=[radius, 0.0, 0.0],
            rgba=rgba,
            group=group,
            contype=0,
            conaffinity=0,
        )
