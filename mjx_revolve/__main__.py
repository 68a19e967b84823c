"""All commands under one name: `mjx-revolve evolve lake_swim`, or `python -m mjx_revolve ...`."""

from __future__ import annotations

import importlib
import re
import shutil
import sys
import textwrap
from pathlib import Path

import mjx_revolve
from mjx_revolve.inputs.commands import program, run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.shipped import list_shipped

COMMANDS = {
    "evolve": "evolve a robot's brain, bodies with their brains, or a colony: a run folder",
    "sweep": "a grid of such runs, several seeds of each, and one report",
    "inspect": "a robot's modules, and what it weighs in air and in water; its picture",
    "viewer": "a page that replays a run's champion, or a robot, in any browser",
    "replay": "a film of it: MP4 and GIF",
    "live": "a running world in a browser, to drop robots into",
    "report": "a page about one run, several, or a sweep",
    "passport": "what a run's champion was tried for, and what it fails",
    "fit": "the water's coefficients, from recordings of a robot that swam",
    "export": "a champion, or a robot, for MuJoCo, ROS and Gazebo",
    "import": "a robot of a URDF or an MJCF file",
    "schema": "the JSON Schema of a kind of YAML, by which editors complete and underline",
    "completion": "a script for bash or zsh that completes commands and names",
}
_EXAMPLES = (
    "inspect spider --picture spider.png",
    "evolve lake_swim --set task.duration=8 --out runs/mine",
    "viewer runs/mine",
    "schema config",
)


def main() -> int:
    """Runs the command that the first argument names.

    Returns:
        The exit code.
    """
    return run_command(_main, sys.argv[1:])


def _main(argv: list[str] | None) -> int:
    name, *rest = argv or ["--help"]
    if name in ("-h", "--help"):
        print(_help())
        return 0
    if name == "--version":
        print(f"mjx_revolve {mjx_revolve.__version__}")
        return 0
    if name not in COMMANDS:
        raise InputError(f"expected one of {', '.join(COMMANDS)}; found {name!r} (see --help)")
    module = "importer" if name == "import" else name  # which no module may be called
    return importlib.import_module(f"mjx_revolve.{module}").main(rest)


def _help() -> str:
    """All commands, examples, and what comes with the package."""
    configs = {name: _first_words(path) for name, path in list_shipped("configs").items()}
    robots = ", ".join(list_shipped("morphologies"))
    worlds = ", ".join(list_shipped("worlds"))
    return "\n".join((
        f"usage: {program('COMMAND')} ...",
        "",
        "Evolves modular robots that swim and crawl under water.",
        "",
        "commands, each of which explains itself with --help:",
        *_columns(COMMANDS),
        "",
        "examples:",
        *(f"  {program(line)}" for line in _EXAMPLES),
        "",
        "configurations that come with the package; a path to your own does as well:",
        *_columns(configs),
        "",
        _fill(f"robots: {robots}", 2),
        "",
        f"worlds: {worlds}",
        "",
        "--version prints the version.",
    ))  # fmt: skip


def _columns(words: dict[str, str]) -> list[str]:
    indent = max(map(len, words)) + 4
    lines = (f"  {name}".ljust(indent) + text for name, text in words.items())
    return [_fill(line, indent) for line in lines]


def _fill(line: str, indent: int) -> str:
    width = shutil.get_terminal_size().columns - 2  # as argparse has it
    return textwrap.fill(line, max(width, indent + 20), subsequent_indent=" " * indent)


def _first_words(path: Path) -> str:
    """The comment that a file begins with, up to its first stop or colon."""
    return re.split(r"[.:]", path.read_text("utf-8").removeprefix("# "))[0]


if __name__ == "__main__":
    sys.exit(main())
