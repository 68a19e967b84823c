"""What the shipped configurations come to: score, passport, time and memory of each.

``python -m experiments.shipped [--only NAME,...] [--results]``

Each evolves by the command, as it is shipped, with a compilation cache of its own that is empty:
what somebody sees who does it for the first time. With `--results` each
has its `docs/results/NAME.json`.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from experiments.common import ROOT, make_folder, make_parser, write_results
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.run_reader import RunReader
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.yaml_reader import load_yaml

NAMES = tuple(path.stem for path in sorted((ROOT / "configs").glob("*.yaml")))


def evolve(name: str, folder: Path) -> dict[str, Any]:
    """Evolves a configuration, and reads what it came to.

    Args:
        name: of a file in `configs/`.
        folder: for the run; what is there is removed.

    Returns:
        The numbers: times [s] by the clock and of all processors, the largest process's memory,
        load averages before and after, the champion's file and its passport.

    Raises:
        InputError: the command fails.
    """
    shutil.rmtree(folder, ignore_errors=True)
    load, began = os.getloadavg()[0], time.monotonic()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "mjx_revolve.evolve", name, "--out", str(folder)]
    place = {"JAX_COMPILATION_CACHE_DIR": str(folder.with_name(f"{name}_cache"))}
    done = subprocess.run(command, cwd=ROOT, env=os.environ | place, stdout=subprocess.DEVNULL)
    shutil.rmtree(place["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
    if done.returncode:
        raise InputError(f"{name}: expected exit code 0 of evolve; found {done.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    reader = RunReader(folder)
    champion, metrics = reader.load_champion(), reader.load_metrics()
    passport = folder / "champion" / "passport.yaml"
    return {
        "wall_s": time.monotonic() - began,
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "generations_s": float(metrics["seconds"][-1]),
        "evaluations": int(metrics["evaluations"][-1]),
        "memory_bytes": 1024 * after.ru_maxrss,
        "load_average": [load, os.getloadavg()[0]],
        **{key: value for key, value in champion.facts.items() if not isinstance(value, str)},
        "passport": load_yaml(passport) if passport.is_file() else None,
    }


def main(argv: list[str] | None = None) -> int:
    """Evolves them one after the other."""
    parser = make_parser("shipped", "What the shipped configurations come to.")
    parser.add_argument(
        "--only", default=",".join(NAMES), metavar="NAME,...", help="(default: all)"
    )
    options = parser.parse_args(argv)
    names = options.only.split(",")
    if unknown := [name for name in names if name not in NAMES]:
        raise InputError(f"--only: expected any of {', '.join(NAMES)}; found {unknown[0]}")
    folder = make_folder(options.out, "shipped").resolve()
    for name in names:
        numbers = evolve(name, folder / name)
        seed = load_config(name).evolution.seed
        print(f"{name}: {numbers['cpu_s']:.0f} s of CPU time", flush=True)
        if options.results:
            write_results(name, numbers, [seed])
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
