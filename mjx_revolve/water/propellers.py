"""Parameters of a propeller, apart from its laws (`thrusters.py`)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from annotated_types import Unit

from mjx_revolve.inputs.errors import ConstraintError, show
from mjx_revolve.inputs.schema import Direction, NonNegative, Number, Pair, TupleOf, Vector, checked


@checked
class Thruster:
    """A propeller that pushes along an axis; `thrusters.py` holds the laws.

    Commands have no unit: 1 is full ahead, -1 full astern (UUV Simulator's command is the rotor's
    speed; divide by the top speed). Thrust is in newtons at such a command. Out of the water there
    is none.

    Attributes:
        axis: unit vector of positive thrust, part frame.
        position: where it pushes, part frame [m].
        curve: "basic" (k x|x|), "dead_band" (k (x|x| - δ) beyond a dead band) or "interpolated" (a
            broken line).
        gain: k, thrust per command squared [N]; of "dead_band" the one ahead; not for
            "interpolated".
        gain_backward: k astern [N]; "dead_band" only, by default `gain`.
        dead_band: [δ_l, δ_r] around 0, in units of x|x|, between which there is no thrust;
            "dead_band" only [-].
        commands: points of the broken line, rising; "interpolated" only [-].
        thrusts: thrust at each of them; "interpolated" only [N].
        range: lowest and highest command, around 0 [-]; what lies beyond is clamped.
        time_constant: τ of the first-order lag of the command [s]; 0 is no lag.
        torque_ratio: reaction torque about the axis per thrust [m]: positive for a right-handed
            propeller, which turns its robot left-handed as it pushes ahead; negative for a
            left-handed one. K_Q / K_T times the propeller's diameter.

    Raises:
        InputError: a number is out of range, or one is given that the curve does not have.
    """

    axis: Direction = (1.0, 0.0, 0.0)
    position: Annotated[Vector, Unit("m")] = (0.0, 0.0, 0.0)
    curve: Literal["basic", "dead_band", "interpolated"] = "basic"
    gain: Annotated[NonNegative, Unit("N")] = 1.0
    gain_backward: Annotated[NonNegative, Unit("N")] | None = None
    dead_band: Annotated[Pair[Number], Unit("-")] = (0.0, 0.0)
    commands: Annotated[TupleOf[Number], Unit("-")] = ()
    thrusts: Annotated[TupleOf[Number], Unit("N")] = ()
    range: Annotated[Pair[Number], Unit("-")] = (-1.0, 1.0)
    time_constant: Annotated[NonNegative, Unit("s")] = 0.0
    torque_ratio: Annotated[Number, Unit("m")] = 0.0

    def __post_init__(self) -> None:
        """Checks that the numbers fit, and are those of the curve: others would do nothing."""
        low, high = self.range
        if not low <= 0.0 <= high or low == high:
            around = "[lowest, highest] around the command 0 [-]"
            raise ConstraintError("range", around, show([low, high]))
        if not self.dead_band[0] <= 0.0 <= self.dead_band[1]:
            around = "[at most 0, at least 0] [-]"
            raise ConstraintError("dead_band", around, show(list(self.dead_band)))
        line = self.curve == "interpolated"
        strange = {
            "gain": line and self.gain != 1.0,
            "gain_backward": self.curve != "dead_band" and self.gain_backward is not None,
            "dead_band": self.curve != "dead_band" and self.dead_band != (0.0, 0.0),
            "commands": not line and self.commands != (),
            "thrusts": not line and self.thrusts != (),
        }
        for name, given in strange.items():
            if given:
                expected = f"none with curve {self.curve}"
                raise ConstraintError(name, expected, show(getattr(self, name)))
        points = len(self.commands), len(self.thrusts)
        if line and (points[0] < 2 or points[0] != points[1]):
            pairs = "as many as thrusts, two or more"
            raise ConstraintError("commands", pairs, f"{points[0]} and {points[1]}")
        if not all(a < b for a, b in pairwise(self.commands)):
            rising = "numbers that rise from each to the next [-]"
            raise ConstraintError("commands", rising, show(list(self.commands)))

    def thrust_at(self, command: float) -> float:
        """Thrust at a steady command, for tables and pictures; `thrusters.thrust` is for water.

        Args:
            command: clamped to the range [-].

        Returns:
            Thrust along the axis [N].
        """
        x = min(max(command, self.range[0]), self.range[1])
        if self.curve == "interpolated":
            return float(np.interp(x, self.commands, self.thrusts))
        square, (low, high) = x * abs(x), self.dead_band
        backward = self.gain if self.gain_backward is None else self.gain_backward
        return backward * min(square - low, 0.0) + self.gain * max(square - high, 0.0)

    @property
    def largest_thrust(self) -> float:
        """The size of its largest thrust at any command of its range [N]."""
        return max(abs(self.thrust_at(command)) for command in (*self.range, *self.commands))

    def scaled(self, factor: float) -> Thruster:
        """The same with thrust multiplied by a factor at every command.

        Args:
            factor: at least 0 [-].

        Returns:
            The scaled thruster.
        """
        if self.curve == "interpolated":
            return replace(self, thrusts=tuple(factor * x for x in self.thrusts))
        backward = self.gain_backward
        return replace(
            self,
            gain=factor * self.gain,
            gain_backward=backward if backward is None else factor * backward,
        )
