"""Factors on coefficients: the same as a world, a module or a servo that has them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import (
    QUICK,
    WATER,
    accelerate,
    body,
    box_robot,
    oar_robot,
    random_states,
    with_motors,
    world,
)
from mjx_revolve.body.module_types import Thruster
from mjx_revolve.engine.population import acceleration, tree_plant
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.single_tree import make_single_tree
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.water.flow import water_of

BOX = (0.2, 0.1, 0.06)
CUBE = {"mass": 1.0, "center_of_volume": (0.01, 0.0, 0.0)}


def push(robot, states, variation=None, ctrl=None) -> np.ndarray:
    """Accelerations of lanes of states, `[nv, lanes]`."""
    levels = make_single_tree(robot)
    ctrl = np.zeros((robot.mj_model.nu, states[0].shape[1])) if ctrl is None else ctrl

    def run(qpos, qvel, ctrl, variation):
        own = levels if variation is None else levels.with_variation(variation)
        asked = tree_plant(levels).arrange(ctrl)
        return acceleration(own, qpos, qvel, asked, water_of(robot.world))

    with jax.enable_x64(True):
        arrays = jax.tree.map(jnp.asarray, (*states, ctrl, variation))
        return np.asarray(jax.jit(run, compiler_options=QUICK)(*arrays))


# A factor, and a box or a world that has it in its coefficients.
WORTH = {
    "density": (1.2, {}, {"density": 1200.0}),
    "drag": (1.3, {"drag_coefficient": 1.05 * 1.3}, {}),
    "added_mass": (0.7, {"added_mass_coefficient": 0.7}, {}),
}


@pytest.mark.slow
@pytest.mark.parametrize("drag", ["faces", "lift_drag"])
def test_a_factor_is_worth_a_coefficient(drag):
    """In three lanes each, none in the last three; a plate's coefficients are its own."""
    names = [name for name in WORTH if (name, drag) != ("drag", "lift_drag")]
    worth = np.array([WORTH[name][0] for name in names])
    factors = np.repeat(1 + (worth - 1)[:, None] * np.eye(len(names), len(names) + 1), 3, 1)
    tank = {**WATER, "density": 1000.0, "drag": drag}
    plain = box_robot(BOX, tank=world(**tank), **CUBE)
    states = random_states(plain, factors.shape[1], depth=0.0)
    found = push(plain, states, Variation(**dict(zip(names, factors, strict=True))))
    usual = accelerate(plain, *states)
    np.testing.assert_allclose(found[:, -3:], usual[:, -3:], rtol=1e-9, atol=1e-12)
    for k, name in enumerate(names):
        _, part, fields = WORTH[name]
        own = slice(3 * k, 3 * k + 3)
        other = box_robot(BOX, tank=world(**tank | fields), **CUBE | part)
        expected = accelerate(other, *states)[:, own]
        np.testing.assert_allclose(found[:, own], expected, rtol=1e-9, atol=1e-12)
        assert not np.allclose(found[:, own], usual[:, own], rtol=1e-3)


@pytest.mark.slow
def test_a_faster_motor_and_one_lane_each():
    arm = oar_robot(world(**WATER))
    qpos, qvel = random_states(arm, 2, speed=0.3)
    qvel[6:] = 4.6  # between the knee and the top speed
    ctrl = np.full((arm.mj_model.nu, 2), 1.0)
    factors = np.array([0.8, 1.25])
    found = push(arm, (qpos, qvel), Variation(motor=factors), ctrl)
    for lane, factor in enumerate(factors):
        other = with_motors(arm, factor)
        one = slice(lane, lane + 1)
        expected = push(other, (qpos[:, one], qvel[:, one]), None, ctrl[:, one])
        np.testing.assert_allclose(found[:, one], expected, rtol=1e-9)


def test_motors_without_a_limit_have_none_after_it():
    arm = with_motors(build_robot(body("spider"), world(**WATER)), np.inf)
    levels = make_single_tree(arm)
    varied = levels.with_variation(Variation(motor=0.5))
    for before, after in zip(levels.below, varied.below, strict=True):
        assert after.hinges.motor == before.hinges.motor


PUSHES = {
    "dead_band": {"gain": 2.0, "gain_backward": 1.5, "dead_band": (-0.1, 0.1)},
    "interpolated": {"commands": (-1.0, 0.2, 1.0), "thrusts": (-2.0, 0.0, 3.0)},
}


@pytest.mark.parametrize("curve", PUSHES)
def test_a_stronger_thruster_is_one_with_another_curve(curve):
    """Ahead and astern, its power too: the same episodes."""
    pusher, swum = Thruster(curve=curve, time_constant=0.1, **PUSHES[curve]), []
    for own, factor in ((1.0, 1.3), (1.3, 1.0)):
        robot = box_robot(BOX, tank=world(**WATER), thruster=pusher.scaled(own), **CUBE)
        varied = Variation(motor=factor)
        swum += [simulate(robot, [x], 0.1, variation=varied) for x in (0.9, -0.8)]
    for one, other in zip(swum[:2], swum[2:], strict=True):
        np.testing.assert_allclose(one.qvel, other.qvel, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(one.power, other.power, rtol=1e-4)
        assert one.power[-1] > 0.01
