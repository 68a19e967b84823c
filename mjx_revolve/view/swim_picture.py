"""Picture of a swimming robot: poses along its way from above and from the side, and one stroke.

Drawn with the depth buffer of `raster`, so it needs no display and no graphics driver. All views
are parallel projections, turned so that the robot swims to the right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

from mjx_revolve.numerics.spatial import quat_to_matrix
from mjx_revolve.view.motion import Motion, analyse_motion, stroke_rows
from mjx_revolve.view.palette import ACCENT, CURRENT, RGB, SAND, TARGET
from mjx_revolve.view.pieces import Scene, make_pieces, mount_piece, place_pieces
from mjx_revolve.view.plots import INK, in_style, new_figure
from mjx_revolve.view.poses import pose_robot
from mjx_revolve.view.raster import make_view, show_scene
from mjx_revolve.view.surroundings import bed_at, is_moving
from mjx_revolve.water.flow import Water

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.config import TaskConfig
    from mjx_revolve.episodes.simulate import Trajectory

_INCHES, _DPI = (16.0, 9.0), 100
_LEFT, _RIGHT, _TOP, _GAP = 0.95, 0.3, 0.74, 0.14  # free margins of the page [inches]
_STRIP, _SNAPSHOTS = 2.0, 6  # height [inches] and number of the snapshots of a stroke
_SOFT, _WATER, _SURFACE = "#4d6675", "#eaf3f9", "#2f7fb5"
_FLOW: RGB = (0.5 * CURRENT[0], 0.5 * CURRENT[1], 0.5 * CURRENT[2])  # darker, on pale water
_RIM = [withStroke(linewidth=2.5, foreground=(1, 1, 1, 0.7))]  # around words on any ground
# The surface and the bed are shown where they are at most this far away [body lengths].
_SURFACE_NEAR, _BED_NEAR = 0.3, 0.6
_SHORTER = 0.28  # share of the height that the lower of both views has at least


def pose_scenes(robot: Robot, qpos: np.ndarray) -> list[Scene]:
    """The robot's parts in poses `qpos` `[S, nq]`: a scene for each, world frame [m]."""
    poses, pieces = pose_robot(robot, qpos), make_pieces(robot.morphology)
    mounts = [mount_piece(robot, piece) for piece in pieces]
    scenes = []
    for place, turn in zip(poses.position, quat_to_matrix(poses.quaternion), strict=True):
        frames = [(place[k] + turn[k] @ at, turn[k] @ own) for k, at, own in mounts]
        scenes.append(place_pieces(pieces, frames))
    return scenes


def plot_swim(
    robot: Robot,
    trajectory: Trajectory,
    counted_from: float = 0.0,
    water: Water | None = None,
    target: np.ndarray | None = None,
    task: TaskConfig | None = None,
) -> Figure:
    """Draws the way a robot swam, see `draw_motion`.

    Args:
        robot: the robot.
        trajectory: of the robot. Rows after the first that is not finite are left out.
        counted_from: when its task begins to count, see `motion.counted_time` [s].
        water: surface and current, each a number or a row for each step; None: the world's.
        target: `[3]` that it was to reach, world frame [m].
        task: see `motion.analyse_motion`.

    Returns:
        The figure.

    Raises:
        InputError: the trajectory is another robot's, or has no finite row.
    """
    return draw_motion(analyse_motion(robot, trajectory, counted_from, water, target, task))


@in_style
def draw_motion(motion: Motion) -> Figure:
    """Draws the way a robot swam.

    Args:
        motion: of the robot.

    Returns:
        The figure: poses along the way with the core's path, from above and from the side in one
        scale, and below them six snapshots of one stroke where the robot has hinges. Speed and
        distance are those that count.
    """
    width, height = _INCHES
    figure = new_figure(width, height)
    figure.set(dpi=_DPI, layout_engine="none")
    line = 1.0 - 0.5 * _TOP / height
    figure.text(0.36 / width, line, _headline(motion), fontsize=17, color=INK, va="center")
    figure.text(1 - _RIGHT / width, line, _facts(motion), fontsize=12, color=_SOFT, ha="right",
                va="center")  # fmt: skip
    strip = bool(stroke_words(motion))
    _draw_way(figure, motion, 0.7 + (_STRIP + 0.65 if strip else 0.0))
    if strip:
        _draw_stroke(figure, motion)
    return figure


def stroke_words(motion: Motion) -> str:
    """What the strip of snapshots shows; nothing where there is none."""
    if motion.robot.num_hinges == 0 or len(motion.time) < 2:
        return ""
    return "the last second" if motion.period is None else "one stroke"


def _headline(motion: Motion) -> str:
    """Name, and mean speed while it counts."""
    name = motion.robot.morphology.title
    if motion.seconds <= 0.0:
        return name
    words = f"{name}: {motion.speed / motion.length:.2g} body lengths/s ({motion.speed:.2g} m/s)"
    if not is_moving(motion.current):
        return words
    # A robot that drifts covers ground without swimming.
    return f"{words} over ground, {motion.water_speed / motion.length:.2g} through the water"


def _facts(motion: Motion) -> str:
    """Distance and time while it counts."""
    begun = motion.time[motion.first]
    lengths = motion.distance / motion.length
    way = f"one episode: {motion.distance:.2g} m ({lengths:.2g} body lengths)"
    return f"{way} in {motion.seconds:.3g} s, from {begun:.3g} s on"


def _axes_at(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes of so many inches, that far from the page's lower left corner."""
    wide, high = _INCHES
    return figure.add_axes((left / wide, bottom / high, width / wide, height / high))


def _write(axes: Axes, words: str, at: Any, **style: Any) -> None:
    axes.annotate(words, at, path_effects=_RIM, zorder=8,
                  **{"color": INK, "ha": "center", "va": "center"} | style)  # fmt: skip


# --- the way --------------------------------------------------------------------------------------


def _draw_way(figure: Figure, motion: Motion, bottom: float) -> None:
    """Plan and side view of poses along the way, in metres from the start and the surface."""
    length = motion.length
    origin = np.array([*motion.path[0, :2], motion.surface[0]])
    heading = math.degrees(math.atan2(motion.along[1], motion.along[0]))
    plan, side = make_view(heading - 90.0, 90.0), make_view(heading - 90.0, 0.0)
    scenes = [replace(scene, corners=scene.corners - origin)
              for scene in pose_scenes(motion.robot, motion.qpos[motion.poses])]  # fmt: skip
    path, steady = motion.path - origin, motion.steady - origin
    target = None if motion.target is None else motion.target - origin
    near = target is not None and _is_near(motion, target, path)
    points = np.concatenate([*(scene.corners.reshape(-1, 3) for scene in scenes), path,
                             *([target[None]] if near and target is not None else [])])  # fmt: skip
    ahead, across = points @ plan[0], points @ plan[1]
    bed = _bed_profile(motion, points, side, origin)
    heights = [points[:, 2].min(), points[:, 2].max()]
    if bed is not None:
        heights[0] = min(heights[0], *np.interp([ahead.min(), ahead.max()], *bed))
    if heights[1] > -_SURFACE_NEAR * length:
        heights[1] = max(heights[1], 0.0)
    low = np.array([ahead.min(), across.min(), heights[0]]) - 0.12 * length
    high = np.array([ahead.max(), across.max(), heights[1]]) + 0.2 * length
    middle, unit, boxes = (low + high) / 2, *_arrange(high - low, bottom)
    both = []
    for view, centre, (left, at, wide, tall) in zip(
        (plan, side), (middle[[0, 1]], middle[[0, 2]]), boxes, strict=True
    ):
        axes = _axes_at(figure, left, at, wide, tall)
        (x0, y0), (x1, y1) = (centre + sign * unit * np.array([wide, tall]) / 2 for sign in (-1, 1))
        axes.axis((x0, x1, y0, y1))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=int(0.8 * wide), steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(nbins=max(3, int(tall)), steps=[1, 2, 5, 10]))
        axes.set_facecolor(_WATER)
        axes.grid(color="white", linewidth=1.0)
        axes.tick_params(labelsize=12)
        fades = np.linspace(0.45, 1.0, len(scenes)) if len(scenes) > 1 else [1.0]
        for scene, fade in zip(scenes, fades, strict=True):
            show_scene(axes, scene, view, unit / _DPI, float(fade))
        # The same line once behind the robots and once, faintly, in front of them.
        way, smooth = path @ view[:2].T, steady @ view[:2].T
        axes.plot(*way.T, color=ACCENT, linewidth=0.9, alpha=0.6, zorder=2)
        axes.plot(*smooth.T, color=ACCENT, linewidth=2.6, zorder=2)
        axes.plot(*smooth.T, color=ACCENT, linewidth=1.4, alpha=0.7, zorder=4)
        axes.plot(*way[motion.poses].T, "o", color="white", markeredgecolor=ACCENT,
                  markeredgewidth=1.6, markersize=5, zorder=5)  # fmt: skip
        if target is not None and (near or view is plan):
            away = float(np.linalg.norm(target - path[-1]))
            words = motion.target_name + ("" if near else f", {away:.2g} m on")
            _draw_target(axes, words, view[:2] @ target, way[-1], near, unit)
        both.append(axes)
    above, beside = both
    if boxes[0][0] == boxes[1][0]:  # above each other
        above.tick_params(labelbottom=False)
    else:
        above.set_xlabel("along the way (m)", fontsize=13)
    above.set_ylabel("across (m)", fontsize=13)
    beside.set_xlabel("along the way (m)", fontsize=13)
    beside.set_ylabel("depth (m)", fontsize=13)
    beside.yaxis.set_major_formatter(FuncFormatter(lambda z, _: f"{0.0 - z:.4g}".replace("-", "−")))
    for axes, words in ((above, "from above"), (beside, "from the side")):
        axes.text(0.99, 0.03, words, transform=axes.transAxes, color=_SOFT, ha="right")
    if heights[1] >= 0.0:
        beside.axhspan(0.0, beside.get_ylim()[1], color="white", zorder=0)
        beside.axhline(0.0, color=_SURFACE, linewidth=1.6, zorder=1)
        beside.text(0.985, 0.0, "water surface", color=_SURFACE, fontsize=8, ha="right",
                    va="bottom", transform=beside.get_yaxis_transform())  # fmt: skip
    if bed is not None:
        beside.fill_between(*bed, beside.get_ylim()[0], color=SAND, zorder=1)
    _label_poses(beside, motion, scenes, side, 0.5 * unit)
    above.add_artist(AnchoredSizeBar(
        above.transData, length, f"1 body length ({length:.2g} m)", "lower left", frameon=False,
        color=INK, sep=4, borderpad=0.6, size_vertical=0.03 * unit,
    ))  # fmt: skip
    _draw_current(above, motion.current, plan, unit)


Box = tuple[float, float, float, float]
"""Left, bottom, width and height of axes [inches]."""


def _arrange(size: np.ndarray, bottom: float) -> tuple[float, tuple[Box, Box]]:
    """Metres per inch and the boxes of plan and side view, whichever way they become larger.

    Above each other or side by side; both views have one scale and fill the page.

    Args:
        size: `[3]` along the way, across it and upwards of what is shown [m].
        bottom: of the lower view [inches].
    """
    wide, tall = _INCHES[0] - _LEFT - _RIGHT, _INCHES[1] - _TOP - bottom
    share = float(np.clip(size[2] / size[1:].sum(), _SHORTER, 1 - _SHORTER))
    low, high, half = (tall - _GAP) * share, (tall - _GAP) * (1 - share), (wide - _LEFT) / 2
    stacked = (_LEFT, bottom + low + _GAP, wide, high), (_LEFT, bottom, wide, low)
    paired = (_LEFT, bottom, half, tall), (2 * _LEFT + half, bottom, half, tall)

    def unit(boxes: tuple[Box, Box]) -> float:
        (_, _, w, h), (_, _, _, below) = boxes
        return float((size / [w, h, below]).max())

    return min(((unit(boxes), boxes) for boxes in (stacked, paired)), key=lambda found: found[0])


def _is_near(motion: Motion, target: np.ndarray, path: np.ndarray) -> bool:
    """Whether a target has room in the picture: within half the way of it, or two bodies."""
    away = float(np.linalg.norm(path - target, axis=1).min())
    return away <= max(0.5 * float(np.linalg.norm(path[-1] - path[0])), 2 * motion.length)


def _bed_profile(
    motion: Motion, points: np.ndarray, side: np.ndarray, origin: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Places along the way and heights of the bed there, if it is near the points `[n, 3]`."""
    if motion.robot.world.bed is None:
        return None
    ahead, across = points @ side[0], points @ side[2]
    span = float(np.ptp(ahead)) + 4 * motion.length
    x = (ahead.min() + ahead.max()) / 2 + np.linspace(-2 * span, 2 * span, 400)
    place = np.outer(x, side[0, :2]) + across.mean() * side[2, :2] + origin[:2]
    z = bed_at(motion.robot.world.bed, *place.T) - origin[2]
    below = float((points[:, 2] - np.interp(ahead, x, z)).min())
    return (x, z) if below < _BED_NEAR * motion.length else None


def _label_poses(
    axes: Axes, motion: Motion, scenes: Sequence[Scene], view: np.ndarray, least: float
) -> None:
    """The time of each pose above it, where the last label is at least `least` [m] away."""
    last = None
    for row, scene in zip(motion.poses, scenes, strict=True):
        low, high = scene.bounds(view)
        at = np.array([(low[0] + high[0]) / 2, high[1]])
        if last is None or np.abs(at - last).max() > least:
            when = f"{motion.time[row]:.1f}".removesuffix(".0") + " s"
            _write(axes, when, at, xytext=(0, 9), textcoords="offset points", fontsize=12,
                   fontweight="bold")  # fmt: skip
            last = at


def _draw_current(axes: Axes, current: np.ndarray, plan: np.ndarray, unit: float) -> None:
    """An arrow along the mean of velocities `[T, 3]` in the upper left corner, and its speed."""
    mean = current.mean(axis=0)
    speed = float(np.linalg.norm(mean))
    if is_moving(current) and speed > 0.1 * np.linalg.norm(current, axis=1).mean():
        corner = np.array([axes.get_xlim()[0], axes.get_ylim()[1]])
        words = f"current {speed:.2g} m/s"
        _write(axes, words, corner + unit * np.array([1.0, -0.2]), color=_FLOW, fontsize=11)
        middle, ahead = corner + unit * np.array([1.0, -0.5]), 0.35 * unit * (plan[:2] @ mean)
        _arrow(axes, middle - ahead / speed, middle + ahead / speed, _FLOW)


def _draw_target(
    axes: Axes, words: str, target: np.ndarray, here: np.ndarray, near: bool, unit: float
) -> None:
    """A mark on the target; where it is out of the picture, an arrow from `here` towards it."""
    if near:
        axes.plot(*target, "o", color="none", markersize=15, markeredgecolor=TARGET,
                  markeredgewidth=2, zorder=6)  # fmt: skip
        axes.plot(*target, "o", color=TARGET, markersize=5, zorder=6)
        _write(axes, words, target + unit * np.array([0, 0.22]), color=TARGET, fontsize=11)
        return
    ahead = unit * (target - here) / max(float(np.linalg.norm(target - here)), 1e-9)
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    end = np.clip(here + 1.2 * ahead, low + 0.1 * unit, high - 0.1 * unit)
    _arrow(axes, end - 0.6 * ahead, end, TARGET)
    _write(axes, words, end + unit * np.array([0, 0.2]), color=TARGET, fontsize=11, ha="right")


def _arrow(axes: Axes, start: np.ndarray, end: np.ndarray, color: RGB) -> None:
    look = {"arrowstyle": "-|>", "color": color, "lw": 2.6, "mutation_scale": 18, "shrinkB": 0}
    axes.annotate("", (end[0], end[1]), (start[0], start[1]), zorder=7, arrowprops=look)


# --- one stroke -----------------------------------------------------------------------------------


def _draw_stroke(figure: Figure, motion: Motion) -> None:
    """The strip: snapshots of one stroke, or of the last second, from a little above."""
    rows = stroke_rows(motion.time, motion.period, _SNAPSHOTS)
    heading = math.degrees(math.atan2(motion.along[1], motion.along[0]))
    view = make_view(heading - 76.0, 20.0)
    scenes = [replace(scene, corners=scene.corners - motion.path[row]) for row, scene in
              zip(rows, pose_scenes(motion.robot, motion.qpos[rows]), strict=True)]  # fmt: skip
    flat = np.concatenate([scene.corners.reshape(-1, 3) for scene in scenes]) @ view[:2].T
    low, high = flat.min(axis=0), flat.max(axis=0)
    box = np.array([(_INCHES[0] - 2 * _RIGHT + _GAP) / _SNAPSHOTS - _GAP, _STRIP])
    unit = float(((high - low) / (box - 0.3)).max())
    middle, half = (low + high) / 2, unit * box / 2
    for k, (row, scene) in enumerate(zip(rows, scenes, strict=True)):
        axes = _axes_at(figure, _RIGHT + k * (box[0] + _GAP), 0.25, *box)
        axes.set(xticks=[], yticks=[], facecolor=_WATER)
        axes.spines[:].set_visible(False)
        axes.axis((middle[0] - half[0], middle[0] + half[0],
                   middle[1] - half[1], middle[1] + half[1]))  # fmt: skip
        show_scene(axes, scene, view, unit / _DPI)
        since = motion.time[row] - motion.time[rows[0]]
        late = f"+{since:.2f} s" if k else f"{motion.time[row]:.2f} s"
        axes.text(0.04, 0.96, late, transform=axes.transAxes, color=INK, fontsize=11, va="top")
    period = motion.period
    words = "The last second" if period is None else f"One stroke of {period:.2f} s"
    figure.text(_RIGHT / _INCHES[0], (_STRIP + 0.42) / _INCHES[1],
                f"{words}, seen by a camera that follows the core", fontsize=12, color=INK,
                va="center")  # fmt: skip
