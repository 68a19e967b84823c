"""Ctrl-C in commands: one line and exit code 130, also while a command still imports."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

# True while `run_command` can turn a KeyboardInterrupt into one line.
running = False
# Whether Ctrl-C came: compiled code may turn a KeyboardInterrupt into another exception.
interrupted = False


def watch_imports() -> None:
    """Installs `on_sigint` in processes that run a command of ours; others keep their handler."""
    # While Python looks for the module that `python -m` names, this is its first argument.
    name = sys.argv[0] if sys.argv else ""
    ours = name == "-m" or os.path.basename(name) == "mjx-revolve"
    if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, on_sigint)


def on_sigint(number: int, frame: FrameType | None) -> None:
    """Raises KeyboardInterrupt; during imports, which may lose it, and after a command it exits."""
    global interrupted
    if not running or _is_importing(frame):
        os.write(2, b"interrupted\n")
        os._exit(128 + number)
    interrupted = True
    raise KeyboardInterrupt


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False
