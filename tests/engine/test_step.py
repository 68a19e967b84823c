"""Whole steps with all laws at work: conserved, carried along, righted, differentiable."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import laboratory as lab
from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.episodes.starts import gusty_water
from mjx_revolve.water.added_mass import box_added_mass
from mjx_revolve.water.bed import Bed
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.flow import Water, gust_path
from references import Lagrangian, each_lane

RHO, G = 999.1026, 9.81
CUBE = (0.1, 0.1, 0.1)  # carries the same water along every axis, so no Munk moment turns it
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.mark.slow
def test_a_limp_jointed_body_keeps_energy_and_impulse():
    """Without drag, within a few per cent; what is lost halves with the step.

    Nothing here has a time of its own, so 2.5 ms at 0.2 m/s stand for 5 ms at 0.1 m/s. The arm's
    light tips whip round at up to 40 rad/s.
    """
    lost = []
    for dt in (0.0025, 0.00125):
        robot = lab.limp(lab.arm_robot(lab.world(added_mass=True, timestep=dt)))
        qpos, qvel = lab.random_states(robot, 8, speed=0.2)
        _, q, v, _ = lab.march(robot, 1.0, qpos, qvel, every=round(0.1 / dt))
        lagrangian = Lagrangian(robot, RHO)
        energies = [each_lane(lagrangian.energy, *s) for s in zip(q, v, strict=True)]
        momenta = [each_lane(lagrangian.impulse, *s) for s in zip(q, v, strict=True)]
        first = each_lane(lagrangian.impulse, qpos, qvel)
        scale = np.abs(first).max(1)
        kept = [energy / each_lane(lagrangian.energy, qpos, qvel) - 1 for energy in energies]
        moved = [np.abs(momentum - first).max(1) / scale for momentum in momenta]
        assert np.abs(kept).max() < 0.05
        assert np.max(moved) < 0.02
        lost.append([np.median(np.abs(kept[-1])), np.max(moved)])
    assert np.divide(*lost) == pytest.approx(2.0, abs=0.4)


@pytest.mark.slow
def test_servos_give_no_more_energy_than_they_deliver():
    """At the default step, without drag, from a tumble of 1 m/s: start + work bounds the energy."""
    robot = lab.arm_robot(lab.world(added_mass=True))
    qpos, qvel = lab.random_states(robot, 16, speed=1.0)
    ctrl = np.random.default_rng(1).uniform(-0.6, 0.6, (robot.num_hinges, 16))
    _, q, v, work = lab.march(robot, 2.0, qpos, qvel, ctrl, every=20)
    lagrangian = Lagrangian(robot, RHO)
    start = each_lane(lagrangian.energy, qpos, qvel)
    for *state, done in zip(q, v, np.cumsum(work, 0), strict=True):
        # End stops and friction take some; the step errs by a few per cent.
        assert np.all(each_lane(lagrangian.energy, *state) < 1.02 * (start + done))


def gusty(tank, seed, seconds):
    """The same gusts that `simulate` draws, and the water that they make."""
    steps = round(seconds / tank.timestep)
    path = gust_path(tank.gust, jax.random.key(seed), steps, tank.timestep, 1)[..., 0]
    return np.asarray(path), gusty_water(tank, path)


STANDING = lambda phase, lag: np.sin(phase) * np.cos(lag)  # noqa: E731
TRAVELLING = lambda phase, lag: np.sin(phase - lag)  # noqa: E731
# Between steps: a command changes with the same one, whatever rounding says.
JERKING = lambda phase, lag: np.sign(np.sin(phase - lag + 1e-6))  # noqa: E731


@pytest.mark.sampled(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "name, strokes",
    [
        ("fish", [(0.6, TRAVELLING, 4, 0.003, 2), (0.7, JERKING, 3, 0.04, 3)]),
        ("snake", [(0.3, STANDING, 2, 0.012, 3)]),
    ],
)
def test_a_stroke_in_the_default_water_is_of_second_order(name, strokes):
    """Where a swimmer is in the end, against steps of 0.6 ms, even if servos rush and halt.

    Each stroke has a lane: its size, its wave, how long it lasts [s], and two bounds.
    """
    marched = {}
    for dt in (0.01, 0.005, 0.000625):
        tank = lab.world(drag="cross_flow", added_mass=True, timestep=dt)
        robot = build_robot(trim_neutral(lab.body(name), RHO), tank)
        longest = max(seconds for _, _, seconds, _, _ in strokes)
        steps = dt * np.arange(round(longest / dt))[:, None]
        lag = np.arange(robot.num_hinges)
        ctrl = [x * np.minimum(steps, 1) * wave(2 * np.pi * steps, lag) for x, wave, *_ in strokes]
        states = lab.at_rest(robot, len(strokes), -5.0)
        _, marched[dt], _, _ = lab.march(robot, longest, *states, np.stack(ctrl, -1))
    for lane, (_, _, seconds, most, gain) in enumerate(strokes):
        ends = [q[round(seconds / dt) - 1, :3, lane] for dt, q in marched.items()]
        way = np.linalg.norm(ends[-1] - [0, 0, -5])
        errors = [np.linalg.norm(end - ends[-1]) / way for end in ends[:2]]
        assert errors[1] < most and errors[0] > gain * errors[1]


def test_a_neutral_body_goes_with_the_water_whatever_its_shape():
    """Without drag; pressure and carried water move it as they would the water in its place."""
    gust = {"std": [0.2, 0.1, 0.1], "time": 0.5}
    tank = lab.world(added_mass=True, buoyancy="partial", gravity=G, gust=gust, current=(0.3, 0, 0))
    size = (0.2, 0.1, 0.02)
    robot = lab.box_robot(size, RHO * np.prod(size), tank)
    qpos, _ = lab.random_states(robot, 1, seed=3)
    with jax.enable_x64(True):
        path, water = gusty(tank, 0, 2.0)
        start = np.concatenate([path[0] + tank.current, np.zeros(3)])
        found = simulate(robot, None, 2.0, qpos=qpos[:, 0], qvel=start, water=water)
    assert path.std(0) == pytest.approx([0.2, 0.1, 0.1], rel=0.6)
    assert np.asarray(found.qvel[:, :3]) == pytest.approx(path[1:] + tank.current, abs=1e-12)
    assert np.abs(found.qvel[:, 3:]).max() < 1e-9


@pytest.mark.slow
def test_gusts_move_a_heavy_body_less():
    """m v' = ρ V u' + m_a (u' - v'), so v - v₀ = (ρ V + m_a) / (m + m_a) (u - u₀).

    To rounding without carried water; with it, the step extrapolates momentum from the step before,
    which knows nothing of the next gust, and a cube gets a spin that it should not have.
    """
    gust = {"std": 0.2, "time": 0.5}
    for added_mass, error in ((False, 1e-12), (True, 1e-4)):
        # Without weight, or it would fall at several metres per second.
        tank = lab.world(added_mass=added_mass, buoyancy="partial", gust=gust)
        robot = lab.box_robot(CUBE, 2.0, tank)
        with jax.enable_x64(True):
            path, water = gusty(tank, 1, 1.0)
            start = robot.start_qpos(5.0)
            found = simulate(robot, None, 1.0, qpos=start, water=water)
        carried = RHO * robot.fluid.carried_mass[0, 0]
        share = (RHO * 1e-3 + carried) / (2.0 + carried)
        assert found.qvel[:, :2] == pytest.approx(share * (path[1:] - path[0])[:, :2], abs=error)
        assert np.abs(found.qvel[:, 3:]).max() < (0.05 if added_mass else 1e-12)


def test_a_floating_box_goes_with_a_long_wave():
    """Its height is the surface's where it is, its velocity the water's, its deck level with it."""
    amplitude, length = 0.2, 40.0
    tank = lab.world(**lab.WATER, waves=[{"amplitude": amplitude, "wavelength": length}])
    size = (0.2, 0.2, 0.06)
    robot = lab.box_robot(size, RHO * np.prod(size) / 2, tank)
    k = 2 * np.pi / length
    omega = np.sqrt(G * k)
    qpos, qvel = lab.at_rest(robot, 1, amplitude)
    qvel[0] = amplitude * omega
    time, q, v, _ = lab.march(robot, 10.0, qpos, qvel, every=10)
    theta = k * q[:, 0, 0] - omega * time
    # Of second order, k a = 0.03, is what linear theory and a body of finite size leave out.
    assert q[:, 2, 0] == pytest.approx(amplitude * np.cos(theta), abs=0.03 * amplitude)
    fast = amplitude * omega
    assert v[:, 0, 0] == pytest.approx(fast * np.cos(theta), abs=0.1 * fast)
    pitch = 2 * q[:, 5, 0]
    # Rotation about +y by θ turns the deck's normal to (θ, 0, 1); the surface's is (-η', 0, 1).
    assert pitch == pytest.approx(k * amplitude * np.sin(theta), abs=0.2 * k * amplitude)
    assert np.ptp(q[:, 2, 0]) > 1.9 * amplitude


def test_entrained_water_is_mass_without_weight():
    """A box flooded to 70 % moves as one that is heavier by that water, spread evenly over it."""
    size, mass, volume, share = (0.2, 0.1, 0.06), 0.4, 3e-4, 0.7
    tank = lab.world(added_mass=True, drag="faces")
    flooded = lab.box_robot(size, mass, tank, volume, entrained_water=share)
    inside = RHO * share * (np.prod(size) - volume)
    heavy = lab.box_robot(size, mass + inside, tank, volume)
    states = lab.random_states(flooded, 16, speed=0.5)
    _, q, v, _ = lab.march(flooded, 1.0, *states)
    _, other_q, other_v, _ = lab.march(heavy, 1.0, *states)
    assert q == pytest.approx(other_q, abs=1e-9)
    assert v == pytest.approx(other_v, abs=1e-9)
    assert inside > mass


def winged(switch, tank):
    """A core with a brick at either side, to which the switch belongs."""
    text = "body: {type: Core, children: {"
    text += ", ".join(f"{k}: {{type: FixedBrick, params: {{{switch}}}}}" for k in (2, 3)) + "}}"
    return build_robot(lab.read(text), tank)


SWITCHES = {
    "none": "", "buoyancy": 'buoyancy: "off"', "mask": "buoyancy: mask", "drag": 'drag: "off"',
    "added_mass": "added_mass: false",
}  # fmt: skip


@lru_cache
def switched(switch):
    """A robot that compiles once, and its parts without the switch."""
    tank = lab.world(**lab.WATER)
    return winged(SWITCHES[switch], tank), winged("", tank).fluid


@pytest.mark.slow
@pytest.mark.parametrize("switch", SWITCHES)
@pytest.mark.parametrize(("height", "speed"), [(-0.001, 0.0), (-2.0, -0.5)])
def test_switches_of_single_modules(switch, height, speed):
    """At rest half out of the water, deep at speed: summed by hand over what takes part."""
    robot, plain = switched(switch)
    qpos, qvel = lab.at_rest(robot, 1, height)
    qvel[2] = speed
    mass, wings = robot.mj_model.body_mass.sum(), np.array([False, True, True])
    half = plain.half_size[:, 2]
    partial = np.clip(0.5 - height / (2 * half), 0, 1)
    share = np.where(wings & (switch == "mask"), float(height < 0), partial)
    # Without buoyancy of its own, a part is wet or dry by its centre.
    share = np.where(wings & (switch == "buoyancy"), float(height < 0), share)
    on = lambda name: np.where(wings & (switch == name), 0.0, share)  # noqa: E731
    drag = FACES.numbers(plain, robot.world).linear
    force = RHO * G * on("buoyancy") @ plain.volume - mass * G
    force -= on("drag") @ drag[:, 2] * speed * abs(speed)
    carried = RHO * on("added_mass") @ plain.added_mass[:, 2]
    found = lab.accelerate(robot, qpos, qvel)[:, 0]
    assert found[2] == pytest.approx(force / (mass + carried), rel=1e-9)
    assert found[[0, 1, 3, 4, 5]] == pytest.approx(0.0, abs=1e-9)
    if speed == 0:
        after = lab.march(robot, 0.01, qpos, qvel)[2]
        assert after[0, 2, 0] / 0.005 == pytest.approx(force / (mass + carried), rel=1e-9)


def test_what_a_world_switches_off_stays_off():
    """A module may not turn a law on that its world has turned off."""
    robot = winged("buoyancy: partial, drag: faces, added_mass: true", lab.world(gravity=G))
    qpos, qvel = lab.at_rest(robot, 1, -2.0)
    qvel[2] = -0.5
    assert lab.accelerate(robot, qpos, qvel)[:, 0] == pytest.approx([0, 0, -G, 0, 0, 0], abs=1e-12)


def test_ballast_in_the_keel_rights_a_body():
    """Neutral, rolled by 0.02 rad, without drag: a pendulum in its carried water.

    With T = ½ (m + A) v² - m z v φ' + ½ (I + A') φ'² (z of the centre of mass; I about the box's
    centre, at which the water's mass acts) and no force sideways, v follows φ' and
    ω² = m g (z_b - z) / (I + A' - (m z)² / (m + A)). Semi-implicit Euler errs by (ω dt)² / 24.
    """
    size, hull, lead, low, high = (0.2, 0.1, 0.06), 0.5, 0.3, -0.025, 0.005
    tank = lab.world(gravity=G, buoyancy="partial", added_mass=True)
    mass = hull + lead
    robot = lab.box_robot(
        size, hull, tank, mass / RHO, center_of_volume=(0, 0, high), ballast_mass=lead,
        ballast_position=(0, 0, low),
    )  # fmt: skip
    z = lead * low / mass
    added, turning = box_added_mass(np.array(size) / 2)
    for axis, edges, sideways in ((0, (0.1, 0.06), 1), (1, (0.2, 0.06), 0)):
        inertia = hull / 12 * np.sum(np.square(edges)) + lead * low**2 + RHO * turning[axis]
        inertia -= (mass * z) ** 2 / (mass + RHO * added[sideways])
        omega = np.sqrt(mass * G * (high - z) / inertia)
        qpos, qvel = lab.at_rest(robot, 1, -5.0)
        qpos[3], qpos[4 + axis] = np.cos(0.01), np.sin(0.01)
        time, q, _, _ = lab.march(robot, 3.0, qpos, qvel)
        angle = 2 * np.arcsin(q[:, 4 + axis, 0])
        assert omega * 3.0 / (2 * np.pi) > 0.5
        assert angle == pytest.approx(0.02 * np.cos(omega * time), abs=0.02 * 0.04)


def check_slope(robot, *cases, kinks=(), compiled=lab.QUICK):
    """In float64, a rollout's gradient against differences over 2 µ, one-sided at `kinks`."""
    steps = 20

    def end(inputs):
        qpos = jnp.asarray(robot.qpos0).at[:3].set(inputs["place"]).at[3:7].set(inputs["quat"])
        trajectory = simulate(
            robot, jnp.broadcast_to(inputs["ctrl"], (steps, robot.mj_model.nu)), qpos=qpos,
            qvel=inputs["qvel"], water=Water(0.0, tuple(inputs["current"]), time=inputs["time"]),
        )  # fmt: skip
        # Weights, so that no slope vanishes by symmetry alone.
        weights = jnp.arange(1, robot.mj_model.nq + 1) / 10
        return jnp.sum(weights * trajectory.qpos[-1]) + trajectory.qvel[-1] @ weights[:-1]

    usual = {
        "place": np.array([0.0, 0.0, -2.0]), "quat": np.array([1.0, 0.0, 0.0, 0.0]),
        "ctrl": np.zeros(robot.mj_model.nu), "qvel": np.zeros(robot.mj_model.nv),
        "current": np.zeros(3), "time": 0.0,
    }  # fmt: skip
    value = jax.jit(end, compiler_options=compiled)
    slope = jax.jit(jax.grad(end), compiler_options=lab.SLOPE)
    for case in kinks:
        with jax.enable_x64(True):
            found = slope(jax.tree.map(jnp.asarray, usual | case))
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))
    for case in cases:
        with jax.enable_x64(True):
            inputs = jax.tree.map(jnp.asarray, usual | case)
            flat, build = ravel_pytree(inputs)
            found = np.asarray(ravel_pytree(slope(inputs))[0])
            assert np.all(np.isfinite(found))
            expected = [
                (float(value(build(flat + s))) - float(value(build(flat - s)))) / 2e-6
                for s in 1e-6 * np.eye(len(flat))
            ]
            assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
        assert np.sum(np.abs(found) > 1e-3) > 5


@pytest.mark.slow
def test_gradient_at_rest_and_at_the_waterline():
    """Level, still, deep: drag's |v| and every angle stand at their kinks.

    And a core's centre in the surface, or while it drops through it, as users compile it. Where its
    deck or its keel just touches, the submerged share has its kinks.
    """
    robot = build_robot(trim_neutral(lab.body("core"), RHO), lab.world(**lab.WATER))
    waterline = {"place": np.array([0.0, 0.0, -0.001]), "qvel": np.full(6, 0.05)}
    drop = {
        "place": np.array([0.0, 0.0, 0.04]),
        "qvel": np.array([0.1, -0.05, -0.5, 0.1, 0.2, 0.1]),
        "current": np.array([0.1, 0.0, 0.0]),
    }
    kinks = [{"place": np.array([0.0, 0.0, z])} for z in (0.0, 0.0225, -0.0225)]
    check_slope(robot, {}, waterline, drop, kinks=kinks, compiled=lab.USUAL)


@pytest.mark.long
def test_gradient_in_waves_and_in_contact():
    """In the moment at which the sea is met, too; and sliding over a deep bed, corners in it."""
    tank = lab.world(
        **lab.WATER,
        waves=[{"amplitude": 0.05, "wavelength": 2.0, "direction": 0.5}],
        bed=Bed(kind="flat", height=-6.0),
    )
    afloat = {
        "place": np.array([0.2, 0.1, 0.02]), "quat": np.array([1.0, 0.02, -0.03, 0.1]),
        "qvel": np.full(6, 0.1), "current": np.array([0.05, 0.02, 0.01]), "time": 0.3,
    }  # fmt: skip
    sliding = {
        "place": np.array([0.0, 0.0, -6.0 + 0.0215]),
        "qvel": np.array([0.1, 0.05, -0.02, 0.1, 0.05, 0.2]),
    }
    check_slope(build_robot(lab.body("core"), tank), afloat, sliding)


@pytest.mark.long
def test_gradient_of_a_jointed_body():
    """In a joint's target and speed, too; half out of the water."""
    inputs = {
        "place": np.array([0.0, 0.0, -0.005]),
        "ctrl": np.array([0.03]),
        "qvel": np.array([0.1, -0.05, 0.02, 0.1, 0.2, 0.1, 0.5]),
        # Not the body's own speed: there |v|, of which drag's implicit part is made, has its kink.
        "current": np.array([0.12, 0.0, 0.0]),
    }
    check_slope(lab.oar_robot(lab.world(**lab.WATER)), inputs)


@pytest.mark.long
def test_gradient_through_thrusters():
    """In the commands, behind their lag; one of them stands still."""
    inputs = {"ctrl": np.array([0.5, -0.3, 0.0, 0.8]), "qvel": np.full(6, 0.05)}
    check_slope(build_robot(lab.body("auv"), lab.world(**lab.WATER)), inputs)
