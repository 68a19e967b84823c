"""Pictures of a morphology at rest: three-quarter, top and side view in one PNG."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_name, write_atomic
from mjx_revolve.view.pieces import rest_scene
from mjx_revolve.view.plots import figure_png, in_style, new_figure
from mjx_revolve.view.raster import REST_VIEW, make_view, show_scene

_DPI = 130
_INCHES = (13.0, 7.4)
_INK = "#3a4250"


def draw_morphology(morphology: Morphology, path: str | Path) -> None:
    """Draws a morphology at rest: three-quarter, top and side view, axes in metres.

    Modules have the colours of their file; the part of a hinge that moves is drawn darker than its
    frame. An orange rod is a hinge's axis, a green arrow the thrust of a command ahead. The file
    appears whole or not at all.

    Args:
        morphology: what to draw.
        path: where to write the PNG.

    Raises:
        InputError: `path` does not end in `.png`, its folder does not exist, or it cannot be
            written.
    """
    path = check_name(path, (".png",))
    if not path.parent.is_dir():
        raise InputError(path, f"the folder {path.parent} to exist", "none")
    try:
        write_atomic(path, figure_png(_compose(morphology)))
    except OSError as error:
        raise InputError(path, "a writable file", error.strerror) from None


@in_style
def _compose(morphology: Morphology) -> Figure:
    """The whole picture."""
    scene = rest_scene(morphology)
    low, high = scene.corners.min((0, 1)), scene.corners.max((0, 1))
    width, height = _INCHES
    figure = new_figure(width, height)
    figure.set(dpi=_DPI, layout_engine="none")
    counts = {"thrusters": morphology.num_thrusters, "fins": morphology.num_fins}
    words = ", ".join([
        f"modules {morphology.num_modules}, hinges {morphology.num_hinges}",
        *(f"{name} {count}" for name, count in counts.items() if count),
        f"{morphology.mass:.4g} kg, {1e6 * morphology.volume:.4g} cm³",
    ])  # fmt: skip
    look: dict[str, Any] = {"y": 1 - 0.38 / height, "color": _INK, "va": "center"}
    figure.text(x=0.3 / width, s=morphology.title, fontsize=15, **look)
    figure.text(x=1 - 0.35 / width, s=words, fontsize=10, ha="right", **look)

    room = np.array([8.3, height - 0.75])
    axes = figure.add_axes((0.1 / width, 0.1 / height, room[0] / width, room[1] / height))
    axes.set_axis_off()
    lowest, highest = scene.bounds(REST_VIEW)
    unit = float(((highest - lowest) / room).max()) * 1.1  # metres per inch
    middle = (lowest + highest) / 2
    (left, bottom), (right, top) = middle - unit * room / 2, middle + unit * room / 2
    axes.axis((left, right, bottom, top))
    show_scene(axes, scene, REST_VIEW, unit / _DPI)

    # Top and side view, in one scale, above each other in the right part.
    pad = 0.05 * float((high - low).max())
    size = high - low + 2 * pad
    along = 0 if high[0] - low[0] >= 0.8 * (high[1] - low[1]) else 1  # looks across the longer way
    panels = (
        (0, 1, "from above", np.eye(3)),
        (along, 2, "from the side", make_view(-90.0 if along == 0 else 0.0, 0.0)),
    )
    room = np.array([3.4, height - 2.7])
    unit = max(max(size[0], size[along]) / room[0], (size[1] + size[2]) / room[1])
    spare = room[1] - (size[1] + size[2]) / unit
    bottoms = (1.55 + size[2] / unit + 0.6 * spare, 0.65 + 0.4 * spare)
    for (across, up, title, view), bottom in zip(panels, bottoms, strict=True):
        wide, tall = size[across] / unit, size[up] / unit  # inches
        left = width - 0.35 - (room[0] + wide) / 2
        axes = figure.add_axes((left / width, bottom / height, wide / width, tall / height))
        axes.set(xlim=(low[across] - pad, high[across] + pad), ylim=(low[up] - pad, high[up] + pad))
        axes.set_title(title, loc="center", fontsize=9)
        axes.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]")
        axes.tick_params(labelsize=8, length=3)
        axes.spines[:].set_visible(True)
        for axis, span in ((axes.xaxis, wide / 0.6), (axes.yaxis, tall / 0.35)):
            count = int(np.clip(span, 1, 6))
            axis.set_major_locator(MaxNLocator(nbins=count, steps=[1, 2, 5, 10]))
        show_scene(axes, scene, view, unit / _DPI)
    return figure
