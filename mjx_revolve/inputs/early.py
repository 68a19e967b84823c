"""Ctrl-C while a command still imports: one line and the end, rather than a traceback."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import NoReturn

_LINE = "interrupted\n"


def watch_imports() -> None:
    """Has Ctrl-C end a command at once until `run_command` takes over; for other programs nothing.

    An exception would not do: within the import of compiled code it becomes another one, or is
    lost.
    """
    # While Python looks for the module that `python -m` names, this is its first argument.
    name = sys.argv[0] if sys.argv else ""
    ours = name == "-m" or os.path.basename(name) == "mjx-revolve"
    if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end_at_once)


def end_at_once(number: int, _: FrameType | None) -> NoReturn:
    """The handler: says so, and ends the process, whatever stands on its stack."""
    os.write(2, _LINE.encode())
    os._exit(128 + number)


def is_importing(frame: FrameType | None) -> bool:
    """Whether an import is under way in a frame, or in those that called it."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False
