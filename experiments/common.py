"""What the experiments share: options of command lines, output folders, files of results."""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.inputs.commands import Parser
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.view.statistics import Interval

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
"""What README and the pages take their figures from; see `docs/figures.py`."""


def make_parser(name: str, description: str, files: bool = True) -> Parser:
    """A parser with the options that all experiments share.

    Args:
        name: of the experiment's module.
        description: what it does, in a sentence.
        files: whether it writes others than that of its results.

    Returns:
        The parser, with `--results` and, for its files, `--out`.
    """
    parser = Parser(
        prog=f"python -m experiments.{name}", description=description, allow_abbrev=False
    )
    add = parser.add_argument
    if files:
        add("--out", metavar="DIR", help=f"folder to write into (default: runs/{name})")
    add("--results", action="store_true", help="write docs/results as well, which pages show")
    return parser


def check_whole(parser: Parser, options: argparse.Namespace, *names: str) -> None:
    """Raises `InputError` if `--results` would replace what pages show by a part of it.

    Args:
        parser: of the options.
        options: as given.
        names: of options that leave something out.
    """
    for name in names:
        if options.results and getattr(options, name) != parser.get_default(name):
            option = name.replace("_", "-")
            raise InputError("--results", "all of the study", f"--{option}")


def make_folder(out: str | None, name: str) -> Path:
    """Makes the folder that an experiment writes into.

    Args:
        out: what the user chose, or None.
        name: of the experiment's module.

    Returns:
        The folder.

    Raises:
        InputError: it cannot be made.
    """
    folder = Path(out) if out is not None else ROOT / "runs" / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--out", "a folder to write into", f"{error.strerror}: {out}") from None
    return folder


def as_numbers(found: Interval) -> dict[str, Any]:
    """An interval as results files have it: null where it is not known, and as pages show it."""
    finite = [x if np.isfinite(x) else None for x in (found.mean, found.half)]
    return {"mean": finite[0], "half": finite[1], "size": found.size, "text": str(found)}


def read_rows(
    name: str, rows: str, folder: Path = RESULTS, any_machine: bool = False
) -> list[dict[str, Any]]:
    """Rows that `write_results` wrote before, for what adds to them.

    Args:
        name: of the study.
        rows: their key in its numbers.
        folder: where its file is.
        any_machine: whether rows may be of another machine than this one.

    Returns:
        The rows; none where there is no file.

    Raises:
        InputError: they are of another machine.
    """
    path = folder / f"{name}.json"
    if not path.exists():
        return []
    from mjx_revolve.numerics.runtime import describe_process

    known = json.loads(path.read_text("utf-8"))
    if not any_machine and (here := _machine(describe_process())) != known["machine"]:
        raise InputError(str(path), f"rows of this machine, {here}", f"those of {known['machine']}")
    return known["numbers"][rows]


def _machine(process: Mapping[str, Any]) -> dict[str, Any]:
    """What times depend on, of what `describe_process` says."""
    return {key: process[key] for key in ("cpu", "cpu_count", "device")}


def today() -> str:
    """The date that results have."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()


def study_hash() -> str:
    """A hash of what studies run besides the package: experiments, configurations and robots."""
    found = hashlib.sha256()
    for folder in ("experiments", "configs", "morphologies"):
        for path in sorted((ROOT / folder).iterdir()):
            if path.suffix in (".py", ".yaml"):
                found.update(path.read_bytes())
    return found.hexdigest()[:12]


def _plain(value: Any) -> Any:
    """A value as JSON has it; null for a number that is not finite, as pages show none."""
    if isinstance(value, Mapping):
        return {key: _plain(x) for key, x in value.items()}
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_results(
    name: str, numbers: Mapping[str, Any], seeds: Sequence[int], folder: Path | None = None
) -> Path:
    """Writes what a study found, with what it depends on, as `NAME.json`.

    Args:
        name: of the study.
        numbers: numbers, texts, and mappings or lists of these; SI units, or the unit at the end of
            the key. Numbers of NumPy will do; what is not finite becomes null.
        seeds: that it ran; () where nothing is drawn.
        folder: where to; None: `docs/results`, from where the pages take them.

    Returns:
        The file.
    """
    from mjx_revolve.numerics.runtime import describe_process, source_hash

    known = describe_process()
    result = {
        "study": name,
        "date": today(),
        "versions": known["versions"] | {"source": source_hash(), "study": study_hash()},
        "machine": _machine(known),
        "seeds": list(seeds),
        "numbers": numbers,
    }
    path = (folder or RESULTS) / f"{name}.json"
    text = json.dumps(_plain(result), indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(path, f"{text}\n".encode())
    return path
