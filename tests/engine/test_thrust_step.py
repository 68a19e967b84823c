"""Thrusters and fins in whole steps: steady speed, lag, torque, MuJoCo's actuators, the fish."""

import re
from dataclasses import replace

import jax
import numpy as np
import pytest

from laboratory import (
    WATER,
    accelerate,
    at_rest,
    body,
    box_robot,
    face_drag,
    march,
    random_states,
    world,
)
from mjx_revolve.body.module_types import Thruster
from mjx_revolve.engine.robot import build_robot, check_timestep
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.world import load_world
from references import check_mujocos_steps

RHO, G = 999.1026, 9.81
CUBE = (0.1, 0.1, 0.1)
NEUTRAL = RHO * 1e-3
pytestmark = pytest.mark.usefixtures("quick_compiles")


def driven(tank, **thruster):
    """A neutral cube with a thruster in its centre."""
    return box_robot(CUBE, NEUTRAL, tank, thruster=Thruster(**thruster))


def test_speed_under_thrust():
    """v = v_t tanh(t / τ), v_t² = T / (½ ρ C_d A), τ = (m + m_a) v_t / T; 0.2 % of it at 5 ms."""
    robot = driven(world(**WATER), gain=0.5)
    qpos, qvel = at_rest(robot, 3, -5.0)
    commands = np.array([[1.0, 0.5, -0.7]])
    time, _, v, work = march(robot, 20.0, qpos, qvel, commands, every=10)
    force = 0.5 * commands[0] * np.abs(commands[0])
    steady = np.sqrt(np.abs(force) / (face_drag(robot).linear[0, 0])) * np.sign(force)
    inertia = NEUTRAL + RHO * robot.fluid.added_mass[0, 0]
    expected = steady * np.tanh(time[:, None] * force / (inertia * steady))
    assert v[:, 0] == pytest.approx(expected, abs=0.002 * steady[0])
    assert v[-1, 0, 0] == pytest.approx(steady[0], rel=1e-4)
    assert np.abs(v[:, 1:]).max() < 1e-9
    # Froude's ideal propeller, over the face across its axis unless it says otherwise.
    assert np.all(work > 0)
    assert work[0, 0] / work[0, 1] == pytest.approx(0.25**-1.5, rel=1e-3)


def test_a_trajectory_tells_the_command_behind_its_lag():
    """s = x (1 - e^(-t/τ)), held or beyond the range, in float64; thrust follows it by a step."""
    tau, dt = 0.1, 0.005
    robot = driven(world(**WATER), gain=0.5, time_constant=tau)
    start = robot.start_qpos(5.0)
    with jax.enable_x64(True):
        found = simulate(robot, [3.0], 0.5, qpos=start)
    time = np.asarray(found.time)
    assert found.command[:, 0] == pytest.approx(1 - np.exp(-time / tau), rel=1e-12)
    assert np.all(np.asarray(found.ctrl) == 3.0)
    inertia = NEUTRAL + RHO * robot.fluid.added_mass[0, 0]
    assert found.qvel[0, 0] == pytest.approx(0.0, abs=1e-12)
    second = dt * 0.5 * (1 - np.exp(-dt / tau)) ** 2 / inertia
    assert found.qvel[1, 0] == pytest.approx(second, rel=1e-6)


def test_a_propeller_turns_its_robot_the_other_way():
    """α = -c T / (I + A') about the axis, whichever way that points; a cube carries no spin."""
    axis, ratio = np.array([1.0, 2.0, -2.0]) / 3, -0.02
    robot = driven(world(added_mass=True), gain=0.5, torque_ratio=ratio, axis=tuple(axis))
    qacc = accelerate(robot, *at_rest(robot, 1, -5.0), np.ones((1, 1)))[:, 0]
    inertia = NEUTRAL * 0.1**2 / 6 + RHO * robot.fluid.added_inertia[0, 0]
    carried = NEUTRAL + RHO * robot.fluid.added_mass[0, 0]
    assert qacc[:3] == pytest.approx(0.5 * axis / carried, rel=1e-9)
    assert qacc[3:] == pytest.approx(-ratio * 0.5 * axis / inertia, rel=1e-9)


def test_out_of_the_water_there_is_nothing_to_push():
    """In the air it falls, and neither flies nor spins; half in it, it has half of its thrust."""
    robot, share = driven(world(**WATER), gain=0.5, torque_ratio=0.02), np.array([0.0, 0.5, 1.0])
    qpos, qvel = at_rest(robot, 3)
    qpos[2] = 1.0, 0.0, -1.0
    qacc = accelerate(robot, qpos, qvel, np.ones((1, 3)))
    inertia = NEUTRAL + share * RHO * robot.fluid.added_mass[0, 0]
    assert qacc[0] == pytest.approx(0.5 * share / inertia, abs=1e-12)
    assert qacc[2] == pytest.approx(-(1 - share) * NEUTRAL * G / inertia, abs=1e-9)
    assert qacc[3] == pytest.approx(-0.02 * 0.5 * share / (NEUTRAL * 0.1**2 / 6), rel=1e-6)


def linear(morphology):
    """The robot with thrusters as stock MuJoCo can have them: linear in the command."""
    line = {"curve": "interpolated", "gain": 1.0, "commands": (-1.0, 1.0), "thrusts": (-0.4, 0.4)}

    def part(old):
        return old if old.thruster is None else replace(old, thruster=replace(old.thruster, **line))

    kinds = [replace(m.kind, parts=tuple(map(part, m.kind.parts))) for m in morphology.modules]
    pairs = zip(morphology.modules, kinds, strict=True)
    return replace(morphology, modules=tuple(replace(m, kind=kind) for m, kind in pairs))


def test_a_linear_thruster_is_mujocos_filtered_actuator():
    """200 steps of `mj_step` with `filterexact` forces at sites, in weight but without water."""
    robot = build_robot(linear(body("auv")), world(gravity=G))
    assert robot.num_thrusters == 4
    qpos, qvel = random_states(robot, 4, depth=50.0, speed=0.3)
    ctrl = np.random.default_rng(1).uniform(-1.3, 1.3, (4, 4))
    _, q, v, _ = march(robot, 1.0, qpos, qvel, ctrl)
    acts = check_mujocos_steps(robot.mj_model, qpos, qvel, ctrl, (q, v), (1e-9, 1e-9))
    settled = np.clip(ctrl, -1, 1) * (1 - np.exp(-10))
    assert acts == pytest.approx(settled.T)


@pytest.mark.slow
def test_the_auv_surges_without_pitch_and_heaves_without_drift():
    """Pairs of thrusters: what one does across, the other undoes."""
    robot = build_robot(body("auv"), world(**WATER))
    names = [robot.mj_model.actuator(k).name for k in range(4)]
    ctrl = np.zeros((4, 2))
    for name in ("port", "starboard"):
        ctrl[names.index(name), 0] = 0.5
    for name in ("bow", "stern"):
        ctrl[names.index(name), 1] = 0.5
    _, q, _, _ = march(robot, 2.0, *at_rest(robot, 2, -2.0), ctrl, every=20)
    surge, heave = q[..., 0], q[..., 1]
    assert surge[-1, 1] > 0.1
    assert np.abs(surge[:, 0]).max() < 1e-6
    assert heave[-1, 2] > -2.0 + 0.1
    assert np.abs(heave[:, :2]).max() < 1e-3
    # Yaw stays, as propellers of a pair turn against each other.
    assert np.abs(q[:, 6]).max() < 1e-3


@pytest.mark.slow
def test_lagged_thrusters_compile_in_any_water():
    """XLA ended the process where a piece of the step left its commands unused."""
    tank = load_world("empty_underwater", waves=[{"amplitude": 0.03, "wavelength": 1.0}],
                      surface_tension=True, bed=None)  # fmt: skip
    robot = build_robot(body("auv"), tank)
    found = simulate(robot, np.zeros(robot.mj_model.nu), 0.05)
    assert np.isfinite(np.asarray(found.qvel)).all()


def test_the_longest_step_that_a_message_names_is_accepted():
    def build(timestep):
        tank = load_world("empty_underwater", drag="inertia_box", timestep=timestep)
        return build_robot(body("fish"), tank)

    with pytest.raises(InputError, match="timestep: expected at most") as found:
        check_timestep(build(0.02))
    check_timestep(build(float(re.search("at most ([0-9.]+) s", str(found.value))[1])))
