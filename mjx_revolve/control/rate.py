"""Controllers with a rate of their own, independent of the world's timestep.

Revolve and revolve2 command servos at 20 Hz, Gymnasium environments at about the same rate. Between
two commands targets are held, or ramp linearly from the command before to the last one, as in
servos with a profile and boards that interpolate. A ramp arrives one period late, without jerks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from mjx_revolve.control.controller import Controller, StepOutput
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensors import count_samples
from mjx_revolve.engine.plant import Plant
from mjx_revolve.numerics.xla import fuse


class HeldState(NamedTuple):
    """State of a controller with held commands.

    Attributes:
        number: of the last command, -1 before the first.
        own: the controller's state after it.
        ctrl: last command, `[n, lanes]` [rad, -]; () if there are no actuators.
        last: the command before the last, if commands ramp; else ().
    """

    number: jax.Array
    own: PyTree
    ctrl: Any
    last: Any


def hold_commands(controller: Controller, plant: Plant, ramp: bool = False) -> Controller:
    """A controller that acts `plant.rate` times a second, its commands held in between, or ramped.

    Command k is due at k / rate. It is computed at the first of the world's steps from then on,
    from the readings of that step and the time k / rate: a controller that depends on time alone
    gives the same commands at any timestep. The first is due at time 0; in a colony, at birth.

    Args:
        controller: made for `plant`; its own steps are `plant.timestep` apart.
        plant: from `Plant.at_rate`.
        ramp: whether targets ramp linearly from the command before to the last one.

    Returns:
        The controller; its `step` is called at each of the world's steps.
    """
    rate = plant.rate
    assert rate is not None

    def decode(genes: jax.Array, body: Plant) -> PyTree:
        lanes = genes.shape[1:]
        # XLA's loops cannot carry arrays of size 0.
        still = jnp.zeros((body.num_rows, *lanes), genes.dtype) if body.num_rows else ()
        begin = HeldState(jnp.full(lanes, -1, genes.dtype), (), still, still if ramp else ())
        return controller.decode(genes, body.at_rate(rate)), begin

    def init(parameters: PyTree) -> HeldState:
        own, begin = parameters
        return begin._replace(own=controller.init(own))

    def step(
        parameters: PyTree, state: HeldState, time: jax.Array, sense: SensorReadings
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
        else:  # a command that is not due is not computed
            own, ctrl = jax.lax.cond(due[0], fuse(act, inline=True), lambda x: x, (before, held))
        shown = ctrl if len(ctrl) else jnp.zeros((0, *last.shape), last.dtype)
        number = jnp.broadcast_to(number, last.shape)
        if ramp and len(ctrl):  # the first command stands until the second
            start = jnp.where(due, jnp.where(last < 0, ctrl, held), start)
            shown = start + jnp.clip(time * rate - number, 0, 1) * (ctrl - start)
        return HeldState(number, own, ctrl, start), shown

    return controller._replace(decode=decode, init=init, step=step, rate=rate)
