"""How well `mjx_revolve.fit` finds coefficients that are known: synthetic recordings, noisy.

    python -m experiments.fit_coverage [--cases 100] [--robots auv,spider,snake]

Each case draws the robot's coefficients and a current, has it swim under commands, adds noise (5
mm, 1°, 15 to 60 frames a second, some of them lost), and fits. A table says how often the 95 %
interval holds the truth, how large the error is, and how long a fit takes.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import numpy as np

from experiments.common import make_parser, write_results
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.fitting.parameters import read_free, split_free
from mjx_revolve.fitting.problem import FitSettings
from mjx_revolve.fitting.recording import RobotRecording
from mjx_revolve.fitting.result import Fit, fit_robot
from mjx_revolve.fitting.synthetic import make_noisy, simulate_signals
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.numerics import runtime
from mjx_revolve.water.world import load_world

FREE = {
    "auv": ("drag", "added_mass", "thrust", "current"),
    "spider": ("drag", "added_mass", "servo_speed", "current"),
    "snake": ("drag", "added_mass", "servo_speed", "current"),
}
DURATION = 24.0
"""Of a recording [s]."""


def commands(robot: Robot, draw: np.random.Generator, duration: float) -> np.ndarray:
    """`[T, nu]` steps of thrusters and bursts of waves, with pauses in which it coasts."""
    count = round(duration / robot.world.timestep)
    t = robot.world.timestep * np.arange(count)
    found = np.zeros((count, robot.mj_model.nu))
    swims = t % 8 < 6
    for k in robot.servos:
        hertz, late = 1.2, draw.uniform(0, 2 * np.pi)
        found[:, k] = swims * 0.6 * np.sin(2 * np.pi * hertz * t + late)
    for k in robot.thrusters:
        levels = draw.uniform(-0.8, 0.8, 40) * (draw.random(40) < 0.7)
        found[:, k] = levels[(t / 2).astype(int) % 40]
    return found


def make_case(robot: Robot, free: tuple[str, ...], seed: int) -> tuple[list[float], RobotRecording]:
    """The coefficients of a case, and what a camera would have seen of it."""
    draw = np.random.default_rng(seed)
    own, _ = split_free(free)
    parameters = read_free(own, robot)
    offsets = np.array([p.spread * draw.uniform(-1, 1) for p in parameters])
    current = (*(0.01 * draw.normal(size=2)), 0.0)
    signals = simulate_signals(
        robot, own, offsets, commands(robot, np.random.default_rng(7), DURATION), current
    )
    rate = float(draw.choice([15.0, 30.0, 60.0]))
    recording = make_noisy(signals, rate=rate, lost=0.03, seed=seed)
    return [p.value(float(x)) for p, x in zip(parameters, offsets, strict=True)], recording


def run_case(name: str, seed: int) -> tuple[list[float], Fit, float]:
    """True values of a case, what was fitted, and the processor's seconds that fitting took."""
    robot = _robot(name)
    truth, recording = make_case(robot, FREE[name], seed)
    before = time.process_time()
    fit = fit_robot(robot, [recording], FREE[name], FitSettings(held_out=0.0), seed)
    return truth, fit, time.process_time() - before


_ROBOTS: dict[str, Robot] = {}


def _robot(name: str) -> Robot:
    if name not in _ROBOTS:
        _ROBOTS[name] = build_robot(load_morphology(name), load_world("lake", bed="off"))
    return _ROBOTS[name]


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def main(argv: list[str] | None = None) -> int:
    """Prints the table."""
    parser = make_parser("fit_coverage", "Fits beside coefficients that are known.")
    parser.add_argument("--cases", type=whole(1), default=100)
    parser.add_argument("--first", type=whole(0), default=0, help="seed of the first case")
    parser.add_argument("--robots", default=",".join(FREE))
    arguments: argparse.Namespace = parser.parse_args(argv)
    runtime.prepare_process()
    results: dict[str, Any] = {}
    for name in arguments.robots.split(","):
        inside, errors, seconds, found = [], [], [], []
        for seed in range(arguments.first, arguments.first + arguments.cases):
            truth, fit, taken = run_case(name, seed)
            pairs = list(zip(fit.values, truth, strict=True))
            inside.append([v.low <= x <= v.high for v, x in pairs])
            errors.append([abs(v.value / x - 1) for v, x in pairs])
            found.append([v.found for v in fit.values])
            seconds.append(taken)
            words = ", ".join(f"{v.name} {v.value:.4g} ({x:.4g})" for v, x in pairs)
            print(
                f"  {name} {seed}: {words}; {fit.state.iteration} steps, {taken:.0f} s", flush=True
            )
        print(f"{name}: {len(seconds)} cases; CPU time a fit: median {np.median(seconds):.0f} s, "
              f"most {max(seconds):.0f} s")  # fmt: skip
        results[name] = {"cases": len(seconds), "cpu_s": np.median(seconds), "coefficients": []}
        for k, v in enumerate(fit.values):
            known = np.array(found)[:, k]
            share = np.mean(np.array(inside)[known, k]) if known.any() else np.nan
            middle = np.median(np.array(errors)[known, k]) if known.any() else np.nan
            print(f"  {v.name}: found in {known.mean():.0%}, within its interval in {share:.0%} of "
                  f"those, median error {middle:.2%}", flush=True)  # fmt: skip
            results[name]["coefficients"].append({
                "name": v.name, "found": known.mean(), "error": _finite(middle),
                "within": _finite(share), "fits": int(known.sum()),
            })  # fmt: skip
    if arguments.results:
        first = arguments.first
        write_results("fit_coverage", results, range(first, first + arguments.cases))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
