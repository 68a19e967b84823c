"""Phase oscillators with feedback from sensors on phases, amplitudes and offsets."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.controller import (
    Controller,
    GeneBlocks,
    StepOutput,
    as_plant,
    fade_in,
    lag_share,
    make_controller,
)
from mjx_revolve.control.neighbours import apply_matrix, pair_matrix
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensors import make_observer
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import Scalar, sincos
from mjx_revolve.numerics.xla import materialize

# Time constant of amplitudes and offsets [s], and coupling strength between neighbours [rad/s]:
# choices, a fifth of a second, and phases that settle within a stroke.
_FOLLOW, _PULL = 0.2, 10.0
# The longest step of the phases [s]: a joint with ten neighbours settles without overshoot.
_PHASE_STEP = 0.0125
# Phases beyond this lose whole turns [rad]: after hours float32 lacks the digits for their steps.
# As far as `sincos` is exact; no episode of minutes gets there.
_MOST_PHASE = 8192.0


def make_sensory_cpg(
    body: Plant | Robot,
    sensors: Sequence[Sensor] | None = None,
    max_frequency: float = 2.0,
    amplitude: float = 1.0,
    gain: float = 1.0,
) -> Controller:
    """One phase oscillator per hinge, neighbours coupled, with feedback from sensors.

    After Ijspeert, Crespi, Ryczko & Cabelguen 2007 (Science 315), amplitudes of first order:

        θ̇_i = 2π f + Σ_j w sin(θ_j - θ_i - φ_ij) + 2π f_max gain Σ_k P_ik s_k,
        ṙ_i = a (A_i + gain Σ_k R_ik s_k - r_i),   ȯ_i = a (B_i + gain Σ_k O_ik s_k - o_i),

    with s the observation, φ_ij = -φ_ji, and both sums clipped to ±1. Target of hinge i: middle +
    amplitude × half range × clip(o_i + r_i sin θ_i, ±1). All states start at 0, and the
    middle fades in, so with zero genes nothing moves but to there. A command has the phases of its
    time, and the r and o that the lag reaches a period later: a reflex answers at once, and the
    first command is that far on its way (a period of 50 ms: 22 %). Thrusters have o only, and only
    observations of the robot as a whole.

    Args:
        body: a plant or a robot.
        sensors: of the feedback; by default `DEFAULT_SENSORS`.
        max_frequency: upper end of f [Hz].
        amplitude: share of the ranges used [-].
        gain: largest response to a sensor at the end of its range, as a share of half the hinge's
            range [-].

    Returns:
        The controller; genes: A, B, then P, R and O of each sense, per hinge; φ per pair; f; B and
        O per thruster. All are sin(gene), but φ = π sin(gene), f = f_max (1 + sin(gene)) / 2.
    """
    made_for = as_plant(body)
    observer = make_observer(sensors, made_for.timestep, made_for)
    robot, joint = observer.robot_names, observer.joint_names
    own, few = [*robot, *(f"joint {x}" for x in joint)], len(robot)
    # P, R and O: how the observation acts on phase, amplitude and offset.
    on_phase, on_size = ([f"{what} {x}" for x in own] for what in ("phase", "amplitude"))
    on_offset, on_bend = ([f"offset {x}" for x in some] for some in (own[:few], own[few:]))
    blocks = GeneBlocks(
        made_for,
        *((what, "hinge") for what in ("amplitude", *on_phase, *on_size, *on_bend)),
        ("lag", "pair"),
        ("frequency", "robot"),
        *((what, "actuator") for what in ("offset", *on_offset)),
    )
    # Integration steps of the phases between two commands; one without a rate (older versions).
    count = 1 if made_for.rate is None else math.ceil(made_for.timestep / _PHASE_STEP - 1e-6)
    dt = made_for.timestep / count

    def decode(genes: jax.Array, plant: Plant) -> PyTree:
        values = blocks.split(jnp.sin(genes), plant)
        some = lambda names: [values[name] for name in names]  # noqa: E731
        sine, cosine = sincos(np.pi * values["lag"])
        return (
            (values["amplitude"], some(on_phase), some(on_size)),
            (values["offset"], some(on_offset), some(on_bend)),
            np.pi * max_frequency * (1 + values["frequency"]),
            (pair_matrix(cosine, cosine, plant), pair_matrix(sine, -sine, plant)),
            (amplitude * plant.reach(genes), plant.middle(genes)),
            plant.source[: plant.num_hinge_rows],
        )

    def init(parameters: PyTree) -> PyTree:
        still, bias = jnp.zeros_like(parameters[0][0]), jnp.zeros_like(parameters[1][0])
        # XLA's loops cannot carry arrays of size 0.
        return observer.init(still), (still, still) if still.shape[0] else (), bias

    def step(
        parameters: PyTree, state: PyTree, time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        waves, offsets, rate, near, (reach, middle), number = parameters
        center = fade_in(time) * middle
        (size, on_phase, on_size), (bias, on_offset, on_bend) = waves, offsets
        samples, oscillators, offset = state
        samples, observation = observer.observe(samples, time, sense, number)
        inputs = [*observation.robot, *observation.joint]

        def respond(weights: Iterable[Scalar], inputs: Iterable[Scalar]) -> Scalar:
            terms = [w * x for w, x in zip(weights, inputs, strict=True)]
            return gain * sum(terms) if terms else 0.0

        follow = lag_share(made_for, _FOLLOW)
        aim = bias + respond(on_offset, inputs[:few])
        if not oscillators:
            offset = offset + follow * (jnp.clip(aim, -1, 1) - offset)
            return (samples, (), offset), center + reach * jnp.clip(offset, -1, 1)
        phase, swing = oscillators
        rows = phase.shape[0]
        speed = rate + 2 * np.pi * max_frequency * respond(on_phase, inputs)
        sine, cosine = sincos(phase)
        along, across = near
        begun = sine
        for k in range(count):
            if k:
                sine, cosine = map(materialize, sincos(phase))
            # sin(θ_j - φ - θ_i) by the addition theorem, so that each phase has one sine.
            up = apply_matrix(along, sine) - apply_matrix(across, cosine)
            level = apply_matrix(along, cosine) + apply_matrix(across, sine)
            phase = phase + dt * (speed + _PULL * (cosine * up - sine * level))
        turns = 2 * np.pi * jnp.round(phase / (2 * np.pi))
        phase = jnp.where(jnp.abs(phase) > _MOST_PHASE, phase - turns, phase)
        if on_bend:
            more = aim[:rows] + respond(on_bend, inputs[few:])
            aim = more if rows == aim.shape[0] else jnp.concatenate([more, aim[rows:]])
        size_aim = jnp.clip(size + respond(on_size, inputs), -1, 1)
        swing = swing + follow * (size_aim - swing)
        offset = offset + follow * (jnp.clip(aim, -1, 1) - offset)
        wave = offset[:rows] + swing * begun
        command = wave if rows == offset.shape[0] else jnp.concatenate([wave, offset[rows:]])
        target = center + reach * jnp.clip(command, -1, 1)
        return (samples, (phase, swing), offset), target

    found = make_controller(made_for, blocks.genes, decode, init, step)
    return found._replace(signals=observer.signals, observer=observer)
