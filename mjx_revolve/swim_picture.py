"""Picture of a swimming robot: poses along its way, and one stroke seen by a camera that follows.

Drawn with the depth buffer of `pictures`, so it needs no display and no graphics driver. The view
is a parallel projection from a little above, turned so that the robot swims to the right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter, map_coordinates

from mjx_revolve.errors import InputError
from mjx_revolve.pictures import (
    Piece,
    Scene,
    check_picture_path,
    draw_scene,
    make_pieces,
    make_view,
    place_pieces,
    write_figure,
)

if TYPE_CHECKING:
    from mjx_revolve.robot import Robot
    from mjx_revolve.rollout import Trajectory
    from mjx_revolve.world import World

_PAGE = (1600, 900)  # pixels
_DPI = 100
_LEFT, _TOP, _GAP = 36, 74, 14  # of the panels on the page [pixels]
_STRIP = 212  # height of the snapshots
_INK, _SOFT = "#17303f", "#4d6675"
_HIGH_WATER, _LOW_WATER = np.array([0.925, 0.968, 0.985]), np.array([0.52, 0.745, 0.86])
_SAND = np.array([0.80, 0.74, 0.58])
_PATH = "#e2711d"

_ELEVATION = 20.0  # of the viewer [deg]
_TOWARDS = 20.0  # the robot swims this much towards the viewer, not straight to the right [deg]
_MOST = 6  # poses in the large picture, and snapshots of the stroke
# Neighbouring poses are at least this far apart [body lengths]; two alone may be closer.
_APART, _PAIR = 0.55, 0.35
# A stroke must come back to where it began: correlation with the record one period earlier.
_REPEATS = 0.7


# --- what to show -------------------------------------------------------------------------------


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
    modules, fluid = robot.morphology.modules, robot.fluid
    row = np.cumsum([0] + [len(module.kind.parts) for module in modules])

    def place(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
        k = row[piece.module] + piece.part
        part = modules[piece.module].kind.parts[piece.part]
        body = fluid.body[k]
        frame = data.xmat[body].reshape(3, 3)
        rotation = frame @ fluid.rotation[k]
        # The table has the centre of the part's main box.
        center = np.asarray(part.position) + np.asarray(part.boxes[0].position)
        return data.xpos[body] + frame @ fluid.position[k] - rotation @ center, rotation

    return place_pieces(make_pieces(robot.morphology) if pieces is None else pieces, place)


def choose_poses(time: np.ndarray, path: np.ndarray, length: float) -> list[int]:
    """Rows of a trajectory at equal times that can be told apart.

    Args:
        time: `[T]` [s].
        path: `[T, 3]` of the core [m].
        length: of the body [m].

    Returns:
        At most six rows from the first to the last; only the last where the robot stayed.
    """
    for count in range(_MOST, 1, -1):
        moments = np.linspace(time[0], time[-1], count)
        rows = np.abs(time[:, None] - moments).argmin(axis=0)
        apart = np.linalg.norm(path[rows, None] - path[rows], axis=-1) / length
        apart[np.diag_indices(count)] = np.inf
        if apart.min() >= (_APART if count > 2 else _PAIR):
            return rows.tolist()
    return [len(time) - 1]


def stroke_period(time: np.ndarray, angles: np.ndarray) -> float | None:
    """Period of the strokes, from the strongest frequency of all hinges together.

    Args:
        time: `[T]` [s], equal steps.
        angles: `[T, nhinge]` [rad].

    Returns:
        The period [s]; None where the hinges do not repeat themselves.
    """
    late = slice(len(time) // 3, None)  # the beginning is no steady stroke
    time, angles = time[late], angles[late]
    count = len(time)
    if count < 16 or angles.shape[1] == 0 or np.ptp(angles, axis=0).max() < 0.02:
        return None
    step = float(time[-1] - time[0]) / (count - 1)
    waves = (angles - angles.mean(axis=0)) * np.hanning(count)[:, None]
    power = (np.abs(np.fft.rfft(waves, 16 * count, axis=0)) ** 2).sum(axis=1)
    power[: 16 * 2] = 0.0  # fewer than two periods in the record are no period
    period = 16 * count * step / int(power.argmax())
    lag = round(period / step)
    if lag < 4:
        return None
    late, early = angles[lag:] - angles.mean(axis=0), angles[:-lag] - angles.mean(axis=0)
    alike = (late * early).sum() / max(math.sqrt((late**2).sum() * (early**2).sum()), 1e-12)
    return period if alike >= _REPEATS else None


# --- a panel of the page ------------------------------------------------------------------------


@dataclass(frozen=True)
class _Panel:
    """A view into the water: pixels of the page against the world."""

    view: np.ndarray  # [3, 3] right, up, towards the viewer
    low: np.ndarray  # [2] lower left corner in the view [m]
    pixel: float  # [m]
    size: tuple[int, int]  # columns, rows

    def pixels(self, points: Any) -> np.ndarray:
        """Where points `[..., 3]` of the world lie: `[..., 2]` pixels from the lower left."""
        return (np.asarray(points, float) @ self.view[:2].T - self.low) / self.pixel

    def on_plane(self, height: float, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points x, y `[rows, columns, 2]` of the plane z = height + slope · (x, y), and z."""
        columns, rows = self.size
        right = self.low[0] + self.pixel * (np.arange(columns) + 0.5)
        up = self.low[1] + self.pixel * (np.arange(rows)[:, None] + 0.5)
        base = right[..., None] * self.view[0] + up[..., None] * self.view[1]
        towards = self.view[2]
        rise = height + base[..., :2] @ slope - base[..., 2]
        depth = rise / (towards[2] - towards[:2] @ slope)
        point = base + depth[..., None] * towards
        return point[..., :2], point[..., 2]


def _fit(view: np.ndarray, points: np.ndarray, size: tuple[int, int], margins: Sequence[int]) -> _Panel:
    """The panel that shows all points `[n, 3]` within margins: left, right, bottom, top [pixels]."""
    flat = points @ view[:2].T
    low, high = flat.min(axis=0), flat.max(axis=0)
    left, right, bottom, top = margins
    room = np.array([size[0] - left - right, size[1] - bottom - top])
    pixel = float(np.max((high - low) / room))
    corner = (low + high) / 2 - pixel * (np.array([left, bottom]) + room / 2)
    return _Panel(view, corner, pixel, size)


def _water(size: tuple[int, int]) -> np.ndarray:
    """Colours `[rows, columns, 3]` of open water: light from above, darker below."""
    columns, rows = size
    up = np.linspace(0.0, 1.0, rows)[:, None, None]
    side = np.linspace(-1.0, 1.0, columns)[None, :, None]
    light = np.clip(up**1.1 - 0.06 * side**2, 0.0, 1.0)
    return np.broadcast_to(_LOW_WATER + (_HIGH_WATER - _LOW_WATER) * light, (rows, columns, 3)).copy()


def _over(image: np.ndarray, color: Any, alpha: np.ndarray) -> None:
    """Lays a colour over an image, in place."""
    image += alpha[..., None] * (np.asarray(color) - image)
