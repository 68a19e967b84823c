"""The motor curve at its corners, where a division by zero would end a rollout."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.random_bodies import random_body
from laboratory import batch_engine, body, elbow_robot, read, world
from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.engine.assembly import FULL_TORQUE_ERROR
from mjx_revolve.engine.batch import fit_capacity
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.servos import servo
from mjx_revolve.engine.single_tree import make_single_tree
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import load_world


@pytest.fixture(scope="module")
def hinges():
    return make_single_tree(elbow_robot(world())).below[0].hinges


def curve(hinges, speed, target):
    zero = jnp.zeros_like(speed)
    return servo(hinges, zero, speed, target, 0.005, zero + 1e-4, zero)


@pytest.mark.slow
def test_the_curve_is_finite_exactly_at_the_top_speed(hinges):
    """For every push from none through the friction that it meets there to full effort."""
    friction, slope, top = (np.float32(np.max(x)) for x in hinges.motor)
    gain = float(np.max(hinges.gain))
    push = np.linspace(-1, 1, 41, dtype=np.float32) * np.float32(np.max(hinges.effort[1]))
    push = np.append(push, [friction, -friction, 0.5 * friction, 1e-9])
    for speed in (top, -top, np.nextafter(top, np.float32(0)), np.nextafter(top, np.float32(9))):
        speeds = jnp.full((1, push.size), speed, jnp.float32)
        targets = jnp.asarray(push / gain, jnp.float32)[None]
        torque, inertia = curve(hinges, speeds, targets)
        assert np.isfinite(torque).all() and np.isfinite(inertia).all()
        assert (inertia >= 0).all()
        # No push beyond what friction eats; slope times rounding is the tolerance.
        forward = np.asarray(torque)[0] * np.sign(speed)
        assert forward.max() <= friction + 4 * slope * np.spacing(top)
        slopes = jax.grad(lambda x, t=targets: sum(map(jnp.sum, curve(hinges, x, t))))(speeds)
        assert np.isfinite(slopes).all()


def test_below_the_knee_the_servo_is_mujocos(hinges):
    """clip(k_p (target - q), ± effort), and nothing implicit, at rest under a small push."""
    gain, effort = float(np.max(hinges.gain)), float(np.max(hinges.effort[1]))
    target = jnp.asarray([[1e-6, -1e-6]], jnp.float32)
    torque, inertia = curve(hinges, jnp.zeros((1, 2), jnp.float32), target)
    assert np.asarray(torque) == pytest.approx(gain * np.asarray(target), rel=1e-5)
    assert np.abs(torque).max() < effort
    assert (inertia == 0).all()


@pytest.mark.parametrize("timestep", [0.0025, 0.005, 0.01, 0.02])
def test_a_servo_is_as_stiff_at_every_step(timestep):
    """Without speed, torque is the stiffness times the error, up to the effort; the step adds 0.36
    dt² times the implicit part of the stiffness to the inertia (Newmark's β at γ = 0.2).
    """
    robot = build_robot(body("centipede"), load_world("lake", timestep=timestep))
    assembly = robot.assembly
    assert assembly.stiffness[2:] == pytest.approx(
        assembly.effort[2:] / FULL_TORQUE_ERROR, rel=1e-12
    )
    assert (assembly.implicit_stiffness[2:].max() > 0) == (timestep >= 0.005)
    for level in make_single_tree(robot, contact=False).below:
        hinges = level.hinges
        still = jnp.zeros((level.count, 2), jnp.float32)
        target = still + jnp.asarray([0.02, 0.2])
        torque, inertia = servo(hinges, still, still, target, timestep, still + 1e-4, still)
        effort = np.broadcast_to(hinges.effort[1], (level.count, 1))[:, 0]
        stiffness = effort / FULL_TORQUE_ERROR
        assert np.asarray(torque) == pytest.approx(np.c_[stiffness * 0.02, effort], rel=1e-5)
        rest = np.broadcast_to(hinges.implicit_stiffness, (level.count, 1))[:, 0]
        assert (np.asarray(inertia)[:, 0] >= 0.36 * timestep**2 * rest * (1 - 1e-6)).all()


@pytest.mark.sampled(1)
@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.005, 0.0125])
def test_hinges_that_reverse_together_do_not_push_each_other_far_beyond_the_top_speed(dt):
    """Chains of light hinges whose targets jump between their limits at every step.

    What others push on is no motor's doing: so it is in steps of 0.3 ms, too, to 1.85 times the
    top speed. Where motors went on pushing it was 2.9 (12.5 ms) and 3.5 times (5 ms).
    """
    waters = load_world("lake", bed=False, self_contact=False, timestep=dt)
    kinds = [(18, 6), (38, 5), (47, 7), (19, 7)]
    robots = [
        build_robot(trim_neutral(random_body(s, n, (s // 7) % 5), waters.density), waters)
        for s, n in kinds
    ]
    capacity = fit_capacity(robots, (), False, 0, 0, 0, ())
    engine = batch_engine(robots, capacity, len(robots), np.float32)
    low, high = engine.plant.low, engine.plant.high
    start = np.zeros((7 + low.shape[0], len(robots)), np.float32)
    start[2], start[3] = -3, 1
    jumps = np.random.default_rng(3).integers(0, 2, (round(3 / dt), *low.shape)).astype(np.float32)

    def step(state, jump):
        state, _ = engine.step(state, low + (high - low) * jump, water_of(waters))
        return state, engine.joints(state)[1]

    begin = engine.init(jnp.asarray(start), jnp.zeros_like(start[1:]))
    speed = np.asarray(jax.jit(lambda x: jax.lax.scan(step, begin, x)[1])(jnp.asarray(jumps)))
    there = np.asarray(engine.plant.source)[: speed.shape[1]] < [r.num_hinges for r in robots]
    ratio = np.where(there, np.abs(speed), 0) / 5.235988
    assert ratio.max() < 1.85
    assert np.quantile(ratio[:, there], 0.5) > 0.3  # they do move


CHAIN = "body: {type: Core, children: {1: {type: ActiveHinge, children: {1: {type: ActiveHinge, "
CHAIN += "children: {1: {type: FixedBrick, children: {1: {type: FixedBrick}}}}}}}}}"


@pytest.mark.slow
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("limbs", "timestep", "depth"), [
    (read(CHAIN), 0.0125, 1), (body("snake"), 0.005, -3), (body("salamander"), 0.02, 1)
])  # fmt: skip
def test_limbs_come_to_rest_after_jumps_of_their_targets(limbs, timestep, depth):
    """Those of a light base, with no water to slow them, and light ones at the torque's limit."""
    robot = build_robot(limbs, load_world("lake", bed=None, gravity=0.0, timestep=timestep))
    jumps = np.random.default_rng(0).uniform(-0.78, 0.78, (8, robot.mj_model.nu))
    targets = np.repeat([*jumps, *0 * jumps], round(0.4 / timestep), 0)
    start = np.where(np.arange(7 + len(jumps[0])) == 2, -depth, robot.start_qpos())
    speeds = np.abs(np.asarray(simulate(robot, targets, qpos=start, once=True).qvel)[:, 6:])
    assert speeds[: len(targets) // 2].max() > 2
    assert speeds[-len(targets) // 8 :].max() < 0.1
