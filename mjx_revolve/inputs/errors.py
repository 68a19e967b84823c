"""Errors in a user's input: one exception, one line, and how values are shown in it.

Whatever reads user input raises `InputError` with one line: "PLACE: expected X; found Y". Commands
turn it into exit code 2 (`run_command`).
"""

from __future__ import annotations

import contextlib
import functools
import logging
import re
import reprlib
from collections.abc import Iterator
from pathlib import Path

# The longest value, without blanks or in quotes, that a message repeats [characters].
_MAX_VALUE = 200
_LONG_VALUE = re.compile(
    rf"(?<![^\s(\[])(['\"])(?:(?!\1).){{{_MAX_VALUE},}}\1(?!\w)|\S{{{2 * _MAX_VALUE},}}"
)
# The longest message that is not shortened [characters], and lists of many names in longer ones.
_MAX_MESSAGE = 400
_LONG_LIST = re.compile(r"(?:[\w.:/-]+, ){9,}")
_SHORT_REPR = reprlib.Repr()
_SHORT_REPR.maxstring = _SHORT_REPR.maxother = 60


def plain(text: str) -> str:
    """A text on one line of a terminal or a page: what is not printable is escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _cut(match: re.Match[str]) -> str:
    """Beginning and end of a long value."""
    half = _MAX_VALUE // 4
    return f"{match[0][:half]}…{match[0][-half:]}"


def _leave_out(match: re.Match[str]) -> str:
    """The first names of many."""
    names = match[0].removesuffix(", ").split(", ")
    return f"{', '.join(names[:5])}, … ({len(names) - 5} more), "


class InputError(ValueError):
    """A user's input is wrong; the message says where, what was expected and what was found.

    Names in it may come from a stranger's files: it is one printable line; long values are cut, and
    so are lists of names in a long message.
    """

    def __init__(self, place: object = "", expected: object = None, found: object = None) -> None:
        """Takes the parts of a message, or all of it.

        Args:
            place: a file, an option, a key in it; or the whole message.
            expected: in words; None where the message is whole.
            found: in words, or a value as it is shown.
        """
        whole = expected is None
        message = str(place) if whole else f"{place}: expected {expected}; found {found}"
        text = _LONG_VALUE.sub(_cut, plain(message))
        super().__init__(_LONG_LIST.sub(_leave_out, text) if len(text) > _MAX_MESSAGE else text)


class ConstraintError(ValueError):
    """Values that do not fit together, raised by a validator or a `__post_init__`."""

    def __init__(self, place: str, expected: str, found: object) -> None:
        """Takes the parts of a message.

        Args:
            place: relative to the validator, such as a field's name; "" for itself.
            expected: in words.
            found: in words, or a value as it is shown.
        """
        super().__init__(f"{place}: expected {expected}; found {found}")
        self.place, self.expected, self.found = place, expected, found


@functools.cache
def note(text: str) -> None:
    """Logs a remark about accepted input, once per process."""
    logging.getLogger(__name__).warning("%s", plain(text))


def show(value: object) -> str:
    """A value as a message shows it: short."""
    try:
        return _SHORT_REPR.repr(value)
    except ValueError:  # Python refuses to print integers of more than 4300 digits
        return "a huge integer"


@contextlib.contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Puts a file's path before errors about it, those of the operating system included.

    Raises:
        InputError: the body raised one, or could not read the file.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise InputError(path, "a file", "none") from None
    except IsADirectoryError:
        raise InputError(path, "a file", "a folder") from None
    except UnicodeDecodeError as error:
        raise InputError(path, "UTF-8 text", error.reason) from None
    except OSError as error:
        raise InputError(path, "a readable file", error.strerror) from None
