"""Users' own tasks, controllers and genotypes: functions in files, named as FILE.py:FUNCTION.

A configuration may name them instead of the package's own (`task: {type: mine/tasks.py:stay}`). The
file is ordinary Python and may import any installed package. It is run in every process that makes
a fitness from the configuration. A run folder with such a file contains a program; so the file is
audited first (`trust.py`).
"""

from __future__ import annotations

import hashlib
import sys
import traceback
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.trust import audit

T = TypeVar("T")

# Longest message of another library in ours [characters].
_MAX_MESSAGE = 200


class UserFunction(NamedTuple):
    """A function in a file.

    Attributes:
        path: the Python file.
        function: the function's name.
    """

    path: str
    function: str


def parse_user_function(name: object) -> UserFunction | None:
    """File and function of FILE.py:FUNCTION; None for anything else."""
    if not isinstance(name, str):
        return None
    path, colon, function = name.rpartition(":")
    if not colon or not path.endswith(".py") or not function.isidentifier():
        return None
    return UserFunction(path, function)


def short_name(name: str) -> str:
    """A task or controller in titles and tables: a user's by its function alone."""
    own = parse_user_function(name)
    return own.function if own else name


def function_place(name: str) -> str:
    """A user's function as the place of a message: `FILE.py: FUNCTION`."""
    own = parse_user_function(name)
    return f"{own.path}: {own.function}" if own else name


def content_name(name: str) -> str:
    """A name that depends on a user's function and on the content of its file, not on its path."""
    own = parse_user_function(name)
    if own is None:
        return name
    path = Path(own.path)
    content = path.read_bytes() if path.is_file() else b""
    return f"{own.function} {hashlib.sha256(content).hexdigest()[:16]}"


def announce(name: str) -> None:
    """Audits a user's file without running it, before workers do.

    Raises:
        InputError: it is refused.
    """
    own = parse_user_function(name)
    if own is not None and Path(own.path).is_file():
        audit(own.path, "Python", Path(own.path).read_bytes())


def load_user_function(name: str, label: str, kind: type | tuple[type, ...] = ()) -> Any:
    """The function that FILE.py:FUNCTION names; its file is run once per process and content.

    Args:
        name: `FILE.py:FUNCTION`.
        label: the place that named it, for messages: `lake.yaml: task.type`.
        kind: types that may stand there instead of a function.

    Raises:
        InputError: there is no such file or function, or the file raises when it is run.
    """
    own = parse_user_function(name)
    if own is None:
        raise InputError(label, "FILE.py:FUNCTION", repr(name))
    module, wanted = _run_file(own.path, label), f"a function {own.function} in {own.path}"
    if not hasattr(module, own.function):
        made = [
            key
            for key, value in vars(module).items()
            if isinstance(value, types.FunctionType) and value.__module__ == module.__name__
        ]
        found = f"only {', '.join(made)}" if made else "no function in it"
        raise InputError(label, wanted, found)
    function = getattr(module, own.function)
    if not callable(function) and not isinstance(function, kind):
        raise InputError(label, wanted, f"{function!r:.60}")
    return function


def _run_file(path: str, label: str) -> types.ModuleType:
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(label, "a file", f"none at {path}") from None
    except OSError as error:
        raise InputError(path, "a readable file", error.strerror) from None
    audit(path, "Python", content)
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
    """An error in a user's file, as one line: `FILE: line N: expected ...; found ERROR`."""
    line: int | None = None
    if isinstance(error, SyntaxError) and error.filename == path:
        line, message = error.lineno, error.msg
    else:
        lines = str(error).strip().splitlines()
        message = lines[0] if lines else ""
        for frame in traceback.extract_tb(error.__traceback__):
            if frame.filename == path:
                line = frame.lineno
    if len(message) > _MAX_MESSAGE:
        message = message[: _MAX_MESSAGE - 1] + "…"
    place = f"line {line}: " if line else ""
    what = f"{type(error).__name__}: {message}".rstrip(": ")
    return f"{path}: {place}expected {expected}; found {what}"


def call_user_function(
    name: str, expected: str, function: Callable[..., T], *arguments: object
) -> T:
    """Calls a user's function, or one that it made.

    Args:
        name: `FILE.py:FUNCTION`, for the message.
        expected: what the function should do.
        function: to call.
        *arguments: of the call.

    Raises:
        InputError: it raised something; the message says what, and where in the file.
    """
    own = parse_user_function(name)
    path = own.path if own else name
    try:
        return function(*arguments)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (Exception, SystemExit) as error:
        raise InputError(explain(error, path, expected)) from None
