"""Tasks and controllers of users' own: functions in Python files, named as FILE.py:FUNCTION.

A configuration names them where it would name one of ours (`task: {type: mine/tasks.py:stay}`).
The file is ordinary Python and may import what is installed. It is run when a fitness is made from
the configuration, in every process that makes one, so a run folder that holds such a file holds a
program: commands ask before they run a stranger's (`trust.py`).
"""

from __future__ import annotations

import hashlib
import sys
import traceback
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.witness import tell

# Longest message of another library that we pass on [characters].
_LONGEST = 200


class OwnName(NamedTuple):
    """A function in a file.

    Attributes:
        path: the Python file.
        function: the function's name.
    """

    path: str
    function: str


def parse_own(name: Any) -> OwnName | None:
    """Takes FILE.py:FUNCTION apart.

    Args:
        name: what a configuration says, `mine/tasks.py:stay` or the name of one of ours.

    Returns:
        File and function; None where it is not of that form.
    """
    if not isinstance(name, str):
        return None
    path, colon, function = name.rpartition(":")
    if not colon or not path.endswith(".py") or not function.isidentifier():
        return None
    return OwnName(path, function)


def short_name(name: str) -> str:
    """What to call a task or controller in titles and tables: an own one by its function alone."""
    own = parse_own(name)
    return own.function if own else name


def content_name(name: str) -> str:
    """A name that stays the same wherever the file is, and changes with what is in it.

    Args:
        name: of a task or controller.

    Returns:
        Function and a fingerprint of the file; names of ours as they are.
    """
    own = parse_own(name)
    if own is None:
        return name
    path = Path(own.path)
    content = path.read_bytes() if path.is_file() else b""
    return f"{own.function} {hashlib.sha256(content).hexdigest()[:16]}"


def announce(name: str) -> None:
    """Tells of a user's file, if a name means one, without running it; see `witness.tell`.

    Workers run what the process that starts them has announced.

    Args:
        name: of a task, controller or genotype.

    Raises:
        InputError: it is refused.
    """
    own = parse_own(name)
    if own is not None and Path(own.path).is_file():
        tell(own.path, "Python", Path(own.path).read_bytes())


def load_own(name: str, label: str, kind: type | tuple[type, ...] = ()) -> Any:
    """The function that FILE.py:FUNCTION names; its file is run once per process and content.

    Args:
        name: `FILE.py:FUNCTION`.
        label: the place that named it, for messages: `lake.yaml: task.type`.
        kind: what may stand there instead of a function.

    Returns:
        The function, or a value of that kind.

    Raises:
        InputError: there is no such file or function, or the file raises when it is run.
    """
    own = parse_own(name)
    if own is None:
        raise InputError(f"{label}: expected FILE.py:FUNCTION; found {name!r}")
    module = _run_file(own.path, label)
    if not hasattr(module, own.function):
        made = [
            key
            for key, value in vars(module).items()
            if isinstance(value, types.FunctionType) and value.__module__ == module.__name__
        ]
        raise InputError(
            f"{label}: expected a function {own.function} in {own.path}; found "
            f"{'only ' + ', '.join(made) if made else 'no function in it'}"
        )
    function = getattr(module, own.function)
    if not callable(function) and not isinstance(function, kind):
        raise InputError(
            f"{label}: expected a function {own.function} in {own.path}; found {function!r:.60}"
        )
    return function


def _run_file(path: str, label: str) -> types.ModuleType:
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{label}: expected a file; found none at {path}") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; found {error.strerror}") from None
    tell(path, "Python", content)
    digest = hashlib.sha256(path.encode() + b"\0" + content).hexdigest()[:16]
    name = f"mjx_revolve_own_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    module = types.ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # dataclasses look their module up there while they are made
    try:
        exec(compile(content, path, "exec"), module.__dict__)
    except KeyboardInterrupt:
        del sys.modules[name]
        raise
    except BaseException as error:  # a file may well call sys.exit
        del sys.modules[name]
        raise InputError(explain(error, path, "Python that runs")) from None
    return module


def explain(error: BaseException, path: str, expected: str) -> str:
    """What went wrong in a user's file, as one line.

    Args:
        error: what it raised.
        path: the file.
        expected: what it should have been or done.

    Returns:
        `FILE: line N: expected ...; found ERROR`, with the last line of the file that was run.
    """
    line: int | None = None
    if isinstance(error, SyntaxError) and error.filename == path:
        line, message = error.lineno, error.msg
    else:
        lines = str(error).strip().splitlines()
        message = lines[0] if lines else ""
        for frame in traceback.extract_tb(error.__traceback__):
            if frame.filename == path:
                line = frame.lineno
    if len(message) > _LONGEST:
        message = message[: _LONGEST - 1] + "…"
    place = f"line {line}: " if line else ""
    what = f"{type(error).__name__}: {message}".rstrip(": ")
    return f"{path}: {place}expected {expected}; found {what}"


def call_own(name: str, expected: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a user's function, or what it made, and turns what it raises into an `InputError`.

    Args:
        name: `FILE.py:FUNCTION`, for the message.
        expected: what the function should do.
        function: what to call.
        *arguments: with what.

    Returns:
        What it returns.

    Raises:
        InputError: it raised something; the message says what, and where in the file.
    """
    own = parse_own(name)
    path = own.path if own else name
    try:
        return function(*arguments)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:
        raise InputError(explain(error, path, expected)) from None
