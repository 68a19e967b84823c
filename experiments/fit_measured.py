"""Fits to robots that were measured: AmphiBot's glide, and the lamprey robot's gaits.

    python -m experiments.fit_measured [--results]

The glide is fitted to its first two seconds and predicts the rest of its way; every other one of
the lamprey's gaits is fitted, and the others are predicted. `docs/fit.md` has the numbers.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments import measured_data as data
from experiments.common import make_parser, write_results
from experiments.measured_cases import body, make_pool
from mjx_revolve.fitting import FitSettings, RobotRecording, TimeSeries, fit_robot, load_recording
from mjx_revolve.fitting.recording import read_map
from mjx_revolve.fitting.result import Fit
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

GLIDE = Path(__file__).parents[2] / "shared" / "swimmers" / "amphibot_glide.csv"
"""The marks' tracks; they are not ours to ship (`AMPHIBOT_GLIDE` says where they are from)."""
_BEGUN, _FITTED, _ALL = 989.05, 2.05, 4.402  # the joints have stopped; lengths fitted and whole [s]
_GAIT, _SETTLED = 8.5, 4.5  # length of a swim, and its mean speed is that from here on [s]
_LEAST = 0.1  # slower gaits are left out of scatters, as in measured.md [m/s]


def fit_glide(drag: str = "cross_flow") -> Fit:
    """Drag and friction from the marks of 2 s of AmphiBot's glide."""
    robot, half = body("ChainHead", make_pool(drag, 0.001), "ChainModule", 6), data.CHAIN_MODULE / 2
    given = {f"angle.link{k}": str(np.radians(a)) for k, a in enumerate(data.AMPHIBOT_GLIDE.angles)}
    given["mark.0"] = "core"
    for k in range(6):
        given |= {f"mark.{2 * k + 1}": f"link{k}", f"mark.{2 * k + 2}": f"link{k}:{half},0,0"}
    recording = load_recording(GLIDE, robot, read_map([f"{k}={v}" for k, v in given.items()]))
    signals = {}
    for name, (time, value) in recording.signals.items():
        late = time > _BEGUN
        signals[name] = TimeSeries(time[late], value[late])
    settings = FitSettings(held_out=1 - _FITTED / _ALL)
    return fit_robot(robot, [replace(recording, signals=signals)], ["drag", "friction"], settings)


def glide_errors(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the way in the frames held out, over the way: fitted, and before the fit [-]."""
    [p] = fit.predictions
    ways = [
        np.linalg.norm(x[:, :2] - p.recorded[0, :2], axis=1)[p.held]
        for x in (p.recorded, p.fitted, p.before)
    ]
    return ways[1] / ways[0] - 1, ways[2] / ways[0] - 1


def fit_lamprey(drag: str = "cross_flow") -> Fit:
    """Drag and added mass from the mean speeds of every other gait of the lamprey robot."""
    robot = body("ChainHead", make_pool(drag, 0.002), "ChainModule", 5)
    time, recordings = np.arange(0, _GAIT, 0.02), []
    for gait in data.LAMPREY:
        grown = np.minimum(time, 1.0) * np.radians(gait.amplitude)
        signals = {
            f"angle.link{k}": TimeSeries(
                time, grown * np.sin(2 * np.pi * (gait.frequency * time - k * gait.lag))
            )
            for k in range(5)
        }
        signals["mean_speed"] = TimeSeries(
            np.array([_SETTLED, _GAIT]), np.array([gait.speed, gait.speed])
        )
        name = f"{gait.amplitude:g} degrees, {5 * gait.lag:.3g} cycles"
        recordings.append(RobotRecording(name, signals))
    return fit_robot(robot, recordings, ["drag", "added_mass"], FitSettings(held_out=0.5))


def lamprey_ratios(fit: Fit) -> dict[str, Any]:
    """Bias and scatter of our speeds over the measured ones in gaits held out, before and after."""
    rows = [
        [np.log(x[-1, 0] / p.recorded[-1, 0]) for x in (p.before, p.fitted)]
        for p in fit.predictions
        if p.held.all() and p.recorded[-1, 0] > _LEAST
    ]
    bias, scatter = np.exp(np.mean(rows, 0)), np.std(rows, 0, ddof=1)
    return {"gaits": len(rows), "bias_before": float(bias[0]), "bias": float(bias[1]),
            "scatter_before": float(scatter[0]), "scatter": float(scatter[1])}  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Prints what was predicted."""
    parser = make_parser("fit_measured", "Fits to robots that were measured.", files=False)
    arguments = parser.parse_args(argv)
    runtime.prepare_process()
    if arguments.results and not GLIDE.is_file():
        raise InputError("--results", f"the tracks of {GLIDE.name}", "none")
    results: dict[str, Any] = {"lamprey": {}}
    if GLIDE.is_file():
        fitted, before = glide_errors(fit_glide())
        results["glide"] = {"error": float(np.abs(fitted).max()),
                            "error_before": float(np.abs(before).max())}  # fmt: skip
        print(f"glide: way held out within {np.abs(fitted).max():.1%}, before the fit "
              f"{np.abs(before).max():.1%}")  # fmt: skip
    for drag in ("cross_flow", "faces"):
        found = results["lamprey"][drag] = lamprey_ratios(fit_lamprey(drag))
        print(f"lamprey, {drag}: {found}", flush=True)
    if arguments.results:
        write_results("fit_measured", results, [0])
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
