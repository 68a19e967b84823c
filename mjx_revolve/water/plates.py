"""What module types and worlds state for drag laws, apart from the laws, which need JAX."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from annotated_types import Gt, Le, Unit

from mjx_revolve.inputs.errors import ConstraintError, show
from mjx_revolve.inputs.schema import Boolean, Direction, NonNegative, Number, Vector, checked
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
