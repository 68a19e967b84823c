"""What module types and worlds state for drag laws, apart from the laws, which need JAX."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le, Unit
from pydantic import BeforeValidator

from mjx_revolve.inputs.errors import ConstraintError, show
from mjx_revolve.inputs.schema import (
    LARGEST,
    Boolean,
    Direction,
    NonNegative,
    Number,
    Vector,
    also,
    as_tuple,
    checked,
    words,
)
from mjx_revolve.water.coefficients import TODAY

CUBE_DRAG = TODAY["cube_drag"].value  # of a cube that faces the flow


@checked
class LiftDrag:
    """Parameters of Gazebo's LiftDrag plugin for one plate.

    As `lift_drag` of a part they make it a fin; as `lift_drag` of a world with `drag: lift_drag`
    they hold for every module.

    Attributes:
        a0: angle of attack at zero lift [rad].
        cla: lift slope before the stall [1/rad].
        cda: drag slope before the stall [1/rad]; of fins with `drag: fin_wake`, the default, drag
            follows from lift there instead.
        alpha_stall: stall angle [rad].
        cla_stall: lift slope after the stall [1/rad].
        cda_stall: drag slope after the stall [1/rad].
        cma: pitching moment slope before the stall [m/rad]; the moment is slope × angle × dynamic
            pressure × area.
        cma_stall: pitching moment slope after the stall [m/rad].
        area: of the plate [m²]; by default the part's largest face.
        forward: direction of zero angle of attack, part frame; by default the longer edge of that
            face.
        upward: normal of the plate's upper surface, part frame; by default that of that face.
        cp: centre of pressure, part frame [m]; by default the box's centre.
        radial_symmetry: whether every direction across `forward` is upward, as for a body of
            revolution.
        density: of the fluid [kg/m³] (Gazebo's `air_density`); by default the world's.
    """

    a0: Annotated[Number, Unit("rad")] = 0.0
    cla: Annotated[Number, Unit("1/rad")] = 1.0
    cda: Annotated[Number, Unit("1/rad")] = 0.01
    alpha_stall: Annotated[Number, Gt(0), Le(math.pi / 2), Unit("rad")] = math.pi / 2
    cla_stall: Annotated[Number, Unit("1/rad")] = 0.0
    cda_stall: Annotated[Number, Unit("1/rad")] = 1.0
    cma: Annotated[Number, Unit("m/rad")] = 0.0
    cma_stall: Annotated[Number, Unit("m/rad")] = 0.0
    area: Annotated[NonNegative, Unit("m2")] | None = None
    forward: Direction | None = None
    upward: Direction | None = None
    cp: Annotated[Vector, Unit("m")] | None = None
    radial_symmetry: Boolean = False
    density: Annotated[NonNegative, Unit("kg/m3")] | None = None

    def __post_init__(self) -> None:
        """Checks that the directions fit."""
        if self.forward is None and self.upward is None:
            return
        if self.forward is None or self.upward is None:
            raise ConstraintError("", "both forward and upward, or neither", "one")
        if abs(np.dot(self.forward, self.upward)) > 1e-6:
            across = f"a vector perpendicular to forward {show(self.forward)}"
            raise ConstraintError("upward", across, show(self.upward))


_SIX = "six numbers, or six rows of six"


@also({"type": "array", "items": {"type": "number"}, "minItems": 6, "maxItems": 6})
def _read_matrix(value: Any) -> Any:
    """Six numbers on the diagonal, or six rows of six, as six rows."""
    rows = as_tuple(value)
    rows = tuple(map(as_tuple, rows)) if isinstance(rows, tuple) else ()
    if len(rows) == 6 and not any(isinstance(row, tuple) for row in rows):
        rows = tuple((0,) * i + (x,) + (0,) * (5 - i) for i, x in enumerate(rows))
    square = len(rows) == 6 and all(isinstance(row, tuple) and len(row) == 6 for row in rows)
    numbers = [x for row in rows for x in row] if square else []
    plain = all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
    if not square or not plain or not all(abs(x) <= LARGEST for x in numbers):
        raise ConstraintError("", _SIX, show(value))
    matrix = np.array(rows, float)
    size = np.abs(matrix).max()
    if np.abs(matrix - matrix.T).max() > 1e-6 * size:
        raise ConstraintError("", "a symmetric matrix", show(value))
    if np.linalg.eigvalsh(matrix)[0] < -1e-6 * size:
        raise ConstraintError("", "a matrix without negative eigenvalues", show(value))
    return tuple(tuple(map(float, row)) for row in (matrix + matrix.T) / 2)


Matrix = Annotated[
    tuple[tuple[float, ...], ...], BeforeValidator(_read_matrix), words(_SIX), Unit("SI")
]
"""A symmetric 6×6 without negative eigenvalues: along x, y, z, then about them."""
_NOTHING = ((0.0,) * 6,) * 6


@checked
class Fossen:
    """What is known of a part's water from a tank or a panel code, in place of our laws.

    M ν̇ + C(ν) ν + (D + diag(d) |ν|) ν in the part's own axes, at its frame's origin, the centre of
    its main box (Fossen 2011, Handbook of Marine Craft Hydrodynamics, chapters 6 and 7). What is
    left out is 0. Numbers are positive, where X_u̇, X_u and X_|u|u are negative. Six numbers serve a
    frame with z down, too; of six rows, entries that couple x or roll with y, z, pitch or yaw
    change their sign then. They hold wholly submerged; half out, the submerged share of the main
    box of them acts.

    Attributes:
        added_mass: M, about the centre of the part's main box, in the part's axes (z up), surge,
            sway, heave, roll, pitch and yaw in this order; positive [kg, kg·m, kg·m²].
        linear_damping: D, of the same point and axes [N·s/m, N·s, N·m·s]. It is symmetric.
        quadratic_damping: d, six numbers >= 0 [N·s²/m², N·m·s²].
        whole: whether they are those of the whole robot, of which the part is the core: the water
            then neither drags nor is carried by any other part. For robots without hinges.

    Raises:
        InputError: a matrix is not symmetric, or could make energy.
    """

    added_mass: Matrix = _NOTHING
    linear_damping: Matrix = _NOTHING
    quadratic_damping: Annotated[
        tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative],
        BeforeValidator(as_tuple),
        words("six numbers >= 0"),
        Unit("SI"),
    ] = (0.0,) * 6
    whole: Boolean = False
