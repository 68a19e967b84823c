"""A film's pictures: as arrays, one frame after the other.

MuJoCo's renderer gives colours and their distances; `mujoco.Renderer` would draw twice for both.
Frames come one by one, so that a long film needs no more memory than a short one.
"""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import jax
import mujoco
import numpy as np

from mjx_revolve.view.film.film import Film
from mjx_revolve.view.film.overlay import make_overlay
from mjx_revolve.view.film.stage import build_stage, robot_qpos
from mjx_revolve.view.film.waterlight import make_shader
from mjx_revolve.view.palette import SUN

# Range of sight, in distances of the camera from the robot.
_SIGHT = 9.0
# Room for decoration, beside the model's geoms.
_MOST_GEOMS = 100
# A group of geoms that is not drawn.
_HIDDEN = 5
# The sky is a cube about so large, in shares of the far plane's distance; nothing else is that far.
_SKY = 0.3

_Paint = Callable[[mujoco.MjvScene], tuple[np.ndarray, np.ndarray]]


def draw_frames(film: Film, way: str) -> Iterator[np.ndarray]:
    """Draws a film.

    Args:
        film: from `make_film` or `make_colony_film`.
        way: of making an OpenGL context, from `opengl.find_opengl`.

    Yields:
        `[height, width, 3]` uint8, one frame after the other.
    """
    for picture, depth, frame in draw_shaded(film, way):
        if frame == 0:
            overlay = make_overlay(film)
        yield overlay(picture, depth, frame)


def draw_shaded(film: Film, way: str) -> Iterator[tuple[Any, np.ndarray, int]]:
    """Draws a film without marks and words; see `draw_frames`.

    Yields:
        `[height, width, 3]` uint8, depths along the view `[height, width]` [m], the frame's number.
    """
    shots, origin = film.shots, film.origin
    reach = float(np.linalg.norm((film.center - origin)[:, :2], axis=1).max()) + shots.distance
    robots = {k: one.robot for k, one in enumerate(film.robots)}
    model = build_stage(robots, film.world, film.size, origin, reach, _SIGHT * shots.distance)
    shade = make_shader(
        film.world, film.size, shots.distance / film.fine, shots.above, origin.tolist()
    )
    waiting: tuple[Any, np.ndarray, int] | None = None
    with _open_painter(model, film.size, way) as paint:
        data, scene = mujoco.MjData(model), mujoco.MjvScene(model, _MOST_GEOMS + model.ngeom)
        for flag in (mujoco.mjtRndFlag.mjRND_FOG, mujoco.mjtRndFlag.mjRND_HAZE):
            scene.flags[flag] = 0
        groups = model.geom_group.copy()
        for frame in range(len(film.time)):
            _arrange(data, scene, film, groups, frame)
            color, depth = paint(scene)
            water = jax.tree.map(lambda x, frame=frame: np.float32(x[frame]), film.water)
            water = water._replace(surface_height=water.surface_height - np.float32(origin[2]))
            place = (shots.position[frame] - origin).astype(np.float32)
            # JAX works on this frame while MuJoCo draws the next.
            shaded = shade(color, depth, place, shots.axes(frame).astype(np.float32), water)
            if waiting is not None:
                yield waiting
            waiting = (shaded, depth, frame)
        if waiting is not None:
            yield waiting


def _arrange(
    data: mujoco.MjData, scene: mujoco.MjvScene, film: Film, groups: np.ndarray, frame: int
) -> None:
    """Puts robots, camera and light in their places; hides robots that are not alive."""
    model, shots = data.model, film.shots
    owner = model.body_rootid[model.geom_bodyid]
    for k, one in enumerate(film.robots):
        own = owner == model.jnt_bodyid[model.joint(f"{k}/root").id]
        model.geom_group[own] = groups[own] if one.alive[frame] else _HIDDEN
        qpos = robot_qpos(data, k)
        qpos[:] = one.qpos[frame]
        qpos[:3] -= film.origin
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    x, y, z = shots.axes(frame)[2]
    camera.lookat[:] = shots.target[frame] - film.origin
    camera.distance = np.linalg.norm(shots.position[frame] - shots.target[frame])
    camera.azimuth = math.degrees(math.atan2(y, x))
    camera.elevation = math.degrees(math.asin(np.clip(z, -1.0, 1.0)))
    mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
    # The shadow map is spread around the sun's own place: close to the robot it is fine.
    sun = film.center[frame] - film.origin + 4.0 * shots.distance * np.array(SUN)
    for light in scene.lights[: scene.nlight]:
        if light.castshadow:
            light.pos[:] = sun
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
