"""The TriFinger tasks as Gymnasium environments: move a cube, move an object, turn a cube."""

import os
from dataclasses import replace
from typing import Unpack

from difflcs_envs.checks import checked_integer, checked_number
from difflcs_envs.trifinger.base import CommonArguments, TriFingerEnv
from difflcs_envs.trifinger.model import CubeObject
from difflcs_envs.trifinger.objects import make_object
from difflcs_envs.trifinger.task import MOVE, TURN
from difflcs_envs.ycb import YCB

TURN_CUBE_EDGE = 0.07  # [m] of the turning task (Jin & Posa 2024)


class TriFingerMoveCubeEnv(TriFingerEnv):
    """Three fingers push a cube on a table to a goal pose.

    ## Description

    The TriFinger Moving Cube task of LCS-RL (Bui & Posa), simulated with MuJoCo. A hand with three fingers of three
    joints each stands above a table, on which lies a cube of 6 cm. The fingers must bring the cube to a goal position
    and yaw within 20 steps of 0.1 s. An action says how far each fingertip shall move in the plane; an
    operational-space controller turns it into joint torques and keeps the fingertips 3 cm above the table.

    The controller is compliant: with the default stiffness a fingertip reaches 83 % of its command within the step
    (96 % with `osc_kp=2500`), and a blocked fingertip pushes with 0.45 N (1.07 N).

    ## Action space

    `Box(-0.015, 0.015, (6,), float64)`: the displacement of each fingertip from where it is now. Actions outside the
    box are clipped to it; `info["executed_action"]` is what was executed, `info["clipped"]` says whether it differs.

    | Num    | Action                                               | Min    | Max   | Unit |
    |--------|------------------------------------------------------|--------|-------|------|
    | 0 to 5 | displacements of fingertips 0, 1, 2, x and y of each | -0.015 | 0.015 | m    |

    ## Observation space

    `Dict(goal=Box(3), state=Box(9))`, all float64, in the frame of the table (z up, origin below the hand).

    | Num    | `state`                              | Min    | Max   | Unit |
    |--------|--------------------------------------|--------|-------|------|
    | 0, 1   | cube x, y                            | -0.5   | 0.5   | m    |
    | 2      | cube yaw                             | -8 pi  | 8 pi  | rad  |
    | 3 to 8 | fingertips 0, 1, 2, x and y of each  | -0.5   | 0.5   | m    |

    | Num    | `goal`                               | Min    | Max   | Unit |
    |--------|--------------------------------------|--------|-------|------|
    | 0, 1   | cube x, y                            | -0.06  | 0.06  | m    |
    | 2      | cube yaw                             | -0.5   | 0.5   | rad  |

    The yaw is continuous within an episode: it starts in [-pi, pi] and each step adds the turn made, so that no jump
    by 2 pi disturbs a learned model or the cost. Beyond the bounds, which no push reaches, it is wrapped.

    ## Rewards

    The dense reward of step t is minus the path cost C(x_t, u_t) of the paper, at the state x_t *in which* the action
    was taken and the executed (clipped) action u_t. At the last step a penalty is added unless the final state x_T is
    a success. Each term is in `info` and the reward is their sum:

    | `info` key          | Value                                                             |
    |---------------------|-------------------------------------------------------------------|
    | `reward_tips`       | -10 (sum of squared distances of the fingertips to the cube's centre) |
    | `reward_position`   | -200 (squared distance of the cube to the goal position)          |
    | `reward_yaw`        | -0.3 (yaw - goal yaw)^2                                           |
    | `reward_action`     | -200 (squared norm of the executed action)                        |
    | `reward_completion` | -`sparse_penalty` at the last step without success, else 0        |

    Further entries of `info`, after `reset` and `step`, about the state that is returned: `success` (both errors within
    the tolerances), `position_error` [m], `yaw_error` [rad] (0 to pi, the smallest angle between the poses); after
    `step` also `executed_action` [m], `clipped` and `physics_error`.

    ## Starting state

    The cube lies at the origin, the fingertips are at a radius of 0.0977 m around it, everything at rest. `reset_noise`
    s disturbs this uniformly: the cube's position by up to 0.1 s m, its yaw by up to 0.5 s rad, and each joint of the
    posture from which the fingers come down by up to 0.2 s rad. The goal is uniform over the goal space. All depends on
    the seed only. `reset` takes the options

    - `goal`: x [m], y [m], yaw [rad] of the goal, inside the goal space;
    - `state`: a state (9,) to start from exactly, at rest; yaw in [-pi, pi].

    ## Episode end

    - Termination: never.
    - Truncation: after `horizon` steps. Also when the simulation becomes unstable: then the observation is the last
      finite state, `info["physics_error"]` is True and a `PhysicsWarning` is given.

    ## Arguments

    | Argument             | Default | Meaning                                                                        |
    |----------------------|---------|--------------------------------------------------------------------------------|
    | `render_mode`        | None    | "rgb_array", or "human" (a window; only where a display is)                    |
    | `osc_kp`             | 1000    | stiffness of the controller [1/s^2]; too soft above 0.45 N of resistance       |
    | `position_tolerance` | 0.02    | distance [m] that counts as success                                            |
    | `yaw_tolerance`      | 0.2     | angle [rad] that counts as success                                             |
    | `horizon`            | 20      | steps of an episode                                                            |
    | `object_mass`        | 0.01    | mass of the cube [kg]                                                          |
    | `object_friction`    | 0.5     | sliding friction of cube and table (fingertip and cube: at least 0.9)          |
    | `reset_noise`        | 0.05    | scale of the disturbed start, 0 to 0.2                                         |
    | `sparse_penalty`     | 10      | penalty for an episode that ends without success                               |
    | `reward_weights`     | None    | other weights than those above, such as `{"tips": 0, "action": 100}`            |
    | `observe_time`       | False   | adds `time_to_go` [s] to the observation, shape (1,)                           |
    | `width`, `height`    | 320, 240 | size of rendered pictures [pixel]                                             |

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        position_tolerance: float = MOVE.position_tolerance,
        object_mass: float = 0.01,
        object_friction: float = 0.5,
        **common: Unpack[CommonArguments],
    ) -> None:
        cube = CubeObject(
            mass=checked_number("object_mass", object_mass, low=0.0, low_open=True),
            friction=checked_number("object_friction", object_friction, low=0.0),
        )
        super().__init__(cube, replace(MOVE, position_tolerance=position_tolerance), render_mode=render_mode, **common)


class TriFingerMoveObjectEnv(TriFingerEnv):
    """Three fingers push an everyday object on a table to a goal pose.

    ## Description

    The task of `TriFingerMoveCube-v0` with an object of the YCB set (Calli et al. 2015) or any mesh. The fingertips
    push at half the height of the object, 10.5 to 40 mm above the table, and start at least 21 mm away from it.

    The YCB meshes do not ship with this package. They are taken from the folder `DIFFLCS_YCB_DIR`, or from where
    `difflcs assets download` puts them. Without them primitive stand-ins of the same size, mass and resting height are
    used: `env.unwrapped.object.source` is then "stand_in" instead of "ycb_mesh", and results must say so
    (`env.unwrapped.object.describe()` has what belongs in a record).

    The paper gives no masses. With the default stiffness a fingertip pushes with 0.45 N, which moves no more than 90 g
    at the default friction, so all objects weigh 50 g unless asked otherwise; with `object_mass="true"` also raise
    `osc_kp` (2500 gives 1.07 N, 6000 gives 2.4 N).

    | `object`            | YCB name              | Published mass | Size at rest            |
    |---------------------|-----------------------|----------------|-------------------------|
    | `sugar_box`         | 004_sugar_box         | 514 g          | 176 x 92 x 45 mm        |
    | `fish_can`          | 007_tuna_fish_can     | 171 g          | 85 x 85 x 33 mm         |
    | `banana`            | 011_banana            | 66 g           | 198 x 69 x 36 mm        |
    | `mug`               | 025_mug               | 118 g          | 105 x 93 x 81 mm        |
    | `wrench`            | 042_adjustable_wrench | 252 g          | 203 x 58 x 13 mm        |
    | `clamp`             | 050_medium_clamp      | 59 g           | 85 x 77 x 26 mm         |
    | `large_clamp`       | 051_large_clamp       | 125 g          | 165 x 122 x 36 mm       |
    | `extra_large_clamp` | 052_extra_large_clamp | 202 g          | 202 x 165 x 35 mm       |

    The paper names no size of its clamp; `clamp` is the medium one.

    ## Action space, observation space, rewards, episode end

    As in `TriFingerMoveCube-v0`; read "object" for "cube". The object's position is that of its centre of mass, its yaw
    is 0 with the longest horizontal side along x (a mesh stored in its rest pose keeps the yaw it is stored with).

    ## Starting state

    As in `TriFingerMoveCube-v0`, but each fingertip starts at a radius of at least 0.0977 m and 21 mm outside the
    object.

    ## Arguments

    Those of `TriFingerMoveCube-v0` and:

    | Argument        | Default | Meaning                                                                             |
    |-----------------|---------|-------------------------------------------------------------------------------------|
    | `object`        | "mug"   | a name from the table, or the path of a mesh (.stl, .obj, .ply, ...)                |
    | `object_mass`   | 0.05    | mass [kg], or "true" for the published mass                                         |
    | `object_source` | "auto"  | "auto" (mesh if there, else stand-in), "mesh" (or an error), "stand_in"             |
    | `rest_pose`     | "lying" | "lying" (lowest), "upright" (highest), or the number of a stable pose, from below   |
    | `mesh_scale`    | 1.0     | length of one unit of the mesh file [m]; 0.001 for millimetres                      |
    | `mesh_parts`    | None    | most convex parts for the collisions of a mesh; None for our choice                 |

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        object: str | os.PathLike[str] = "mug",
        render_mode: str | None = None,
        *,
        position_tolerance: float = MOVE.position_tolerance,
        object_mass: float | str | None = None,
        object_friction: float = 0.5,
        object_source: str = "auto",
        rest_pose: str | int = "lying",
        mesh_scale: float = 1.0,
        mesh_parts: int | None = None,
        **common: Unpack[CommonArguments],
    ) -> None:
        if not isinstance(object, str | os.PathLike):
            raise ValueError(f"Expected object to be a name or a path, got {object!r}. Choose one of {', '.join(YCB)}.")
        if not isinstance(object_mass, str | None):
            object_mass = checked_number("object_mass", object_mass, low=0.0, low_open=True)
        scene_object = make_object(
            os.fspath(object),
            mass=object_mass,
            friction=checked_number("object_friction", object_friction, low=0.0),
            source=object_source,
            rest_pose=rest_pose,
            parts=None if mesh_parts is None else checked_integer("mesh_parts", mesh_parts),
            mesh_scale=checked_number("mesh_scale", mesh_scale, low=0.0, low_open=True),
        )
        task = replace(MOVE, position_tolerance=position_tolerance)
        super().__init__(scene_object, task, render_mode=render_mode, **common)


class TriFingerTurnCubeEnv(TriFingerEnv):
    """Three fingers turn a cube about a fixed vertical axis to a goal yaw.

    ## Description

    The turning task of Jin & Posa (2024), the prior work of LCS-RL: a cube of 7 cm on a pivot with a damping of
    0.01 N m s/rad and stops at 1.5008 rad either way.

    ## Action space, observation space, rewards, episode end

    As in `TriFingerMoveCube-v0`. The cube's x and y are always 0, the goal is (0, 0, yaw) with |yaw| <= 1.5 rad,
    and success is a matter of the yaw alone.

    ## Starting state

    As in `TriFingerMoveCube-v0`, with the cube on its pivot; a given `state` needs x = y = 0 and |yaw| <= 1.5008 rad.

    ## Arguments

    Those of `TriFingerMoveCube-v0`, but `position_tolerance`.

    ## Version history

    - v0: first version.
    """

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        object_mass: float = 0.01,
        object_friction: float = 0.5,
        **common: Unpack[CommonArguments],
    ) -> None:
        cube = CubeObject(
            half_size=TURN_CUBE_EDGE / 2,
            mass=checked_number("object_mass", object_mass, low=0.0, low_open=True),
            friction=checked_number("object_friction", object_friction, low=0.0),
            pinned=True,
        )
        super().__init__(cube, TURN, render_mode=render_mode, **common)
