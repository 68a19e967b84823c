"""Words and scale bars on a picture, none on another or on the robot; all in the panel's pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from mjx_revolve.view.water_panel import Panel, round_values

INK, SOFT = "#17303f", "#4d6675"


class Places:
    """Which pixels of a panel are taken.

    Attributes:
        axes: whose units are the panel's pixels.
        taken: `[rows, columns]` bool.
    """

    def __init__(self, axes: Axes, taken: np.ndarray):
        self.axes = axes
        self.taken = taken

    def extent(self, text: Text) -> np.ndarray:
        """Lower left and upper right corner of a text: `[2, 2]`."""
        box = text.get_window_extent(cast(FigureCanvasAgg, text.figure.canvas).get_renderer())
        return self.axes.transData.inverted().transform(box.get_points())

    def _window(self, low: np.ndarray, high: np.ndarray) -> tuple[slice, slice]:
        (left, bottom), (right, top) = (np.maximum(np.round(k).astype(int), 0) for k in (low, high))
        return slice(bottom, top + 1), slice(left, right + 1)

    def free(self, low: np.ndarray, high: np.ndarray, pad: int) -> bool:
        """Whether a box lies in the panel with nothing else within `pad` of it."""
        rows, columns = self.taken.shape
        inside = min(low) >= pad and high[0] < columns - pad and high[1] < rows - pad
        return bool(inside and not self.taken[self._window(low - pad, high + pad)].any())

    def take(self, low: np.ndarray, high: np.ndarray) -> None:
        """Marks a box."""
        self.taken[self._window(low, high)] = True

    def take_line(self, points: np.ndarray) -> None:
        """Marks a line `[n, 2]` and three pixels on both sides of it."""
        for start, end in pairwise(points):
            count = int(min(np.abs(end - start).max() // 3, 1000)) + 2
            for point in np.linspace(start, end, count):
                self.take(point - 3, point + 3)

    def put(self, text: Text, spots: Iterable[Sequence[float]]) -> bool:
        """Moves a text to the first of the spots that is free; removes it where none is.

        Returns:
            Whether it is there.
        """
        for spot in spots:
            text.set_position((spot[0], spot[1]))
            low, high = self.extent(text)
            if self.free(low, high, 6):
                self.take(low, high)
                return True
        text.remove()
        return False


def write(axes: Axes, spot: Sequence[float], words: str, **style: Any) -> Text:
    """Words with a pale rim, so that they can be read on any ground."""
    look: dict[str, Any] = {"fontsize": 11, "color": INK, "ha": "center", "va": "center"}
    rim = [withStroke(linewidth=2.5, foreground=(1, 1, 1, 0.55))]
    return axes.text(spot[0], spot[1], words, path_effects=rim, zorder=8, **(look | style))


_CURRENT, _TARGET = "#0b7a85", "#c2185b"
_ARROW = 62  # of a current's arrow [pixels]


def draw_current(panel: Panel, velocity: np.ndarray, places: Places) -> None:
    """An arrow along a current, and how fast it is, where the upper left corner is free.

    Args:
        panel: whose projection shows its direction; the length says nothing.
        velocity: `[3]` of the water, world frame [m/s].
        places: what is taken.
    """
    size = float(np.linalg.norm(velocity))
    along = panel.view[:2] @ velocity / size  # its length is below 1 where it leads away or nearer
    arrow = _ARROW * along / max(float(np.linalg.norm(along)), 0.5)
    words = f"current {size:.2g} m/s"
    label = write(places.axes, (0, 0), words, color=_CURRENT, fontweight="bold")
    wide, high = np.ptp(places.extent(label), axis=0)
    box = np.array([max(wide, abs(arrow[0])), high + 14 + abs(arrow[1])])
    columns, rows = panel.size
    for low in (np.array([x, y]) for y in range(rows - 14, 20, -8) for x in range(14, columns, 24)):
        low = low - [0, box[1]]
        if places.free(low, low + box, 8):
            break
    else:
        label.remove()
        return
    places.take(low, low + box)
    label.set_position((low[0] + box[0] / 2, low[1] + box[1] - high / 2))
    middle = low + np.array([box[0] / 2, (box[1] - high - 6) / 2])
    _arrow(places.axes, middle - arrow / 2, middle + arrow / 2, _CURRENT)


def draw_target(panel: Panel, target: np.ndarray, here: np.ndarray, places: Places) -> None:
    """A mark on the target; or, where it is out of the picture, an arrow that points there.

    Args:
        panel: what is shown.
        target: `[3]` world frame [m].
        here: `[3]` where the robot ends, world frame [m].
        places: what is taken.
    """
    (x, y), (columns, rows) = panel.pixels(target), panel.size
    if 0 < x < columns and 0 < y < rows:
        for size, fill in ((16, "none"), (5, _TARGET)):
            places.axes.plot([x], [y], "o", markersize=size, markerfacecolor=fill,
                             markeredgecolor=_TARGET, markeredgewidth=2, zorder=6)  # fmt: skip
        places.take(np.array([x - 14, y - 14]), np.array([x + 14, y + 14]))
        spots = [(x + side, y + up) for up in (26, -26, 44, -44) for side in (0, 40, -40)]
        places.put(write(places.axes, (x, y), "target", color=_TARGET, fontweight="bold"), spots)
        return
    away = float(np.linalg.norm(target - here))
    start = panel.pixels(here)
    along = np.array([x, y]) - start
    along = along / np.linalg.norm(along)
    words = f"target, {away:.2g} m on"
    label = write(places.axes, (0, 0), words, color=_TARGET, fontweight="bold")
    for reach in range(70, 500, 12):
        middle = start + along * (reach + _ARROW / 2)
        label.set_position((middle[0], middle[1] + 16 + 0.5 * _ARROW * abs(along[1])))
        low, high = places.extent(label)
        low = np.minimum(low, middle - _ARROW / 2 * np.abs(along))
        high = np.maximum(high, middle + _ARROW / 2 * np.abs(along))
        if places.free(low, high, 4):
            places.take(low, high)
            _arrow(places.axes, middle - _ARROW / 2 * along, middle + _ARROW / 2 * along, _TARGET)
            return
    spots = [(columns - 110, y) for y in range(rows - 20, 20, -12)]
    places.put(label, spots)


def _arrow(axes: Axes, start: np.ndarray, end: np.ndarray, color: str) -> None:
    look: dict[str, Any] = {"arrowstyle": "-|>", "color": color, "lw": 2.6, "mutation_scale": 18}
    look |= {"shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (end[0], end[1]), (start[0], start[1]), zorder=7, arrowprops=look)


def draw_scale_bars(panel: Panel, along: np.ndarray, length: float, places: Places) -> None:
    """Bars of a round number of metres and of one body length, parallel to the way.

    In a parallel projection they may lie anywhere: where the lower left corner is free. If there is
    no room for both, the first has to do, or a shorter one; over the robot they would be read
    wrongly.

    Args:
        panel: whose projection they measure.
        along: `[2]` unit vector of the way.
        length: of the body [m].
        places: what is taken.
    """
    rounds = round_values(0.0, length, 4)
    bars = [(float(x), f"{x:g} m") for x in rounds if 0 < x <= 1.001 * length]
    own = (length, f"1 body length ({length:.2g} m)")
    unit = np.subtract(*panel.pixels([[*along, 0.0], [0.0, 0.0, 0.0]]))  # pixels per metre
    for sizes in ((bars[-1], own), bars[-1:], bars[:1]):
        marks = _scale_marks(places.axes, unit, sizes)
        corners = np.concatenate(
            [line for _, line in marks] + [places.extent(text) for text, _ in marks]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        columns, rows = panel.size
        # Columns first: better further right than up beside the robot.
        spots = (
            np.array([x, y]) for y in range(16, rows // 3, 8) for x in range(20, columns // 2, 24)
        )
        spot = next((s for s in spots if places.free(s, s + high - low, 8)), None)
        if spot is None:
            for text, _ in marks:
                text.remove()
            continue
        shift = spot - low
        places.take(low + shift, high + shift)
        for text, line in marks:
            text.set_position(np.asarray(text.get_position()) + shift)
            places.axes.plot(*(line + shift).T, color=INK, lw=1.8, solid_capstyle="butt",
                             solid_joinstyle="miter", zorder=7)  # fmt: skip
        return


def _scale_marks(
    axes: Axes, unit: np.ndarray, sizes: Sequence[tuple[float, str]]
) -> list[tuple[Text, np.ndarray]]:
    """Texts and lines of bars from a common origin; `unit` are pixels per metre, `[2]`."""
    angle = math.degrees(math.atan2(unit[1], unit[0]))
    ahead = unit / np.linalg.norm(unit)
    across = np.array([ahead[1], -ahead[0]])
    marks = []
    for k, (size, label) in enumerate(sizes):
        start = 26 * k * across
        end = start + size * unit
        text = write(axes, end + 12 * ahead, label, ha="left", rotation=angle,
                     rotation_mode="anchor")  # fmt: skip
        tick = 5 * across
        line = np.array([start - tick, start + tick, start, end, end - tick, end + tick])
        marks.append((text, line))
    return marks
