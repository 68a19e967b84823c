"""Command line: fits coefficients of the water to recordings of a robot that swam, or plans them.

    python -m mjx_revolve.fit ROBOT RECORDING [RECORDING ...] --free drag,added_mass,thrust
    python -m mjx_revolve.fit --plan ROBOT --free drag,added_mass,thrust

It writes a folder with `coefficients.yaml`, which morphologies and configurations can name, and
`report.html`; `docs/fit.md` takes a reader through it.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.inputs.commands import (
    Parser,
    check_place,
    program,
    program_again,
    read_path,
    read_seed,
    read_world,
    run_command,
)
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import check_path, short_path
from mjx_revolve.inputs.trust import add_trust_argument, opening
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.fitting.recording import RobotRecording
    from mjx_revolve.fitting.result import Fit
    from mjx_revolve.fitting.run import FitRun

_FREE = "drag,added_mass"
_MUCH = 5.0
"""Times the usual noise [-] beyond which residuals are no noise. A choice."""


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=program("fit"),
        description="Fits coefficients of the water, and of a robot, to recordings of it; or plans "
        "which recordings to make.",
        examples=(
            "fit --plan auv --free drag,added_mass,thrust",
            "fit auv swim.csv --free drag,added_mass,thrust,current --out runs/fitted",
        ),
    )
    add = parser.add_argument
    add("robot", type=read_path, nargs="?", metavar="ROBOT",
        help="a morphology, a configuration, or a run folder")  # fmt: skip
    add("recordings", type=read_path, nargs="*", metavar="RECORDING",
        help="a CSV, an MCAP or ROS 2 bag, or a run folder")  # fmt: skip
    add("--free", default=_FREE, metavar="NAMES",
        help=f"what is fitted, with commas between (default: {_FREE}); also servo_speed, thrust, "
        "thruster_lag, mass, ballast@MODULE, current, clock, any coefficient, each also "
        "@TYPE or @MODULE, per axis as drag_coefficient.x")  # fmt: skip
    add("--map", action="append", default=[], metavar="NAME=COLUMN", dest="columns",
        help="where a signal is: NAME=COLUMN, NAME=COLUMN*FACTOR, NAME=NUMBER, mark.NAME=MODULE:"
        "X,Y,Z, or a YAML file of them; may be repeated")  # fmt: skip
    add("--plan", action="store_true", help="plan a programme of motions; takes no recordings")
    add("--world", type=read_world, help="of a morphology: a name or a YAML (default: lake)")
    add("--modules", type=read_path, metavar="MY.yaml", help="module types of your own")
    add("--seed", type=read_seed, default=0, metavar="N", help="of the search's first draws")
    add("--out", type=read_path, metavar="DIR", help="the fit's folder (default: runs/fit-TIME)")
    add("--resume", type=read_path, metavar="DIR", help="go on with this folder, bit for bit")
    add("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="window, held_out, iterations, duration, motions, rate; world.KEY; trim=neutral; may "
        "be repeated")  # fmt: skip
    add_trust_argument(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Runs the command.

    Args:
        argv: the arguments; None: `sys.argv[1:]`.

    Returns:
        The exit code: 0 when the fit is finished, 130, 143 or 129 when it was interrupted.

    Raises:
        InputError: the arguments, the robot or a recording are wrong.
    """
    arguments = _parser().parse_args(argv)
    if arguments.resume is None and arguments.robot is None:
        raise InputError("expected a ROBOT and a RECORDING, or --resume DIR; found neither")
    if arguments.resume is not None:
        a = arguments
        given = {"robot": a.robot, "out": a.out, "map": a.columns, "plan": a.plan, "world": a.world,
                 "modules": a.modules, "seed": a.seed, "set": a.settings,
                 "free": a.free != _FREE}  # fmt: skip
        for name in (name for name, value in given.items() if value):
            alone = "--trust alone beside it, as the folder has all else"
            raise InputError("--resume", alone, name)
    if arguments.plan and (arguments.columns or arguments.out or arguments.seed):
        raise InputError("--plan", "neither --map, --out nor --seed", "one")
    if arguments.plan and arguments.recordings:
        raise InputError("--plan", "a ROBOT and no recordings", "some")
    if arguments.resume is None and not arguments.plan and not arguments.recordings:
        raise InputError("expected a RECORDING, or --plan; found neither")
    for name in arguments.recordings:  # before JAX is imported
        if not check_path(name).exists():
            raise InputError(name, "a CSV, an MCAP, a ROS 2 bag or a run folder", "none")
    places = [check_path(name).resolve() for name in arguments.recordings]
    for k, name in enumerate(arguments.recordings):
        if places[k] in places[:k]:  # it would count twice, and be held out from itself
            raise InputError(name, "each recording once", "it twice")
    with Interrupts() as interrupts:
        runtime.prepare_process()
        maps = [x for x in arguments.columns if "=" not in x]
        named = [arguments.resume or arguments.robot, *arguments.recordings, *maps]
        named += [x for x in (arguments.world, arguments.modules) if x is not None]
        with opening(*named, trust=arguments.trust):
            if arguments.plan:
                return _plan(arguments)
            return _fit(arguments, interrupts)


def _with_own_names(
    recordings: Sequence[RobotRecording], paths: Sequence[str]
) -> tuple[RobotRecording, ...]:
    """Recordings with names of their own: files of one name in several folders with the paths."""
    names = [recording.name for recording in recordings]
    return tuple(
        replace(one, name=short_path(path)) if names.count(one.name) > 1 else one
        for one, path in zip(recordings, paths, strict=True)
    )


def _free(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _fit(arguments: argparse.Namespace, interrupts: Interrupts) -> int:
    from mjx_revolve.fitting.axes import find_other_axes
    from mjx_revolve.fitting.recording import load_recording, read_map
    from mjx_revolve.fitting.run import FitRun, Request, load_robot, read_settings

    if arguments.resume is not None:
        run = FitRun.resume(arguments.resume)
        done = run.state.iteration if run.state else 0
        print(f"resuming after iteration {done}", flush=True)
    else:
        settings, fields, trim = read_settings(arguments.settings)
        robot, entry, copies = load_robot(
            arguments.robot, arguments.world, arguments.modules, fields, trim
        )
        columns = read_map(arguments.columns)
        print(plain(f"loading {', '.join(arguments.recordings)}"), flush=True)
        read = [load_recording(path, robot, columns) for path in arguments.recordings]
        recordings = _with_own_names(read, arguments.recordings)
        for recording in recordings:
            for note in recording.notes:
                print(plain(f"note: {recording.name}: {note}"))
        out = arguments.out
        check_place(Path(out or "runs/any") / "any", f"--out {out}" if out else "runs")
        free = tuple(_free(arguments.free))
        request = Request(robot, recordings, free, settings, arguments.seed, (entry, copies))
        run = FitRun.begin(out, request)
        for line in find_other_axes(run.problem):
            print(plain(f"warning: {line}"), flush=True)
    try:
        return _finish(run, interrupts)
    finally:
        run.folder.close()


def _finish(run: FitRun, interrupts: Interrupts) -> int:
    from mjx_revolve.view.report.fit import make_fit_page

    place = short_path(run.folder.path)
    problem = run.problem
    print(plain(
        f"{problem.robot.morphology.name}: {', '.join(run.request.free)} | "
        f"recordings: {len(problem.recordings)}, {int(problem.drive.resets.sum())} windows of "
        f"{problem.window:.3g} s | {place}"
    ), flush=True)  # fmt: skip
    interrupts.finish_first("finishing the step that is under way")
    fit = run.run(interrupts)
    if fit is None:
        again = f"{program_again('fit')} --resume {shlex.quote(place)}"
        print(f"stopped; all of it is saved\nresume: {again}")
        return interrupts.exit_code
    with interrupts.writing:
        run.write(fit, make_fit_page(fit))
    for line in describe(fit):
        print(plain(line))
    print(f"coefficients: {place}/coefficients.yaml; report: {place}/report.html")
    return 0


def describe(fit: Fit) -> list[str]:
    """What a fit has found, in lines."""
    from mjx_revolve.fitting.parameters import LARGEST_FACTOR
    from mjx_revolve.fitting.problem import NOISE

    lines = []
    for v in fit.values:
        unit = v.unit or "times what it was"
        ends = f"[{v.low:.4g}, {v.high:.4g}]" if v.found else "(not found by itself)"
        lines.append(f"{v.name}: {v.value:.4g} {unit} {ends}")
    lines += [f"{r}: {n} {words}" for r, n, words in fit.local_words]
    lines += [f"{u.words}: the recordings do not determine more" for u in fit.unknown]
    for p in fit.predictions:
        held = bool(p.held.any())
        what, unit = "held out" if held else "fitted", "m/s" if p.is_speed else "m"
        lines.append(
            f"{p.name}, {what}: {p.error(p.fitted, held):.3g} {unit} off (before: "
            f"{p.error(p.before, held):.3g})" + (f", of a way of {p.way:.3g} m" if p.way else "")
        )
    for kind, sigma in fit.estimate.noise.items():
        if sigma > _MUCH * NOISE[kind]:
            lines.append(
                f"{kind}: {sigma:.2g} is left, {sigma / NOISE[kind]:.0f} times what is usual: the "
                "law or the robot is another one, or the search went astray; trust no interval"
            )
    pairs = zip(fit.problem.parameters, fit.state.point.free, strict=True)
    if stuck := ", ".join(p.name for p, x in pairs if p.is_at_bound(float(x))):
        lines.append(
            f"{stuck}: at the bound, a factor of {LARGEST_FACTOR:g}: the robot, its units or its "
            "law is another one; trust no interval"
        )
    if not fit.state.finished:
        lines.append("the search has not arrived: begin anew with more --set iterations")
    if fit.advice:
        lines.append(f"the most informative motion: {fit.advice}")
    return lines


def _plan(arguments: argparse.Namespace) -> int:
    from mjx_revolve.fitting.identify import plan_motions
    from mjx_revolve.fitting.run import load_robot, read_settings

    settings, fields, trim = read_settings(arguments.settings)
    robot, *_ = load_robot(arguments.robot, arguments.world, arguments.modules, fields, trim)
    print(plain(f"simulating motions of {robot.morphology.name}"), flush=True)
    plan = plan_motions(robot, _free(arguments.free), settings)
    print(f"{settings.duration:g} s each, {settings.rate:g} frames/s, noise of 5 mm and 1°")
    for k, (motion, spreads) in enumerate(zip(plan.motions, plan.spreads, strict=True), 1):
        print(plain(f"{k}. {motion.words}"))
        pairs = zip(plan.parameters, spreads, strict=True)
        parts = (f"{p.name} ± {_expected(p.positive, x)}" for p, x in pairs)
        print(plain(f"   then: {', '.join(parts)}"))
    for unknown in plan.unknown:
        print(plain(f"still: {unknown.words}"))
    return 0


def _expected(positive: bool, spread: float) -> str:
    """Half of a 95 % interval."""
    return f"{196 * spread:.2g} %" if positive else f"{1.96 * spread:.2g}"


if __name__ == "__main__":
    sys.exit(run_command(main))
