"""What the shipped configurations come to: score, passport, time and memory of each.

``python -m experiments.shipped [--only NAME,...] [--seeds N] [--results]``

Each evolves by the command, as it is shipped, with a compilation cache of its own that is empty:
what somebody sees who does it for the first time. Further seeds find the programs of the first
one. With `--results` each has its `docs/results/NAME.json`: all of the first seed, the score and
what the passport fails of each.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.common import ROOT, as_numbers, make_folder, make_parser, write_results
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.run_reader import RunReader
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.view.statistics import interval

NAMES = tuple(path.stem for path in sorted((ROOT / "configs").glob("*.yaml")))


def evolve(name: str, folder: Path, seed: int, cache: Path) -> dict[str, Any]:
    """Evolves a configuration, and reads what it came to.

    Args:
        name: of a file in `configs/`.
        folder: for the run; what is there is removed.
        seed: of the run.
        cache: for compiled programs.

    Returns:
        The numbers: times [s] by the clock and of all processors, the largest process's memory,
        load averages before and after, the champion's file and its passport.

    Raises:
        InputError: the command fails.
    """
    shutil.rmtree(folder, ignore_errors=True)
    load, began = os.getloadavg()[0], time.monotonic()
    command = [sys.executable, "-m", "mjx_revolve.evolve", name, "--out", str(folder)]
    command += ["--seed", str(seed)]
    place = {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    with subprocess.Popen(
        command, cwd=ROOT, env=os.environ | place, stdout=subprocess.DEVNULL
    ) as process:
        _, status, used = os.wait4(process.pid, 0)  # its own use, and its workers'
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise InputError(name, "exit code 0 of evolve", process.returncode)
    reader = RunReader(folder)
    champion, metrics = reader.load_champion(), reader.load_metrics()
    passport = folder / "champion" / "passport.yaml"
    return {
        "wall_s": time.monotonic() - began,
        "cpu_s": used.ru_utime + used.ru_stime,
        "generations_s": float(metrics["seconds"][-1]),
        "evaluations": int(metrics["evaluations"][-1]),
        "memory_bytes": 1024 * used.ru_maxrss,
        "load_average": [load, os.getloadavg()[0]],
        **{key: value for key, value in champion.facts.items() if not isinstance(value, str)},
        "passport": load_yaml(passport) if passport.is_file() else None,
    }


def over_seeds(runs: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """What the seeds of a configuration come to.

    Args:
        runs: by seed, as `evolve` reads each.

    Returns:
        The interval of their scores, how many passports pass, what others fail in words, and a row
        for each seed with the checks that fail; None without a passport.
    """
    rows = [
        {
            "seed": seed,
            "score": run["score"],
            "score_std": run["score_std"],
            "cpu_s": run["cpu_s"],
            "failed": run["passport"]
            and [key for key, x in run["passport"]["checks"].items() if not x.get("passed", True)],
        }
        for seed, run in runs.items()
    ]
    return {
        "score": as_numbers(interval([row["score"] for row in rows])),
        "passed": sum(row["failed"] == [] for row in rows),
        "size": len(rows),
        "failed": "; ".join(
            f"seed {row['seed']}: {', '.join(row['failed'])}" for row in rows if row["failed"]
        )
        or None,
        "runs": rows,
    }


def main(argv: list[str] | None = None) -> int:
    """Evolves them one after the other."""
    parser = make_parser("shipped", "What the shipped configurations come to.")
    parser.add_argument(
        "--only", default=",".join(NAMES), metavar="NAME,...", help="(default: all)"
    )
    parser.add_argument(
        "--seeds", type=whole(1), default=1, metavar="N", help="runs of each (default: 1)"
    )
    options = parser.parse_args(argv)
    names = options.only.split(",")
    if unknown := [name for name in names if name not in NAMES]:
        raise InputError("--only", f"any of {', '.join(NAMES)}", unknown[0])
    folder = make_folder(options.out, "shipped").resolve()
    for name in names:
        first = load_config(name).evolution.seed
        runs: dict[int, dict[str, Any]] = {}
        cache = folder / f"{name}_cache"
        shutil.rmtree(cache, ignore_errors=True)
        for seed in range(first, first + options.seeds):
            at = folder / (name if seed == first else f"{name}_{seed}")
            runs[seed] = evolve(name, at, seed, cache)
            print(f"{name}, seed {seed}: {runs[seed]['cpu_s']:.0f} s of CPU time", flush=True)
        shutil.rmtree(cache, ignore_errors=True)
        if options.results:
            write_results(name, runs[first] | {"over_seeds": over_seeds(runs)}, list(runs))
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
