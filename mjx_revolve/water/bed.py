"""The bed under the water: its height and slope at any place, as closed forms.

A bed is a function z = height(x, y). Closed forms rather than a stored grid because the population
step evaluates them inside one compiled loop, where a table look-up costs more than the formula;
MuJoCo gets a height field sampled from the same function, so pictures and physics agree.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Unit

from mjx_revolve.inputs.errors import ConstraintError
from mjx_revolve.inputs.schema import NonNegative, Number, Positive, checked
from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import namespace, sincos

# The thesis's lake: bed about 998 m x 998 m, z from -112.8 m to +36.7 m.
LAKE_LOWEST = -112.8
LAKE_HIGHEST = 36.7
# Height of the dunes as a share of the lake's: 0.8 m in the thesis's lake. A choice.
_DUNES = 0.8 / (LAKE_HIGHEST - LAKE_LOWEST)


@checked
class Bed:
    """The ground below the water.

    Attributes:
        kind: "flat" (a plane) or "lake" (a basin, a slope, a shore and low dunes).
        height: height of the plane, or of the lake's deepest place, world frame [m].
        highest: height of the lake's shore [m]; unused by "flat".
        extent: side of the square that is drawn and that "lake" is shaped in [m].
        stiffness: of one contact point. The spring is implicit, so that no mass needs a shorter
            step, but a robot of a weight w in water sinks in by some w / (4 stiffness); ten times
            the default throws thin plates in air [N/m].
        friction: Coulomb coefficient [-].
        contact: what keeps robots out of it: "penalty" (see `contact.bed_contact`), or "mjx", the
            modules' boxes by MuJoCo's constraint solver (see `engine.mjx_engine`), which needs
            `engine: mjx` and ignores `stiffness`.
    """

    kind: Literal["flat", "lake"] = "flat"
    height: Annotated[Number, Unit("m")] = -100.0
    highest: Annotated[Number, Unit("m")] = LAKE_HIGHEST
    extent: Annotated[Positive, Unit("m")] = 2000.0
    stiffness: Annotated[Positive, Unit("N/m")] = 3000.0
    friction: Annotated[NonNegative, Unit("-")] = 0.6
    contact: Literal["penalty", "mjx"] = "penalty"

    def __post_init__(self) -> None:
        """Checks that a lake is deepest at its deepest place."""
        if self.kind == "lake" and self.highest <= self.height:
            above = f"more than height ({self.height:g})"
            raise ConstraintError("highest", above, f"{self.highest:g}")


def bed_height(bed: Bed, x: Any, y: Any) -> Any:
    """Height of the bed.

    The lake is a basin that is flat out to 30 % of its half width, climbs along a smooth-step slope
    and ends in a shore at 98 %; the waterline lies two thirds up. It is a little longer in x
    than in y, and carries low dunes (0.8 m in the thesis's lake) that vanish at the bottom and on
    the shore, so that the stated extremes are exact.

    Args:
        bed: the bed.
        x: world x [m], any shape; NumPy's arrays are left to NumPy.
        y: world y [m], same shape.

    Returns:
        z of the bed, world frame [m], same shape.
    """
    x, y = _real(x), _real(y)
    xp = namespace(x)
    if bed.kind == "flat":
        return xp.full_like(x, bed.height)
    half = bed.extent / 2
    # 1e-12 keeps the square root differentiable at the centre.
    radius = xp.sqrt(_over(x, 1.05 * half) ** 2 + _over(y, half) ** 2 + 1e-12)
    rise = xp.clip(_over(radius - 0.3, 0.98 - 0.3), 0.0, 1.0)
    dunes = _DUNES * sincos(x * (2 * np.pi / 61))[0] * sincos(y * (2 * np.pi / 43))[0]
    # Squared, like the smooth step's start: dunes that rose faster would dig below the bottom.
    where = 16 * (rise * (1 - rise)) ** 2
    smooth = rise * rise * (3 - 2 * rise)
    return bed.height + (bed.highest - bed.height) * (smooth + dunes * where)


def highest_bed(bed: Bed, reach: float) -> float:
    """The bed's greatest height within a square around the world's origin.

    Args:
        bed: the bed.
        reach: half of the square's edge [m].

    Returns:
        z, world frame [m], of the highest of 101 x 101 points.
    """
    line = np.linspace(-reach, reach, 101)
    return float(np.max(bed_height(bed, *np.meshgrid(line, line))))


def _real(x: Any) -> Any:
    """Places as floats: whole numbers would cut the height, or its shape, down to whole ones."""
    known = hasattr(x, "dtype") and np.issubdtype(x.dtype, np.floating)
    return x if known else namespace(x).asarray(x, float)


def _over(x: Any, number: float) -> Any:
    """A quotient that is rounded alike by NumPy and XLA, which multiplies by the inverse."""
    if isinstance(x, np.ndarray):
        return x * (x.dtype.type(1) / x.dtype.type(number))
    return x / number


def bed_slope(bed: Bed, x: Any, y: Any) -> tuple[Any, Any]:
    """Slope of the bed by central differences over 2 cm.

    Differences, because they are cheap, need no second formula, and average over about the size of
    a module's edge.

    Args:
        bed: the bed.
        x: world x [m], any shape.
        y: world y [m], same shape.

    Returns:
        (dz/dx, dz/dy) [-], same shape.
    """
    x, y = _real(x), _real(y)
    if bed.kind == "flat":
        return jnp.zeros_like(x), jnp.zeros_like(y)
    d = 0.01
    return (
        (bed_height(bed, x + d, y) - bed_height(bed, x - d, y)) / (2 * d),
        (bed_height(bed, x, y + d) - bed_height(bed, x, y - d)) / (2 * d),
    )


@lru_cache(maxsize=8)  # every robot above a bed needs it
def sample_bed(bed: Bed, n: int = 201) -> np.ndarray:
    """The bed on a grid, for MuJoCo's height field and for pictures.

    Args:
        bed: the bed.
        n: points along each side.

    Returns:
        `[n, n]` heights, world frame [m]; rows run along y, columns along x, both upwards.
    """
    # float32, as the population step computes it.
    line = np.linspace(-bed.extent / 2, bed.extent / 2, n).astype(np.float32)
    x, y = np.meshgrid(line, line)
    heights: np.ndarray = bed_height(bed, x, y).astype(np.float64)
    heights.flags.writeable = False
    return heights
