"""Does the package install beside others? Makes environments, and tries it in each.

``python -m experiments.installations [--only lowest,newest,neighbours] [--tests]``

`lowest` has the lowest version of each package that `pyproject.toml` names, `newest` the newest of
everything, `neighbours` brax, MuJoCo Playground, Stable-Baselines3 and QDax. In each: `pip check`,
imports, the smoke run from an empty folder, and with `--tests` the quick tests, or beside
neighbours, whose versions of the rest are the newest, the tests and examples that need them. Each
takes minutes and up to 8 GB, in `--out`, and is removed afterwards.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.common import ROOT, make_folder, make_parser, read_rows, today, write_results
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic

QUICK = ("-m", "not slow and not long")
DOORS = "test_doors or 13_ or 14_ or 15_ or 16_ or 17_"
# What is installed besides this package, what is imported beside it, whose versions are named, and
# what is tested.
COLUMNS: dict[str, tuple[tuple[str, ...], ...]] = {
    "lowest": ((), (), ("mujoco", "jax", "numpy"), QUICK),
    "newest": ((), (), ("mujoco", "jax", "numpy"), QUICK),
    "neighbours": (
        ("brax", "playground", "stable-baselines3", "qdax", "gymnasium>=1.1", "ribs>=0.12,<0.13"),
        ("brax.envs", "mujoco_playground", "stable_baselines3", "qdax.core.map_elites"),
        ("brax", "playground", "stable-baselines3", "qdax", "ribs", "mujoco", "jax"),
        ("tests/episodes/test_doors.py", "tests/test_examples.py", "-k", DOORS),
    ),
}
STEPS = ("pip check", "imports", "smoke run", "quick tests", "doors and examples")
TOOLS = ("pytest>=8", "pytest-xdist>=3.6", "hypothesis>=6.130", "pandas>=2.2")

# What is installed, and how many distributions some of it cannot do without, itself included.
_LOOK = """
import json, re
from importlib.metadata import distributions
from packaging.requirements import Requirement

def plain(name):
    return re.sub(r"[-_.]+", "-", name).lower()

installed = {plain(one.metadata["Name"]): one for one in distributions()}

def needed_by(*names):
    found, todo = set(), [(name, "") for name in names]
    while todo:
        name, extra = one = todo.pop()
        if one in found or name not in installed:
            continue
        found.add(one)
        for need in map(Requirement, installed[name].requires or ()):
            if need.marker is None or need.marker.evaluate({"extra": extra}):
                todo += [(plain(need.name), more) for more in ("", *need.extras)]
    return {name for name, _ in found}

needs = [Requirement(line) for line in installed["mjx-revolve"].requires]
direct = [plain(need.name) for need in needs if "extra" not in str(need.marker)]
print(json.dumps({
    "versions": {name: installed[name].version for name in sorted(installed)},
    "evosax": len(needed_by("evosax")),
    "evosax_and_mujoco": len(needed_by("evosax", "mujoco")),
    "without_evosax": 1 + len(needed_by(*(name for name in direct if name != "evosax"))),
}))
"""


# As in names of tox's environments.
_PYTHON = f"py{sys.version_info.major}{sys.version_info.minor}"


def lowest_versions() -> list[str]:
    """A pin for each package that the base installation names."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    found = (re.match(r"([\w-]+)>=([\d.]+)", line) for line in project["dependencies"])
    return [f"{one[1]}=={one[2]}" for one in found if one]


def run(*command: str | Path, folder: Path = ROOT) -> tuple[bool, str]:
    """Whether a command succeeded, and the last lines of what it said."""
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    said = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    return done.returncode == 0, "\n".join(said[-5:])


def measure(python: Path) -> dict[str, Any]:
    """How many distributions an environment has, pip left out, and how large they are."""
    done = subprocess.run([python, "-c", _LOOK], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    versions = {k: v for k, v in found["versions"].items() if k not in ("pip", "setuptools")}
    size = sum(
        path.stat().st_size
        for path in python.parent.parent.glob("lib/python*/site-packages/**/*")
        if path.is_file() and path.parts[-2] != "__pycache__"
    )
    sizes = {"distributions": len(versions), "megabytes": round(size / 1e6)}
    return sizes | found | {"versions": versions}


def try_column(name: str, folder: Path, tests: bool) -> dict[str, Any]:
    """Makes an environment and tries the package in it; a step that fails ends it."""
    more, imports, _, tested = COLUMNS[name]
    pins = lowest_versions() if name == "lowest" else []
    python, empty = folder / name / "bin" / "python", folder / f"{name}_empty"
    shutil.rmtree(folder / name, ignore_errors=True)
    shutil.rmtree(empty, ignore_errors=True)
    empty.mkdir(parents=True)
    pip = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    modules = ("mjx_revolve.episodes.fitness", *imports)
    steps: dict[str, tuple[str | Path, ...]] = {
        "venv": (sys.executable, "-m", "venv", folder / name),
        "install": (*pip, ROOT, *pins, *more),
        "pip check": (python, "-m", "pip", "check"),
        "imports": (python, "-c", f"import {', '.join(modules)}"),
        "smoke run": (python.with_name("mjx-revolve"), "evolve", "smoke", "--out", "run"),
    }
    if tests:
        pytest = (python, "-m", "pytest", "--numprocesses", "2", "--dist", "loadfile")
        steps["test tools"] = (*pip, *pins, *TOOLS)
        steps["quick tests" if tested is QUICK else "doors and examples"] = (*pytest, *tested)
    found: dict[str, Any] = {}
    for step, command in steps.items():
        here = empty if step in ("imports", "smoke run") else ROOT
        well, said = run(*command, folder=here)
        counts = re.search(r"\d+ passed.*(?= in )", said)
        found[step] = (counts[0] if counts else "passed") if well else f"failed: {said}"
        print(f"{name}: {step}: {found[step]}", flush=True)
        if not well:
            break
        if step == "install":
            found |= measure(python)
            print(f"{name}: {found['distributions']} distributions, {found['megabytes']} MB")
    shutil.rmtree(folder / name)
    return found


def describe(name: str, found: dict[str, Any]) -> str:
    """What was found in an environment, in a line: versions, then what each step said."""
    versions = found.get("versions", {})
    named = ", ".join(f"{one} {versions[one]}" for one in COLUMNS[name][2] if one in versions)
    return f"{named}: " + "; ".join(f"{step} {found[step]}" for step in STEPS if step in found)


def main(argv: Sequence[str] | None = None) -> int:
    """Tries all columns; returns 1 if a step failed."""
    parser = make_parser("installations", "Tries the package in environments of its own.")
    parser.add_argument("--only", default=",".join(COLUMNS), help="columns (default: all)")
    parser.add_argument("--tests", action="store_true", help="the quick tests, too")
    args = parser.parse_args(argv)
    names = args.only.split(",")
    if unknown := [name for name in names if name not in COLUMNS]:
        raise InputError("--only", f"any of {', '.join(COLUMNS)}", unknown[0])
    folder = make_folder(args.out, "installations").resolve()
    found = {name: try_column(name, folder, args.tests) for name in names}
    path = folder / "installations.json"
    write_atomic(path, (json.dumps(found, indent=1) + "\n").encode())
    print(f"Wrote {path}")
    if args.results:
        # Columns that were not tried stay as they were found.
        columns = {
            row["name"]: row for row in read_rows("installations", "columns", any_machine=True)
        }
        for name, one in found.items():
            title = f"{name}-{_PYTHON}"
            said = describe(name, one)
            columns[title] = {"name": title, "date": today(), **one, "found": said}
        rows = [columns[title] for title in sorted(columns)]
        write_results("installations", {"columns": rows}, ())
    return int(any("failed" in str(step) for one in found.values() for step in one.values()))


if __name__ == "__main__":
    raise SystemExit(run_command(main))
