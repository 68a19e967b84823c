"""The thrusters of robots in a step: commands → lag → thrust → power, all of a robot at once.

The laws are those of `water.thrusters`; here they run over tables, so that thrusters of any curve
stand side by side, in one robot or in many.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.module_types import Thruster
from mjx_revolve.body.placement import counted
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.level import Thrusters
from mjx_revolve.numerics.spatial import cast
from mjx_revolve.water.thrusters import (
    dead_band_thrust,
    ideal_power,
    interpolated_thrust,
    lag_decay,
    lagged_command,
)

# Padding where a robot has fewer thrusters than others.
_PADDING = Thruster(gain=0.0)


def curve_points(thruster: Thruster | None) -> int:
    """How many points a thruster's broken line has; 0 for another curve."""
    return 0 if thruster is None else len(thruster.commands)


def read_thrusters(assembly: Assembly, count: int, points: int = 0) -> Thrusters:
    """The thrusters of robots side by side.

    Args:
        assembly: of the robots.
        count: how many a robot may have; the others do nothing.
        points: room for at least so many points of a curve.

    Returns:
        Tables `[count, robots]`.
    """
    robots, rows = len(assembly.morphologies), assembly.thruster_row
    owner = assembly.layout.body[rows]
    rank = counted(np.bincount(owner, minlength=robots))[1]
    disc = np.zeros((count, robots))
    padded = [[_PADDING] * count for _ in range(robots)]
    size = 2 * assembly.fluid.half_size[rows]
    for k, part in enumerate(assembly.thruster_part):
        assert part.thruster is not None
        padded[owner[k]][rank[k]] = part.thruster
        # The circle in its box, seen along its axis.
        across = np.prod(size[k]) / size[k]
        disc[rank[k], owner[k]] = np.pi / 4 * np.abs(np.asarray(part.thruster.axis)) @ across

    def column(look: Any, dtype: Any = np.float64) -> np.ndarray:
        return np.array([[look(t) for t in some] for some in padded], dtype).T.reshape(
            count, robots
        )

    backward = lambda t: t.gain if t.gain_backward is None else t.gain_backward  # noqa: E731
    most = max([points, *(curve_points(t) for some in padded for t in some)])
    line = None
    if most:
        line = (
            tuple(column(lambda t, k=k: _point(t, k)[0]) for k in range(most)),
            tuple(column(lambda t, k=k: _point(t, k)[1]) for k in range(most)),
            column(lambda t: t.curve == "interpolated", bool),
        )
    return Thrusters(
        count=count,
        low=column(lambda t: t.range[0]),
        high=column(lambda t: t.range[1]),
        kept=lag_decay(column(lambda t: t.time_constant), assembly.world.timestep),
        delayed=column(lambda t: t.time_constant > 0, bool),
        backward=column(backward),
        forward=column(lambda t: t.gain),
        dead_low=column(lambda t: t.dead_band[0]),
        dead_high=column(lambda t: t.dead_band[1]),
        line=line,
        disc=disc,
    )


def _point(thruster: Thruster, k: int) -> tuple[float, float]:
    """A point of a broken line; beyond its last one, level."""
    if thruster.curve != "interpolated":
        return float(k), 0.0
    last = len(thruster.commands) - 1
    return thruster.commands[min(k, last)] + max(k - last, 0), thruster.thrusts[min(k, last)]


def run_thrusters(
    thrusters: Thrusters, lagged: jax.Array, ctrl: jax.Array, density: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The thrusters' part of a step.

    As in MuJoCo's filtered actuators, a command passes its lag at the end of the step, and thrust
    follows the command that had passed at its beginning; without a lag it follows at once.

    Args:
        thrusters: of the robots.
        lagged: their commands behind the lag, `[nthruster, lanes]` [-].
        ctrl: their commands, `[nthruster, lanes]` [-].
        density: of the water [kg/m³].

    Returns:
        The lagged commands after the step, the thrusts, `[nthruster, lanes]` [N], and the power
        that ideal propellers need for them, `[nthruster, lanes]` [W] (`ideal_power`). Above the
        surface, where they push nothing, they are taken to need as much.
    """
    known = partial(cast, like=ctrl)
    clipped = jnp.clip(ctrl, known(thrusters.low), known(thrusters.high))
    after = lagged_command(lagged, clipped, thrusters.kept)
    delayed = thrusters.delayed
    # Folded by XLA, the selection would leave `ctrl` unused in its piece of the step: it aborts.
    every = isinstance(delayed, np.ndarray) and bool(delayed.all())
    acting = lagged if every else jnp.where(delayed, lagged, clipped)
    curve = thrusters.backward, thrusters.forward, thrusters.dead_low, thrusters.dead_high
    push = dead_band_thrust(acting, *map(known, curve))
    if thrusters.line is not None:
        commands, thrusts, is_line = thrusters.line
        line = interpolated_thrust(acting, *(list(map(known, x)) for x in (commands, thrusts)))
        push = jnp.where(is_line, line, push)
    return after, push, ideal_power(push, known(thrusters.disc), density)
