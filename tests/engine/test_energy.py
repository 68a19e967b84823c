"""Energy balances: they close where motors, water, bed and contact are right, and only there."""

import numpy as np
import pytest

from laboratory import ARM, OAR, fork, read
from mjx_revolve import build_robot, load_morphology, load_world, simulate
from mjx_revolve.engine.energy import energy_balance
from mjx_revolve.engine.forces import motor_torques
from mjx_revolve.engine.variation import Variation
from mjx_revolve.water.flow import water_of

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("quick_compiles")]


def swing(morphology, depth, seconds=3.0, variation=None, phase=2.0, **fields):
    """A robot whose motors follow sines, and what it did."""
    robot = build_robot(morphology, load_world("lake", **{"bed": None} | fields))
    count, dt = robot.mj_model.nu, robot.world.timestep
    time = dt * np.arange(round(seconds / dt))[:, None]
    ctrl = 0.7 * np.sin(2 * np.pi * time + phase * np.arange(count))
    qpos = np.array(robot.start_qpos())
    qpos[2] = robot.world.surface_height - depth
    return robot, simulate(robot, ctrl, qpos=qpos, once=True, variation=variation)


def balance(robot, found, variation=None, factor=1.0):
    rows = found.qpos, factor * found.qvel, found.ctrl, found.command
    return energy_balance(robot, *rows, water_of(robot.world), variation)


def test_a_swimmer_in_a_current_and_in_other_water():
    drawn = Variation(drag=1.4, added_mass=0.8, density=1.0, motor=0.7)
    robot, found = swing(read(OAR), 2.0, variation=drawn, drag="cross_flow", current=(0.2, 0, 0))
    own = balance(robot, found, drawn)
    assert own.residual < 0.03
    assert own.drag > 0 and own.joints > 0 and own.contact == 0 < own.work
    # Torques as passports and bags have them do the same work.
    speed = np.asarray(found.qvel)[:, 6:]
    turned = robot.world.timestep * (speed[1:] + speed[:-1]) / 2
    work = motor_torques(robot, found.qpos, found.qvel, found.ctrl, drawn)[1:] * turned
    assert work.sum() == pytest.approx(own.given, rel=1e-3)
    assert np.abs(work).sum() == pytest.approx(own.work, rel=1e-3)
    # Neither other coefficients nor other velocities fit.
    assert balance(robot, found).residual > 2 * own.residual
    assert balance(robot, found, drawn, 1.2).residual > 0.1


@pytest.mark.sampled(1)
@pytest.mark.parametrize("timestep", [0.005, 0.00125])
def test_arms_that_clap(timestep):
    """Where modules hit each other energy is lost, and never made."""
    robot, found = swing(
        fork(3, 1), 2.0, phase=np.pi, self_contact=True, bed=None, timestep=timestep
    )
    own = balance(robot, found)
    assert own.contact > 0.005 * own.work
    assert own.residual < (0.05 if timestep > 0.002 else 0.03)


@pytest.mark.long
def test_a_crawler_gives_energy_to_the_bed():
    robot, found = swing(read(ARM), 0.08, bed={"kind": "flat", "height": -0.1})
    own = balance(robot, found)
    assert own.contact > 0.02 * own.work and own.residual < 0.05


def test_what_water_takes_at_the_surface():
    """A slam, and water that joins or leaves what a robot carries."""
    robot, found = swing(read(ARM), -0.15, drag="faces")
    assert balance(robot, found).residual < 0.015


@pytest.mark.long
def test_waves_that_a_robot_makes_are_drag():
    robot, found = swing(read(OAR), 0.0, near_surface=True)
    calm = build_robot(read(OAR), load_world("lake", bed=None))
    own, other = balance(robot, found), balance(calm, found)
    assert own.residual < 0.005 and own.potential == pytest.approx(other.potential, rel=1e-4)


def test_thrusters():
    robot, found = swing(load_morphology("auv"), 2.0)
    own = balance(robot, found)
    assert own.joints == 0 < own.drag and own.residual < 0.01


@pytest.mark.long
def test_what_a_trajectory_cannot_tell():
    robot, found = swing(read(OAR), 2.0, 0.1, shear={"velocity": [0.2, 0, 0]})
    assert balance(robot, found) is None
