"""Recordings of a robot that swam: CSV, ROS 2 bags and run folders, read as signals and checked.

A signal has times and values of its own. Their names: `x`, `y`, `z` and `qw`, `qx`, `qy`, `qz`, or
`roll`, `pitch`, `yaw`, of the core, world frame; `mark.NAME.x` (`.y`, `.z`) of points on the robot;
`command.MODULE` of hinges [rad] and thrusters [-]; `angle.MODULE`, measured; `gyro.x`, `accel.x`
(specific force) of the core, its own frame; `depth`, `mean_speed`. SI units and radians.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import make_links, plain
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import check_path, read_file
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.inputs.yaml_reader import load_yaml

# Units that a column's name may end in, and what they are in SI.
_UNITS = {"_m": 1.0, "_cm": 1e-2, "_mm": 1e-3, "_s": 1.0, "_ms": 1e-3, "_us": 1e-6, "_ns": 1e-9,
          "_rad": 1.0, "_deg": math.pi / 180}  # fmt: skip
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz", "roll", "pitch", "yaw", "depth", "mean_speed")
_PLACE = ("x", "y", "z")
_SENSED = tuple(f"{kind}.{axis}" for kind in ("gyro", "accel") for axis in "xyz")
_SIGNAL = re.compile("|".join([*map(re.escape, ("time", *_POSE, *_SENSED)),
                               r"mark\..+\.[xyz]", r"(command|angle)\..+"]))  # fmt: skip
_KNOWN = "the name of a signal, such as time, x, yaw, depth, mark.NAME or command.MODULE"
_SOURCE = re.compile(r"^(?P<column>.*?)(?:\*(?P<factor>[-+0-9.eE]+))?$", re.DOTALL)
# Faster than any robot of modules swims [body lengths/s]; wrong units are beyond it. A choice.
_FASTEST = 30.0
# And turns so fast [rad/s]: twice a second, noise of frames with it; degrees are beyond. A choice.
_FASTEST_TURN = 4 * math.pi
# A wild frame or two are weighted down; so many frames later what has jumped stays away. A choice.
_STAYS = 5
# Commands are sampled, and not as sent, where this share of them is of frames and is new. A choice.
_SAMPLED = 0.6
# Robots are filmed faster than with a frame in so long [s]; numbers of frames are not. A choice.
_SLOW = 0.5
GAP = 2.5
"""A gap is longer than so many usual frames; one of two is a dropped frame. A choice."""


class TimeSeries(NamedTuple):
    """A measured or commanded number; `[n]` times [s], rising, and `[n]` values."""

    time: np.ndarray
    value: np.ndarray


class MarkedPoint(NamedTuple):
    """A point on the robot: index of its module, and where in its frame [m]."""

    module: int
    place: tuple[float, float, float]


@dataclass(frozen=True)
class RobotRecording:
    """A robot that swam.

    Attributes:
        name: of the file.
        signals: by name.
        marks: points on the robot, by name.
        notes: remarks for the user, a line each.
    """

    name: str
    signals: Mapping[str, TimeSeries]
    marks: Mapping[str, MarkedPoint] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def table(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Times `[n]` at which any of them is known, and `[n, names]` values, else NaN."""
        known = [self.signals[name].time for name in names if name in self.signals]
        time = np.unique(np.concatenate(known)) if known else np.zeros(0)
        values = np.full((len(time), len(names)), np.nan)
        for k, name in enumerate(names):
            if name in self.signals:
                signal = self.signals[name]
                values[np.searchsorted(time, signal.time), k] = signal.value
        return time, values


def read_map(options: Sequence[str]) -> dict[str, str]:
    """The mapping of names to columns, from `NAME=COLUMN` texts and YAML files of them.

    Raises:
        InputError: one is neither.
    """
    found: dict[str, str] = {}
    for option in options:
        name, equals, source = option.partition("=")
        if equals and name and source:
            found[name.strip()] = source.strip()
            continue
        if not Path(option).is_file():
            raise InputError(f"--map {option}", "NAME=COLUMN, or a YAML file of them", "neither")
        data = load_yaml(option)
        if not isinstance(data, dict):
            raise InputError(option, "a mapping of names to columns", show(data))
        for key in map(str, data):
            if not _SIGNAL.fullmatch(key) and not key.startswith("mark.") and key not in _TYPES:
                raise InputError(f"{option}: {key}", _KNOWN, "a key of no meaning")
        found |= {str(key): str(value) for key, value in data.items()}
    return found


def load_recording(path: str | Path, robot: Robot, columns: Mapping[str, str]) -> RobotRecording:
    """Reads a recording of a robot.

    Args:
        path: a CSV file, an MCAP file or folder of a ROS 2 bag, or a run folder of ours.
        robot: that swam.
        columns: `read_map`: a signal's column or topic, also `COLUMN*FACTOR`, or a number that
            holds all the time; `time=COLUMN*FACTOR`; `mark.NAME=MODULE` or `MODULE:X,Y,Z` [m].

    Returns:
        The recording, checked.

    Raises:
        InputError: it cannot be read, or is not of this robot; one line that says where and why.
    """
    path = check_path(path)
    if not path.exists():
        raise InputError(path, "a CSV, an MCAP, a ROS 2 bag or a run folder", "none")
    points = [key for key in columns if key.startswith("mark.") and key.count(".") == 1]
    marks = {key.removeprefix("mark."): _read_mark(key, columns[key], robot) for key in points}
    rest = {key: source for key, source in columns.items() if key not in points}
    unused: list[str] = []
    run = path.is_dir() and (path / "run.json").is_file()
    bag = not run and (path.is_dir() or path.suffix in (".mcap", ".db3"))
    if path.is_dir() and not run and not (path / "metadata.yaml").is_file():
        both = "a ROS 2 bag or a run folder"
        raise InputError(path, both, "a folder with neither metadata.yaml nor run.json")
    for name in rest:
        if not _SIGNAL.fullmatch(name) and not (bag and name in _TYPES):
            raise InputError(f"--map {name}", _KNOWN, show(name))
    notes: list[str] = []
    with reading(path):
        if run:
            swum, own = _read_run(path, robot)
            signals, notes = _mapped(swum, rest, robot)
            notes = own + notes
        elif bag:
            signals, notes = _read_bag(path, rest, robot)
        else:
            signals, unused = _read_csv(path, rest, robot)
        _add_marks(marks, signals, robot)
        notes += _check_signals(signals, robot)
    if marks and "x" in signals:
        notes.append(f"marks {', '.join(marks)} beside x and y of the core: not fitted")
    body = robot.morphology
    uncommanded = [*(body.modules[k].name for k in body.hinges), *body.thruster_names]
    uncommanded = [n for n in uncommanded if not {f"command.{n}", f"angle.{n}"} & set(signals)]
    if uncommanded:
        notes.append(f"no commands of {', '.join(uncommanded)}: taken to be 0")
    if unused:
        notes.append(f"columns of no known name, not read: {', '.join(unused)} (--map NAME=COLUMN)")
    return RobotRecording(path.stem, signals, marks, tuple(notes))


def check_recording(recording: RobotRecording, robot: Robot) -> None:
    """Refuses a recording, made in code, that is none of the robot.

    Raises:
        InputError: a signal has no known name, times that do not rise, or values that cannot be.
    """
    with reading(recording.name):
        for name, signal in recording.signals.items():
            if not _SIGNAL.fullmatch(name):
                raise InputError(name, _KNOWN, "a name of no meaning")
            shapes = np.shape(signal.time), np.shape(signal.value)
            if shapes[0] != shapes[1] or len(shapes[0]) != 1 or 0 in shapes[0]:
                raise InputError(name, "[n] times and values", " and ".join(map(str, shapes)))
            if not (np.isfinite(signal.time).all() and (np.diff(signal.time) > 0).all()):
                raise InputError(f"{name}: time", "rising times", "others")
        seen = {name.split(".")[1] for name in recording.signals if name.startswith("mark.")}
        if lacking := sorted(seen.symmetric_difference(recording.marks)):
            raise InputError(f"mark {lacking[0]}", "one of `marks`, with signals", "one of the two")
        _check_signals(recording.signals, robot)


def _mapped(
    signals: dict[str, TimeSeries], columns: Mapping[str, str], robot: Robot
) -> tuple[dict[str, TimeSeries], list[str]]:
    """With the signals that a map takes from others of them, as `y=y*-1`, or that are numbers.

    Sources that others of a study's recordings may have are left out, with a note; joints of
    another name than the module that has them go to that module alone.
    """
    # What a map says of a source holds, not the source's own name; commands and angles keep theirs.
    taken = {match["column"] for x in columns.values() if (match := _SOURCE.match(x))}
    found = {n: x for n, x in signals.items() if n not in taken or not _is_measured(n)}
    notes, body = [], robot.morphology
    modules = {*(m.name for m in body.modules), *body.thruster_names}
    for name, source in columns.items():
        match, number = _SOURCE.match(source), _finite(source)
        assert match is not None
        if match["column"] in signals:
            time, value = signals[match["column"]]
            head, _, joint = match["column"].partition(".")
            if head in ("command", "angle") and joint not in modules:
                found.pop(match["column"], None)
            found[name] = TimeSeries(time, _factor(name, match["factor"] or "1") * value)
        elif number is not None and name != "time":
            time = max((one.time for one in signals.values()), key=len)
            found[name] = TimeSeries(time, np.full(len(time), number))
        else:
            known = ", ".join(signals)
            notes.append(f"--map {name}: there is no {show(source)}, but {known}: left out")
    return found, notes


def _is_measured(name: str) -> bool:
    """Whether a signal is measured of the whole robot or of its marks."""
    return name in _POSE or name in _SENSED or name.partition(".")[0] == "mark"


def _read_mark(key: str, source: str, robot: Robot) -> MarkedPoint:
    module, _, at = source.partition(":")
    names = [m.name for m in robot.morphology.modules]
    read = [_finite(x) for x in at.split(",")] if at else [0.0, 0.0, 0.0]
    place = [x for x in read if x is not None]
    if module not in names or not len(read) == len(place) == 3:
        raise InputError(
            f"--map {key}", f"a module ({', '.join(names)}), or MODULE:X,Y,Z [m]", show(source)
        )
    return MarkedPoint(names.index(module), (place[0], place[1], place[2]))


# --- CSV ------------------------------------------------------------------------------------------


def _read_csv(
    path: Path, columns: Mapping[str, str], robot: Robot
) -> tuple[dict[str, TimeSeries], list[str]]:
    """Signals by name, and the columns that are none."""
    text = read_file(path).decode("utf-8-sig")
    try:
        reader = csv.reader(io.StringIO(text, newline=None))
        numbered = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise InputError(f"expected a CSV; found: {error}") from None
    lines, rows = [line for line, _ in numbered], [row for _, row in numbered]
    if not rows:
        raise InputError("expected a line of column names and rows of numbers; found an empty file")
    header = [cell.strip() for cell in rows[0]]
    for sign, words in ((";", "semicolons"), ("\t", "tabs")):
        if len(header) == 1 and sign in header[0]:
            raise InputError(f"expected columns with commas between them; found {words}")
    if len(rows) < 3:
        raise InputError(f"expected rows of numbers below the names; found {len(rows) - 1}")
    named = _name_columns(header, columns, robot)
    read = {k for k, _ in named.values()}
    values = np.full((len(rows) - 1, len(header)), np.nan)
    for k, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise InputError(f"row {lines[k + 1]}", f"{len(header)} cells", len(row))
        for j, cell in enumerate(row):
            if j in read and cell.strip():
                try:
                    values[k, j] = float(cell)
                except ValueError:
                    raise InputError(
                        f"row {lines[k + 1]}, column {header[j]}", "a number", show(cell)
                    ) from None
    if "time" not in named:
        raise InputError(
            f"expected a column time (--map time=COLUMN, or frame*0.0333); found "
            f"{', '.join(header)}"
        )
    unused = [name for k, name in enumerate(header) if k not in read]
    column, scale = named.pop("time")
    time = scale * values[:, column]
    if not np.isfinite(time).all():
        bad = int(np.flatnonzero(~np.isfinite(time))[0])
        raise InputError(f"row {lines[bad + 1]}, column {header[column]}", "a time", "none")
    steps = np.diff(time)
    if np.any(steps <= 0):
        late = int(np.flatnonzero(steps <= 0)[0]) + 1
        word = "goes back" if steps[late - 1] < 0 else "stands still"
        raise InputError(
            f"row {lines[late + 1]}: expected a time later than {time[late - 1]:.13g} s; found "
            f"{time[late]:.13g} s: time {word}"
        )
    found = {}
    for name, (k, scale) in named.items():
        value = scale * values[:, k] if k is not None else np.full(len(time), scale)
        known = np.isfinite(value)
        if not known.any():
            raise InputError(f"column {header[k]}", "numbers", "none, or NaN only")
        found[name] = TimeSeries(time[known], value[known])
    return found, unused


def _name_columns(
    header: Sequence[str], columns: Mapping[str, str], robot: Robot
) -> dict[str, tuple[Any, float]]:
    """Signals by name: column (None: a constant) and factor; by the mapping, or by name."""
    found: dict[str, tuple[Any, float]] = {}
    for name, source in columns.items():
        match = _SOURCE.match(source)
        assert match is not None
        column, factor = match["column"], match["factor"]
        if column in header:
            scale = _factor(name, factor) if factor else 1.0
            if column != name and (not factor or scale == -1.0):  # a sign leaves the unit as it is
                scale *= _unit(column)[1]
            found[name] = header.index(column), scale
            continue
        number = _finite(source)
        if number is None:
            raise InputError(
                f"--map {name}: expected one of the columns {', '.join(header)}, also with "
                f"*FACTOR, or a number; found {show(source)}"
            )
        found[name] = None, number
        if name == "time":
            raise InputError("--map time", "a column", f"the number {source}")
    body = robot.morphology
    modules = list(dict.fromkeys([*(m.name for m in body.modules), *body.thruster_names]))
    twice = [column for column in header if header.count(column) > 1]
    if twice:
        raise InputError(f"column {twice[0]}", "each name once", "it twice")
    mapped = {k for k, _ in found.values()}
    for k, column in enumerate(header):
        head, _, rest = column.partition(".")
        own = head in ("command", "angle") and rest in modules  # also one that ends like a unit
        bare, factor = (column, 1.0) if own else _unit(column)
        bare = {"t": "time"}.get(bare, bare)
        if mark := re.fullmatch(r"([xyz])(\d+)", bare):
            bare = f"mark.{mark[2]}.{mark[1]}"
        head, _, rest = bare.partition(".")
        if _is_measured(bare) and k in mapped:
            continue  # the map says what it is
        known = bare == "time" or _is_measured(bare)
        if bare not in found and (known or (head in ("command", "angle") and rest in modules)):
            found[bare] = k, factor
        elif head in ("command", "angle") and rest not in modules and k not in mapped:
            raise InputError(
                f"column {column}: expected a module of {robot.morphology.name} "
                f"({', '.join(modules)}); found {show(rest)}: another robot?"
            )
    return found


def _factor(name: str, text: str) -> float:
    number = _finite(text)
    if number is None:
        raise InputError(f"--map {name}", "a number after *", show(text))
    return number


def _finite(text: str) -> float | None:
    """A finite number; None for other text."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _unit(column: str) -> tuple[str, float]:
    """A column's name without its unit, and the unit in SI."""
    for end, factor in _UNITS.items():
        if column.endswith(end):
            return column.removesuffix(end), factor
    return column, 1.0


# --- bags and run folders -------------------------------------------------------------------------


def _read_bag(
    path: Path, columns: Mapping[str, str], robot: Robot
) -> tuple[dict[str, TimeSeries], list[str]]:
    """Topics by their types, and notes; of several poses the first, or that of `odometry=/topic`.

    Of several of another type it is the same; but all of joints, points (marks, by the last of
    their topics' names) and numbers (`depth`, or what `command.port=/topic*FACTOR` names) are read.
    """
    check_package("a bag", "rosbags")
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    # What we export has names that ROS takes.
    links, jets = make_links(robot), robot.morphology.thruster_names
    modules = {
        "JointState": {x.joint.name: robot.mj_model.body(x.body).name for x in links if x.joint},
        "Float64MultiArray": {
            **{str(k): name for k, name in enumerate(jets)},
            **{plain(name): name for name in jets},
            **{name: name for name in jets},
        },
    }
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    kept: dict[str, list[tuple[float, float]]] = {}
    chosen: dict[str, str] = {}
    try:
        with Reader(path) as bag:
            kinds = {c.topic: c.msgtype.rpartition("/")[2] for c in bag.connections}
            picked = {
                _role(_TYPES[name]): source for name, source in columns.items()
                if name in _TYPES and _role(kinds.get(source, "")) == _role(_TYPES[name])
            }  # fmt: skip
            for connection, stamp, raw in bag.messages():
                kind, topic = connection.msgtype.rpartition("/")[2], connection.topic
                if (use := _TOPICS.get(kind)) is None:
                    continue
                role = f"{kind} {topic}" if kind in _MANY else _role(kind)
                if chosen.get(role, picked.get(role, topic)) != topic:
                    continue
                message = store.deserialize_cdr(raw, connection.msgtype)
                if kind == "Float64MultiArray" and not _has_names(message, topic):
                    continue  # such as a sensor's numbers
                chosen[role] = topic
                for name, value in use(message, topic):
                    if names := modules.get(kind):
                        head, _, module = name.partition(".")
                        name = f"{head}.{names.get(module, module)}"
                    kept.setdefault(name, []).append((1e-9 * stamp, float(value)))
    except InputError:
        raise
    except Exception as error:  # rosbags' own kinds, struct's, zstd's
        found_instead = str(error).partition("\n")[0]
        raise InputError(f"expected a ROS 2 bag; found: {found_instead}") from None
    if not kept:
        raise InputError(f"expected topics of the types {', '.join(_TOPICS)}; found none")
    found = {}
    for name, rows in kept.items():
        time, value = np.array(rows).T
        order = np.argsort(time, kind="stable")
        once = np.append(True, np.diff(time[order]) > 0)
        found[name] = TimeSeries(time[order][once], value[order][once])
    # Numbers are named by the map, or by their topic's end.
    sources = {source.rpartition("*")[0] or source for source in columns.values()}
    depth = [n for n in found if n.endswith("/depth") and n not in sources]
    if depth and "depth" not in columns:
        found["depth"] = found[depth[0]]
    rest = {n: x for n, x in columns.items() if n not in _TYPES or _role(_TYPES[n]) not in picked}
    found, notes = _mapped(found, rest, robot)
    found = {name: one for name, one in found.items() if name not in kinds}
    first = min((one.time[0] for one in found.values()), default=0.0)
    return {n: TimeSeries(one.time - first, one.value) for n, one in found.items()}, notes


def _role(kind: str) -> str:
    """Of a type of messages: all poses are of the core, and one topic has them."""
    return "pose" if kind in _POSES else kind


def _pose(pose: Any) -> Iterable[tuple[str, float]]:
    yield from ((axis, getattr(pose.position, axis)) for axis in "xyz")
    yield from ((f"q{axis}", getattr(pose.orientation, axis)) for axis in "wxyz")


def _joints(message: Any, topic: str) -> Iterable[tuple[str, float]]:
    kind = "command" if "target" in topic or "command" in topic else "angle"
    pairs = zip(message.name, message.position, strict=False)
    yield from ((f"{kind}.{name}", value) for name, value in pairs)


def _has_names(message: Any, topic: str) -> bool:
    """Whether it is known what an array's numbers are: an exported brain's node gives no labels."""
    return bool(message.layout.dim) or topic.endswith("/thruster_commands")


def _array(message: Any, topic: str) -> Iterable[tuple[str, float]]:
    dim = message.layout.dim
    names = dim[0].label.split(",") if dim else []
    if len(names) != len(message.data):  # none, or a module's name has a comma: by their order
        names = [*map(str, range(len(message.data)))]
    yield from ((f"command.{n}", x) for n, x in zip(names, message.data, strict=False))


def _imu(message: Any, topic: str) -> Iterable[tuple[str, float]]:
    yield from ((f"gyro.{axis}", getattr(message.angular_velocity, axis)) for axis in "xyz")
    yield from ((f"accel.{axis}", getattr(message.linear_acceleration, axis)) for axis in "xyz")


def _point(message: Any, topic: str) -> Iterable[tuple[str, float]]:
    name = topic.rpartition("/")[2]
    yield from ((f"mark.{name}.{axis}", getattr(message.point, axis)) for axis in "xyz")


def _number(message: Any, topic: str) -> Iterable[tuple[str, float]]:
    yield topic, message.data


_TOPICS: dict[str, Callable[[Any, str], Iterable[tuple[str, float]]]] = {
    "Odometry": lambda m, _: _pose(m.pose.pose),
    "PoseStamped": lambda m, _: _pose(m.pose),
    "JointState": _joints,
    "Float64MultiArray": _array,
    "Imu": _imu,
    "PointStamped": _point,
    "Float64": _number,
    "Float32": _number,
}
_TYPES = {kind.lower(): kind for kind in _TOPICS}
_POSES = "Odometry", "PoseStamped"
_NUMBERS = "Float64", "Float32"
_MANY = ("JointState", "PointStamped", *_NUMBERS)


def _read_run(path: Path, fitted: Robot) -> tuple[dict[str, TimeSeries], list[str]]:
    """What the champion of a run folder does, sampled 50 times a second; and notes.

    Args:
        path: of the folder.
        fitted: robot that is fitted, as the run may have another one.
    """
    from mjx_revolve.episodes.champion import load_episode

    episode = load_episode(path)
    trajectory = episode.trajectory
    robot = episode.robot
    every = max(1, round(0.02 / robot.world.timestep))
    time = np.asarray(trajectory.time, float)[every - 1 :: every]
    qpos = np.asarray(trajectory.qpos, float)[every - 1 :: every]
    pose = zip(_POSE[:7], qpos.T[:7], strict=True)
    signals = {name: TimeSeries(time, x) for name, x in pose}
    notes, ours, theirs = [], fitted.morphology, robot.morphology
    for what, number, other, unit in (
        ("mass", ours.mass, theirs.mass, "kg"),
        ("volume", 1e6 * ours.volume, 1e6 * theirs.volume, "cm³"),
    ):
        if not math.isclose(number, other, rel_tol=1e-3):
            notes.append(
                f"the run's robot has a {what} of {other:.4g} {unit}, {ours.name} here "
                f"{number:.4g}: trimmed (--set trim=neutral), or another one?"
            )
    if (varied := trajectory.variation) is not None:
        words = ", ".join(f"{name} {float(x):.3g}" for name, x in varied._asdict().items())
        notes.append(f"task.robust: the episode had factors of its own, which a fit finds: {words}")
    signals = sent_commands(robot, trajectory.ctrl) | signals
    # The sea's time at the episode's start, which is drawn: waves are those at a recording's times.
    if robot.world.waves and episode.water is not None:
        sea = float(np.ravel(episode.water.time)[0])
        signals = {name: TimeSeries(sea + one.time, one.value) for name, one in signals.items()}
    return signals, notes


def sent_commands(robot: Robot, ctrl: ArrayLike) -> dict[str, TimeSeries]:
    """Signals of commands `[T, nu]` in MuJoCo's order, a row for each step."""
    names = [robot.mj_model.actuator(k).name for k in range(robot.mj_model.nu)]
    rows = np.asarray(ctrl, float)
    begun = robot.world.timestep * np.arange(len(rows))
    return {f"command.{n}": TimeSeries(begun, x) for n, x in zip(names, rows.T, strict=True)}


# --- checks ---------------------------------------------------------------------------------------


def _add_marks(
    marks: dict[str, MarkedPoint], signals: Mapping[str, TimeSeries], robot: Robot
) -> None:
    """Adds marks named after modules; those without a place or without a signal are refused."""
    modules = [m.name for m in robot.morphology.modules]
    seen = {name.split(".")[1] for name in signals if name.startswith("mark.")}
    for name in sorted(seen - marks.keys()):
        if name not in modules:
            raise InputError(
                f"mark {name}: expected where it is (--map mark.{name}=MODULE:X,Y,Z [m], of the "
                f"modules {', '.join(modules)}); found nothing"
            )
        marks[name] = MarkedPoint(modules.index(name), (0.0, 0.0, 0.0))
    for name in marks:
        if name not in seen:
            raise InputError(f"mark {name}", f"columns mark.{name}.x and .y", "none")


def _check_signals(signals: Mapping[str, TimeSeries], robot: Robot) -> list[str]:
    """Plain faults, one line each; and notes about gaps."""
    body = robot.morphology
    hinges = [body.modules[k].name for k in body.hinges]
    parts = [body.modules[i].kind.parts[k].thruster for i, k in body.thrusters]
    jets = dict(zip(body.thruster_names, parts, strict=True))
    seen = [n for n in signals if n in _POSE or n in _SENSED or n.startswith("mark.")]
    if not any(n in ("x", "mean_speed") or n.startswith("mark.") for n in signals):
        raise InputError("expected x and y of the core, marks, or mean_speed; found none of them")
    if (speed := signals.get("mean_speed")) is not None:
        if len(speed.time) < 2:
            raise InputError("mean_speed", "rows from two times on", "one")
        if (low := float(np.mean(speed.value))) < 0:
            raise InputError("mean_speed", "at least 0 m/s", f"{low:g}")
    quat = [f"q{axis}" for axis in "wxyz"]
    whole, tilt = ["qw" if "qw" in signals else "yaw"], ["roll", "pitch"]
    both = [] if "qw" in signals else tilt  # one alone says nothing of the other
    for given, needed in ((tilt, whole), (tilt, both), (quat, quat)):
        there = [n for n in given if n in signals]
        if there and (missing := [n for n in needed if n not in signals]):
            raise InputError(
                f"{there[0]}: expected {', '.join(missing)} beside it; found none, and an attitude "
                "is four numbers, or three angles with yaw first of all"
            )
    for name, signal in signals.items():
        if not np.isfinite(signal.value).all():
            raise InputError(name, "finite numbers", "NaN or infinity")
        head, _, module = name.partition(".")
        if head not in ("command", "angle"):
            continue
        if module not in (hinges if head == "angle" else {*hinges, *jets}):
            known = ", ".join([*hinges, *jets]) or "it has none"
            raise InputError(
                f"{name}: expected a hinge or thruster of {body.name} ({known}); found "
                f"{show(module)}: another robot?"
            )
        most = float(np.abs(signal.value).max())
        if module in hinges and most > 2 * math.pi:
            raise InputError(
                f"{name}: expected radians; found {most:.3g}: degrees? (--map "
                f"{name}=COLUMN*0.01745, or a column that ends in _deg)"
            )
        jet = jets.get(module)
        if jet is not None and most > 3 * max(map(abs, jet.range)):
            raise InputError(
                f"{name}: expected commands within {list(jet.range)}; found {most:.3g}: percent? "
                f"(--map {name}=COLUMN*0.01)"
            )
    if (depth := signals.get("depth")) is not None:
        middle = float(np.median(depth.value))
        if middle < -float(body_geometry(robot).length):
            raise InputError(
                f"depth: expected that of a robot in water, above 0 m; found {middle:.3g} m: a "
                "height? (--map depth=COLUMN*-1)"
            )
    if all(name in signals for name in quat):
        length = np.sqrt(sum(np.median(signals[name].value ** 2) for name in quat))
        if not 0.5 < length < 1.5:
            raise InputError("qw, qx, qy, qz", "unit quaternions", f"length {length:.3g}")
    for name in ("roll", "pitch", "yaw"):
        if name in signals and len(signals[name].time) > 2:
            time, angle = signals[name]
            # Between quantiles: angles that are wrapped jump now and then.
            rate = float(np.quantile(np.abs(np.diff(angle) / np.diff(time)), 0.75))
            if rate > _FASTEST_TURN:
                raise InputError(
                    f"{name}: expected radians; found steps of {rate:.3g} a second: degrees? "
                    f"(--map {name}=COLUMN*0.01745, or a column that ends in _deg)"
                )
    frames = {n: signals[n] for n in seen}
    most = max((len(signal.time) for signal in frames.values()), default=3)
    if most < 3 and "mean_speed" not in signals:
        raise InputError(f"expected three frames or more; found {most}")
    _check_motion(signals, robot)
    angles = {n: s for n, s in signals.items() if n.startswith("angle.")}
    notes = [*_gaps(frames | angles), *_sampled_commands(signals, frames, robot)]
    times = [signal.time for signal in frames.values() if len(signal.time) > 2]
    every = [(float(np.median(np.diff(time))), time[-1] - time[0]) for time in times]
    if every and min(every)[0] > _SLOW:
        rate, span = 1 / min(every)[0], min(every)[1]
        notes.append(f"{rate:.2g} frames a second, {span:.0f} s in all: is time in seconds (--map "
                     "time=COLUMN*FACTOR)?")  # fmt: skip
    return notes


def _check_motion(signals: Mapping[str, TimeSeries], robot: Robot) -> None:
    """Refuses what is too fast for its units, jumps, flies, and what does not move at all."""
    length, top = float(body_geometry(robot).length), robot.world.surface_height
    for name in (n for n in signals if n == "z" or (n.startswith("mark.") and n.endswith(".z"))):
        middle = float(np.median(signals[name].value))
        if middle > top + length:
            raise InputError(
                f"{name}: expected heights of a robot in water, below {top:g} m; found {middle:.3g}"
                f" m: does z point down (--map {name}=COLUMN*-1), or begin elsewhere (--set "
                "world.surface_height=HEIGHT)?"
            )
    places = {n: s for n, s in signals.items() if n in _PLACE or n.startswith("mark.")}
    still = "mean_speed" not in signals and any(len(s.time) > 2 for s in places.values())
    for name, signal in places.items():
        if len(signal.time) < 3:
            continue
        # Between quantiles: single frames may be wrong.
        speed = float(np.quantile(np.abs(np.diff(signal.value) / np.diff(signal.time)), 0.75))
        if speed > _FASTEST * length:
            raise InputError(
                f"{name}: expected metres of a robot {length:.2g} m long; found steps of "
                f"{speed:.3g} a second: millimetres or pixels? (--map {name}=COLUMN*FACTOR, or a "
                "column that ends in _mm)"
            )
        _check_jump(name, signal, length)
        jitter = float(np.median(np.abs(np.diff(signal.value, 2)))) / 2
        still = still and float(np.ptp(signal.value)) < max(12 * jitter, 2e-3 * length)
    for name in ("yaw", "pitch", "roll", "qx", "qy", "qz"):
        if name in signals and np.ptp(signals[name].value) > 0.1:
            still = False
    if still:
        raise InputError(
            "expected a robot that moves; found nothing that moves more than its noise"
        )


def _check_jump(name: str, signal: TimeSeries, length: float) -> None:
    """Refuses a coordinate that goes elsewhere between two frames, and stays there."""
    time, value = signal
    step, bound = np.diff(value), length * (1 + _FASTEST * np.diff(time))
    for k in np.flatnonzero(np.abs(step) > bound) + 1:
        before, after = value[max(k - _STAYS, 0) : k], value[k : k + _STAYS]
        away = abs(np.median(after) - np.median(before)) > bound[k - 1]
        if away and min(len(before), len(after)) > _STAYS / 2:
            raise InputError(
                f"{name}: expected a way without jumps; found one of {abs(step[k - 1]):.3g} m at "
                f"{time[k]:.13g} s: another origin, or another robot, from there on?"
            )


def _sampled_commands(
    signals: Mapping[str, TimeSeries], frames: Mapping[str, TimeSeries], robot: Robot
) -> list[str]:
    """A note where hinges' commands are known at the frames only, and go on in between."""
    seen = np.unique(np.concatenate([time for time, _ in frames.values()]))
    for module in robot.morphology.modules:
        command = signals.get(f"command.{module.name}")
        if module.kind.hinge is None or command is None or len(command.time) < 3:
            continue
        time, value = command
        usual = float(np.median(np.diff(time)))
        at_frames = float(np.isin(time, seen).mean())
        changes = float((np.diff(value) != 0).mean())
        if usual > 2 * robot.world.timestep and min(at_frames, changes) > _SAMPLED:
            return [
                f"commands go on changing from frame to frame, at {1 / usual:.3g} Hz, and each is "
                "held until the next one: if the robot was sent more of them, record those, or "
                "its servos' speed and added mass are biased"
            ]
    return []


def _gaps(signals: Mapping[str, TimeSeries]) -> list[str]:
    """Frames that are missing, in words; once for signals of the same times."""
    found: dict[str, None] = {}
    for name, (time, _) in signals.items():
        if len(time) < 3:
            continue
        steps = np.diff(time)
        usual = float(np.median(steps))
        lost = np.round(steps / usual) - 1
        single, long = int((lost == 1).sum()), steps[steps > GAP * usual]
        group = {"mark": "mark", "angle": "angles"}.get(name.partition(".")[0], "frames")
        if single or len(long):
            words = f"{group} at {1 / usual:.3g} Hz: {single} dropped"
            if len(long):
                words += f", {len(long)} gaps of up to {long.max():.2g} s"
            found[words] = None
    return list(found)
