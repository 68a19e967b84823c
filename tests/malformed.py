"""Malformed files by the thousand, and what must be true of whoever reads them.

`mutants` and `wrecks` draw files that somebody might be sent; `read_file` has one read and says
what became of it. `make fuzz` looks for more of them, and longer (`MJX_REVOLVE_FUZZ=N` examples of
each test, drawn anew); without it the examples are few, and the same each time.
"""

import contextlib
import copy
import io
import math
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis
import numpy as np
import yaml
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError

HUNT = int(os.environ.get("MJX_REVOLVE_FUZZ", "0"))
# Of any message [characters]: some list all settings that there are.
_LONGEST = 2000
# For one file [s]. It takes some hundredths; a bomb would take hours.
_PATIENCE = 5.0


def fuzz(examples: int) -> settings:
    """How a test draws its examples: so many of them, or as many as a hunt asks for."""
    hypothesis.configuration.set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")
    return settings(
        max_examples=HUNT or examples,
        derandomize=not HUNT,
        database=None,
        deadline=None,  # `read_file` has its own
        suppress_health_check=list(HealthCheck),
        print_blob=bool(HUNT),
        report_multiple_bugs=False,
    )


class Raw(str):
    """YAML as it is written, rather than a text."""


SENTINEL = "mjx_revolve_was_here"
_BOMB = "[&a [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]" + "".join(
    f", &{b} [{', '.join([f'*{a}'] * 10)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
NASTY: list[Any] = [
    None, True, False, 0, -1, 1, 10**20, -(2**63), 2**32, 0.0, -0.0, 1e-320, 1e30, 1e300, -1e300,
    math.nan, math.inf, -math.inf, "", " ", "off", "null", "1e3", "0x10", "\0", "a\0b", "\ud800",
    "\u202e", "\x1b[2J", "\x07", "\u2028", "\ufeff", "é", "🐟", "x" * 5000, "x y " * 5000, "/", ".",
    "..", "../../../etc/passwd", "/etc/passwd", "/dev/zero", "~", "~root", "C:\\x", "own.py:f",
    "{}", "%s", "{0}", "<script>alert(1)</script>", [], {}, [[]], [None], {"": None}, {"a": 1},
    [1, 2, 3], [1e300] * 3, [math.nan] * 3, ["a", "b"], {"name": "lake"}, {1: 2}, {"type": "Core"},
    [[0] * 50] * 50,
    Raw("0x" + "f" * 5000), Raw("1" * 5000), Raw("1e999"), Raw("-.inf"), Raw("1_000"), Raw("0o7"),
    Raw("12:30:45"), Raw("1:1" + ":59" * 400 + ".5"), Raw("2001-01-01"), Raw("2001-99-99"),
    Raw("2001-12-14t21:59:43.10-05:00"), Raw("0001-01-01T00:00:00+23:59"), Raw("~"), Raw("="),
    Raw("<<"), Raw("{<<: {a: 1}}"), Raw("{<<: 3}"), Raw("{<<: [{a: 1}, {b: 2}], a: 3}"),
    Raw(f"!!python/object/apply:os.system ['touch {SENTINEL}']"), Raw("!!python/name:os.system"),
    Raw(f"!!python/object/new:os.system ['touch {SENTINEL}']"), Raw("!!python/tuple [1, 2]"),
    Raw("!!binary aGVsbG8="), Raw("!!binary x"), Raw("!!set {a, b}"), Raw("!!omap [a: 1]"),
    Raw("!!pairs [a: 1]"), Raw("!!float x"), Raw("!!int x"), Raw("!!int ''"), Raw("!!bool x"),
    Raw("!!null x"), Raw("!!timestamp x"), Raw("!!str [1]"), Raw("!!map 3"), Raw("!!seq 3"),
    Raw("!own x"), Raw("!"), Raw("*missing"), Raw("&loop [*loop]"), Raw("&loop {a: *loop}"),
    Raw("&loop !!omap [a: *loop]"), Raw("&loop !!set {? *loop}"), Raw("{? [1, 2] : 3}"),
    Raw("{? {a: 1} : 3}"), Raw("{a: 1, a: 2}"), Raw("{.nan: 1, .nan: 2}"), Raw("{1: 1, true: 2}"),
    Raw("[" * 300 + "]" * 300), Raw("{a: " * 300 + "}" * 300), Raw("[" * 2000), Raw(_BOMB + "]"),
    Raw("!!omap " + _BOMB.replace("[&a", "[a: &a").replace(", &", ", b: &") + "]"),
    Raw("|\n x"), Raw("%YAML 9.9"), Raw("%YAML 1." + "1" * 5000), Raw(r'"\U00110000"'),
    Raw(r'"\Uffffffff"'), Raw("---\na"), Raw("\t"), Raw("\0"), Raw("@"), Raw("`"),
]  # fmt: skip

_ANY_TEXT = st.text(st.characters(exclude_categories=()), max_size=20)
_SCALAR = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 20), st.integers(), st.floats(-10, 10), st.floats(),
    _ANY_TEXT,
)  # fmt: skip
_TREE = st.recursive(
    _SCALAR,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(_ANY_TEXT, inner, max_size=4)
    ),
    max_leaves=8,
)
VALUES = st.one_of(st.sampled_from(NASTY), _SCALAR, _TREE)
"""Whatever a YAML file may have somewhere."""


def emit(value: Any) -> str:
    """Values as YAML, `Raw` ones as they are; mappings may be lists of pairs in `Pairs`."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, str):
        return f'"{"".join(map(_escape, value))}"'
    if isinstance(value, Pairs):
        return f"{{{', '.join(f'{emit(key)}: {emit(item)}' for key, item in value)}}}"
    if isinstance(value, dict):
        return emit(Pairs(value.items()))
    if isinstance(value, list):
        return f"[{', '.join(map(emit, value))}]"
    if isinstance(value, float):
        return ".nan" if math.isnan(value) else repr(value).replace("inf", ".inf")
    return {None: "null", True: "true", False: "false"}[value] if (
        value is None or isinstance(value, bool)
    ) else str(value)  # fmt: skip


class Pairs(list):
    """A mapping as pairs, which may repeat a key."""


def _escape(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if " " <= character <= "~":
        return character
    number = ord(character)
    return f"\\U{number:08x}" if number > 0xFFFF else f"\\u{number:04x}"


class Mutant(NamedTuple):
    """A file that was changed.

    Attributes:
        content: what is in it.
        strange: dotted places of keys that nobody knows, if that is all that was changed.
    """

    content: bytes
    strange: str | None = None


def _places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values."""
    yield at
    if isinstance(value, Pairs):
        for k, (_, item) in enumerate(value):
            yield from _places(item, (*at, k))
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from _places(item, (*at, k))


def _to_pairs(value: Any) -> Any:
    if isinstance(value, dict):
        return Pairs([key, _to_pairs(item)] for key, item in value.items())
    return [_to_pairs(item) for item in value] if isinstance(value, list) else value


def _at(tree: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        tree = tree[step][1] if isinstance(tree, Pairs) else tree[step]
    return tree


def _put(tree: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    above = _at(tree, path[:-1])
    if isinstance(above, Pairs):
        above[path[-1]][1] = value
    else:
        above[path[-1]] = value
    return tree


def _dotted(tree: Any, path: tuple[Any, ...], *more: Any) -> str:
    names = []
    for step in path:
        names.append(tree[step][0] if isinstance(tree, Pairs) else step)
        tree = _at(tree, (step,))
    return ".".join(map(str, (*names, *more)))


def _misspell(draw: Callable, name: str) -> str:
    at = draw(st.integers(0, max(len(name) - 1, 0)))
    return draw(
        st.sampled_from(
            [name[:at] + name[at + 1 :], name[:at] + "x" + name[at:], name.upper(), name + "s",
             name[:at] + name[at : at + 1] * 2 + name[at + 1 :], f"{name} "]
        )
    )  # fmt: skip


@st.composite
def mutants(draw: Callable, *texts: str) -> Mutant:
    """Valid files in which one to three things are wrong, or may be."""
    before = yaml.safe_load(draw(st.sampled_from(texts)))
    tree = _to_pairs(copy.deepcopy(before))
    count = draw(st.sampled_from([1, 1, 1, 2, 3]))
    strange = None
    for _ in range(count):
        how = draw(st.sampled_from(["replace", "replace", "replace", "remove", "add", "misspell",
                                    "twice", "move"]))  # fmt: skip
        paths = list(_places(tree))
        path = draw(st.sampled_from(paths))
        here = _at(tree, path)
        if how in ("remove", "add", "misspell", "twice"):
            maps = [p for p in paths if isinstance(_at(tree, p), Pairs)]
            if not maps:
                continue
            path = draw(st.sampled_from(maps))
            here = _at(tree, path)
            known = [key for key, _ in here]
            if how == "add":
                key = draw(st.one_of(st.sampled_from(["foo", "nmae", "__class__", "<<"]), VALUES))
                here.append([key, draw(VALUES)])
                if count == 1 and key == "foo":
                    strange = _dotted(tree, path, key)
                continue
            if not here:
                continue
            which = draw(st.integers(0, len(here) - 1))
            if how == "remove":
                del here[which]
            elif how == "twice":
                here.append([here[which][0], draw(VALUES)])
            elif isinstance(here[which][0], str):
                name = _misspell(draw, here[which][0])
                here[which][0] = name
                if count == 1 and name not in known:
                    strange = _dotted(tree, path, name)
        elif how == "move":
            tree = _put(tree, path, copy.deepcopy(_at(tree, draw(st.sampled_from(paths)))))
        else:
            tree = _put(tree, path, draw(VALUES))
    return Mutant(emit(tree).encode(errors="surrogatepass"), strange)


@st.composite
def wrecks(draw: Callable, *contents: bytes) -> Mutant:
    """Files with bits flipped, cut short, with something in their midst, or of something else."""
    content = bytearray(draw(st.sampled_from(contents)))
    how = draw(st.sampled_from(["flip", "cut", "insert", "splice", "other"]))
    size = len(content)
    if how == "flip":
        for bit in draw(st.lists(st.integers(0, max(8 * size - 1, 0)), min_size=1, max_size=4)):
            if size:
                content[bit // 8] ^= 1 << bit % 8
    elif how == "cut":
        del content[draw(st.integers(0, size)) :]
    elif how == "insert":
        at = draw(st.integers(0, size))
        content[at:at] = draw(st.one_of(st.binary(max_size=20), _ANY_TEXT.map(_as_bytes),
                                        VALUES.map(lambda x: _as_bytes(emit(x)))))  # fmt: skip
    elif how == "splice":
        low, high = sorted(draw(st.integers(0, size)) for _ in range(2))
        content[low:high] = b""
    else:
        content = bytearray(
            draw(
                st.one_of(
                    st.binary(max_size=60), VALUES.map(lambda x: _as_bytes(emit(x))),
                    st.sampled_from([b"", b"\0" * 100, b"PK\3\4", b"\x89PNG\r\n", b"\xff\xfe[\0"]),
                )
            )
        )  # fmt: skip
    return Mutant(bytes(content))


def _as_bytes(text: str) -> bytes:
    return text.encode(errors="surrogatepass")


class Accepted(BaseException):
    """A command has read all that it was given: what it would do now takes too long for a test."""


def stop(*_: Any, **__: Any) -> Any:
    """Stands where a command begins its work."""
    raise Accepted


_watching: list[tuple[Path, ...]] = []
_strays: list[str] = []
_READ_ALWAYS = tuple(
    os.path.realpath(path)
    for path in {
        sys.prefix, sys.base_prefix, *sys.path, Path(__file__).resolve().parents[1],
        os.path.dirname(os.__file__), "/proc", "/sys", "/dev/null", "/dev/urandom",
        Path.home() / ".cache" / "matplotlib", "/usr/lib", "/usr/share", "/lib",
        "/etc/localtime", "/etc/mime.types",
    }
    if path
)  # fmt: skip
_WRITTEN_ALWAYS = ["/dev/null"] + [
    os.path.realpath(os.environ[name])
    for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_STATE_HOME")
    if os.environ.get(name)
]
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_TRUNC
_CHANGES = {"os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.truncate", "os.link",
            "os.symlink", "os.chmod"}  # fmt: skip
# By which a run knows its version and its processor.
_PROGRAMS = ("git", "uname")
_STARTS = {"os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.fork", "os.startfile",
           "socket.connect"}  # fmt: skip


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    """Python's own account of files that are opened, and programs that are begun."""
    if not _watching:
        return
    if event in _STARTS and arguments[0] not in _PROGRAMS:
        _strays.append(f"{event} {arguments!r:.200}")
    if event != "open" and event not in _CHANGES:
        return
    path = arguments[0]
    if not isinstance(path, str | bytes | os.PathLike):
        return
    real = os.path.realpath(os.fsdecode(path))
    inside = [*map(str, _watching[-1]), *_WRITTEN_ALWAYS]
    if event == "open" and not (isinstance(arguments[2], int) and arguments[2] & _WRITES):
        inside += _READ_ALWAYS
    if not any(real == folder or real.startswith(f"{folder}{os.sep}") for folder in inside):
        _strays.append(f"{event} {real}")


_hooked: list[bool] = []  # there is no taking it away again


@contextlib.contextmanager
def watching(*folders: str | Path) -> Iterator[None]:
    """Has no file read or written outside of some folders and the program's own; runs nothing."""
    if not _hooked:
        sys.addaudithook(_watch)
        _hooked.append(True)
    _strays.clear()
    _watching.append(tuple(Path(os.path.realpath(folder)) for folder in folders))
    began = time.process_time()
    try:
        yield
    finally:
        _watching.pop()
    assert not _strays, _strays
    assert time.process_time() - began < _PATIENCE


def check_message(message: str, *places: str | Path) -> None:
    """A message is one printable line of bounded length: one of the places, expected and found."""
    assert message.isprintable(), message
    assert len(message) <= _LONGEST, message
    assert message.startswith(tuple(map(str, places))), message
    assert re.search(r"\bexpected\b.+; ?found\b", message), message


def read_file(read: Callable[[], Any], folder: Path, *places: str | Path) -> Any:
    """Has a file in a folder read, twice where that goes well: what it holds, or `InputError`."""
    with watching(folder):
        try:
            found = read()
        except InputError as error:
            check_message(str(error), *places)
            return error
        again = read()
    assert same(found, again)
    return found


def same(one: Any, other: Any) -> bool:
    """Whether two values are, NaN being NaN."""
    if isinstance(one, np.ndarray):
        return one.tobytes() == other.tobytes()
    return one == other or repr(one) == repr(other)


def run_main(main: Callable, argv: list[str], folder: Path, *places: str | Path) -> int:
    """Runs a command here; its exit code, 0 also where it is `Accepted`; with 2, one line."""
    out, err = io.StringIO(), io.StringIO()
    with watching(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = run_command(main, argv)
        except Accepted:
            code = 0
    lines = err.getvalue().split("\n")
    assert all(line.isprintable() for line in lines), lines
    assert all(map(str.isprintable, out.getvalue().replace("\n", ""))), out.getvalue()
    if code:
        assert code == 2, (code, lines)
        notes = [line for line in lines if line.startswith("note: ")]
        (error,) = (line for line in lines[:-1] if line not in notes)
        check_message(error.removeprefix("error: "), *places)
    return code


def check_finite(value: Any, place: str = "") -> None:
    """No number in nested values is NaN or infinite, nor larger than float32 can hold."""
    if isinstance(value, dict):
        for key, item in value.items():
            check_finite(item, f"{place}.{key}")
    elif isinstance(value, list | tuple):
        for k, item in enumerate(value):
            check_finite(item, f"{place}.{k}")
    elif isinstance(value, float):
        assert abs(value) < 3.4e38, f"{place}: {value}"
