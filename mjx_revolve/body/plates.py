"""Parameters of a plate in the water, apart from their law (`lift_drag.py`).

Module types and worlds hold them, and neither should load JAX.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_revolve.inputs.errors import InputError

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class LiftDrag:
    """Parameters of Gazebo's LiftDrag plugin for one plate.

    As `lift_drag` of a part they make it a fin; as `lift_drag` of a world with `drag: lift_drag`
    they hold for every module.

    Attributes:
        a0: angle of attack at zero lift [rad].
        cla: lift slope before the stall [1/rad].
        cda: drag slope before the stall [1/rad].
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

    a0: float = 0.0
    cla: float = 1.0
    cda: float = 0.01
    alpha_stall: float = math.pi / 2
    cla_stall: float = 0.0
    cda_stall: float = 1.0
    cma: float = 0.0
    cma_stall: float = 0.0
    area: float | None = None
    forward: Vector | None = None
    upward: Vector | None = None
    cp: Vector | None = None
    radial_symmetry: bool = False
    density: float | None = None

    def __post_init__(self) -> None:
        """Checks the numbers."""
        for name in ("a0", "cla", "cda", "alpha_stall", "cla_stall", "cda_stall", "cma"):
            _check_number(name, getattr(self, name))
        _check_number("cma_stall", self.cma_stall)
        if not 0 < self.alpha_stall <= math.pi / 2:
            raise InputError(
                f"lift_drag.alpha_stall: expected an angle above 0, at most pi/2 [rad]; found "
                f"{self.alpha_stall:g}"
            )
        for name in ("area", "density"):
            value = getattr(self, name)
            if value is not None:
                _check_number(name, value)
                if value < 0:
                    raise InputError(f"lift_drag.{name}: expected at least 0; found {value:g}")
        for name in ("forward", "upward", "cp"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _vector(name, value, unit=name != "cp"))
        if not isinstance(self.radial_symmetry, bool):
            raise InputError(
                f"lift_drag.radial_symmetry: expected true or false; found {self.radial_symmetry!r}"
            )
        if (self.forward is None) != (self.upward is None):
            raise InputError("lift_drag: expected both forward and upward, or neither; found one")
        if self.forward is not None and self.upward is not None:
            along = sum(a * b for a, b in zip(self.forward, self.upward, strict=True))
            if abs(along) > 1e-6:
                raise InputError(
                    f"lift_drag.upward: expected a vector perpendicular to forward "
                    f"{list(self.forward)}; found {list(self.upward)}"
                )


def _check_number(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"lift_drag.{name}: expected a number; found {value!r}")
    try:
        finite = math.isfinite(value)
    except OverflowError:  # an integer of more than 308 digits
        finite, value = False, "a huge integer"
    if not finite:
        raise InputError(f"lift_drag.{name}: expected a finite number; found {value!r}")


def _vector(name: str, value: Any, unit: bool) -> Vector:
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 3:
        raise InputError(f"lift_drag.{name}: expected three numbers; found {value!r}")
    for x in value:
        _check_number(name, x)
    length = math.sqrt(sum(x * x for x in value)) if unit else 1.0
    if length < 1e-9:
        raise InputError(f"lift_drag.{name}: expected a direction, not zero; found {list(value)}")
    x, y, z = (float(v) / length for v in value)
    return (x, y, z)
