"""Controllers with a rate of their own: what a brain does depends on no timestep of the world.

Revolve and revolve2 command servos at 20 Hz, Gymnasium environments at about as much. In between
targets are held, or ramp from the last command to this one, as servos with a profile and boards
that interpolate have it: a ramp arrives one period late, and does not jerk.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.control.controller import Controller, StepOutput
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensors import count_samples
from mjx_revolve.engine.plant import Plant
from mjx_revolve.numerics.xla import fuse


class HeldState(NamedTuple):
    """State of a controller whose commands are held.

    Attributes:
        number: of the last command, -1 before the first.
        own: the controller's state after it.
        ctrl: it, `[n, lanes]` [rad, -]; () where there are no actuators.
        last: the command before it, where commands ramp; else ().
    """

    number: jax.Array
    own: Any
    ctrl: Any
    last: Any


def hold_commands(controller: Controller, plant: Plant, ramp: bool = False) -> Controller:
    """A controller that acts `plant.rate` times a second, its commands held in between, or ramped.

    Command k is due at k / rate, and is given at the first of the world's steps from then on, with
    the readings of that step and the time k / rate: a controller that depends on the time alone
    gives the same commands at any timestep. The first is due at time 0, which is the robot's birth
    in a colony.

    Args:
        controller: made for `plant`; its own steps are `plant.timestep` apart.
        plant: from `Plant.at_rate`.
        ramp: whether targets go evenly from the last command to this one until the next is due.

    Returns:
        The controller; its `step` is called at each of the world's steps.
    """
    rate = plant.rate
    assert rate is not None

    def decode(genes: jax.Array, body: Plant) -> Any:
        lanes = genes.shape[1:]
        # XLA takes nothing of no size into its loops.
        still = jnp.zeros((body.num_rows, *lanes), genes.dtype) if body.num_rows else ()
        begin = HeldState(jnp.full(lanes, -1, genes.dtype), (), still, still if ramp else ())
        return controller.decode(genes, body.at_rate(rate)), begin

    def init(parameters: Any) -> HeldState:
        own, begin = parameters
        return begin._replace(own=controller.init(own))

    def step(
        parameters: Any, state: HeldState, time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        last, before, held, start = state
        number = count_samples(time, rate)
        due = number != last

        def act(given: tuple[Any, Any]) -> tuple[Any, Any]:
            own, ctrl = controller.step(parameters[0], given[0], number / rate, sense)
            return own, jnp.broadcast_to(ctrl, held.shape) if len(held) else ()

        def pick(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(due if old.ndim else due[0], new, old)

        if jnp.ndim(time):  # robots of different ages
            own, ctrl = jax.tree.map(pick, act((before, held)), (before, held))
        else:  # what is not due is not computed
            own, ctrl = jax.lax.cond(due[0], fuse(act, inline=True), lambda x: x, (before, held))
        shown = ctrl if len(ctrl) else jnp.zeros((0, *last.shape), last.dtype)
        number = jnp.broadcast_to(number, last.shape)
        if ramp and len(ctrl):  # the first command stands until the second
            start = jnp.where(due, jnp.where(last < 0, ctrl, held), start)
            shown = start + jnp.clip(time * rate - number, 0, 1) * (ctrl - start)
        return HeldState(number, own, ctrl, start), shown

    return controller._replace(decode=decode, init=init, step=step, rate=rate)
