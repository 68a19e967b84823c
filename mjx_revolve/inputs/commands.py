"""What the command lines share: how arguments are read, how notes are shown, how mistakes end.

What the package says by `logging` is a line on stderr, `note: ...`; a mistake is one line there and
an exit code. Nothing heavy is imported here: `--help` is there
at once.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NoReturn

from mjx_revolve.inputs.early import end_at_once, is_importing
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.shipped import list_shipped
from mjx_revolve.inputs.terminal import spell_what_is_lacking
from mjx_revolve.inputs.trust import add_trust_argument, opening

_SEEDS = 2**32  # what JAX's keys take, and a run's configuration
# A day [s]: its poses already take several GB.
_LONGEST = 86_400.0


class Parser(argparse.ArgumentParser):
    """Argument parser whose complaints are one line, like those about files."""

    def error(self, message: str) -> NoReturn:
        """Raises `InputError` instead of printing the usage and ending the process."""
        raise InputError(f"{message.removeprefix('argument ')} (see --help)")


def read_path(text: str) -> str:
    """Reads a path, for `add_argument(type=read_path)`: refuses what an unset variable leaves."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"expected a path; found {text!r}")
    return text


def read_seconds(text: str) -> float:
    """Reads a duration [s], for `add_argument(type=read_seconds)`."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"expected seconds > 0; found {text!r}")
    if value > _LONGEST:
        raise argparse.ArgumentTypeError(f"expected at most {_LONGEST:.0f} s; found {text!r}")
    return value


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """Makes a reader of whole numbers, for `add_argument(type=whole(1))`.

    Args:
        low: the smallest.
        high: the largest; None: there is none.

    Returns:
        Takes what was typed and returns the number.
    """

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


def add_episode_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what `champion.load_episode` is to be told: path, duration, seed, individual, world ...

    Args:
        parser: of a command that shows an episode.
    """
    parser.add_argument(
        "path", type=read_path, help="run folder, genes.yaml, or morphology (YAML or name)"
    )
    parser.add_argument(
        "--duration", type=read_seconds, metavar="S", help="[s] (default: the task's, or 10)"
    )
    parser.add_argument("--seed", type=read_seed, metavar="N", help="draws another start")
    parser.add_argument(
        "--individual", type=whole(0), metavar="N",
        help="one of those who lived in the run, where bodies evolve (default: the champion)",
    )  # fmt: skip
    parser.add_argument("--world", help="of a morphology: a name or a YAML (default: lake)")
    parser.add_argument(
        "--modules", type=read_path, metavar="MY.yaml",
        help="of a morphology: module types of your own (a run's are in its folder)",
    )  # fmt: skip
    add_trust_argument(parser)


def add_colony_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what names a whole colony instead of an episode: `--colony` and `--time`.

    Args:
        parser: of a command that shows an episode.
    """
    parser.add_argument(
        "--colony",
        action="store_true",
        help="a run's whole colony, which lives on for --duration (default: 60 s) from its newest "
        "checkpoint",
    )
    parser.add_argument(
        "--time",
        type=read_seconds,
        metavar="S",
        help="with --colony: from this time of its life on [s]",
    )


def check_colony_arguments(arguments: argparse.Namespace) -> None:
    """Refuses what does not go with a colony, or without one.

    Args:
        arguments: with what `add_episode_arguments` and `add_colony_arguments` add.

    Raises:
        InputError: one was given, or `--colony` without a run folder.
    """
    if not arguments.colony:
        if arguments.time is not None:
            raise InputError("--time: expected --colony with it; found none")
        return
    for name in ("individual", "seed", "world", "modules"):
        if getattr(arguments, name) is not None:
            raise InputError(f"--{name}: expected none with --colony; found one")
    if not Path(arguments.path).is_dir():
        raise InputError(f"{arguments.path}: expected the run folder of a colony; found a file")


def opening_episode(arguments: argparse.Namespace) -> contextlib.AbstractContextManager[None]:
    """Asks for what the path names, as `trust.opening` does, while it is entered.

    Args:
        arguments: with what `add_episode_arguments` adds.
    """
    named = (arguments.path, arguments.world, arguments.modules)
    return opening(*(name for name in named if name is not None), trust=arguments.trust)


def individual_name(number: int | None) -> str:
    """What files of an individual are called, from its run folder on, but for their ending."""
    return "" if number is None else f"individuals/{number}"


def check_episode_path(path: str | Path) -> None:
    """Refuses a path at which there is nothing, before anything heavy is imported.

    Args:
        path: of a run folder, a `genes.yaml` or a morphology; or a shipped morphology's name.

    Raises:
        InputError: there is nothing.
    """
    shipped = list_shipped("morphologies")
    if not Path(path).exists() and str(path) not in shipped:
        raise InputError(
            f"{path}: expected a run folder, a genes.yaml or a morphology; found none, and no "
            f"shipped morphology of this name ({', '.join(shipped)})"
        )


def check_place(path: str | Path, label: str) -> None:
    """Refuses a place where no file can be, before any work is done for it.

    Args:
        path: of a file or a folder to write; the folders that it names are made later.
        label: what messages call it.

    Raises:
        InputError: a file is in its way, or the folder may not be written.
    """
    for folder in Path(path).parents:
        if folder.is_dir():
            if not os.access(folder, os.W_OK | os.X_OK):
                raise InputError(
                    f"{label}: expected a folder to write into; found {folder} read-only"
                )
            return
        if folder.exists():
            raise InputError(f"{label}: expected the folder {folder}; found a file")


class _Note(logging.Formatter):
    """Notes repeat names from files, which must not move a terminal's cursor."""

    def format(self, record: logging.LogRecord) -> str:
        """The note, each line of it plain."""
        return "\n".join(map(plain, super().format(record).split("\n")))


@contextlib.contextmanager
def show_notes() -> Iterator[None]:
    """Shows on stderr what the package says by `logging`, while it is entered."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Note("note: %(message)s"))
    logger = logging.getLogger("mjx_revolve")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def run_command(main: Callable[[list[str] | None], int], argv: list[str] | None = None) -> int:
    """Runs a command line's `main`; what goes wrong by no fault of ours becomes one line.

    Args:
        main: takes the arguments (None: `sys.argv[1:]`) and returns the exit code.
        argv: the arguments.

    Returns:
        The exit code: `main`'s; 2 where the input is wrong (`InputError`), 1 where the system
        refused something (a full disk, too little memory), and 130 when interrupted.
    """
    spell_what_is_lacking()
    interrupts: list[int] = []
    try:
        with _noting_interrupts(interrupts), show_notes():
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
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if interrupts:  # what the import of compiled code makes of a KeyboardInterrupt
            print("interrupted", file=sys.stderr)
            return 130
        # XLA's kind of error; its class cannot be named without importing JAX.
        if not (isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)):
            raise
        reason = str(error).partition("\n")[0].removeprefix("RESOURCE_EXHAUSTED:").strip()
        print(f"error: too little memory: {reason or 'none is left'}", file=sys.stderr)
        return 1


@contextlib.contextmanager
def _noting_interrupts(noted: list[int]) -> Iterator[None]:
    """Has Ctrl-C raise `KeyboardInterrupt`, as ever, and notes it; while importing, see `early`."""

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        if before is end_at_once and is_importing(frame):
            end_at_once(number, frame)
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    ours = before in (signal.default_int_handler, end_at_once)
    if not ours or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def describe_refusal(error: OSError) -> str:
    """What the system refused, in one line: the file, where one is known, and why."""
    reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
    return f"{error.filename}: {reason}" if error.filename else reason
