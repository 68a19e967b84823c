"""A film's pictures: into arrays, one frame after the other, or into MuJoCo's own window.

MuJoCo's renderer gives colours, and how far away they are; `mujoco.Renderer` would draw twice for
both. Frames come one by one, so that a long film needs no more memory than a short one.
"""

from __future__ import annotations

import importlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.film.film import Film, Shown
from mjx_revolve.view.film.overlay import Overlay, make_overlay
from mjx_revolve.view.film.stage import SUN, SURFACE, build_stage
from mjx_revolve.view.film.waterlight import make_shader

# How far one sees, in distances of the camera from the robot.
SIGHT = 9.0
# The bed, the robot's parts, and what a user adds in the viewer.
_MOST_GEOMS = 4000
# The sky is a cube about so large, in shares of the far plane's distance; nothing else is that far.
_SKY = 0.3

_Pose = Callable[[mujoco.MjData, int], None]
_Paint = Callable[[mujoco.MjvScene], tuple[np.ndarray, np.ndarray]]


def draw_frames(film: Film, way: str) -> Iterator[np.ndarray]:
    """Draws a film.

    Args:
        film: from `make_film`.
        way: of making an OpenGL context, from `opengl.find_opengl`.

    Yields:
        `[height, width, 3]` uint8, one frame after the other.
    """
    model = _stage_of(film, plain=True)
    pose = partial(_pose, film)
    yield from draw_staged(film, model, pose, make_overlay(film), way)


def draw_staged(
    film: Shown,
    model: mujoco.MjModel,
    pose: _Pose,
    overlay: Overlay,
    way: str,
    fine: float = 1.0,
) -> Iterator[np.ndarray]:
    """Draws a film of whoever is in a model.

    Args:
        film: where the camera stands in what water, frame by frame.
        model: what is drawn, counted from the film's origin.
        pose: sets a model's data to a frame.
        overlay: what is laid over frames, as from `overlay.make_overlay`.
        way: see `draw_frames`.
        fine: how fine the surface is and how thick the haze, next to films of one robot.

    Yields:
        See `draw_frames`.
    """
    shots, world = film.shots, film.robot.world
    shade = make_shader(world, film.size, shots.distance / fine, shots.above, film.origin.tolist())
    waiting: tuple[Any, np.ndarray, int] | None = None
    with _open_painter(model, film.size, way) as paint:
        data, scene = mujoco.MjData(model), mujoco.MjvScene(model, _MOST_GEOMS + model.ngeom)
        for flag in (mujoco.mjtRndFlag.mjRND_FOG, mujoco.mjtRndFlag.mjRND_HAZE):
            scene.flags[flag] = 0
        for frame in range(len(film.time)):
            _arrange(model, data, scene, film, pose, frame)
            color, depth = paint(scene)
            water = jax.tree.map(lambda x, frame=frame: np.float32(x[frame]), film.water)
            # JAX works on this frame while MuJoCo draws the next.
            shaded = shade(
                color,
                depth,
                (shots.position[frame] - film.origin).astype(np.float32),
                shots.axes(frame).astype(np.float32),
                water._replace(surface_height=water.surface_height - np.float32(film.origin[2])),
            )
            if waiting is not None:
                yield overlay(*waiting)
            waiting = (shaded, depth, frame)
        if waiting is not None:
            yield overlay(*waiting)


def _stage_of(film: Film, plain: bool) -> mujoco.MjModel:
    """What is drawn of a film's robot and the world around its way."""
    distance = film.shots.distance
    reach = float(np.linalg.norm(np.ptp(film.center[:, :2], axis=0))) / 2 + distance
    return build_stage(film.robot, film.size, film.origin, reach, SIGHT * distance, plain)


def _aim(camera: mujoco.MjvCamera, film: Shown, frame: int) -> None:
    """Puts MuJoCo's camera where the film's stands."""
    shots = film.shots
    x, y, z = shots.axes(frame)[2]
    camera.lookat[:] = shots.target[frame] - film.origin
    camera.distance = np.linalg.norm(shots.position[frame] - shots.target[frame])
    camera.azimuth = math.degrees(math.atan2(y, x))
    camera.elevation = math.degrees(math.asin(np.clip(z, -1.0, 1.0)))


def _pose(film: Film, data: mujoco.MjData, frame: int) -> None:
    """Puts the robot where it is in a frame."""
    data.qpos[:] = film.qpos[frame]
    data.qpos[:3] -= film.origin


def _arrange(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    scene: mujoco.MjvScene,
    film: Shown,
    pose: _Pose,
    frame: int,
) -> None:
    """Poses who is shown, and puts camera and light in their places."""
    pose(data, frame)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    _aim(camera, film, frame)
    option.geomgroup[SURFACE] = 0
    mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    # The shadow map is spread around the sun's own place: close to the robot it is fine.
    for light in scene.lights[: scene.nlight]:
        if light.castshadow:
            light.pos[:] = film.center[frame] - film.origin + 4.0 * film.shots.distance * SUN
    # What is there for show casts no shadow. The bed's own would only stain it with dots.
    for geom in scene.geoms[: scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and model.geom_bodyid[geom.objid] == 0:
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR


@contextmanager
def _open_painter(model: mujoco.MjModel, size: tuple[int, int], way: str) -> Iterator[_Paint]:
    """Makes an OpenGL context, and frees it in the end.

    Yields a function of a scene that returns colours `[height, width, 3]` uint8 and depths along
    the view `[height, width]` float32 [m], infinite where nothing is; the first row is the top one.
    """
    width, height = size
    # PyOpenGL looks at this once, when it is first imported.
    if way in ("egl", "osmesa"):
        os.environ.setdefault("PYOPENGL_PLATFORM", way)
    opengl = importlib.import_module(f"mujoco.{way}").GLContext(*size)
    opengl.make_current()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    # Zero far: floats are dense near 0, where the far distances then are.
    context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
    near, far = (model.stat.extent * z for z in (model.vis.map.znear, model.vis.map.zfar))
    area = mujoco.MjrRect(0, 0, width, height)

    def paint(scene: mujoco.MjvScene) -> tuple[np.ndarray, np.ndarray]:
        color = np.empty((height, width, 3), np.uint8)
        raw = np.empty((height, width), np.float32)
        mujoco.mjr_render(area, scene, context)
        mujoco.mjr_readPixels(color, raw, area, context)
        # OpenGL's hyperbola, from 1 at the near plane to 0 at the far one.
        depth = near * far / (near + raw * (far - near))
        depth[depth > _SKY * far] = np.inf
        return np.ascontiguousarray(color[::-1]), np.ascontiguousarray(depth[::-1])

    try:
        yield paint
    finally:
        context.free()
        # EGL's clean-up may find its library gone already when Python ends.
        with suppress(Exception):
            opengl.free()


def show_film(film: Film) -> None:
    """Plays a film over and over in MuJoCo's viewer, until its window is closed.

    Args:
        film: from `make_film`.

    Raises:
        InputError: there is no screen with OpenGL.
    """
    import mujoco.viewer

    model = _stage_of(film, plain=False)
    data = mujoco.MjData(model)
    before = set(threading.enumerate())
    try:
        window = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except Exception as error:  # GLFW's, X's and macOS's reasons come in many kinds
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"--view: expected a screen with OpenGL; found: {reason}") from None
    target = film.shots.target
    with window:
        with window.lock():
            _aim(window.cam, film, 0)
        begun, last = time.monotonic(), 0
        while window.is_running():
            frame = int((time.monotonic() - begun) * film.fps) % len(film.time)
            with window.lock():
                _pose(film, data, frame)
                # The user may turn the camera; it goes along with the robot.
                window.cam.lookat[:] += target[frame] - target[last]
                mujoco.mj_forward(model, data)
            last = frame
            window.sync()
            time.sleep(0.5 / film.fps)
    # The viewer's thread must be through with GLFW before Python ends, and GLFW with it.
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=10.0)
