"""What the experiments' command lines share: options, the output folder, tables."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjx_revolve.inputs.commands import Parser
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.packages import installed_version

ROOT = Path(__file__).resolve().parent.parent


def make_parser(name: str, description: str) -> Parser:
    """A parser with the option that all experiments share.

    Args:
        name: of the experiment's module.
        description: what it does, in a sentence.

    Returns:
        The parser, with `--out`.
    """
    parser = Parser(
        prog=f"python -m experiments.{name}", description=description, allow_abbrev=False
    )
    parser.add_argument("--out", metavar="DIR", help=f"folder to write into (default: runs/{name})")
    return parser


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
        raise InputError(
            f"--out: expected a folder to write into; found {error.strerror}: {out}"
        ) from None
    return folder


def write_results(name: str, numbers: Mapping[str, Any], seeds: Sequence[int]) -> Path:
    """Writes `docs/results/NAME.json`, which pages take their figures from.

    Args:
        name: of the study.
        numbers: that it found.
        seeds: that it used.

    Returns:
        The file.
    """
    packages = ("mjx_revolve", "jax", "jaxlib", "mujoco", "evosax", "numpy")
    data = {
        "versions": {package: installed_version(package) for package in packages},
        "seeds": list(seeds),
        "machine": {"processor": platform.machine(), "cores": os.cpu_count()},
        **numbers,
    }
    path = ROOT / "docs" / "results" / f"{name}.json"
    write_atomic(path, (json.dumps(data, indent=1) + "\n").encode())
    return path
