"""What is free in a fit: names, priors and bounds, and the robot that has given values of them.

`NAME[.AXIS][@WHERE]`: `drag`, `drag_coefficient.x@Core`, `servo_speed@left_hip`. Names of the
water's come from the laws (`law_names.factor_names`); WHERE is a type of module or a module.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjx_revolve.body.coefficients import ALL, correct_modules, merge_params
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.params import MODULE_FACTORS, apply_overrides
from mjx_revolve.body.placement import Module
from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.water.law_names import factor_names

RECORDING = {"current": ("x", "y"), "clock": ("",)}
"""What each recording has of its own, where it is free."""
# Standard deviations of what each recording has of its own: currents of pools and ponds [m/s], and
# how far a camera's clock is off once a light or a first motion has set it [s]. Choices.
LOCAL_SPREAD = {"current": 0.05, "clock": 0.05}
# Numbers of thrusters that are free by their own names, with the prior's factor. A choice.
_THRUSTER = {"time_constant": 2.0, "gain": 1.3, "gain_backward": 1.3, "torque_ratio": 2.0}
# Median of the prior of a lag that is not known at all [s]: hobby thrusters' take 0.05 to 0.3.
_USUAL_LAG = 0.1
_BALLAST_SHARE, _BALLAST_PLACE = 0.05, 0.01  # of the robot's mass; [m]; choices
# No coefficient is wrong by more than this factor, or the robot is another one.
LARGEST_FACTOR = 30.0


@dataclass(frozen=True)
class Parameter:
    """A number that is fitted.

    Attributes:
        name: as the user wrote it.
        unit: of its value; "" for a factor.
        initial: value without any data: the prior's median.
        spread: standard deviation of the prior, of the logarithm where `positive`.
        positive: whether the logarithm is what is fitted.
        entries: value → params by module, type or `all`.
    """

    name: str
    unit: str
    initial: float
    spread: float
    positive: bool
    entries: Callable[[float], Mapping[str, Mapping[str, Any]]]

    def value(self, offset: float) -> float:
        """The value at so many of the prior's own units (log or plain) from `initial`."""
        return self.initial * math.exp(offset) if self.positive else self.initial + offset

    def bound(self, offset: float) -> float:
        """The nearest offset within bounds."""
        if not self.positive:
            return offset
        most = math.log(LARGEST_FACTOR)
        return min(max(offset, -most), most)

    def is_at_bound(self, offset: float) -> bool:
        """Whether it can go no farther."""
        return self.bound(1.001 * offset) != 1.001 * offset


def with_values(robot: Robot, parameters: Sequence[Parameter], offsets: np.ndarray) -> Robot:
    """The robot with values of its free numbers."""
    entries = entries_of(robot, parameters, offsets)
    modules = correct_modules(robot.morphology.modules, entries, "fit")
    return Robot(replace(robot.morphology, modules=modules), robot.world)


def entries_of(
    robot: Robot, parameters: Sequence[Parameter], offsets: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Params of values of free numbers, by type of module, module or `all`.

    Numbers of one thruster join, and so do coordinates of one ballast.
    """
    at = {m.name: m.kind.parts[0].ballast_position for m in robot.morphology.modules}
    found: dict[str, dict[str, Any]] = {}
    for parameter, offset in zip(parameters, offsets, strict=True):
        for where, params in parameter.entries(parameter.value(float(offset))).items():
            own = found.get(where, {})
            found[where] = merge_params(own, params)
            if "ballast_position" in own and "ballast_position" in params:
                found[where]["ballast_position"] = [
                    new if new != start else old
                    for old, new, start in zip(
                        own["ballast_position"], params["ballast_position"], at[where], strict=True
                    )
                ]
    return found


def split_free(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """What the robot has, and what each recording has (`current`, `clock`)."""
    own = [name for name in names if name not in RECORDING]
    return own, [name for name in RECORDING if name in names]


def read_free(names: Sequence[str], robot: Robot) -> list[Parameter]:
    """The free numbers of a robot.

    Args:
        names: as the user wrote them.
        robot: with its water; its laws have the parameters.

    Raises:
        InputError: there is no such number, or it would change nothing.
    """
    if len(set(names)) < len(names):
        twice = next(name for name in names if list(names).count(name) > 1)
        raise InputError(f"--free {twice}", "each name once", "it twice")
    return [_read_one(name, robot) for name in names]


def _read_one(text: str, robot: Robot) -> Parameter:
    name, _, where = text.partition("@")
    body = robot.morphology
    kinds = _targets(text, where or ALL, body)
    base, dot, axis = name.rpartition(".")
    water = factor_names()
    if dot and axis in ("x", "y", "z") and base in water:
        if not water[base][0]:
            raise InputError(f"--free {text}", f"{base} without an axis", repr(axis))
        key, place = base, "xyz".index(axis)
    else:
        key, place = name, None
    if key in water or key in MODULE_FACTORS:
        spread = water[key][1] if key in water else MODULE_FACTORS[key]
        _check_present(text, key, kinds, robot)

        def factor(value: float) -> dict[str, Any]:
            x: Any = value if place is None else [value if k == place else 1.0 for k in range(3)]
            return {where or ALL: {"factors": {key: x}}}

        return Parameter(text, "", 1.0, math.log(spread), True, factor)
    found = _plain_value(text, name, kinds, body)
    if found is None:
        names = [*water, *MODULE_FACTORS, "thruster_lag", *(f"thruster.{x}" for x in _THRUSTER)]
        more = ["ballast@MODULE", "ballast_position.z@MODULE", *RECORDING]
        raise InputError(
            f"--free {text}: expected some of {', '.join([*names, *more])}, each also with @TYPE "
            f"or @MODULE, per axis as drag_coefficient.x; found {show(name)}"
        )
    return found


def _targets(text: str, where: str, body: Morphology) -> dict[str, ModuleType]:
    """The modules that a name is about."""
    chosen = {m.name: m.kind for m in body.modules if where in (ALL, m.type, m.name)}
    if not chosen:
        types = sorted({m.type for m in body.modules})
        raise InputError(
            f"--free {text}: expected @ and one of {', '.join(types)}, or a module of {body.name}; "
            f"found {show(where)}"
        )
    return chosen


def _check_present(text: str, key: str, kinds: Mapping[str, ModuleType], robot: Robot) -> None:
    """Refuses a factor on what the robot has nothing of."""
    needs = {
        "thrust": ("a thruster", any(k.is_thruster for k in kinds.values())),
        "servo_speed": ("a hinge", any(k.hinge is not None for k in kinds.values())),
        "servo_effort": ("a hinge", any(k.hinge is not None for k in kinds.values())),
    }
    what, present = needs.get(key, ("", True))
    if not present:
        raise InputError(f"--free {text}", f"a robot with {what}", "none")
    law = key.partition(".")[0]
    used = {*robot.fluid.drag}
    if "." in key and law not in used:
        raise InputError(
            f"--free {text}", f"a law that acts on this robot ({', '.join(sorted(used))})", law
        )


def _before_thrust(module: Module) -> ModuleType:
    """A module's type with its thruster's numbers, before its thrust and factors."""
    own = {key: x for key, x in module.params.items() if key == "thruster"}
    return apply_overrides(module.base or module.kind, own)


def _plain_value(
    text: str, name: str, kinds: Mapping[str, ModuleType], body: Morphology
) -> Parameter | None:
    """A number with a unit, or a thruster's, which may differ from module to module."""
    name = "thruster.time_constant" if name == "thruster_lag" else name
    given = {m.name: m.params for m in body.modules}
    # The types' numbers are after the modules' own factors, which apply to what is put here, too.
    own = lambda module, key: given[module].get("factors", {}).get(key, 1.0)  # noqa: E731
    head, _, field = name.partition(".")
    if head == "thruster" and field in _THRUSTER:
        jets = {
            module: part.thruster
            for module, kind in kinds.items()
            for part in kind.parts
            if part.thruster is not None
            and getattr(part.thruster, field) is not None
            # A curve's values are no gain, and a thrust that is given sets the gain.
            and not (field == "gain" and part.thruster.curve == "interpolated")
            and not (field == "gain" and "thrust" in given[module])
        }
        if not jets:
            raise InputError(f"--free {text}", f"a robot with a thruster's {field}", "none")
        if field == "time_constant":
            start = max(jet.time_constant for jet in jets.values()) or _USUAL_LAG
            lag = lambda v: {m: {"thruster": {field: v}} for m in jets}  # noqa: E731
            return Parameter(text, "s", start, math.log(_THRUSTER[field]), True, lag)
        for module in jets:  # params of a module are of all of its thrusters
            parts = (part.thruster for part in kinds[module].parts)
            if len({getattr(jet, field) for jet in parts if jet is not None}) > 1:
                raise InputError(f"--free {text}", f"thrusters alike in {module}", "several")

        # The modules' own thrust and factors apply to what is put here, too.
        bare = {
            m.name: getattr(part.thruster, field)
            for m in body.modules
            if m.name in jets
            for part in _before_thrust(m).parts
            if part.thruster is not None
        }

        def scaled(value: float) -> dict[str, Any]:
            return {m: {"thruster": {field: value * x}} for m, x in bare.items()}

        return Parameter(text, "", 1.0, math.log(_THRUSTER[field]), True, scaled)
    if head not in ("ballast", "ballast_position"):
        return None
    if len(kinds) > 1:
        raise InputError(f"--free {text}", "@ and one module, as ballast@core", "more")
    [(module, kind)] = kinds.items()
    part = kind.parts[0]
    at = list(part.ballast_position)
    if name == "ballast":
        most = _BALLAST_SHARE * body.mass
        start = part.ballast_mass or most
        spread = math.log(2.0) if part.ballast_mass else 1.0
        # What has none of a place is spread over the module, and so is what is found.
        spread_out = given[module].get("ballast") and part.ballast_mass == 0
        place = {} if spread_out else {"ballast_position": at}
        put = lambda v: {module: {"ballast": v / own(module, "mass")} | place}  # noqa: E731
        return Parameter(text, "kg", start, spread, True, put)
    if field not in ("x", "y", "z"):
        return None
    axis = "xyz".index(field)

    def moved(value: float) -> dict[str, Any]:
        return {module: {"ballast_position": [*at[:axis], value, *at[axis + 1 :]]}}

    return Parameter(text, "m", at[axis], _BALLAST_PLACE, False, moved)
