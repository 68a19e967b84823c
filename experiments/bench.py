"""How fast it is, beside MuJoCo C and plain MJX, all from one run.

``python -m experiments.bench [--quick] [--population N] [--robot FILE] [--json FILE]``

Every engine runs in a process of its own, as a user would start it: no pinning, no environment
variables but those that `mjx_revolve.evolve` sets, compilation cache off. The processes are started
one after the other, which times their compilation, and then measured in turn, several rounds, the
order reversed in every other round; while one is measured the others wait. What is counted is steps
of one robot. docs/performance.md says what the numbers mean.
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from experiments.common import ROOT, align, count, make_folder, make_parser, shown
from mjx_revolve.errors import InputError, run_command

# Longest wait for an answer [s]; the slowest compiles for a quarter of a minute.
_PATIENCE = 300.0
_MEMORY_POPULATION = 1024


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: what is measured.
        case: which of `bench_cases.MAKERS`.
        physics: which of `bench_cases.PHYSICS`.
        quick: whether `--quick` keeps it.
        limits: whether joint limits are left on (plain MJX).
        task: what the episodes are, ours only.
        cores: the cores that its processes are pinned to, one process each; None: one, not pinned.
    """

    name: str
    case: str
    physics: str
    quick: bool = False
    limits: bool = True
    task: str = "directed_swim"
    cores: tuple[int, ...] | None = None


ROWS = (
    Row("ours, evaluation, default water", "evaluation", "default", quick=True),
    Row("ours, whole generation, default water", "generation", "default"),
    Row("ours, bare steps, default water", "bare", "default"),
    Row("ours, evaluation, ellipsoid law", "evaluation", "ellipsoid"),
    Row("ours, evaluation, no fluid", "evaluation", "none"),
    Row("plain MJX, no fluid", "mjx", "none", quick=True),
    Row("plain MJX, no fluid, no joint limits", "mjx", "none", limits=False),
    Row("plain MJX, inertia box", "mjx", "inertia_box"),
    Row("MuJoCo C, rollout, ellipsoid law", "rollout", "ellipsoid", quick=True),
    Row("MuJoCo C, Batch, ellipsoid law", "batch", "ellipsoid", quick=True),
    Row("MuJoCo C, rollout, no fluid", "rollout", "none"),
    Row("MuJoCo C, Batch, no fluid", "batch", "none"),
)
# `--parts`: the default water with one thing left out, or added.
PARTS = (
    Row("evaluation, default water", "evaluation", "default"),
    Row("mask for partial submersion", "evaluation", "mask"),
    Row("no drag", "evaluation", "no_drag"),
    Row("no added mass", "evaluation", "no_added_mass"),
    Row("no water at all", "evaluation", "none"),
    Row("no controller, track and score", "bare", "default"),
    Row("with contact: crawl on the bed", "evaluation", "default", task="crawl"),
)


class Worker:
    """A process that serves one case; see `bench_cases.main`."""

    def __init__(self, job: dict[str, Any]) -> None:
        self._errors: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  (closed in `close`)
        self._case = job["case"]
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
            raise RuntimeError(f"{self._case}: {reason}")
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


def start(row: Row, job: dict[str, Any]) -> Result:
    """Starts a row's processes and waits until they are ready."""
    result = Result(row)
    job = job | {"case": row.case, "physics": row.physics}
    job |= {"limits": row.limits, "task": row.task}
    try:
        for core in row.cores or (None,):
            result.workers.append(Worker(job | {"core": core}))
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


def run(
    rows: list[Row], job: dict[str, Any], rounds: int, seconds: float
) -> tuple[list[Result], Result]:
    """Measures all rows in turn.

    Args:
        rows: what to measure.
        job: robot, configuration, population and threads.
        rounds: how often.
        seconds: each time, at least [s].

    Returns:
        The results, and that of the large population, measured once, before the others.
    """
    results: list[Result] = []
    say = lambda text: print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)  # noqa: E731
    quiet = not sys.stderr.isatty()
    try:
        large = Row(f"ours, evaluation, population {_MEMORY_POPULATION}", "evaluation", "default")
        memory = start(large, job | {"population": _MEMORY_POPULATION})
        results.append(memory)
        measure(memory, seconds)
        memory.workers.pop().close()
        for row in rows:
            quiet or say(f"starting {row.name}")
            results.append(start(row, job))
        for k in range(rounds):
            for result in results[1:] if k % 2 == 0 else results[:0:-1]:
                quiet or say(f"round {k + 1} of {rounds}: {result.row.name}")
                measure(result, seconds)
        quiet or say("")
    finally:
        for result in results:
            for worker in result.workers:
                worker.close()
    return results[1:], memory


# ------------------------------------------------------------------ what is written


def baselines(results: list[Result]) -> dict[str, float]:
    """Rates to compare with: C's best with "ellipsoid" and with "none", and plain MJX ("mjx")."""
    found = {}
    for physics in ("ellipsoid", "none"):
        rates = [
            r.rate
            for r in results
            if r.row.case in ("rollout", "batch") and r.row.physics == physics
        ]
        if rates:
            found[physics] = max(rates)
    for r in results:
        if r.row.case == "mjx" and r.row.physics == "none" and r.row.limits:
            found["mjx"] = r.rate
    return found


def ratios(result: Result, base: dict[str, float]) -> tuple[float | None, float | None]:
    """To C's best with the same or the nearest physics, and to plain MJX with nothing added."""
    physics = "none" if result.row.physics == "none" else "ellipsoid"
    to_c, to_mjx = (result.rate / base[x] if x in base else None for x in (physics, "mjx"))
    return to_c, to_mjx


def table(results: list[Result]) -> str:
    """The results as an aligned table."""
    base = baselines(results)
    rows = [
        (
            "engine",
            "median",
            "lowest",
            "highest",
            "to C's",
            "to plain",
            "cores",
            "compile",
            "memory",
        ),
        ("", "Msteps/s", "Msteps/s", "Msteps/s", "best", "MJX", "busy", "s", "MiB"),
    ]
    for r in results:
        to_c, to_mjx = ratios(r, base)
        rows.append(
            (
                r.row.name,
                *(f"{x / 1e6:.3f}" for x in (r.rate, min(r.rates), max(r.rates))),
                "-" if to_c is None else f"{to_c:.2f}",
                "-" if to_mjx is None else f"{to_mjx:.2f}",
                f"{statistics.median(r.cores):.1f}",
                f"{r.compile_s:.1f}" if r.row.case not in ("rollout", "batch") else "-",
                f"{r.peak / 2**20:.0f}",
            )
        )
    return align(rows)


def parts_table(results: list[Result]) -> str:
    """What one step of one robot costs, with parts left out."""
    whole = 1e9 / results[0].rate
    rows = [("", "a step", "less", "share"), ("", "ns", "ns", "%")]
    for r in results:
        spent = 1e9 / r.rate
        less = whole - spent
        rows.append((r.row.name, f"{spent:.0f}", f"{less:.0f}", f"{100 * less / whole:.0f}"))
    return align(rows)


def describe_machine() -> dict[str, Any]:
    """Processor, cores, memory and versions; no names and no paths."""
    from mjx_revolve.runtime import describe_process

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


def to_json(
    results: list[Result], memory: Result, settings: dict[str, Any], load: tuple[float, float]
) -> dict[str, Any]:
    """Everything that was measured, as plain values."""
    base = baselines(results)

    def plain(r: Result) -> dict[str, Any]:
        return {
            "name": r.row.name,
            "case": r.row.case,
            "physics": r.row.physics,
            "joint_limits": r.row.limits,
            "pinned_processes": len(r.row.cores or ()),
            "steps_per_second": r.rates,
            "median": r.rate,
            "cores_busy": r.cores,
            "compile_s": r.compile_s,
            "peak_bytes": r.peak,
        }

    rows = []
    for r in results:
        to_c, to_mjx = ratios(r, base)
        rows.append(plain(r) | {"to_c": to_c, "to_plain_mjx": to_mjx})
    return {
        "settings": settings,
        "machine": describe_machine(),
        "load_average": {"before": load[0], "after": load[1]},
        "rows": rows,
        "large_population": plain(memory) | {"population": _MEMORY_POPULATION},
    }


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark, prints the table and writes the JSON."""
    parser = make_parser("bench", "Throughput beside MuJoCo C and plain MJX, from the same run.")
    whole = {"type": count, "metavar": "N"}
    parser.add_argument("--population", default=256, help="individuals (default: 256)", **whole)
    parser.add_argument("--robot", metavar="FILE", help="a morphology (default: the spider)")
    parser.add_argument("--rounds", default=3, help="measurements of each (default: 3)", **whole)
    parser.add_argument("--threads", default=2, help="of MuJoCo C (default: 2)", **whole)
    parser.add_argument("--quick", action="store_true", help="fewer rows, shorter rounds")
    parser.add_argument(
        "--parts", action="store_true", help="instead, what the parts of our step cost"
    )
    parser.add_argument("--json", metavar="FILE", help="where to (default: bench.json in --out)")
    options = parser.parse_args(argv)
    robot = Path(options.robot or ROOT / "morphologies" / "spider.yaml").absolute()

    from mjx_revolve.morphology import load_morphology

    if load_morphology(robot).num_hinges == 0:
        raise InputError(f"--robot: expected a robot with hinges; found none in {options.robot}")
    folder = make_folder(options.out, "bench")
    target = Path(options.json or folder / ("parts.json" if options.parts else "bench.json"))
    rows = list(PARTS) if options.parts else [r for r in ROWS if r.quick or not options.quick]
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(usable) > 1 and not options.quick and not options.parts:
        pinned = Row("ours, two pinned processes", "evaluation", "default", cores=tuple(usable[:2]))
        rows.insert(3, pinned)
    job = {
        "robot": str(robot),
        "config": str(ROOT / "configs" / "lake_swim.yaml"),
        "population": options.population,
        "threads": options.threads,
    }
    began, before = time.monotonic(), os.getloadavg()[0]
    try:
        results, memory = run(rows, job, options.rounds, 0.5 if options.quick else 1.5)
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    settings = {
        "robot": robot.name,
        "population": options.population,
        "rounds": options.rounds,
        "c_threads": options.threads,
        "quick": options.quick,
    }
    report = to_json(results, memory, settings, (before, os.getloadavg()[0]))
    machine, versions = report["machine"], report["machine"]["versions"]
    print(
        f"{robot.stem}, population {options.population}; {machine['cpu']}, {machine['cores']} "
        f"cores, {machine['memory_bytes'] / 2**30:.0f} GiB; jax {versions['jax']}, "
        f"mujoco {versions['mujoco']}, mujoco-mjx {versions['mujoco-mjx']}\n"
    )
    print(parts_table(results) if options.parts else table(results))
    generation = {r.row.case: r.rate for r in results if r.row.physics == "default"}
    if "generation" in generation:
        share = generation["generation"] / generation["bare"]
        print(f"\nA whole generation runs at {100 * share:.0f} % of the bare steps' throughput.")
    print(
        f"\nPopulation {_MEMORY_POPULATION}: {memory.rate / 1e6:.3f} Msteps/s, peak memory "
        f"{memory.peak / 2**20:.0f} MiB (to stay below 4096)."
    )
    print(
        f"MuJoCo C has {options.threads} threads. Load average before {before:.1f}. "
        f"{time.monotonic() - began:.0f} s in all."
    )
    wanted = min(options.threads, machine["cores"])
    served = [x for r in results if r.row.case == "rollout" for x in r.cores] or [wanted]
    if statistics.median(served) < 0.8 * wanted:
        print(
            f"Other programs were running: C's threads got {statistics.median(served):.1f} of "
            f"{wanted} cores, so its rates are too low here, and the ratios to them too high."
        )
    try:
        target.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--json: expected a file to write; found {error.strerror}") from None
    print(f"written: {shown(target)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
