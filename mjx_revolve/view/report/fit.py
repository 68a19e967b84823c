"""The page about a fit: predicted beside recorded motion, values, intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjx_revolve.fitting.intervals import LEVEL
from mjx_revolve.fitting.result import Fit, Prediction
from mjx_revolve.view.plots import BLUE, GREY, INK, ORANGE, WIDE, in_style, new_figure, thin
from mjx_revolve.view.report.page import make_page, sections, svg_source


def make_fit_page(fit: Fit) -> str:
    """Makes the page.

    Args:
        fit: that has ended.

    Returns:
        A complete HTML document that needs no other file.
    """
    problem = fit.problem
    unknown = sections.fit_unknown([u.words for u in fit.unknown], fit.advice)
    content = [
        ("predictions", "Predicted beside recorded", _predictions(fit)),
        ("coefficients", "What was found", _values(fit)),
        ("unknown", "What the recordings do not determine", unknown),
        ("recordings", "Recordings", _recordings(fit)),
        ("use", "Use it", sections.fit_use(problem.robot.morphology.name)),
    ]
    figures = []
    for p in fit.predictions[:1]:
        held = bool(p.held.any())
        unit = "m/s" if p.is_speed else "m"
        what = "off, held out" if held else "off, fitted"
        figures += [(f"{p.error(p.fitted, held):.2g} {unit}", what),
                    (f"{p.error(p.before, held):.2g} {unit}", "before the fit")]  # fmt: skip
    figures.append((f"{sum(v.found for v in fit.values)} of {len(fit.values)}", "numbers found"))
    lead = sections.headline(figures)
    words = ", ".join(r.name for r in problem.recordings)
    return make_page(f"{problem.robot.morphology.name}: water fitted", words, lead, content)


def _predictions(fit: Fit) -> str:
    rows = []
    for p in fit.predictions:
        unit = "m/s" if p.is_speed else "m"
        for held in (True, False):
            part = p.held if held else ~p.held
            if part.any():
                rows.append((p.name, "held out" if held else "fitted",
                             f"{p.error(p.before, held):.3g} {unit}",
                             f"{p.error(p.fitted, held):.3g} {unit}",
                             "" if p.is_speed else f"{p.way:.3g} m"))  # fmt: skip
    rows.sort(key=lambda row: row[1] != "held out")
    header = ("recording", "what", "off, before", "off, fitted", "its way")
    tracks = [p for p in fit.predictions if not p.is_speed]
    pictures = [(p.name, svg_source(plot_prediction(p))) for p in tracks[:8]]
    speeds = [p for p in fit.predictions if p.is_speed]
    if speeds:
        pictures.append(("mean speeds", svg_source(plot_speeds(speeds))))
    return sections.fit_predictions(header, rows, pictures)


@in_style
def plot_prediction(p: Prediction) -> Figure:
    """A way from above, and its coordinates over time; what was held out on grey ground."""
    figure = new_figure(WIDE, 3.4)
    seen = [k for k in range(3) if np.isfinite(p.recorded[:, k]).any()]
    layout: Any = [["way", "xyz"[k]] for k in seen]
    above, *axes = figure.subplot_mosaic(layout, width_ratios=[1.1, 1]).values()
    rows = thin(len(p.time), 1500)
    lines = (("recorded", p.recorded, INK, 2.6), ("before", p.before, ORANGE, 1.0),
             ("fitted", p.fitted, BLUE, 1.2))  # fmt: skip
    for name, track, color, width in lines:
        alpha = 0.35 if name == "recorded" else 1.0
        above.plot(track[rows, 0], track[rows, 1], color=color, lw=width, alpha=alpha, label=name)
        for k, axis in zip(seen, axes, strict=True):
            axis.plot(p.time[rows], track[rows, k], color=color, lw=width, alpha=alpha)
    above.set_aspect("equal", adjustable="datalim")
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.legend(loc="best")
    for k, axis in zip(seen, axes, strict=True):
        axis.set_ylabel(f"{'xyz'[k]} (m)")
        axis.sharex(axes[-1])
        if p.held.any() and not p.held.all():
            axis.axvspan(p.time[p.held][0], p.time[-1], color=GREY, alpha=0.15, lw=0)
        if axis is not axes[-1]:
            axis.tick_params(labelbottom=False)
    axes[-1].set_xlabel("time (s); grey: held out")
    return figure


@in_style
def plot_speeds(predictions: list[Prediction]) -> Figure:
    """Simulated over recorded mean speeds; rings are held out."""
    figure = new_figure(WIDE / 2, 3.4)
    axis = figure.subplots()
    for name, color in (("before", ORANGE), ("fitted", BLUE)):
        for p in predictions:
            fill = "none" if p.held.all() else color
            axis.plot(p.recorded[-1, 0], getattr(p, name)[-1, 0], "o", mec=color, mfc=fill)
        axis.plot([], [], "o", color=color, label=name)
    most = max(float(np.nanmax([p.recorded[-1, 0], p.fitted[-1, 0]])) for p in predictions)
    axis.plot([0, most], [0, most], color=GREY, lw=0.8)
    axis.set(xlabel="recorded (m/s); rings: held out", ylabel="simulated (m/s)")
    axis.legend()
    return figure


def _values(fit: Fit) -> str:
    rows = [
        (
            v.name,
            f"{v.value:.4g} {v.unit}",
            f"{v.low:.4g} to {v.high:.4g}" if v.found else "not found",
            f"{p.value(-2 * p.spread):.3g} to {p.value(2 * p.spread):.3g}",
        )
        for v, p in zip(fit.values, fit.problem.parameters, strict=True)
    ]
    header = ("number", "found\nfactor, or as said", f"interval\n{LEVEL:.0%}", "before\n95 %")
    return sections.table(header, rows)


def _recordings(fit: Fit) -> str:
    rows = []
    for k, recording in enumerate(fit.problem.recordings):
        kinds = {c.kind: c.time for c in fit.problem.channels if c.recording == k}
        rows.append((
            recording.name, f"{fit.problem.end[k] - fit.problem.begin[k]:.3g} s",
            ", ".join(f"{kind} ({len(time)})" for kind, time in kinds.items()),
            "; ".join(recording.notes) or "none",
        ))  # fmt: skip
    noise = [
        (kind, f"{sigma:.3g}", f"{fit.estimate.inflation.get(kind, 1.0):.2g}")
        for kind, sigma in fit.estimate.noise.items()
    ]
    return sections.fit_recordings(rows, fit.local_words, noise)
