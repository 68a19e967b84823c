"""`simulate`: what it takes, what it refuses, and what it returns."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import WATER, body, elbow_robot, march, oar_robot, read, refusal, world
from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.control.controller import bind_genes
from mjx_revolve.control.cpg import make_cpg
from mjx_revolve.control.feedback import make_feedback
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.simulate import Trajectory, simulate
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.motion import analyse_motion
from mjx_revolve.water.flow import Water

STEPS, DT = 40, 0.005
SPAN = STEPS * DT
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def still(elbow):
    """The elbow left alone for 0.2 s."""
    return simulate(elbow, None, SPAN)


@pytest.mark.long
def test_depths_are_below_the_surface_of_the_water_that_is_given():
    """An AUV holds 2 m by feedback, from 1 m, in water whose surface stands at 0 and at 5 m."""
    tank = world(**WATER)
    robot = build_robot(trim_neutral(body("auv"), tank.density), tank)
    holds = make_feedback(robot, depth=2.0)
    weights = np.zeros((4, 7))
    weights[:2, 0], weights[:2, 1] = -0.5, -1.0  # depth error and climb to the two that heave
    genes = bind_genes(holds, np.concatenate([np.zeros(4), weights.ravel()]))
    with jax.enable_x64(True):
        at_home = simulate(robot, genes, 40.0)
        start = robot.start_qpos() + 5 * np.eye(7)[2]
        higher = simulate(robot, genes, 40.0, qpos=start, water=Water(5.0, (0.0, 0.0, 0.0)))
    moved = np.array(higher.qpos)
    moved[:, 2] -= 5.0
    assert moved == pytest.approx(np.array(at_home.qpos), abs=1e-6)
    motions = (analyse_motion(robot, x) for x in (at_home, higher))
    own, other = (motion.surface - motion.path[:, 2] for motion in motions)
    assert own[0] == pytest.approx(1.0, abs=1e-3)
    assert own[-1] == pytest.approx(2.0, abs=0.05)
    assert other == pytest.approx(own, abs=1e-6)


def test_a_start_without_direction_is_refused(elbow):
    qpos = np.array(elbow.start_qpos())
    qpos[3:7] = 0
    with pytest.raises(InputError, match=r"qpos\[3:7\]: expected a quaternion .* found zeros"):
        simulate(elbow, None, SPAN, qpos=qpos)


@pytest.mark.slow
def test_shapes_and_time(elbow, still):
    assert isinstance(still, Trajectory)
    assert still.time == pytest.approx(DT * np.arange(1, STEPS + 1), rel=1e-6)
    assert still.qpos.shape == (STEPS, 9)
    assert still.qvel.shape == (STEPS, 8)
    assert still.xpos.shape == (STEPS, elbow.mj_model.nbody, 3)
    assert still.ctrl.shape == (STEPS, 2)
    assert still.power.shape == (STEPS,)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(still))
    # From rest, 1 m deep: a heavy robot begins to sink.
    assert still.qpos[0, 2] == pytest.approx(-1.0, abs=1e-3)
    assert still.qpos[-1, 2] < -1.001
    assert np.linalg.norm(still.qpos[:, 3:7], axis=1) == pytest.approx(1.0, abs=1e-6)


def test_all_forms_of_joint_targets(elbow, still):
    """None, held, a row for each step, and a function of time."""
    held = simulate(elbow, [0.3, -0.2], SPAN)
    assert held.ctrl == pytest.approx(np.tile([0.3, -0.2], (STEPS, 1)))
    rows = simulate(elbow, np.tile([0.3, -0.2], (STEPS, 1)))
    assert np.array_equal(rows.qpos, held.qpos)
    timed = simulate(elbow, lambda t: jnp.array([0.3, -0.2]) * (t >= 0), SPAN)
    assert np.array_equal(timed.qpos, held.qpos)
    assert np.array_equal(simulate(elbow, [0, 0], SPAN).qpos, still.qpos)
    assert np.abs(held.qpos - still.qpos).max() > 0.01
    # The function sees the time at the start of each step.
    clock = simulate(elbow, lambda t: jnp.array([t, 0.0]), SPAN)
    assert clock.ctrl[:, 0] == pytest.approx(DT * np.arange(STEPS), abs=1e-7)


@pytest.mark.slow
def test_a_controller_with_its_genes(elbow):
    """Played from its genes, without rows of controls (XLA:CPU has aborted over such a rollout)."""
    controller = make_cpg(elbow)
    genes = np.random.default_rng(3).normal(size=controller.num_genes)
    trajectory = simulate(elbow, bind_genes(controller, genes), SPAN)

    @jax.jit
    def command(genes, times):
        parameters = controller.decode(genes, plant_of(elbow))
        step = lambda state, time: controller.step(parameters, state, time, None)  # noqa: E731
        return jax.lax.scan(step, controller.init(parameters), times)[1]

    expected = command(np.float32(genes)[:, None], np.float32(DT * np.arange(STEPS)))
    assert trajectory.ctrl == pytest.approx(np.asarray(expected[..., 0]), abs=1e-5)
    # The same as playing the rows back.
    again = simulate(elbow, trajectory.ctrl)
    assert np.asarray(again.qpos) == pytest.approx(np.asarray(trajectory.qpos), abs=1e-5)


@pytest.mark.slow
def test_controls_reach_the_hinges_they_name():
    """MuJoCo's order of hinges is not the population step's: one limb is deeper than the other."""
    robot = build_robot(
        read("""
body:
  type: Core
  children:
    1:
      id: a
      type: ActiveHinge
      children:
        1:
          type: FixedBrick
          children: {1: {id: b, type: ActiveHinge, children: {1: {type: FixedBrick}}}}
    2: {id: c, type: ActiveHinge, children: {1: {type: FixedBrick}}}
"""),
        world(**WATER),
    )
    assert [robot.mj_model.actuator(k).name for k in range(3)] == ["a", "b", "c"]
    trajectory = simulate(robot, [0.1, -0.2, 0.3], 1.0)
    assert trajectory.ctrl[-1] == pytest.approx([0.1, -0.2, 0.3])
    assert trajectory.qpos[-1, 7:] == pytest.approx([0.1, -0.2, 0.3], abs=0.01)


def test_start_states(elbow):
    qpos = elbow.start_qpos(2.0)
    qpos[3:7] = 0, 0, 0, 2.0  # any length: MuJoCo normalises too
    qvel = np.zeros(8)
    qvel[0] = 1.0
    trajectory = simulate(elbow, None, SPAN, qpos=qpos, qvel=qvel)
    assert trajectory.qpos[0, :3] == pytest.approx([0.005, 0.0, -2.0], abs=1e-3)
    assert trajectory.qpos[0, 3:7] == pytest.approx([0, 0, 0, 1], abs=1e-2)
    assert 0.1 < trajectory.qvel[-1, 0] < 1.0


def test_a_key_turns_the_start_about_the_vertical(elbow):
    quats = []
    for seed in (0, 0, 1):
        trajectory = simulate(elbow, None, SPAN, key=jax.random.key(seed))
        assert trajectory.qpos[0, 4:6] == pytest.approx(0.0, abs=1e-3)
        quats.append(np.asarray(trajectory.qpos[0, 3:7]))
    assert np.array_equal(quats[0], quats[1])
    assert np.abs(quats[0] - quats[2]).max() > 0.01


@pytest.mark.slow
def test_water_of_its_own():
    """A surface below the robot and a current, without compiling the robot anew."""
    # Trimmed, so that it drifts and does not flutter as it sinks.
    robot = build_robot(trim_neutral(body("core"), world().density), world(**WATER))
    dry = simulate(robot, None, SPAN, water=Water(-5.0, (0.0, 0.0, 0.0)))
    assert dry.qvel[-1, 2] == pytest.approx(-9.81 * SPAN, rel=1e-5)
    wet = simulate(robot, None, 4.0, water=Water(0.0, (0.2, 0.0, 0.0)))
    assert 0.15 < wet.qvel[-1, 0] < 0.2  # it drifts along, ever slower to close the gap
    plain = simulate(robot, None, SPAN)
    same = simulate(robot, None, SPAN, water=Water(0.0, (0.0, 0.0, 0.0)))
    assert np.asarray(same.qpos) == pytest.approx(np.asarray(plain.qpos), abs=1e-6)


@pytest.mark.slow
def test_simulate_is_the_population_step_with_one_lane(elbow):
    trajectory = simulate(elbow, [0.3, -0.2], SPAN)
    qpos, qvel = elbow.start_qpos()[:, None], np.zeros((8, 1))
    _, q, v, work = march(elbow, SPAN, qpos, qvel, np.array([[0.3], [-0.2]]), x64=False)
    assert trajectory.qpos == pytest.approx(q[..., 0], abs=1e-5)
    assert trajectory.qvel == pytest.approx(v[..., 0], abs=1e-3)
    assert trajectory.power == pytest.approx(work[:, 0] / DT, abs=1e-3)


WRONG = [
    ({"ctrl": [0.1]}, "ctrl: expected [2] or [T, 2]; found [1]"),
    ({"ctrl": [0.1, math.nan]}, "ctrl: expected finite numbers; found NaN or infinity"),
    ({"ctrl": lambda t: jnp.zeros(3)}, "ctrl: expected 2 targets; found 3"),
    (
        {"ctrl": np.zeros((100, 2)), "duration": 3.0},
        "duration: expected 0.5 s, as ctrl has 100 rows of 0.005 s; found 3",
    ),
    ({"qpos": np.zeros(7)}, "qpos: expected shape [9]; found [7]"),
    (
        {"water": Water(0.0, (0.1, 0.0))},
        "water: expected a Water with three numbers in current and in acceleration; "
        "found ((0.1, 0.0), (0.0, 0.0, 0.0))",
    ),
]


@pytest.mark.parametrize(("given", "message"), WRONG, ids=[m[:40] for _, m in WRONG])
def test_wrong_inputs(elbow, given, message):
    span = {} if "ctrl" in given else {"duration": SPAN}
    assert refusal(simulate, elbow, **span, **given) == message


def test_wrong_genes(elbow):
    controller = make_cpg(elbow)
    with pytest.raises(InputError, match=r"^genes: expected 3 numbers; found 4$"):
        simulate(elbow, bind_genes(controller, np.zeros(4)), SPAN)
    with pytest.raises(InputError, match=r"^genes: expected shape \[-1\]; found \[3, 1\]$"):
        simulate(elbow, bind_genes(controller, np.zeros((3, 1))), SPAN)


@pytest.mark.slow
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("engine", "first"), [("population", "float32"), ("population", "float64"), ("mjx", "float64")]
)
def test_both_precisions_in_one_process(engine, first):
    """The second one's program is what it would be alone.

    JAX 0.10.2 keeps one typed copy of a NumPy array that a trace meets, and hands it to the traces
    of the other mode as well: an index array of 64 bits then ends in an error, a constant in
    float64 silently has the digits of float32.
    """

    def program(robot, controller, kind):
        def end(genes):
            qpos = jnp.asarray(robot.qpos0).at[2].set(-0.005)
            found = simulate(robot, bind_genes(controller, genes), 4 * DT, qpos=qpos, engine=engine)
            return jnp.sum(found.qpos[-1] ** 2)

        with jax.enable_x64(kind == "float64"):
            jitted = jax.jit(end)
            return jitted, jitted.lower(jnp.zeros(controller.num_genes)).as_text()

    second = {"float32": "float64", "float64": "float32"}[first]
    make = oar_robot if engine == "mjx" else elbow_robot  # MJX takes seconds for each joint
    used, fresh = (make(world(**WATER)) for _ in range(2))
    controller = make_cpg(used)
    # Kept alive, and with it the copies that its trace made.
    jitted, _ = program(used, controller, first)
    _, after = program(used, controller, second)
    assert after == program(fresh, make_cpg(fresh), second)[1]
    del jitted
