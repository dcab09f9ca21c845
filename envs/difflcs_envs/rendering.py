"""Pictures of a MuJoCo scene, with or without a screen, and the interactive viewer."""

import ctypes.util
import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from difflcs_envs.errors import RenderingError

_APT_LINE = "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
_BACKENDS = {"", *"enable enabled on true 1 disable disabled off false 0 glfw glx egl osmesa wgl cgl".split()}
_APT_LINE_OSMESA = "apt-get install libosmesa6"


def has_display() -> bool:
    """Return True if a window can be opened (on Linux: if the environment names an X or Wayland display)."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def select_gl_backend() -> str:
    """Choose how MuJoCo gets OpenGL. Call it before `import mujoco`.

    Sets `MUJOCO_GL` to "egl" or "osmesa" if the user has not set it, there is no display, and the library is installed.

    Returns:
        The value of `MUJOCO_GL` in lower case; empty for MuJoCo's own choice.

    Raises:
        RenderingError: MuJoCo would refuse that value when it is imported.
    """
    if not os.environ.get("MUJOCO_GL", "").strip() and not has_display():
        for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
            if ctypes.util.find_library(library):
                os.environ["MUJOCO_GL"] = backend
                break
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen not in _BACKENDS:
        raise RenderingError(f"MUJOCO_GL: expected egl, osmesa, glfw or disabled, got {chosen!r}; change or unset it")
    return chosen


def look_at(position: Sequence[float], target: Sequence[float]) -> dict[str, list[float]]:
    """Make the pose keywords of a camera at a position [m] that looks at a target with the horizon level."""
    backward = np.subtract(position, target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    up = np.cross(backward, right)
    return {"pos": list(position), "xyaxes": [*right, *up]}


def add_sky(spec: Any, top: Sequence[float], bottom: Sequence[float], width: int) -> None:
    """Add a sky of two colours to the spec of a scene, of so many pixels."""
    import mujoco

    sky, gradient = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    spec.add_texture(name="sky", type=sky, builtin=gradient, rgb1=top, rgb2=bottom, width=width, height=6 * width)


def _make_gl_context(width: int, height: int) -> Any:
    backend = select_gl_backend()
    try:
        # MuJoCo binds its own GLContext when it is first imported, perhaps before the backend was chosen.
        if backend == "egl":
            from mujoco.egl import GLContext
        elif backend == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco import GLContext
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # OpenGL raises many types: ImportError, AttributeError, GLError, RuntimeError
        raise _no_context(error) from error
    return context


def _no_context(error: Exception) -> RenderingError:
    return RenderingError(
        f"No OpenGL context could be made (MUJOCO_GL={select_gl_backend()!r}, display: {has_display()}): {error}. To "
        f"draw without a screen install EGL with '{_APT_LINE}', or OSMesa with '{_APT_LINE_OSMESA}' and "
        "MUJOCO_GL=osmesa, and start Python again."
    )


class SceneRenderer:
    """Draws a scene off screen. Without shadows and reflections, which would take ten times as long in software."""

    def __init__(self, model: Any, width: int, height: int) -> None:
        """Open an OpenGL context.

        Args:
            model: The MuJoCo model, made for pictures at least this large.
            width: Width [pixel].
            height: Height [pixel].

        Raises:
            RenderingError: No OpenGL on this machine. The message names the packages to install.
        """
        self._context = _make_gl_context(width, height)
        import mujoco

        from difflcs_envs.trifinger.model import GOAL_COLOR, GOAL_GROUP, HAND_GROUP

        self._mujoco = mujoco
        self._hand_group, self._goal_group = HAND_GROUP, GOAL_GROUP
        self._goal_color = 255.0 * np.array(GOAL_COLOR[:3])
        self._model = model
        self._scene = mujoco.MjvScene(model, maxgeom=200)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = False
        self._options = mujoco.MjvOption()
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        try:
            self._gpu = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except mujoco.FatalError as error:  # GLFW without a display makes contexts that are none
            raise _no_context(error) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gpu)
        self._open = True

    def render(self, data: Any, camera: str = "front") -> np.ndarray:
        """Draw the scene, and over it the outline of the goal, lightly filled.

        Args:
            data: The MuJoCo data.
            camera: "front", or "top", which hides the hand but for its lower links.

        Returns:
            A new picture, uint8 (height, width, 3).
        """
        mujoco = self._mujoco
        self._context.make_current()
        mujoco.mj_camlight(self._model, data)
        self._camera.fixedcamid = self._model.camera(camera).id
        self._options.geomgroup[:] = [1, 0, 1, 0, 0, 0]
        self._options.geomgroup[self._hand_group] = camera != "top"
        picture = self._draw(data)
        self._options.geomgroup[:] = 0
        self._options.geomgroup[self._goal_group] = 1
        segment = mujoco.mjtRndFlag.mjRND_SEGMENT
        self._scene.flags[segment] = True
        goal = np.asarray(self._draw(data).any(axis=2))
        self._scene.flags[segment] = False
        return self._mark_goal(picture, goal)

    def _draw(self, data: Any) -> np.ndarray:
        """Draw the scene with the current options, uint8 (height, width, 3)."""
        mujoco = self._mujoco
        mujoco.mjv_updateScene(
            self._model, data, self._options, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        mujoco.mjr_render(self._rectangle, self._scene, self._gpu)
        pixels = np.empty((self._rectangle.height, self._rectangle.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rectangle, self._gpu)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL counts rows from below

    def _mark_goal(self, picture: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Mark the goal, a mask (height, width), in a picture."""
        inner = goal
        for _ in range(max(1, round(len(picture) / 160))):  # thickness of the line [pixel]
            inner = inner & np.roll(inner, 1, 0) & np.roll(inner, -1, 0) & np.roll(inner, 1, 1) & np.roll(inner, -1, 1)
        share = np.where(inner, 0.15, 0.9 * goal)[..., None]
        return ((1.0 - share) * picture + share * self._goal_color).round().astype(np.uint8)

    def close(self) -> None:
        """Free the OpenGL context. May be called again."""
        if self._open:
            self._open = False
            self._context.make_current()
            self._gpu.free()
            self._context.free()


class SceneViewer:
    """The interactive viewer of MuJoCo, for `render_mode="human"`."""

    def __init__(self, model: Any, data: Any) -> None:
        """Open the window.

        Args:
            model: The MuJoCo model.
            data: The MuJoCo data to follow.

        Raises:
            RenderingError: The window could not be opened.
        """
        try:
            import mujoco.viewer

            self._viewer = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except Exception as error:  # window systems fail in many ways
            raise RenderingError(
                f"The viewer window could not be opened: {error}. It needs a display (and `mjpython` on macOS); "
                'use render_mode="rgb_array" without one.'
            ) from error
        with self._viewer.lock():
            self._viewer.cam.lookat[:] = (0.0, 0.0, 0.1)
            self._viewer.cam.distance, self._viewer.cam.azimuth, self._viewer.cam.elevation = 0.75, 90.0, -35.0

    def render(self) -> None:
        """Show the current state. Does nothing once the user has closed the window."""
        if self._viewer.is_running():
            self._viewer.sync()

    def close(self) -> None:
        """Close the window. May be called again."""
        self._viewer.close()
