"""What the command lines share: reading of arguments, notes on stderr, errors as exit codes.

What the package logs is a line on stderr, `note: ...`; an error is one line there and an exit code.
Nothing heavy is imported here, so that `--help` is quick.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import logging
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from mjx_revolve.inputs import early_sigint
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import SWEEP, check_path, read_file, short_path
from mjx_revolve.inputs.packages import check_mujoco
from mjx_revolve.inputs.shipped import list_shipped
from mjx_revolve.inputs.trust import add_trust_argument, opening

_SEEDS = 2**32  # what JAX's keys take, and a run's configuration
# A day [s]: its poses already take several GB.
_LONGEST_EPISODE = 86_400.0


def program(name: str, python: str = "python") -> str:
    """How a command was called, to call it again.

    Args:
        name: of the command.
        python: the path of Python, where it is the first word.
    """
    own = Path(sys.argv[0])
    if own.name == "mjx-revolve":
        return f"{own.name} {name}"
    whole = (own.parent.name, own.name) == ("mjx_revolve", "__main__.py")
    whole |= name.partition(" ")[0] == "import"  # which no module may be called
    return f"{python} -m mjx_revolve{' ' if whole else '.'}{name}"


def program_again(name: str) -> str:
    """How to call a command with this Python, from the current folder."""
    python = Path(sys.executable)
    own = short_path(python) if python.is_relative_to(Path.cwd()) else "python"
    return program(name, shlex.quote(own))


class Parser(argparse.ArgumentParser):
    """Argument parser with errors of one line, as for files.

    Args:
        examples: what to type, from the command's name on; `--help` ends with them.
        settings: as `argparse.ArgumentParser` has them.
    """

    def __init__(self, *, examples: Sequence[str] = (), **settings: Any) -> None:
        super().__init__(**settings)
        self._examples = examples

    def format_help(self) -> str:
        """The help text, followed by the examples verbatim."""
        lines = [f"  {program(line)}\n" for line in self._examples]
        return super().format_help() + "\nexamples:\n" * bool(lines) + "".join(lines)

    def error(self, message: str) -> NoReturn:
        """Raises `InputError` instead of printing the usage and ending the process."""
        raise InputError(f"{message.removeprefix('argument ')} (see --help)")


def refuse_blank(text: str, what: str = "an address or a file") -> str:
    """Reads a text, for `add_argument(type=refuse_blank)`; refuses "" (an unset shell variable)."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"expected {what}; found {text!r}")
    return text


def note_lost(lost: float | None) -> None:
    """A line on stderr where what is shown of a trajectory ends before it, at a time [s]."""
    if lost is not None:
        words = f"the trajectory is not finite from {lost:.4g} s on; shown up to there"
        print(f"note: {words}", file=sys.stderr)


def read_world(text: str) -> str:
    """Reads the name or file of a world, for `add_argument(type=read_world)`; refuses ""."""
    return refuse_blank(text, "a world's name or file")


def read_path(text: str) -> str:
    """Reads a path, for `add_argument(type=read_path)`; refuses ""."""
    refuse_blank(text, "a path")
    try:
        check_path(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def positive(unit: str, most: float = math.inf, zero: bool = False) -> Callable[[str], float]:
    """A reader of numbers above 0, or from there on, for `add_argument(type=positive("m"))`."""

    def read(text: str) -> float:
        """Reads a number within the bounds."""
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (0 < value <= most or (zero and value == 0)) or value == math.inf:
            bounds = f">{'=' * zero} 0" + ("" if most == math.inf else f" and <= {most:g}")
            raise argparse.ArgumentTypeError(f"expected a number {bounds} [{unit}]; found {text!r}")
        return value

    return read


read_seconds = positive("s", _LONGEST_EPISODE)


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """A reader of whole numbers from low to high, for `add_argument(type=whole(1))`."""

    def read(text: str) -> int:
        """Reads a whole number within the bounds."""
        digits = text.strip()
        # Fewer digits than Python refuses to read.
        value = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 100 else None
        if value is None or value < low or (high is not None and value > high):
            bounds = f">= {low}" if high is None else f"from {low} to {high}"
            raise argparse.ArgumentTypeError(f"expected a whole number {bounds}; found {text!r}")
        return value

    return read


read_seed = whole(0, _SEEDS - 1)


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of commands that evolve: `--workers` and `--cluster`."""
    add = parser.add_argument
    add("--workers", type=whole(1), metavar="N",
        help="processes on this machine (default: its cores)")  # fmt: skip
    add("--cluster", type=refuse_blank, metavar="SCHEDULER",
        help="a Dask scheduler's address, or its scheduler file: its workers score")  # fmt: skip


def check_run_arguments(arguments: argparse.Namespace) -> None:
    """Raises `InputError` if both `--workers` and `--cluster` are given."""
    if arguments.cluster is not None and arguments.workers is not None:
        raise InputError("--cluster", "no --workers beside it", "both")


def add_episode_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `load_episode`: path, duration, seed, individual, world, modules."""
    add = parser.add_argument
    add("path", type=read_path, help="run folder, genes.yaml, or morphology (YAML or name)")
    add("--duration", type=read_seconds, metavar="S", help="seconds (default: the task's, or 10)")
    add("--seed", type=read_seed, metavar="N", help="draws another start")
    add("--individual", type=whole(0), metavar="N",
        help="number of an individual of the run, where bodies evolve (default: the champion)",
    )  # fmt: skip
    add("--world", type=read_world, help="of a morphology: a name or a YAML (default: lake)")
    add("--modules", type=read_path, metavar="MY.yaml",
        help="of a morphology: module types of your own (a run's are in its folder)")  # fmt: skip
    parser.set_defaults(colony=False)
    add_trust_argument(parser)


def add_colony_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds `--colony` and `--time`, which name a whole colony instead of an episode."""
    lives = "which lives on for --duration (default: 60 s) from its newest checkpoint"
    parser.add_argument("--colony", action="store_true", help=f"a run's whole colony, {lives}")
    begins = "with --colony: from this time of its life on, in seconds"
    parser.add_argument("--time", type=positive("s", zero=True), metavar="S", help=begins)


def check_colony_arguments(arguments: argparse.Namespace) -> None:
    """Raises `InputError` for options that do not go with `--colony`, or without it."""
    if not arguments.colony:
        if arguments.time is not None:
            raise InputError("--time", "--colony with it", "none")
        return
    for name in ("individual", "seed", "world", "modules"):
        if getattr(arguments, name) is not None:
            raise InputError(f"--{name}", "none with --colony", "one")
    if not Path(arguments.path).is_dir():
        raise InputError(arguments.path, "the run folder of a colony", "a file")


def opening_episode(arguments: argparse.Namespace) -> contextlib.AbstractContextManager[None]:
    """`trust.opening` of the files that `add_episode_arguments` takes."""
    named = (arguments.path, arguments.world, arguments.modules)
    return opening(*(name for name in named if name is not None), trust=arguments.trust)


def individual_name(number: int | None) -> str:
    """The path of an individual's files in its run folder, without suffix; "" for None."""
    return "" if number is None else f"individuals/{number}"


def check_no_sweep(path: str | Path) -> None:
    """Raises `InputError` if a path is the folder of a sweep, where one run is expected."""
    if (Path(path) / SWEEP).is_file():
        runs = sorted(Path(path).glob("*/seed_*/config.yaml"))
        such = f", such as {runs[0].parent}" if runs else ""
        raise InputError(path, "one run", f"a sweep of several{such}")


def check_no_fit(path: str | Path) -> None:
    """Raises `InputError` if a path is the folder of a fit, where a run of evolve is expected."""
    try:
        info = json.loads(read_file(Path(path) / "run.json"))
    except (InputError, OSError, ValueError, RecursionError):
        return
    if isinstance(info, dict) and info.get("kind") == "fit":
        found = "a fit, which has a report.html, and which fit --resume continues"
        raise InputError(path, "a run of evolve", found)


def check_episode_path(path: str | Path) -> None:
    """Raises `InputError` if there is no run folder, `genes.yaml` or morphology at a path.

    This precedes the imports of JAX and MuJoCo.
    """
    shipped = list_shipped("morphologies")
    check_no_sweep(path)
    check_no_fit(path)
    if not Path(path).exists() and str(path) not in shipped:
        none = f"none, and no shipped morphology of this name ({', '.join(shipped)})"
        raise InputError(path, "a run folder, a genes.yaml or a morphology", none)


def check_place(path: str | Path, label: str) -> None:
    """Raises `InputError` if a file cannot be written at a path, before any work is done for it.

    Args:
        path: of a file or a folder; its parents are made later.
        label: of messages.
    """
    for folder in Path(path).parents:
        if folder.is_dir():
            if not os.access(folder, os.W_OK | os.X_OK):
                raise InputError(label, "a folder to write into", f"{folder} read-only")
            return
        if folder.exists():
            raise InputError(label, f"the folder {folder}", "a file")
        if folder.is_symlink():
            raise InputError(label, f"the folder {folder}", "a link that leads nowhere")


def check_output_folder(folder: str | Path, option: str = "--out") -> None:
    """Raises `InputError` if no files can be written into a folder, before any work is done."""
    label = f"{option} {folder}".lstrip()
    if Path(folder).exists() and not Path(folder).is_dir():
        raise InputError(label, "a folder", "a file")
    check_place(Path(folder) / "any", label)


def check_absent(path: Path, what: str = "file") -> None:
    """Raises `InputError` if a file exists at a path: a user's file is never overwritten."""
    if path.exists():
        raise InputError(f"{path}: expected no such {what} yet; name it with --out to replace it")


class _Note(logging.Formatter):
    """Notes without control characters: they repeat names from files."""

    def format(self, record: logging.LogRecord) -> str:
        """The note, each line of it plain."""
        return "\n".join(map(plain, super().format(record).split("\n")))


@contextlib.contextmanager
def show_notes() -> Iterator[None]:
    """Shows on stderr what the package logs."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Note("note: %(message)s"))
    logger = logging.getLogger("mjx_revolve")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def say(text: str, end: str = "\n") -> None:
    """Prints a line; if nothing reads standard output any more, a run goes on in silence."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.EIO):  # a pipe, a terminal
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def run_command(main: Callable[[list[str] | None], int], argv: list[str] | None = None) -> int:
    """Runs a command's `main`; wrong input and refusals of the system become one line on stderr.

    Args:
        main: takes the arguments (None: `sys.argv[1:]`) and returns the exit code.
        argv: the arguments.

    Returns:
        The exit code: `main`'s; 2 if the input is wrong (`InputError`), 1 if the system refused
        something (a full disk, too little memory), 130 when interrupted.
    """
    # Closed ones are None; what is opened next would get their numbers.
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a test's or a notebook's has none
            # Without UTF-8, Python would end at the first `±` of a result that took hours.
            stream.reconfigure(errors="backslashreplace")
    early_sigint.running = True
    try:
        with show_notes():
            check_mujoco()
            return main(argv)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `| head` closed the pipe: not an error of ours
        sys.stderr.close()
        return 1
    except OSError as error:
        print(f"error: {plain(describe_refusal(error))}", file=sys.stderr)
        return 1
    except (KeyboardInterrupt, Exception) as error:
        if early_sigint.interrupted or isinstance(error, KeyboardInterrupt):
            print("interrupted", file=sys.stderr)
            return 130
        # XLA's kind of error; its class cannot be named without importing JAX.
        if not (isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)):
            raise
        reason = str(error).partition("\n")[0].removeprefix("RESOURCE_EXHAUSTED:").strip()
        print(f"error: too little memory: {reason or 'none is left'}", file=sys.stderr)
        return 1
    finally:
        # From here on Ctrl-C ends the process at once; what JAX does at its end would be cut short
        # by a traceback.
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        early_sigint.running = False


def describe_refusal(error: OSError) -> str:
    """What the system refused, in one line: the file, where one is known, and why."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    return f"{error.filename}: {reason}" if error.filename else reason
