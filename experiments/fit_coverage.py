"""How well `mjx_revolve.fit` finds coefficients that are known: synthetic recordings, noisy.

    python -m experiments.fit_coverage [--cases 100] [--robots auv,spider,snake]

Each case draws the robot's coefficients and a current, has it swim under commands, adds noise (5
mm, 1°, 15 to 60 frames a second, some of them lost), and fits. A table says how often the 95 %
interval holds the truth, how large the error is, and how long a fit takes. Each robot's cases are
kept as lines in the folder; those that are there are not run again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

import numpy as np

from experiments.common import check_whole, make_folder, make_parser, study_hash, write_results
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.fitting.parameters import read_free, split_free
from mjx_revolve.fitting.problem import FitSettings
from mjx_revolve.fitting.recording import RobotRecording
from mjx_revolve.fitting.result import Fit, fit_robot
from mjx_revolve.fitting.synthetic import make_noisy, simulate_signals
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime
from mjx_revolve.water.world import load_world

FREE = {
    "auv": ("drag", "added_mass", "thrust", "current"),
    "spider": ("drag", "added_mass", "servo_speed", "current"),
    "snake": ("drag", "added_mass", "servo_speed", "current"),
}
DURATION = {"auv": 24.0, "spider": 24.0, "snake": 12.0}
"""Of a recording [s]: the snake, with eight hinges, tells more in the same time."""
TIMESTEP = 0.01
"""Of the world in recordings and fits [s]: twice the usual, which halves what a case costs."""


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
    ctrl = commands(robot, np.random.default_rng(7), DURATION[robot.morphology.name])
    signals = simulate_signals(robot, own, offsets, ctrl, current)
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
        world = load_world("lake", bed="off", drag="faces", self_contact=False, timestep=TIMESTEP)
        _ROBOTS[name] = build_robot(load_morphology(name), world)
    return _ROBOTS[name]


def _finite(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _case(name: str, seed: int) -> dict[str, Any]:
    """A row of a robot's file of cases."""
    truth, fit, taken = run_case(name, seed)
    values = [
        {"name": v.name, "true": x, "value": v.value, "low": v.low, "high": v.high,
         "found": v.found}
        for v, x in zip(fit.values, truth, strict=True)
    ]  # fmt: skip
    return {"seed": seed, "cpu_s": taken, "steps": fit.state.iteration,
            "arrived": fit.state.finished, "values": values}  # fmt: skip


def summarize(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What a robot's cases say of its coefficients."""
    coefficients = []
    for k, first in enumerate(rows[0]["values"]):
        found = [row["values"][k] for row in rows if row["values"][k]["found"]]
        within = [v["low"] <= v["true"] <= v["high"] for v in found]
        errors = [abs(v["value"] / v["true"] - 1) for v in found]
        coefficients.append({
            "name": first["name"], "found": len(found) / len(rows), "fits": len(found),
            "within": _finite(np.mean(within)) if found else None,
            "error": _finite(np.median(errors)) if found else None,
        })  # fmt: skip
    seconds = [row["cpu_s"] for row in rows]
    return {"cases": len(rows), "cpu_s": float(np.median(seconds)), "most_cpu_s": max(seconds),
            "coefficients": coefficients}  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Prints the table."""
    parser = make_parser("fit_coverage", "Fits beside coefficients that are known.")
    parser.add_argument("--cases", type=whole(0), default=100)
    parser.add_argument("--robots", default=",".join(FREE))
    arguments: argparse.Namespace = parser.parse_args(argv)
    check_whole(parser, arguments, "robots")
    names = arguments.robots.split(",")
    if unknown := [name for name in names if name not in FREE]:
        raise InputError("--robots", f"any of {', '.join(FREE)}", unknown[0])
    runtime.prepare_process()
    folder = make_folder(arguments.out, "fit_coverage")
    results: dict[str, Any] = {}
    seeds: set[int] = set()
    for name in names:
        path = folder / f"{name}.jsonl"
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        source = f"{runtime.source_hash()} {study_hash()}"
        # What other code, or another robot, found is none of this study.
        rows = [row for row in map(json.loads, lines) if row.get("source") == source]
        rows = [row for row in rows if row["seed"] < arguments.cases]
        done = {row["seed"] for row in rows}
        for seed in range(arguments.cases):
            if seed in done:
                continue
            rows.append(_case(name, seed) | {"source": source})
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            words = ", ".join(f"{v['name']} {v['value']:.4g} ({v['true']:.4g})"
                              for v in rows[-1]["values"])  # fmt: skip
            print(f"  {name} {seed}: {words}; {rows[-1]['cpu_s']:.0f} s", flush=True)
        if not rows:
            continue
        seeds |= {row["seed"] for row in rows}
        found = results[name] = summarize(rows)
        print(f"{name}: {found['cases']} cases; CPU time a fit: median {found['cpu_s']:.0f} s, "
              f"most {found['most_cpu_s']:.0f} s")  # fmt: skip
        for c in found["coefficients"]:
            share, middle = (np.nan if c[x] is None else c[x] for x in ("within", "error"))
            print(f"  {c['name']}: found in {c['found']:.0%}, within its interval in {share:.0%} "
                  f"of those, median error {middle:.2%}", flush=True)  # fmt: skip
    if arguments.results:
        write_results("fit_coverage", results, sorted(seeds))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
