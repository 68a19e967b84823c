"""The look of all figures and what they share: curves with bands, legends, colour bars, bytes.

Figures are made with matplotlib's objects, without pyplot's global state, so that they can be drawn
on a machine without a screen. `figures.mplstyle` has their look; a function that draws one is
decorated with `in_style`.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context, rc_params_from_file
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.body.descriptors import UNITS
from mjx_revolve.episodes.measure_table import MEASURES

STYLE = rc_params_from_file(
    Path(__file__).with_name("figures.mplstyle"), use_default_template=False
)
in_style = rc_context(STYLE)
"""Decorator of functions that draw: gives all that they make the look of `figures.mplstyle`."""
COLORS: tuple[str, ...] = tuple(STYLE["axes.prop_cycle"].by_key()["color"])
BLUE, ORANGE, GREEN = COLORS[:3]
INK, GREY, PALE, DEEP = "#222222", "#6b7680", "#b9c6cf", "#0b3c5d"
# Axis labels of the measures.
LABELS = {name: f"{m.words} ({m.unit.replace('-', '–')})" for name, m in MEASURES.items()}
NO_VALUE = "–"
WIDE = 9.0  # width of most figures [inches]
_DASHES: tuple[str | tuple, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))


class _StyledFigure(Figure):
    """A figure that is also drawn in the style, as matplotlib makes ticks while drawing."""

    @in_style
    def draw(self, renderer: RendererBase) -> None:
        super().draw(renderer)


def new_figure(width: float, height: float, title: str = "") -> Figure:
    """An empty figure of so many inches, with a canvas that needs no screen."""
    figure = _StyledFigure(figsize=(width, height))
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.012, ha="left", color=INK)
    return figure


def label_of(name: str) -> str:
    """Name and unit of a measure or descriptor; any other name as words."""
    unit = UNITS.get(name, "-").replace("m3", "m³")
    words = name.replace("num_", "number of ").replace("_", " ")
    return LABELS.get(name, words if unit in ("-", "modules") else f"{words} ({unit})")


def with_unit(words: str, unit: str) -> str:
    """A name and its unit, where there is one."""
    return f"{words} ({unit})" if unit else words


def format_number(value: float | None, digits: int = 3) -> str:
    """A number to so many digits, with a true minus; `–` where there is none."""
    if value is None or not np.isfinite(value):
        return NO_VALUE
    return f"{value:.{digits}g}".replace("-", "−")


def style_of(index: int) -> dict[str, Any]:
    """Colour and dash of the lines of a group of runs, by its number; colours vary first."""
    dash = _DASHES[(index // len(COLORS)) % len(_DASHES)]
    return {"color": COLORS[index % len(COLORS)], "linestyle": dash}


def letter(index: int) -> str:
    """Letter of a group of runs in tables and pictures, by its number: A, B ... Z, AA, AB ..."""
    return (letter(index // 26 - 1) if index >= 26 else "") + chr(ord("A") + index % 26)


def thin(count: int, most: int = 4000) -> np.ndarray:
    """Rows of a curve of `count` points that are drawn, evenly chosen: at most `most`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))


def curve_with_band(
    axes: Axes,
    x: np.ndarray,
    middle: np.ndarray | None,
    low: np.ndarray,
    high: np.ndarray,
    color: str,
    *,
    band: str | None = None,
    **style: Any,
) -> None:
    """Draws a curve `middle` over `x` and the band from `low` to `high`, `[T]` each.

    Args:
        axes: to draw into.
        x: abscissae.
        middle: the curve; None draws the band alone.
        low: lower edge of the band.
        high: upper edge.
        color: of both.
        band: of the band in the legend.
        **style: of the curve, and its `label` in the legend.
    """
    axes.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0, label=band)
    if middle is not None:
        axes.plot(x, middle, color=color, **{"linewidth": 1.6} | style)


def limit_to_most(axes: Axes, low: Sequence[np.ndarray], high: Sequence[np.ndarray]) -> None:
    """Sets vertical limits that leave out a few very low values, which would flatten the rest.

    Args:
        axes: nothing happens without finite values.
        low: curves of which the lowest few values may lie below the frame.
        high: curves of which all values lie within.
    """
    lows, highs = (np.concatenate([*curves, np.zeros(0)]) for curves in (low, high))
    lows, highs = lows[np.isfinite(lows)], highs[np.isfinite(highs)]
    if not lows.size or not highs.size:
        return
    bottom, top = float(np.percentile(lows, 5)), float(highs.max())
    # Only if they would take most of the frame.
    if top - lows.min() < 2.0 * (top - bottom):
        bottom = float(lows.min())
    margin = 0.06 * (top - bottom) or 0.1 * max(abs(top), 1e-3)
    axes.set_ylim(bottom - margin, top + margin)


def whole_numbers(axes: Axes, count: int = 6) -> None:
    """Ticks of the horizontal axis at about `count` round whole numbers."""
    # One tick is enough: the default of two would split the single generation of a short run.
    axes.xaxis.set_major_locator(
        MaxNLocator(integer=True, steps=[1, 2, 5, 10], nbins=count, min_n_ticks=1)
    )


def panels(figure: Figure, count: int, columns: int, xlabel: str = "", **share: Any) -> list[Axes]:
    """So many axes in rows of `columns`; the lowest of each column has the label `xlabel`.

    `share` are arguments of matplotlib's `subplots`: `sharex`, `sharey`.
    """
    grid = figure.subplots(-(-count // columns), columns, squeeze=False, **share).ravel()
    for axes in grid[count:]:
        axes.remove()
    for axes in grid[max(count - columns, 0) : count]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(xlabel)
    return list(grid[:count])


def legend_above(axes: Axes, side: float = 1.0) -> None:
    """Puts the legend, if there is one, into a line above axes, at the left (0) or right (1)."""
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        axes.legend(handles, labels, loc="lower left" if side < 0.5 else "lower right",
                    bbox_to_anchor=(side, 1.0), borderaxespad=0.2, borderpad=0.2,
                    ncols=len(labels))  # fmt: skip


def legend_outside(figure: Figure, axes: Axes, columns: int, where: str = "lower center") -> None:
    """Puts one legend for all axes, that of `axes`, beside them."""
    handles, labels = axes.get_legend_handles_labels()
    place: Any = f"outside {where}"
    if labels:
        figure.legend(handles, labels, loc=place, ncols=min(columns, len(labels)))


def color_bar(
    figure: Figure | SubFigure, shades: ScalarMappable, label: str, **where: Any
) -> Colorbar:
    """A colour bar without a frame; `where` are arguments of matplotlib's `colorbar`."""
    bar = figure.colorbar(shades, **where)
    bar.set_label(label, fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.grid(False)
    return bar


def figure_png(figure: Figure) -> bytes:
    """The bytes of a figure as a PNG."""
    return _bytes(figure, format="png", dpi=figure.dpi)


def figure_jpeg(figure: Figure) -> bytes:
    """The bytes of a figure as a JPEG: of a rendered robot a quarter of the PNG's size."""
    return _bytes(figure, format="jpeg", pil_kwargs={"quality": 90, "subsampling": 0})


def figure_svg(figure: Figure) -> bytes:
    """The bytes of a figure as an SVG that needs no fonts; the same figure, the same bytes."""
    return _bytes(figure, format="svg", metadata={"Date": None, "Creator": None})


@in_style
def _bytes(figure: Figure, **options: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, **options)
    return buffer.getvalue()
