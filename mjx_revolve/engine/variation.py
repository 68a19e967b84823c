"""Uncertain coefficients of water and motors, as factors on the constants of a step.

A law's coefficients are known to some tens of per cent, a motor's speed and thrust to ten. The
factors are traced, so that one compiled program serves all their values; without factors the
constants are Python numbers and fold away.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Hinges, Level, Thrusters
from mjx_revolve.engine.step_constants import TORQUE_CURVE_KNEE
from mjx_revolve.numerics.spatial import Scalar, cast
from mjx_revolve.water.laws import scale_numbers


class Variation(NamedTuple):
    """Factors on coefficients of a world and its modules, `[lanes]` or a number each.

    Attributes:
        drag: on the coefficients of the faces' drag, of drag and lift of plates (fins), of friction
            and of stated damping.
        added_mass: on all water that parts carry along.
        density: of the water: on buoyancy, on these drags and on what is carried. Weights stay, so
            a robot that hovered no longer does. Thrusters keep their curves, which are measured.
        motor: on the servos' top speed, as they keep their effort, and on the thrusters' thrust.
    """

    drag: Scalar = 1.0
    added_mass: Scalar = 1.0
    density: Scalar = 1.0
    motor: Scalar = 1.0


def vary_level(level: Level, variation: Variation) -> Level:
    """The constants of a step, varied.

    Servos foresee a step's gain in speed with the inertia as it was, which only decides when
    they are careful, and MuJoCo's two drag laws and surface tension are not varied.

    Args:
        level: the constants, numbers or `[..., lanes]`.
        variation: the factors.

    Returns:
        The same level with other numbers.
    """
    row = Variation(*(jnp.atleast_1d(jnp.asarray(x))[None] for x in variation))
    return replace(
        level,
        hinges=None if level.hinges is None else _vary_hinges(level.hinges, row.motor),
        parts=tuple(scale_numbers(parts, row._asdict()) for parts in level.parts),
    )


def vary_thrusters(thrusters: Thrusters, variation: Variation) -> Thrusters:
    """The thrusters of robots, with other thrusts at the same commands."""
    if not thrusters.count:
        return thrusters
    motor = jnp.atleast_1d(jnp.asarray(variation.motor))[None]
    scale = lambda x: cast(x, motor) * motor  # noqa: E731
    line = thrusters.line
    if line is not None:
        commands, thrusts, is_line = line
        line = commands, tuple(map(scale, thrusts)), is_line
    backward, forward = map(scale, (thrusters.backward, thrusters.forward))
    return replace(thrusters, backward=backward, forward=forward, line=line)


def _vary_hinges(hinges: Hinges, motor: jax.Array) -> Hinges:
    """The line between speed and torque near another top speed; see `step_constants.motor_line`."""
    friction, gradient, top = hinges.motor
    limited = np.not_equal(gradient, 0) if not isinstance(gradient, jax.Array) else gradient != 0
    if not isinstance(limited, jax.Array) and not np.any(limited):
        return hinges
    friction, gradient, top = (cast(x, motor) for x in (friction, gradient, top))
    effort = cast(hinges.effort[1], motor)
    steeper = jnp.maximum((effort - motor * friction) / ((1 - TORQUE_CURVE_KNEE) * motor * top), 0)
    # Where there is no limit, the line lies far above any torque, and stays there.
    return hinges._replace(
        motor=(
            jnp.where(limited, motor * friction, friction),
            jnp.where(limited, steeper, gradient),
            jnp.where(limited, motor * top, top),
        )
    )
