"""One small network shared by all joints, with messages between neighbours.

The weights are the same at each joint, as in Huang, Mordatch & Pathak 2020 (One policy to control
them all, ICML), so that a brain fits any body. Joints differ in their readings, their positions,
and their neighbours' messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.controller import (
    Controller,
    Gene,
    StepOutput,
    as_plant,
    fade_in,
    lag_share,
    make_controller,
)
from mjx_revolve.control.neighbours import apply_matrix, neighbour_mean
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensors import make_observer
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import sincos
from mjx_revolve.numerics.xla import materialize

# A weight is sin(gene) times this; a choice, large enough to saturate tanh.
_WEIGHT = 2.0
# Unit of the positions that enter the network [m], about two modules; a choice.
_LENGTH = 0.1
# Time constant of messages [s]; a choice. Without a lag, neighbours with opposite responses would
# chatter at the rate of the steps.
_MESSAGE_LAG = 0.05
# Slowest and fastest unit of a recurrent network [s]; choices: a step, and a slow stroke.
_SLOWEST, _FASTEST = 1.0, 0.02

_PLACE = ("one", "x", "y", "z", "away", "axis x", "axis y", "axis z")
_HINTS = ("sine", "cosine")


def make_joint_network(
    body: Plant | Robot,
    sensors: Sequence[Sensor] | None = None,
    hidden: int = 8,
    messages: int = 2,
    max_frequency: float = 2.0,
    amplitude: float = 1.0,
    recurrent: bool = False,
) -> Controller:
    """A network with one hidden layer, the same at each hinge and thruster.

    Inputs of joint i are the robot's observations; those of the joint; its position at rest (x, y,
    z and distance from the core, in 0.1 m) and its axis, core frame; two phase hints,
    sin(2π f t + φ_i) and cos, where φ_i is linear in the position, so that waves can run along the
    body; and the mean of its neighbours' messages, smoothed by a lag of first order (0.05 s). With
    W from the genes,

        h = tanh(W x),  message = U h,  target = middle + amplitude × half range × tanh(v·h),

    and targets fade in over half a second. If recurrent, hidden units are leaky and coupled,
    τ_k ḣ_k = -h_k + tanh((W x + R h)_k), τ_k from 0.02 to 1 s (a continuous-time recurrent
    network, Beer 1995, Adaptive Behavior 3, with bounded states). Thrusters have a v of their own,
    no joint observations and no neighbours. Weights are 2 sin(gene): with zero genes nothing moves
    but to the middle of its range.

    Args:
        body: a plant or a robot.
        sensors: of the observations; by default `DEFAULT_SENSORS`.
        hidden: units of the hidden layer [-].
        messages: numbers that a joint sends to its neighbours [-].
        max_frequency: of the phase hints [Hz].
        amplitude: share of the ranges used [-].
        recurrent: whether hidden units keep a state.

    Returns:
        The controller; the number of its genes does not depend on the body.
    """
    made_for = as_plant(body)
    observer = make_observer(sensors, made_for.timestep, made_for)
    words = [f"message{k + 1}" for k in range(messages)]
    given = [*observer.robot_names, *(f"joint {x}" for x in observer.joint_names)]
    fixed, shared = len(_PLACE), len(observer.robot_names)
    inputs = [*_PLACE, *given, *_HINTS, *words]
    outputs = ["target", *words]
    units = [f"h{k + 1}" for k in range(hidden)]
    names = [f"{x}>{h}" for h in units for x in inputs]
    names += [f"{h}>{x}" for h in units for x in outputs]
    names += [f"{a}>{b}" for b in units for a in units] if recurrent else []
    names += [f"{h} time" for h in units] if recurrent else []
    names += ["frequency", *(f"phase {x}" for x in _PLACE[1:5])]
    names += [f"{h}>thrust" for h in units] if made_for.num_thrusters else []
    genes = [Gene(name, "robot") for name in names]

    def decode(genes: jax.Array, plant: Plant) -> PyTree:
        folded, lanes, start = jnp.sin(genes), genes.shape[1:], 0

        def take(*shape: int) -> jax.Array:
            nonlocal start
            size = int(np.prod(shape))
            found = folded[start : start + size].reshape(*shape, *lanes)
            start += size
            return found

        layer = _WEIGHT * take(hidden, len(inputs))
        out = _WEIGHT * take(hidden, len(outputs))
        back = _WEIGHT * take(hidden, hidden) if recurrent else None
        pace = None
        if recurrent:
            # Interpolated in the logarithm between the slowest and the fastest; 0.14 s for gene 0.
            share = (1 + take(hidden)) / 2
            tau = _SLOWEST * jnp.exp(share * np.log(_FASTEST / _SLOWEST))
            pace = lag_share(made_for, tau)[:, None]
        rate = 2 * np.pi * max_frequency * (1 + take(1)) / 2
        phase = np.pi * take(4)
        target = out[:, :1]
        if made_for.num_thrusters:
            counts = plant.num_hinge_rows, plant.num_thrusters
            both = target, _WEIGHT * take(hidden)[:, None]
            wide = [jnp.repeat(x, n, 1) for x, n in zip(both, counts, strict=True)]
            target = jnp.concatenate(wide, 1)
        place = _places(plant, genes)
        base = sum(layer[:, k, None] * place[k] for k in range(fixed))
        late = [phase[k, None] * place[k + 1] for k in range(4)]
        sine, cosine = sincos(sum(late[1:], late[0]))
        return (
            (base, layer[:, fixed:], back, pace, target, out[:, 1:]),
            (rate, sine, cosine),
            neighbour_mean(genes, plant),
            (amplitude * plant.reach(genes), plant.middle(genes)),
            plant.source[: plant.num_hinge_rows],
        )

    def init(parameters: PyTree) -> PyTree:
        (base, *_), *_, number = parameters
        rows = number.shape[0]
        like = base[0][:rows]
        sent = tuple(jnp.zeros_like(like) for _ in range(messages)) if rows else ()
        return observer.init(like), sent, jnp.zeros_like(base) if recurrent else ()

    def step(
        parameters: PyTree, state: PyTree, time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        network, clock, near, (reach, middle), number = parameters
        base, layer, back, pace, target, message = network
        samples, sent, memory = state
        rows, total = number.shape[0], base.shape[1]
        samples, observation = observer.observe(samples, time, sense, number)

        def of_all(x: jax.Array) -> jax.Array:
            """Values of the hinges, with 0 for thrusters."""
            if rows == total:
                return x
            return jnp.concatenate([x, jnp.zeros((total - rows, *x.shape[1:]), x.dtype)])

        activity = base
        if observation.robot:
            # Inputs common to all joints are summed once.
            alike = layer[:, 0] * observation.robot[0]
            for k, x in enumerate(observation.robot[1:]):  # no reductions inside the loop
                alike = alike + layer[:, k + 1] * x
            activity = activity + materialize(alike)[:, None]
        rate, sine, cosine = clock
        s, c = sincos(rate * time)
        hints = materialize(sine * c + cosine * s), materialize(cosine * c - sine * s)
        received = [materialize(of_all(apply_matrix(near, x))) for x in sent]
        own = [of_all(x) for x in observation.joint]
        later = shared + len(observer.joint_names)
        for start, found in ((shared, own), (later, [*hints, *received])):
            for k, x in enumerate(found):
                activity = activity + layer[:, start + k, None] * x
        if recurrent:
            for k in range(hidden):
                activity = activity + back[:, k, None] * memory[k]
            h = memory = memory + pace * (jnp.tanh(activity) - memory)
        else:
            h = jnp.tanh(activity)
        command = sum(target[k] * h[k] for k in range(hidden))
        share = lag_share(made_for, _MESSAGE_LAG)
        fresh = [sum(message[k, m] * h[k][:rows] for k in range(hidden)) for m in range(len(sent))]
        sent = tuple(old + share * (new - old) for old, new in zip(sent, fresh, strict=True))
        fade = fade_in(time)
        return (samples, sent, memory), fade * middle + fade * reach * jnp.tanh(command)

    found = make_controller(made_for, genes, decode, init, step)
    return found._replace(signals=observer.signals, observer=observer)


def _places(plant: Plant, like: jax.Array) -> list[jax.Array]:
    """The inputs `_PLACE` of each row, `[n, lanes]`."""

    def wide(x: Any) -> jax.Array:
        x = x if isinstance(x, jax.Array) else np.asarray(x, like.dtype)
        return jnp.broadcast_to(x, (plant.num_rows, *like.shape[1:])).astype(like.dtype)

    x, y, z = (wide(plant.place[:, i] / _LENGTH) for i in range(3))
    # The tiny term keeps the gradient finite at the core's centre.
    away = jnp.sqrt(x * x + y * y + z * z + 1e-12)
    return [jnp.ones_like(x), x, y, z, away, *(wide(plant.axis[:, i]) for i in range(3))]
