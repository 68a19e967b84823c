"""Parameters of the water's own motion: shear, gusts, waves, velocities on a grid.

Worlds hold them; `flow.py` has their laws.
"""

from __future__ import annotations

import hashlib
import math
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le, Unit
from pydantic import BeforeValidator

from mjx_revolve.inputs.errors import ConstraintError, InputError, reading
from mjx_revolve.inputs.files import check_path, read_file, resolve_inside
from mjx_revolve.inputs.schema import NonNegative, Number, Triple, Vector, also, checked, words
from mjx_revolve.inputs.trust import audit

# Shortest wave [m]. Far below 0.1 m surface tension drives waves, which these laws do not know.
_SHORTEST = 0.01

# At least 1e-3 m or s: what is divided by it stays finite.
_Small = Annotated[Number, Ge(1e-3)]
# Degrees would otherwise pass for radians unseen.
_Angle = Annotated[Number, Ge(-2 * math.pi - 1e-6), Le(2 * math.pi + 1e-6), Unit("rad")]


@also({"type": "number"})
def _level(std: Any) -> Any:
    """One number as that of x and y."""
    plain = isinstance(std, int | float | np.number) and not isinstance(std, bool)
    return (std, std, 0.0) if plain else std


@checked
class Shear:
    """A current that fades with depth, on top of the uniform one; see `flow.shear_flow`.

    Attributes:
        velocity: at the surface, world frame [m/s], length 3.
        depth: at which it is gone, or has fallen to 1/e ("exponential") [m].
        profile: "linear", "power" or "exponential".
        exponent: of "power" [-].
    """

    velocity: Annotated[Vector, Unit("m/s")]
    depth: Annotated[_Small, Unit("m")] = 10.0
    profile: Literal["linear", "power", "exponential"] = "linear"
    exponent: Annotated[_Small, Unit("-")] = 1 / 7


@checked
class Gust:
    """A current that wanders around its mean and returns; see `flow.gust_path`.

    Attributes:
        std: its standard deviation along world x, y, z [m/s]; one number counts for x and y.
        time: over which its correlation falls to 1/e [s].
    """

    std: Annotated[
        Triple[NonNegative],
        BeforeValidator(_level),
        Unit("m/s"),
        words("a number or three numbers >= 0 [m/s]"),
    ]
    time: Annotated[_Small, Unit("s")] = 10.0


@checked
class Wave:
    """One regular wave, η = a cos(k·x - ωt + φ); see `flow.wave_flow`.

    Attributes:
        amplitude: a, half the height from trough to crest [m].
        wavelength: from crest to crest [m]; or instead
        period: from crest to crest, felt by what drifts with the uniform current [s].
        direction: towards which it runs, from world x towards y [rad].
        phase: φ, at the world's origin at time 0 [rad]. Episodes of tasks begin at random times.
    """

    amplitude: Annotated[NonNegative, Unit("m")]
    wavelength: Annotated[Number, Ge(_SHORTEST), Unit("m")] | None = None
    period: Annotated[_Small, Unit("s")] | None = None
    direction: _Angle = 0.0
    phase: _Angle = 0.0

    def __post_init__(self) -> None:
        """Checks that its length is given once."""
        if (self.wavelength is None) == (self.period is None):
            found = "none" if self.period is None else "both"
            raise ConstraintError("", "either wavelength or period", found)

    def wavenumber(self, gravity: float, water_depth: float | None) -> float:
        """k, from its length, or from its period by the dispersion relation ω² = g k tanh(k h).

        Newton's method in x = k h from Eckart's x ≈ y / √tanh y, y = ω² h / g (Eckart 1952, within
        5 %; Dean & Dalrymple 1991, § 3.4), to the last digit.

        Args:
            gravity: g, above 0 [m/s²].
            water_depth: h [m], or None for deep water.

        Returns:
            [rad/m].
        """
        if self.wavelength is not None:
            return 2 * math.pi / self.wavelength
        assert self.period is not None
        deep = (2 * math.pi / self.period) ** 2 / gravity
        if water_depth is None:
            return deep
        y = deep * water_depth
        x = y / math.sqrt(math.tanh(y))
        for _ in range(8):
            t = math.tanh(x)
            x -= (x * t - y) / (t + x * (1 - t * t))
        return x / water_depth

    def frequency(self, gravity: float, water_depth: float | None) -> float:
        """ω as the moving water sees it, ω² = g k tanh(k h).

        Args:
            gravity: g, above 0 [m/s²].
            water_depth: h [m], or None for deep water.

        Returns:
            [rad/s].
        """
        if self.period is not None:
            return 2 * math.pi / self.period
        k = self.wavenumber(gravity, water_depth)
        return math.sqrt(gravity * k * (1.0 if water_depth is None else math.tanh(k * water_depth)))


def check_wave(wave: Wave, gravity: float, water_depth: float | None, place: str) -> None:
    """Refuses a wave that would break, or that is too short to be driven by gravity.

    Args:
        wave: the wave.
        gravity: [m/s²].
        water_depth: [m], or None for deep water.
        place: what messages call it.

    Raises:
        ConstraintError: it is one.
    """
    if gravity <= 0:
        raise ConstraintError(place, "gravity above 0", f"{gravity:g}")
    k = wave.wavenumber(gravity, water_depth)
    length = 2 * math.pi / k
    if length < 0.999 * _SHORTEST:
        expected = f"that of a wave of at least {_SHORTEST:g} m"
        found = f"{wave.period:g} s, a wave of {length:.3g} m"
        raise ConstraintError(f"{place}.period", expected, found)
    # Miche 1944 (Dean & Dalrymple 1991, § 4.8): height over length where crests break.
    highest = 0.142 * length * (1.0 if water_depth is None else math.tanh(k * water_depth))
    if 2 * wave.amplitude > highest:
        expected = f"at most {highest / 2:.3g}, or a wave {length:.4g} m long breaks"
        raise ConstraintError(f"{place}.amplitude", expected, f"{wave.amplitude:g}")


@dataclass(frozen=True, eq=False, repr=False)
class CurrentField:
    """Steady velocities of the water on a grid; see `flow.field_flow`.

    Two are equal if their numbers are, wherever they were read.

    Attributes:
        x: `[nx]` rising world x of the grid's planes [m].
        y: `[ny]` rising world y [m].
        z: `[nz]` rising world z [m]; a single one where the current is the same at all depths.
        velocity: `[nx, ny, nz, 3]` world frame [m/s].
        path: where it was read.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    velocity: np.ndarray
    path: str = ""

    def __post_init__(self) -> None:
        """Checks the numbers, and keeps read-only copies."""
        digest = hashlib.sha256()
        shape = []
        for name in ("x", "y", "z", "velocity"):
            if np.ma.is_masked(getattr(self, name)):  # what stands under a mask is no number
                raise InputError(name, "numbers at all points", "masked ones")
            given = np.asarray(getattr(self, name))
            if given.dtype.kind not in "iuf":
                raise InputError(name, "real numbers", given.dtype)
            array = np.array(given, np.float64)
            if name != "velocity":
                _check_axis(name, array)
                shape.append(len(array))
            elif array.shape != (*shape, 3):
                expected = f"shape {[*shape, 3]}, as x, y and z have it"
                raise InputError("velocity", expected, list(array.shape))
            if not np.all(np.isfinite(array)):
                raise InputError(name, "finite numbers", "NaN or infinity")
            array += 0.0  # -0.0 and 0.0 are one number
            array.setflags(write=False)
            object.__setattr__(self, name, array)
            digest.update(f"{name}{array.shape}".encode() + array.tobytes())
        object.__setattr__(self, "_digest", digest.hexdigest()[:16])

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are the same."""
        return isinstance(other, CurrentField) and self._key == other._key

    def __hash__(self) -> int:
        """Of the numbers."""
        return hash(self._key)

    def __repr__(self) -> str:
        """Size and digest: the text of a world tells runs apart."""
        nx, ny, nz = self.velocity.shape[:3]
        return f"CurrentField({nx} x {ny} x {nz} points, {self._key})"

    @property
    def _key(self) -> str:
        return self.__dict__["_digest"]


def _check_axis(name: str, axis: np.ndarray) -> None:
    if axis.ndim != 1 or not len(axis):
        raise InputError(name, "a row of numbers [m]", f"shape {list(axis.shape)}")
    falls = np.flatnonzero(np.diff(axis) <= 0)
    if len(falls):
        first, second = axis[falls[0] : falls[0] + 2]
        raise InputError(name, "rising numbers [m]", f"{second:g} after {first:g}")


_COLUMNS = ("x", "y", "z", "u", "v", "w")
_ARRAYS = ("x", "y", "z", "velocity")


def find_field(path: str | Path, folder: str | Path) -> Path:
    """The file that a relative path names, which must lie inside a folder.

    A world that was passed on must not reach out into its reader's files unseen. An absolute path
    says openly where it leads.

    Args:
        path: what was written.
        folder: from which relative paths start.

    Returns:
        The file's path.

    Raises:
        InputError: a relative path leads out of the folder.
    """
    if Path(path).is_absolute():
        return Path(path)
    resolve_inside(path, folder)
    return Path(folder) / path


def load_current_field(path: str | Path) -> CurrentField:
    """Reads velocities of the water on a grid.

    NPZ: arrays `x` `[nx]`, `y` `[ny]`, `z` `[nz]` [m] and `velocity` `[nx, ny, nz, 3]` [m/s]. CSV:
    columns x, y, z, u, v, w under a line of their names, one row for each point of a full grid, in
    any order. The planes of the grid need not be equally spaced.

    Args:
        path: the file.

    Returns:
        The field.

    Raises:
        InputError: it cannot be read or is no full grid; the message names file and place.
    """
    path = check_path(path)
    read = {".npz": _read_arrays, ".csv": _read_table}.get(path.suffix.lower())
    if read is None:
        found = path.suffix or "no suffix"
        raise InputError(path, "a file .npz or .csv", found)
    audit(path, "data", read_file(path))
    with reading(path):
        return read(path)


def _read_arrays(path: Path) -> CurrentField:
    if not zipfile.is_zipfile(path):
        raise InputError("expected an NPZ archive; found something else")
    try:
        with np.load(path, allow_pickle=False) as data:
            found = {name: data[name] for name in _ARRAYS if name in data}
    except (ValueError, EOFError, zlib.error, zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(f"expected arrays of numbers; found: {error}") from None
    for name in _ARRAYS:
        if name not in found:
            raise InputError(f"expected arrays {', '.join(_ARRAYS)}; found no {name}")
    return CurrentField(**found, path=str(path))


def _read_table(path: Path) -> CurrentField:
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    heading = [name.strip() for name in lines[0].split(",")] if lines else []
    for name in _COLUMNS:
        if heading.count(name) != 1:
            found = f"{name} twice" if name in heading else f"no {name}"
            raise InputError("line 1", f"columns {', '.join(_COLUMNS)}", found)
    rows = []
    for number, line in enumerate(lines[1:], 2):
        if line.strip():
            with reading(f"line {number}"):
                rows.append(_read_row(line.split(","), len(heading)))
    if not rows:
        raise InputError("line 2", "rows of numbers", "none")
    table = np.array(rows)
    columns = {name: table[:, heading.index(name)] for name in _COLUMNS}
    axes = [np.unique(columns[name]) for name in "xyz"]
    shape = tuple(len(axis) for axis in axes)
    index = tuple(np.searchsorted(axis, columns[n]) for axis, n in zip(axes, "xyz", strict=True))
    expected = f"one row for each of {' x '.join(map(str, shape))} points of a full grid"
    points, counts = np.unique(np.stack(index[::-1]), axis=1, return_counts=True)
    if np.any(counts > 1):
        first = points[::-1, np.argmax(counts > 1)]
        point = ", ".join(f"{axis[i]:g}" for axis, i in zip(axes, first, strict=True))
        raise InputError(f"expected {expected}; found ({point}) twice")
    if len(table) != math.prod(shape):
        raise InputError(f"expected {expected}; found {len(table)} rows")
    velocity = np.empty((*shape, 3))
    velocity[index] = np.stack([columns[n] for n in "uvw"], -1)
    return CurrentField(axes[0], axes[1], axes[2], velocity, str(path))


def _read_row(cells: Sequence[str], count: int) -> list[float]:
    if len(cells) != count:
        raise InputError(f"expected {count} numbers; found {len(cells)}")
    row = []
    for cell in cells:
        try:
            row.append(float(cell))
        except ValueError:
            raise InputError(f"expected a number; found {cell.strip()!r}") from None
        if not math.isfinite(row[-1]):
            raise InputError(f"expected a finite number; found {cell.strip()!r}")
    return row
