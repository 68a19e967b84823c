"""Picture of a swimming robot: poses along its way, and one stroke seen by a camera that follows.

Drawn with the depth buffer of `raster`, so it needs no display and no graphics driver. The view
is a parallel projection from a little above, turned so that the robot swims to the right. In it a
pixel further down may be deeper or nearer, so depths are written beside the robot, not on an axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_revolve.view.labels import (
    INK,
    SOFT,
    Places,
    draw_current,
    draw_scale_bars,
    draw_target,
    write,
)
from mjx_revolve.view.motion import Motion, analyse_motion, stroke_rows
from mjx_revolve.view.pieces import Piece, Scene, make_pieces, mount_piece, place_pieces
from mjx_revolve.view.raster import make_view
from mjx_revolve.view.surroundings import moves
from mjx_revolve.view.water_panel import (
    Panel,
    Surface,
    draw_ground,
    draw_pose,
    draw_surface,
    fit_panel,
    open_water,
    region_around,
)
from mjx_revolve.water.bed import bed_height, bed_slope
from mjx_revolve.water.flow import Water

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.simulate import Trajectory

_PAGE = (1600, 900)  # pixels
_DPI = 100
_LEFT, _TOP, _GAP = 36, 74, 14  # of the panels on the page [pixels]
_STRIP = 212  # height of the snapshots
_SNAPSHOTS = 6
_PATH = "#e2711d"
_ELEVATION = 20.0  # of the viewer [deg]
_TOWARDS = 14.0  # the robot swims this much towards the viewer, not straight to the right [deg]
# The surface and the bed are shown where they are at most this far away [body lengths].
_SURFACE_NEAR, _BED_NEAR = 0.3, 0.6


def pose_scene(robot: Robot, qpos: np.ndarray, pieces: Sequence[Piece] | None = None) -> Scene:
    """The robot's parts in a pose.

    Args:
        robot: the robot.
        qpos: `[nq]` as in a trajectory.
        pieces: from `make_pieces(robot.morphology)`, where they are there already.

    Returns:
        The scene, world frame [m].
    """
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(robot.mj_model, data)

    def place(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
        body, position, rotation = mount_piece(robot, piece)
        frame = data.xmat[body].reshape(3, 3)
        return data.xpos[body] + frame @ position, frame @ rotation

    return place_pieces(make_pieces(robot.morphology) if pieces is None else pieces, place)


def _panel_axes(figure: Figure, left: int, bottom: int, size: tuple[int, int]) -> Axes:
    """Axes whose units are the pixels of the page, `size` of them from its corner."""
    width, height = _PAGE
    box = (left / width, bottom / height, size[0] / width, size[1] / height)
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.set_xlim(0, size[0])
    axes.set_ylim(0, size[1])
    return axes


def _show_image(axes: Axes, image: np.ndarray, zorder: float) -> None:
    """Puts an image, pixel for pixel, into axes of `_panel_axes`."""
    rows, columns = image.shape[:2]
    image = np.clip(image, 0.0, 1.0)
    if image.shape[2] == 4:
        image[..., :3] = np.clip(image[..., :3] / np.maximum(image[..., 3:], 1e-6), 0.0, 1.0)
    limits = axes.axis()
    axes.imshow(image, extent=(0, columns, 0, rows), origin="lower", interpolation="nearest",
                aspect="auto", zorder=zorder)  # fmt: skip
    axes.axis(limits)


def _ground(robot: Robot, points: np.ndarray) -> tuple[float, np.ndarray, bool]:
    """The plane below the robot: height at the origin [m], slope [2], and whether it is the bed."""
    length, bed = robot.morphology.length, robot.world.bed
    if bed is not None:
        place = points[:, :2].mean(axis=0)
        slope = np.array([float(k) for k in bed_slope(bed, *place)])
        height = float(bed_height(bed, *place)) - float(slope @ place)
        if (points[:, 2] - height - points[:, :2] @ slope).min() < _BED_NEAR * length:
            return height, slope, True
    return float(points[:, 2].min()) - 0.08 * length, np.zeros(2), False


def _surface(motion: Motion, points: np.ndarray, top: float, fade: float) -> Surface | None:
    """The water's surface around points `[n, 2]`, if it is near the robot's top [m]."""
    height = float(motion.surface[0])
    if height >= top + _SURFACE_NEAR * motion.length:
        return None
    return Surface(height, region_around(motion.along, points, fade))


def _draw_way(
    figure: Figure, motion: Motion, scenes: list[Scene], view: np.ndarray, bottom: int
) -> None:
    """The large picture: the robot in several poses along its way."""
    length, path = motion.length, motion.path
    size = (_PAGE[0] - 2 * _LEFT, _PAGE[1] - _TOP - bottom)
    points = np.concatenate([*(scene.corners.reshape(-1, 3) for scene in scenes), path])
    region = region_around(motion.along, points[:, :2], 0.9 * length)
    surface = _surface(motion, points[:, :2], float(points[:, 2].max()), 0.9 * length)
    shown = points
    if surface is not None:
        shown = np.concatenate([points, [[*path[0, :2], surface.height]]])
    target = motion.target
    if target is not None and _is_near(motion, target):
        shown = np.concatenate([shown, target[None]])
    panel = fit_panel(view, shown, size, (46, 46, 34, 40))

    image = open_water(size)
    opacity = np.linspace(0.45, 1.0, len(scenes)) if len(scenes) > 1 else np.ones(1)
    draw_ground(image, panel, region, _ground(motion.robot, points), scenes, opacity)
    if surface is not None:
        draw_surface(image, panel, surface)
    depth = points @ view[2]
    layer = np.zeros((*image.shape[:2], 4))
    for scene, share in zip(scenes, opacity, strict=True):
        draw_pose(layer, panel, scene, float(share), (depth.min(), depth.max()), surface)
    axes = _panel_axes(figure, _LEFT, bottom, size)
    _show_image(axes, image, zorder=1)
    _show_image(axes, layer, zorder=3)

    # The same line once behind the robots and once, faintly, in front of them.
    way, steady = panel.pixels(path), panel.pixels(motion.steady)
    axes.plot(*way.T, color=_PATH, lw=0.9, alpha=0.6, zorder=2)
    axes.plot(*steady.T, color=_PATH, lw=2.6, solid_capstyle="round", zorder=2)
    axes.plot(*steady.T, color=_PATH, lw=1.4, alpha=0.7, solid_capstyle="round", zorder=4)
    axes.plot(*way[motion.poses].T, "o", color="white", markeredgecolor=_PATH, markeredgewidth=2,
              markersize=7, zorder=5)  # fmt: skip
    places = Places(axes, layer[..., 3] > 0.02)
    places.take_line(way)
    if target is not None:
        draw_target(panel, target, path[-1], places)
    _label_poses(motion, panel, scenes, places, surface is None)
    if moves(motion.current):
        mean = motion.current.mean(axis=0)
        if np.linalg.norm(mean) > 0.1 * np.linalg.norm(motion.current, axis=1).mean():
            draw_current(panel, mean, places)
    draw_scale_bars(panel, motion.along, length, places)
    if surface is not None:
        spots = [(x, y) for y in range(size[1] - 20, 20, -10) for x in range(90, size[0] - 90, 20)]
        places.put(write(axes, (0, 0), "water surface", color=SOFT), spots)


def _is_near(motion: Motion, target: np.ndarray) -> bool:
    """Whether a target has room in the picture: within half the way of it, or two bodies."""
    away = float(np.linalg.norm(motion.path - target, axis=1).min())
    way = float(np.linalg.norm(motion.path[-1] - motion.path[0]))
    return away <= max(0.5 * way, 2 * motion.length)


def _label_poses(
    motion: Motion, panel: Panel, scenes: Sequence[Scene], places: Places, deep: bool
) -> None:
    """When each pose was, and how deep the core is in the first and the last, if `deep`."""
    ends = (motion.poses[0], motion.poses[-1])
    # Further away, it could be a neighbour's.
    sides = (0, 25, -25, 50, -50) + (100, -100, 150, -150) * (len(scenes) == 1)
    for row, scene in zip(motion.poses, scenes, strict=True):
        x, y = at = panel.pixels(motion.path[row])
        when = f"{motion.time[row]:.1f}".removesuffix(".0") + " s"
        reach = int(np.abs(panel.pixels(scene.corners.reshape(-1, 3)) - at).max()) + 60
        spots = [(x + side, y + sign * up) for up in range(20, reach, 4) for sign in (1, -1)
                 for side in sides]  # fmt: skip
        depth = f"\ndepth {motion.depth[row]:.2f} m" if deep and row in ends else ""
        for words in dict.fromkeys((when + depth, when)):
            label = write(places.axes, (x, y), words, fontsize=14, fontweight="bold")
            if places.put(label, spots):
                break


def _draw_stroke(figure: Figure, motion: Motion, pieces: Sequence[Piece], view: np.ndarray) -> None:
    """The strip: snapshots of one stroke, or of the last second."""
    rows = stroke_rows(motion.time, motion.period, _SNAPSHOTS)
    places = motion.path[rows]
    scenes = [pose_scene(motion.robot, motion.qpos[row], pieces) for row in rows]
    size = ((_PAGE[0] - 2 * _LEFT - (_SNAPSHOTS - 1) * _GAP) // _SNAPSHOTS, _STRIP)
    around = np.concatenate(
        [scene.corners.reshape(-1, 3) - at for scene, at in zip(scenes, places, strict=True)]
    )
    home = fit_panel(view, around, size, (8, 8, 10, 26))
    depth = around @ view[2]
    for k, (scene, at) in enumerate(zip(scenes, places, strict=True)):
        panel = replace(home, low=home.low + view[:2] @ at)
        near = float(view[2] @ at)
        image = open_water(size)
        top = float(scene.corners[..., 2].max())
        surface = _surface(motion, at[None, :2], top, motion.length)
        if surface is not None:
            draw_surface(image, panel, surface)
        layer = np.zeros((size[1], size[0], 4))
        draw_pose(layer, panel, scene, 1.0, (near + depth.min(), near + depth.max()), surface)
        axes = _panel_axes(figure, _LEFT + k * (size[0] + _GAP), _LEFT, size)
        _show_image(axes, image * (1.0 - layer[..., 3:]) + layer[..., :3], zorder=1)
        since = motion.time[rows[k]] - motion.time[rows[0]]
        late = f"+{since:.2f} s" if k else f"{motion.time[rows[0]]:.2f} s"
        write(axes, (12, size[1] - 17), late, ha="left")
    period = motion.period
    words = "the last second" if period is None else f"one stroke of {period:.2f} s"
    figure.text(_LEFT / _PAGE[0], (_LEFT + _STRIP + 19) / _PAGE[1],
                f"{words.capitalize()}, seen by a camera that follows the core",
                fontsize=12, color=INK, va="center")  # fmt: skip


def _headline(motion: Motion) -> str:
    """Who, and how fast while it counts."""
    name = str(motion.robot.morphology.name)
    if motion.seconds <= 0.0:
        return name
    words = f"{name}: {motion.speed / motion.length:.2g} body lengths/s ({motion.speed:.2g} m/s)"
    if not moves(motion.current):
        return words
    # What drifts covers ground without swimming.
    return f"{words} over ground, {motion.water_speed / motion.length:.2g} through the water"


def _facts(motion: Motion) -> str:
    """How far and how long."""
    begun = motion.time[motion.first]
    when = f"after the first {begun:.3g} s" if motion.first else "getting under way included"
    return (
        f"{motion.distance:.2g} m ({motion.distance / motion.length:.2g} body lengths) in "
        f"{motion.seconds:.3g} s, {when}"
    )


def draw_motion(motion: Motion) -> Figure:
    """Draws the way a robot swam.

    Args:
        motion: what it did.

    Returns:
        The figure: poses along the way with the core's path, and below them six snapshots of one
        stroke where the robot has hinges. Speed and distance are those that count.
    """
    width, height = _PAGE
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    heading = math.degrees(math.atan2(motion.along[1], motion.along[0]))
    view = make_view(heading - 90.0 + _TOWARDS, _ELEVATION)
    pieces = make_pieces(motion.robot.morphology)
    strip = motion.robot.num_hinges > 0 and len(motion.time) > 1
    if strip:
        _draw_stroke(figure, motion, pieces, view)
    scenes = [pose_scene(motion.robot, motion.qpos[row], pieces) for row in motion.poses]
    _draw_way(figure, motion, scenes, view, _LEFT + (_STRIP + 38 if strip else 0))

    left, line = _LEFT / width, 1.0 - 0.5 * _TOP / height
    figure.text(left, line, _headline(motion), fontsize=17, color=INK, va="center")
    figure.text(1.0 - left, line, _facts(motion), fontsize=12, color=SOFT, ha="right", va="center")
    return figure


def plot_swim(
    robot: Robot,
    trajectory: Trajectory,
    counted_from: float = 0.0,
    water: Water | None = None,
    target: np.ndarray | None = None,
) -> Figure:
    """Draws the way a robot swam, see `draw_motion`.

    Args:
        robot: the robot.
        trajectory: what it did. Rows after the first that is not finite are left out.
        counted_from: when its task begins to count, see `motion.counted_time` [s].
        water: surface and current, each a number or a row for each step; None: the world's.
        target: `[3]` where it was to go, world frame [m].

    Returns:
        The figure.

    Raises:
        InputError: the trajectory is another robot's, or has no finite row.
    """
    return draw_motion(analyse_motion(robot, trajectory, counted_from, None, water, target))
