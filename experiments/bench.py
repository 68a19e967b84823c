"""How fast it is, beside MuJoCo C and plain MJX, all from one run.

``python -m experiments.bench [--quick] [--only CASE ...] [--parts] [--json FILE]``

Case by case: every engine runs in a process of its own, as a user would start it: no environment
variables but those that `mjx_revolve.evolve` sets, compilation cache off. Ours has one process for
each of two cores, as `evolve` does; MuJoCo C has as many threads. The processes of a case are
started one after the other, which times their compilation, and then measured in turn, several
rounds, the order reversed in every other round; while one is measured the others wait. What is
counted is steps of one robot. docs/performance.md says what the numbers mean.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import select
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from experiments.common import ROOT, check_whole, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path

# Longest wait for an answer [s]; 256 bodies are built, and the largest compile, in two minutes.
_PATIENCE = 600.0


@dataclass(frozen=True)
class Row:
    """One engine in one case.

    Attributes:
        name: what is measured.
        engine: which of `bench_cases.MAKERS`.
        physics: which of `bench_cases.PHYSICS`.
        robot: whose morphology.
        population: individuals, over all processes.
        task: what the episodes are, ours only.
        duration: of the episodes [s], ours only.
        limits: whether joint limits are left on (plain MJX).
        each_core: one process pinned to each core, rather than one of all cores.
        brain: which of `bench_cases.BRAINS`.
    """

    name: str
    engine: str
    physics: str
    robot: str = "spider"
    population: int = 2048
    task: str = "directed_swim"
    duration: float = 10.0
    limits: bool = True
    each_core: bool = False
    brain: str = ""


@dataclass(frozen=True)
class Group:
    """A case: what its first row is, relative to the best of those that it is held against.

    Attributes:
        name: of the case.
        rows: the engines; the first is what the case is about.
        against: how many rows from the second on it is held against; the rest is for information.
        goal: the least ratio to be reached; None: no ratio is asked for.
    """

    name: str
    rows: tuple[Row, ...]
    against: int
    goal: float | None


def _c(physics: str, **other: Any) -> tuple[Row, Row]:
    law = {"ellipsoid": "ellipsoid law", "bed": "ellipsoid law, contacts"}[physics]
    return (
        Row(f"MuJoCo C, rollout, {law}", "rollout", physics, **other),
        Row(f"MuJoCo C, Batch, {law}", "batch", physics, **other),
    )


def _ours(physics: str, law: str, **other: Any) -> Row:
    return Row(f"ours, {law}", "evaluation", physics, each_core=True, **other)


_MJX = {"population": 256}  # ten times as many take it minutes
GROUPS = (
    Group(
        "spider, ellipsoid law",
        (
            _ours("ellipsoid", "ellipsoid law"),
            *_c("ellipsoid"),
            Row("plain MJX, inertia box", "mjx", "inertia_box", **_MJX),
        ),
        2,
        40.0,
    ),
    Group(
        "spider, default water",
        (
            _ours("default", "default water"),
            *_c("ellipsoid"),
            Row("plain MJX, no fluid", "mjx", "none", **_MJX),
            Row("plain MJX, no fluid, no joint limits", "mjx", "none", limits=False, **_MJX),
        ),
        2,
        25.0,
    ),
    Group(
        "snake of 8 hinges, ellipsoid law",
        (_ours("ellipsoid", "ellipsoid law", robot="snake"), *_c("ellipsoid", robot="snake")),
        2,
        30.0,
    ),
    Group(
        "centipede of 30 modules and 21 hinges, ellipsoid law",
        (
            _ours("ellipsoid", "ellipsoid law", robot="centipede"),
            *_c("ellipsoid", robot="centipede"),
            _ours("default", "default water", robot="centipede"),
        ),
        2,
        20.0,
    ),
    Group(
        "256 bodies of 4 to 16 hinges, ellipsoid law",
        (
            Row("ours, ellipsoid law", "mixed", "ellipsoid", population=256, each_core=True),
            Row("MuJoCo C, threads, ellipsoid law", "threads", "ellipsoid", population=256),
            Row("ours, default water", "mixed", "default", population=256, each_core=True),
        ),
        1,
        12.0,
    ),
    # Modules of one robot push each other apart on both sides.
    Group(
        "256 bodies of 4 to 16 hinges that touch themselves, ellipsoid law",
        (
            Row("ours, with contact", "mixed", "touching", population=256, each_core=True),
            Row("MuJoCo C, threads, its contacts", "threads", "touching", population=256),
            Row("ours, without contact", "mixed", "ellipsoid", population=256, each_core=True),
        ),
        1,
        15.0,
    ),
    Group(
        "26 bodies of 4 to 16 hinges with 64 learners each, ellipsoid law",
        (
            Row("ours, ellipsoid law", "learners", "ellipsoid", population=26, each_core=True),
            Row("MuJoCo C, threads, ellipsoid law", "threads", "ellipsoid", population=26),
            Row("ours, default water", "learners", "default", population=26, each_core=True),
        ),
        1,
        18.0,
    ),
    Group(
        "spider on the lake's bed",
        (_ours("default", "default water, contact", task="crawl", duration=4.0), *_c("bed")),
        2,
        10.0,
    ),
    # A step with its brain may take a third more than one without.
    Group(
        "brain of 64 units, spider, default water",
        (
            Row("ours, mlp of 64 units", "evaluation", "default", each_core=True, brain="mlp"),
            Row("ours, bare steps", "bare", "default", each_core=True),
            Row(
                "its sensors noisy, at 20 Hz, 0.1 s late",
                "evaluation",
                "default",
                each_core=True,
                brain="tired",
            ),
            Row("ours, three sines a hinge", "evaluation", "default", each_core=True),
        ),
        1,
        0.75,
    ),
    Group(
        "brain of 8 units a hinge, 256 bodies of 4 to 16 hinges, default water",
        (
            Row("ours, mlp", "mixed", "default", population=256, each_core=True, brain="mlp"),
            Row(
                "ours, a sine a hinge",
                "mixed",
                "default",
                population=256,
                each_core=True,
                brain="sine",
            ),
            Row(
                "its sensors noisy, at 20 Hz, 0.1 s late",
                "mixed",
                "default",
                population=256,
                each_core=True,
                brain="tired",
            ),
        ),
        1,
        0.75,
    ),
    Group(
        "whole generation, spider, default water",
        (
            Row("ours, ask, evaluate, tell, log", "generation", "default"),
            Row("ours, bare steps", "bare", "default", each_core=True),
        ),
        1,
        0.85,
    ),
    Group(
        "16,384 individuals to 256, spider, default water, one core",
        tuple(
            Row(f"ours, {n}", "evaluation", "default", population=n, duration=2.5)
            for n in (16384, 256, 1024, 4096)
        ),
        1,
        0.9,
    ),
)
# `--quick`: enough to see that all is well, with a robot that compiles in half of the time.
_FISH: dict[str, Any] = {"robot": "fish", "population": 64}
QUICK = Group(
    "fish, default water",
    (
        Row("ours, default water", "evaluation", "default", **_FISH),
        *_c("ellipsoid", **_FISH),
        Row("plain MJX, no fluid", "mjx", "none", **_FISH),
    ),
    2,
    None,
)
# `--parts`: the default water with one thing left out, or added.
PARTS = Group(
    "parts",
    (
        Row("evaluation, default water", "evaluation", "default", population=512),
        Row("mask for partial submersion", "evaluation", "mask", population=512),
        Row("no drag", "evaluation", "no_drag", population=512),
        Row("no added mass", "evaluation", "no_added_mass", population=512),
        Row("no water at all", "evaluation", "none", population=512),
        Row("no controller, track and score", "bare", "default", population=512),
    ),
    0,
    None,
)


class Worker:
    """A process that serves one case; see `bench_cases.main`."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  (closed in `close`)
        self._engine = job["case"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "experiments.bench_cases", json.dumps(job)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True, cwd=ROOT,
            env=os.environ | {"JAX_COMPILATION_CACHE_DIR": ""},
        )  # fmt: skip

    def ask(self, seconds: float) -> None:
        """Starts a measurement of at least so many seconds."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # `answer` says what became of it
            print(seconds, file=self._process.stdin, flush=True)

    def answer(self) -> dict[str, float]:
        """Waits for the next answer.

        Raises:
            InputError: the case refuses the robot or the configuration.
            RuntimeError: the process died or hangs.
        """
        stream = self._process.stdout
        assert stream is not None
        ready, _, _ = select.select([stream], [], [], _PATIENCE)
        line = stream.readline() if ready else ""
        if not line:
            self._errors.seek(0)
            last = self._errors.read().decode(errors="replace").strip().splitlines()[-1:]
            reason = (last or ["no message"])[0] if ready else f"no answer in {_PATIENCE:g} s"
            raise RuntimeError(f"{self._engine}: {reason}")
        values = json.loads(line)
        if "error" in values:
            raise InputError(values["error"])
        return values

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()


@dataclass
class Result:
    """What was measured of a row.

    Attributes:
        row: the row.
        workers: its processes.
        compile_s: trace and compile, nothing cached [s].
        rates: steps of one robot per second, one for each round.
        cores: cores busy in the mean, likewise.
        peak: the largest resident memory of its processes, summed [B].
    """

    row: Row
    workers: list[Worker] = field(default_factory=list)
    compile_s: float = 0.0
    rates: list[float] = field(default_factory=list)
    cores: list[float] = field(default_factory=list)
    peak: float = 0.0

    @property
    def rate(self) -> float:
        """The median of the rounds [1/s]."""
        return statistics.median(self.rates)


def start(row: Row, threads: int) -> Result:
    """Starts a row's processes and waits until they are ready."""
    result = Result(row)
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [None]
    cores = usable[:threads] if row.each_core else [None]
    job = {
        "case": row.engine,
        "physics": row.physics,
        "robot": str(ROOT / "morphologies" / f"{row.robot}.yaml"),
        "config": str(ROOT / "experiments" / "sine_swim.yaml"),
        "population": max(1, row.population // len(cores)),
        "threads": threads,
        "limits": row.limits,
        "task": row.task,
        "duration": row.duration,
        "brain": row.brain,
    }
    try:
        for number, core in enumerate(cores):
            share = (number, len(cores))
            result.workers.append(Worker(job | {"core": core, "share": share}))
        answers = [worker.answer() for worker in result.workers]
    except BaseException:
        for worker in result.workers:
            worker.close()
        raise
    result.compile_s = max(answer["compile_s"] for answer in answers)
    result.peak = sum(answer["peak_bytes"] for answer in answers)
    return result


def measure(result: Result, seconds: float) -> None:
    """One round of one row, its processes at once."""
    for worker in result.workers:
        worker.ask(seconds)
    answers = [worker.answer() for worker in result.workers]
    result.rates.append(sum(answer["steps_per_second"] for answer in answers))
    result.cores.append(sum(answer["cores"] for answer in answers))
    result.peak = sum(answer["peak_bytes"] for answer in answers)


def run(group: Group, threads: int, rounds: int, seconds: float) -> list[Result]:
    """Measures a case's rows in turn.

    Args:
        group: the case.
        threads: of MuJoCo C; as many processes of ours.
        rounds: how often.
        seconds: each time, at least [s].

    Returns:
        The results.
    """
    results: list[Result] = []
    say = lambda text: print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)  # noqa: E731
    quiet = not sys.stderr.isatty()
    try:
        for row in group.rows:
            quiet or say(f"{group.name}: starting {row.name}")
            results.append(start(row, threads))
        for k in range(rounds):
            for result in results if k % 2 == 0 else results[::-1]:
                quiet or say(f"{group.name}: round {k + 1} of {rounds}, {result.row.name}")
                measure(result, seconds)
        quiet or say("")
    finally:
        for result in results:
            for worker in result.workers:
                worker.close()
    return results


# ------------------------------------------------------------------ what is written


def ratio(group: Group, results: Sequence[Result]) -> float | None:
    """The first row's rate to the best of those that it is held against."""
    if not group.against:
        return None
    return results[0].rate / max(result.rate for result in results[1 : 1 + group.against])


def table(group: Group, results: Sequence[Result]) -> str:
    """A case's results as an aligned table."""
    rows = [
        ("", "median", "lowest", "highest", "first to", "cores", "compile", "memory"),
        ("", "Msteps/s", "Msteps/s", "Msteps/s", "this", "busy", "s", "MiB"),
    ]
    for r in results:
        rows.append(
            (
                r.row.name,
                *(f"{x / 1e6:.3f}" for x in (r.rate, min(r.rates), max(r.rates))),
                f"{results[0].rate / r.rate:.2f}",
                f"{statistics.median(r.cores):.1f}",
                f"{r.compile_s:.1f}" if r.row.engine not in _C else "-",
                f"{r.peak / 2**20:.0f}",
            )
        )
    return "\n".join(align(rows))


_C = ("rollout", "batch", "threads")


def verdict(group: Group, results: Sequence[Result]) -> str:
    """How the case stands, in a line."""
    found = ratio(group, results)
    if found is None:
        return ""
    if group.goal is None:
        return f"{found:.1f} times the best of C"
    met = "reached" if found >= group.goal else "not reached"
    return f"{found:.3g} (goal {group.goal:g}: {met})"


def memory_per_individual(results: Sequence[Result]) -> float:
    """Bytes that each individual of a large population adds to a small one's peak."""
    most = max(results, key=lambda r: r.row.population)
    least = min(results, key=lambda r: r.row.population)
    return max(0.0, most.peak - least.peak) / (most.row.population - least.row.population)


def parts_table(results: Sequence[Result]) -> str:
    """What one step of one robot costs, with parts left out."""
    whole = 1e9 / results[0].rate
    rows = [("", "a step", "less", "share"), ("", "ns", "ns", "%")]
    for r in results:
        spent = 1e9 / r.rate
        less = whole - spent
        rows.append((r.row.name, f"{spent:.0f}", f"{less:.0f}", f"{100 * less / whole:.0f}"))
    return "\n".join(align(rows))


def describe_machine() -> dict[str, Any]:
    """Processor, cores, memory and versions; no names and no paths."""
    from mjx_revolve.numerics.runtime import describe_process

    known = describe_process()
    return {
        "cpu": known["cpu"],
        "cores": known["cpu_count"],
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "machine": platform.machine(),
        "system": platform.system(),
        "device": known["device"],
        "versions": known["versions"],
        "git": known["git"],
    }


def to_json(group: Group, results: Sequence[Result]) -> dict[str, Any]:
    """Everything that was measured of a case, as plain values."""
    rows = [
        {
            "name": r.row.name,
            "engine": r.row.engine,
            "physics": r.row.physics,
            "robot": r.row.robot,
            "population": r.row.population,
            "joint_limits": r.row.limits,
            "processes": len(r.workers),
            "steps_per_second": r.rates,
            "median": r.rate,
            "cores_busy": r.cores,
            "compile_s": r.compile_s,
            "peak_bytes": r.peak,
        }
        for r in results
    ]
    return {"name": group.name, "ratio": ratio(group, results), "goal": group.goal, "rows": rows}


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark, prints the tables and writes the JSON."""
    parser = make_parser("bench", "Throughput beside MuJoCo C and plain MJX, from the same run.")
    number = {"type": whole(1), "metavar": "N"}
    parser.add_argument("--rounds", default=3, help="measurements of each (default: 3)", **number)
    parser.add_argument("--threads", default=2, help="of C, and processes of ours (2)", **number)
    parser.add_argument("--quick", action="store_true", help="one small case, shorter rounds")
    parser.add_argument("--only", metavar="TEXT", help="cases whose name contains this")
    parser.add_argument(
        "--parts", action="store_true", help="instead, what the parts of our step cost"
    )
    parser.add_argument("--json", metavar="FILE", help="where to (default: bench.json in --out)")
    options = parser.parse_args(argv)
    check_whole(parser, options, "quick", "only")
    groups = [QUICK] if options.quick else [PARTS] if options.parts else list(GROUPS)
    if options.only:
        groups = [group for group in groups if options.only in group.name]
        if not groups:
            names = "; ".join(group.name for group in GROUPS)
            raise InputError("--only", f"part of one of: {names}", repr(options.only))
    folder = make_folder(options.out, "bench")
    target = Path(options.json or folder / ("parts.json" if options.parts else "bench.json"))
    began, before = time.monotonic(), os.getloadavg()[0]
    machine = describe_machine()
    versions = machine["versions"]
    print(
        f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB; "
        f"jax {versions['jax']}, mujoco {versions['mujoco']}, "
        f"mujoco-mjx {versions.get('mujoco-mjx', 'none')}; "
        f"{options.threads} threads of MuJoCo C; load average before {before:.1f}"
    )
    report: dict[str, Any] = {
        "settings": {
            name: getattr(options, name) for name in ("rounds", "threads", "quick", "only")
        },
        "machine": machine,
        "load_average": before,
        "cases": [],
    }
    served = []
    for group in groups:
        try:
            results = run(group, options.threads, options.rounds, 0.5 if options.quick else 1.5)
        except RuntimeError as error:
            print(f"error: {group.name}: {error}", file=sys.stderr)
            return 1
        print(f"\n{group.name}: {verdict(group, results)}".rstrip(": "))
        print(parts_table(results) if options.parts else table(group, results), flush=True)
        if "individuals" in group.name:
            each = memory_per_individual(results)
            print(f"An individual adds {each:.0f} B to the peak memory (goal: below 2000).")
        served += [x for r in results if r.row.engine in _C for x in r.cores]
        report["cases"].append(to_json(group, results))
        try:  # after each case: nothing measured is lost
            target.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise InputError("--json", "a file to write", error.strerror) from None
    if options.results:
        numbers = {key: report[key] for key in ("settings", "load_average", "cases")}
        write_results("bench_parts" if options.parts else "bench", numbers, ())
    wanted = min(options.threads, machine["cores"])
    if served and statistics.median(served) < 0.8 * wanted:
        print(
            f"\nOther programs were running: C's threads got {statistics.median(served):.1f} of "
            f"{wanted} cores, so its rates are too low here, and the ratios to them too high."
        )
    print(f"\n{time.monotonic() - began:.0f} s in all; written: {short_path(target)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
