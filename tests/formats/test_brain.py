"""A controller as Python, C99 and a ROS 2 node: the same commands as ours over an episode."""

import ctypes
import shutil
import subprocess
import sys
import types
from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from exports import ODD
from laboratory import body, check_refused, read
from mjx_revolve.control.controller import Controller
from mjx_revolve.control.readings import readings_at_rest
from mjx_revolve.control.sensors import count_samples
from mjx_revolve.control.table import CONTROLLERS
from mjx_revolve.engine.plant import actuators_of, plant_of
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.episodes.rollout import Rollout
from mjx_revolve.formats.brain import _list_readings, champion_brain, make_brain
from mjx_revolve.formats.brain_c import make_brain_c
from mjx_revolve.formats.brain_python import make_brain_python
from mjx_revolve.formats.brain_ros import make_brain_node
from mjx_revolve.view.sensor_log import trace_sensors
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import load_world

needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on the path")
STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-pedantic", "-Werror")

# All kinds of sensors that one robot alone may have, at the core, at a module and at all of a type.
FELT = [
    "depth", "climb", "tilt", "compass", "gyro", "accelerometer", "flow", "sonar", "target",
    "bearing", "distance", "course", "battery", "angle", "speed", "load", "contact",
    "nearest_distance", "nearest_tag", {"type": "touch", "at": "feeler"},
    {"type": "accelerometer", "at": "hand"}, {"type": "angle", "at": "arm 1"},
    {"type": "angle", "at": "arm-1"}, {"type": "tilt", "each": "Fin"},
    {"type": "depth", "each": "FixedBrick"},
]  # fmt: skip
NETWORK = """
brain:
  neurons:
    a: {id: a, layer: input, part_id: core, type: Input}
    t: {id: t, layer: input, part_id: feeler, type: Input}
    clock: {id: clock, layer: hidden, type: Oscillator}
    mix: {id: mix, layer: output, part_id: "arm 1", type: Sigmoid}
    sum: {id: sum, layer: output, part_id: "arm-1", type: Simple}
  connections:
    - {src: a, dst: mix, weight: 0.2}
    - {src: t, dst: sum, weight: 0.5}
    - {src: clock, dst: sum, weight: 0.4}
    - {src: mix, dst: sum, weight: 0.3}
    - {src: sum, dst: mix, weight: 1.5}
  params:
    clock: {period: 0.8, phase_offset: 0.3, amplitude: 0.6}
    mix: {bias: 0.1, gain: 0.9}
    sum: {bias: -0.2, gain: 0.7}
"""
USERS = '''
import jax, jax.numpy as jnp
from mjx_revolve.control import Controller

def matrix(plant, settings):
    """A state-space controller, with what users write: matrices, reductions, choices, counters."""
    n = plant.num_actuators
    names = tuple(f"g{k}" for k in range(n))
    def decode(genes, plant):
        return jnp.sin(genes), jnp.cos(jnp.outer(jnp.arange(3.0), jnp.arange(n)))
    def init(parameters):
        lanes = parameters[0].shape[1:]
        return jnp.zeros((3, *lanes)), jnp.zeros(lanes)
    def step(parameters, state, time, sense):
        genes, matrix = parameters
        x, count = state
        felt = jnp.stack([*sense.up, *sense.angular_velocity])
        mixed = jax.nn.sigmoid(matrix.T @ x) + jnp.max(felt, 0) - jnp.mean(felt[::-1][:3], 0)
        fresh = jnp.where(count.astype(int) & 1 == 1, felt[3], -felt[1] ** 3)
        x = jnp.roll(x, 1, 0).at[0].set(fresh)
        x = jnp.clip(x / jnp.maximum(jnp.linalg.norm(x, axis=0), 1e-3), -1, 1)
        command = jnp.arctan2(mixed, 1 + genes * genes) * jnp.where(count % 3 == 1, 1.0, 0.5)
        return (x, count + 1), command
    return Controller(n, names, decode, init, step)
'''


def config(folder, kind, **settings):
    """A configuration of the odd robot under a kind of controller."""
    text = ODD + (NETWORK if kind == "brain" else "")
    (folder / "robot.yaml").write_text(text)
    (folder / "mine.py").write_text(USERS)
    if kind in ("mlp", "rnn", "sensory_cpg"):
        settings.setdefault("sensors", FELT)
    return {
        "morphology": str(folder / "robot.yaml"),
        "world": "lake",
        "trim": "neutral",
        # Held, so that what the robot is sent is what the brain says.
        "controller": {"type": kind, "between": "hold", **settings},
        "task": {"type": "search", "target_distance": 1.0, "sight": 1.05, "duration": 1.5},
    }


def genes_of(fitness, size=0.7):
    return (size * np.random.default_rng(3).normal(size=fitness.num_genes)).astype(np.float32)


def record(fitness, genes):
    """Readings of an episode and commands, robot's order, one row for each command of the brain."""
    controller, engine, world = fitness.controller, fitness.engine, fitness.world
    key = jax.random.key(1)

    @jax.jit
    def run(genes):
        parameters = controller.decode(genes[:, None], engine.plant)

        def policy(state, time, readings, _):
            own, ctrl = controller.step(parameters, state[0], time, readings)
            return (own, readings), ctrl

        context = jax.tree.map(lambda x: jnp.asarray(x)[None], fitness.context(key))
        rollout = Rollout(engine, policy, world, water_of(world), context, controller.signals)
        start = fitness.starts(key)[0][:, :1]
        state = engine.init(start, jnp.zeros((len(start) - 1, 1), start.dtype))
        own = controller.init(parameters)
        blank = rollout.read(rollout.init(state, own))[2]
        begun = rollout.init(state, (own, jax.tree.map(jnp.zeros_like, blank)))
        keep = lambda now, ctrl, water: (now.controller_state[1], ctrl)  # noqa: E731
        return rollout.advance(begun, keep, fitness.num_timesteps)[1]

    readings, ctrl = jax.tree.map(np.asarray, run(genes))
    rows = due(fitness)
    ctrl = ctrl[..., 0][:, np.argsort(np.asarray(engine.plant.source)[:, 0])]
    return [jax.tree.map(lambda x, k=k: x[k], readings) for k in rows], ctrl[rows]


def due(fitness):
    """The steps at which a brain commands."""
    times = fitness.world.timestep * np.arange(fitness.num_timesteps)
    rate = fitness.controller.rate
    number = np.asarray(count_samples(times, rate)) if rate else np.arange(len(times))
    return np.unique(number, return_index=True)[1]


def as_given(brain, readings):
    """Readings as files take them."""
    found = {name: np.concatenate([np.ravel(x) for x in parts])
             for name, _, _, parts in _list_readings(readings)}  # fmt: skip
    return {signal.name: found[signal.name] for signal in brain.signals}


def run_python(text, brain, readings, real="float32"):
    space, text = {}, text.replace("REAL = np.float32", f"REAL = np.{real}")
    exec(compile(text, "brain.py", "exec"), space)
    assert not {"jax", "mjx_revolve"} & set(space)
    made = space["Brain"]()
    return np.array(
        [made.step(k / space["RATE"], given) for k, given in enumerate(readings)], np.float64
    )


def run_c(folder, brain, readings, double=False):
    """The C file, compiled without a warning, as a shared library."""
    real = ctypes.c_double if double else ctypes.c_float
    header, source = make_brain_c(brain, "brain")
    (folder / "brain.h").write_text(header)
    (folder / "brain.c").write_text(source)
    library = folder / f"brain_{double}.so"
    flags = [*STRICT, "-fPIC", "-shared", *(["-DBRAIN_DOUBLE"] if double else [])]
    command = ["cc", *flags, str(folder / "brain.c"), "-o", str(library), "-lm"]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    assert "alloc" not in source
    made = ctypes.CDLL(str(library))
    made.brain_step.argtypes = [ctypes.c_void_p, real, ctypes.c_void_p, ctypes.c_void_p]
    state = ctypes.create_string_buffer(1 << 16)
    made.brain_init(state)
    rows = []
    for k, given in enumerate(readings):
        numbers = np.concatenate([np.zeros(0), *(given[s.name] for s in brain.signals)])
        sensors = (real * max(len(numbers), 1))(*numbers)
        commands = (real * len(brain.commands))()
        made.brain_step(state, k / brain.rate, sensors, commands)
        rows.append(list(commands))
    return np.array(rows)


def clipped(brain, ctrl):
    return np.clip(ctrl, brain.low, brain.high)


pytestmark = pytest.mark.usefixtures("quick_compiles")


KINDS = [*CONTROLLERS, "mine.py:matrix"]


@pytest.mark.slow
@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_with_sensors_gives_the_same_commands(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # Older runs have no rate: a command at each of the world's steps.
    more = {"sine": {"harmonics": 2}, "feedback": {"rate": None}}.get(kind, {})
    fitness = make_fitness(config(tmp_path, kind, **more))
    genes = genes_of(fitness)
    readings, ctrl = record(fitness, genes)
    brain = champion_brain(fitness, genes)
    assert brain.rate == (20.0 if "rate" not in more else pytest.approx(200.0))
    assert ctrl.shape == (1.5 * brain.rate, len(brain.commands)) and len(brain.commands) == 3
    assert np.ptp(ctrl, axis=0).max() > 0.05
    given = [as_given(brain, row) for row in readings]
    expected = clipped(brain, ctrl)
    text = make_brain_python(brain)
    assert text == make_brain_python(champion_brain(fitness, genes))
    np.testing.assert_allclose(run_python(text, brain, given), expected, rtol=1e-5, atol=1e-5)
    if shutil.which("cc"):
        np.testing.assert_allclose(run_c(tmp_path, brain, given), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_in_double_precision_they_agree_to_rounding(kind, tmp_path, monkeypatch):
    """The step alone, with any readings, so that nothing but the translation is compared."""
    monkeypatch.chdir(tmp_path)
    with jax.enable_x64(True):
        fitness = make_fitness(config(tmp_path, kind))
        genes, controller = genes_of(fitness).astype(np.float64), fitness.bare_controller()
        brain = champion_brain(fitness, genes)
        plant = plant_of(fitness.robot).at_rate(20.0)

        @jax.jit
        def begin(genes):
            parameters = controller.decode(genes[:, None], plant)
            blank = readings_at_rest(plant, 1, controller.signals)
            return parameters, controller.init(parameters), blank._replace(seen=jnp.ones(1, bool))

        parameters, state, blank = begin(genes)
        draw, rows, expected = np.random.default_rng(5), [], []
        step = jax.jit(controller.step)

        def any_of(x):
            if x.dtype == bool:
                return jnp.asarray(draw.random(x.shape) < 0.5)
            if x.dtype == jnp.uint32:
                return x
            return jnp.asarray(draw.normal(size=x.shape))

        for k in range(30):
            sense = jax.tree.map(any_of, blank)
            if sense.modules:
                own = {name: at._replace(present=jnp.asarray(blank.modules[name].present, float))
                       for name, at in sense.modules.items()}  # fmt: skip
                sense = sense._replace(modules=own)
            rows.append(as_given(brain, sense))
            state, command = step(parameters, state, k / 20.0, sense)
            expected.append(np.asarray(command)[:, 0])
    expected = clipped(brain, np.array(expected))
    found = run_python(make_brain_python(brain), brain, rows, "float64")
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11)
    if shutil.which("cc"):
        found = run_c(tmp_path, brain, rows, double=True)
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11)


@pytest.mark.long
def test_noise_rate_and_delay_are_the_devices(tmp_path):
    """What the simulated devices gave, fed to a file whose brain knows of none of it."""
    devices = [
        {"type": "gyro", "noise": 0.1, "delay": 0.02},
        {"type": "angle", "noise": 0.01, "rate": 10},
        {"type": "tilt", "range": 0.8, "rate": 7},
    ]
    fitness = make_fitness(config(tmp_path, "rnn", sensors=devices))
    genes, key = genes_of(fitness), jax.random.key(1)
    swim = fitness.replay(genes, key)
    rows = due(fitness)
    traces = {trace.sensor.type: trace.given for trace in trace_sensors(fitness, swim, key)}
    names = {"gyro": "angular_velocity", "angle": "angle", "tilt": "up"}
    given = [{names[kind]: x[k].ravel() for kind, x in traces.items()} for k in rows]
    brain = champion_brain(fitness, genes)
    text = make_brain_python(brain)
    assert "noise 0.1, 0.02 s late" in text and "7 Hz" in text
    found = run_python(text, brain, given)
    ctrl = np.asarray(swim.ctrl)[rows][:, actuators_of(fitness.robot)]
    np.testing.assert_allclose(found, clipped(brain, ctrl), atol=2e-5)


@lru_cache
def plain_brain():
    """A brain that reads attitude, motion and joints, of a robot with a thruster."""
    robot = build_robot(read(ODD), load_world("lake"))

    def step(parameters, state, time, sense):
        felt = sense.up[0] + 2 * sense.north[1] + 3 * sense.force[2] + sense.flow[0]
        turn = sense.angular_velocity[1] + sense.angle[1] - sense.speed[0] + 5 * sense.load[1]
        return state + 1, jnp.stack([0.01 * felt, 0.02 * turn, 0.001 * state])

    controller = Controller(
        0, (), lambda genes, plant: (), lambda parameters: jnp.zeros(1), step,
        signals=("force", "load"),
    )  # fmt: skip
    return make_brain(robot, controller, np.zeros(0), 20.0)


@needs_cc
def test_whole_numbers_and_truth_values(tmp_path, spider):
    """A state of all kinds, and shifting from one place of it into the next."""

    def step(parameters, state, time, sense):
        count, odd, late, later, *more = state  # too many for one line of a file
        found = (
            sense.angle * jnp.where(odd, 1.0, -0.5) + later + 0.01 * (count % 5 + abs(3 - count))
        )
        near = (sense.angle > 0.1) & ~(sense.speed < 0.0) | (count[None] == 2)
        found = found + jnp.where(near, jnp.sign(sense.speed), jnp.floor(sense.angle))
        found = found + jnp.round(more[0]) + jax.nn.softmax(more[0], 0)
        shifted = jnp.maximum(count + 1, 2) ^ (count & 1)
        more = *more[1:-1], 2 * later, jnp.full_like(later, 0.3)  # a constant from then on
        return (shifted, ~odd, sense.angle, late, *more), 0.2 * found

    zero = jnp.zeros((8, 1))
    begin = (
        jnp.zeros(1, jnp.int32), jnp.ones(1, bool), zero + 0.1, zero - 0.2,
        *(zero for _ in range(6)),
    )  # fmt: skip
    controller = Controller(0, (), lambda genes, plant: (), lambda parameters: begin, step)
    brain = make_brain(spider, controller, np.zeros(0), 20.0)
    draw, rows, expected = np.random.default_rng(1), [], []
    blank = readings_at_rest(plant_of(spider), 1, ())
    for k in range(7):
        sense = blank._replace(angle=draw.normal(size=(8, 1)), speed=draw.normal(size=(8, 1)))
        begin, command = step((), begin, k / 20, jax.tree.map(jnp.asarray, sense))
        rows.append({"angle": sense.angle[:, 0], "speed": sense.speed[:, 0]})
        expected.append(np.asarray(command)[:, 0])
    expected = clipped(brain, np.array(expected))
    assert np.ptp(expected, axis=0).min() > 0.1
    found = run_python(make_brain_python(brain), brain, rows)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(run_c(tmp_path, brain, rows), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["sine", "feedback", "splines", "mlp"])
def test_joints_that_all_do_the_same_have_a_command_each(kind, tmp_path, spider):
    """Genes of 0: numbers that are all alike are written once."""
    controller = CONTROLLERS[kind].make(plant_of(spider).at_rate(20.0))
    brain = make_brain(spider, controller, np.zeros(controller.num_genes), 20.0)
    given = [{s.name: np.zeros(s.size) for s in brain.signals}] * 3
    found = run_python(make_brain_python(brain), brain, given)
    assert found.shape == (3, 8)
    if shutil.which("cc"):
        np.testing.assert_allclose(run_c(tmp_path, brain, given), found, atol=1e-6)


def test_names_and_limits_are_those_of_the_robot():
    brain = plain_brain()
    assert brain.commands == ("arm_1", "arm_1_2", "jet") and brain.num_hinges == 2
    np.testing.assert_allclose(brain.high, [np.pi / 4, np.pi / 4, 1.0])
    assert {s.name: s.size for s in brain.signals}["angle"] == 2
    text = make_brain_python(brain)
    assert "- 2: jet, of the thruster [-], -1 to 1" in text
    with pytest.raises(ValueError, match="expected 2; found 1"):
        given = {s.name: np.zeros(s.size) for s in brain.signals} | {"angle": [0.0]}
        run_python(text, brain, [given])


def test_places_past_the_end_and_robots_without_hinges(spider):
    """What lies past an end is what the operation says, and a sum over no hinges is 0."""
    near = np.arange(1, 9)

    def padded(parameters, state, time, sense):
        some = sense.angle.at[near].get(mode="fill", fill_value=0.5)
        return state, 0.1 * (some + jnp.where(near[:, None] < 8, jnp.take(sense.angle, near, 0), 0))

    def steer(parameters, state, time, sense):
        rows = sense.angle.shape[0]
        felt = jnp.sum(sense.angle, 0) + (jnp.ones((1, rows)) @ sense.angle)[0]
        return state, jnp.vstack([2 * sense.angle, sense.up[0] + felt[None] + jnp.ones((4, 1))])

    still = build_robot(body("auv"), load_world("lake"))
    for robot, step, given, expected in (
        (spider, padded, {"angle": near / 10}, 0.02 * np.append(near[1:], 2.5)),
        (still, steer, {"up": np.array([-0.5, 0.0, 0.0])}, np.full(4, 0.5)),
    ):
        controller = Controller(0, (), lambda genes, plant: (), lambda parameters: (), step)
        brain = make_brain(robot, controller, np.zeros(0), 20.0)
        found = run_python(make_brain_python(brain), brain, [given])
        np.testing.assert_allclose(found[0], expected, atol=1e-6)


def test_a_single_command_is_a_list_of_one():
    jet = read("body: {type: Core, children: {2: {type: Thruster}}}")
    robot = build_robot(jet, load_world("lake"))
    controller = CONTROLLERS["sine"].make(plant_of(robot).at_rate(20.0))
    brain = make_brain(robot, controller, np.zeros(controller.num_genes), 20.0)
    assert run_python(make_brain_python(brain), brain, [{}]).shape == (1, 1)


@pytest.mark.parametrize(("step", "message"), [
    (lambda p, s, t, x: (s, jnp.sort(x.angle, axis=0)), "found JAX's 'sort' in its step"),
    (lambda p, s, t, x: (s, x.angle[(10 * t).astype(int) % 2] + x.angle), "constant places"),
    (lambda p, s, t, x: (s, x.angle + x.noise[0]), "the simulation's sensor noise"),
])  # fmt: skip
def test_what_a_file_cannot_hold_is_refused(step, message, spider):
    controller = Controller(0, (), lambda genes, plant: (), lambda parameters: (), step)
    check_refused(
        message, make_brain, spider, controller, np.zeros(0), 20.0, start="controller: expected"
    )


def test_names_cannot_leave_their_comment(tmp_path):
    brain = replace(plain_brain(), robot='x"""\nimport os\n*/ #error \\')
    given = [{s.name: np.zeros(s.size) for s in brain.signals}]
    run_python(make_brain_python(brain), brain, given)
    compile(make_brain_node(brain, "brain"), "node.py", "exec")
    if shutil.which("cc"):
        run_c(tmp_path, brain, given)


class _Node:
    """Stands in for rclpy's: topics by name, a timer that the test fires."""

    def __init__(self, name):
        self.heard, self.said, self.timers = {}, {}, []

    def create_subscription(self, kind, topic, callback, depth):
        self.heard[topic] = (kind, callback)

    def create_publisher(self, kind, topic, depth):
        self.said[topic] = []
        return types.SimpleNamespace(publish=self.said[topic].append)

    def create_timer(self, period, callback):
        self.timers.append((period, callback))

    def get_clock(self):
        return types.SimpleNamespace(now=lambda: types.SimpleNamespace(to_msg=lambda: "now"))


class _Message:
    """Stands in for a message: a header, and what is set."""

    def __init__(self, **fields):
        self.header = types.SimpleNamespace(stamp=None)
        self.__dict__ |= fields


def _xyz(vector):
    return types.SimpleNamespace(**dict(zip("xyz", map(float, vector), strict=True)))


def test_the_node_gives_the_brains_commands(tmp_path, monkeypatch):
    brain = plain_brain()
    (tmp_path / "brain_of_test.py").write_text(make_brain_python(brain))
    for name, fields in {
        "rclpy": {}, "rclpy.node": {"Node": _Node},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"}, "sensor_msgs": {},
        "sensor_msgs.msg": {"Imu": _Message, "JointState": _Message}, "std_msgs": {},
        "std_msgs.msg": {"Float64MultiArray": _Message},
    }.items():  # fmt: skip
        module = types.ModuleType(name)
        module.__dict__.update(fields)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(tmp_path)
    space = {"__name__": "node"}
    exec(compile(make_brain_node(brain, "brain_of_test"), "node.py", "exec"), space)
    node = space["BrainNode"]()
    [(period, tick)] = node.timers
    assert period == pytest.approx(0.05)
    tick()
    assert node.said == {"/joint_targets": [], "/thruster_commands": []}  # nothing felt so far
    # The core turned by 120° about (1, 1, 1).
    turn = types.SimpleNamespace(w=0.5, x=0.5, y=0.5, z=0.5)
    spin, force = (0.1, -0.2, 0.3), (1.0, 2.0, 9.0)
    known = [0.0] * 9
    imu = {"orientation": turn, "angular_velocity": _xyz(spin), "linear_acceleration": _xyz(force)}
    node.heard["/imu"][1](_Message(**imu, **{f"{name}_covariance": known for name in imu}))
    # What is not estimated, and what is no number, leaves what is known.
    blank = dict.fromkeys(imu, types.SimpleNamespace(w=1.0, x=0.0, y=0.0, z=0.0))
    none = {f"{name}_covariance": [-1.0, *known[1:]] for name in imu}
    node.heard["/imu"][1](_Message(**blank, **none))
    node.heard["/sensors/flow"][1](_Message(data=[0.4, 0.5, 0.6]))
    node.heard["/sensors/flow"][1](_Message(data=[0.4, np.nan, 0.6]))
    joints = node.heard["/joint_states"][1]
    joints(_Message(name=["arm_1_2"], position=[0.2], velocity=[-1.0], effort=[0.05]))
    tick()
    assert node.said["/joint_targets"] == []  # a joint is missing
    joints(_Message(name=["other", "arm_1"], position=[9, 0.1], velocity=[9, 2.0], effort=[9, 0.0]))
    joints(_Message(name=["arm_1"], position=[0.1], velocity=[np.nan], effort=[np.nan]))
    matrix = Rotation.from_quat([0.5, 0.5, 0.5, 0.5]).as_matrix()
    given = {"up": matrix[2], "north": matrix[0], "angular_velocity": spin, "force": force,
             "flow": [0.4, 0.5, 0.6], "angle": [0.1, 0.2], "speed": [2.0, -1.0],
             "load": [0.0, 0.05]}  # fmt: skip
    tick()
    tick()
    expected = run_python(make_brain_python(brain), brain, [given] * 2)
    targets = [message.position for message in node.said["/joint_targets"]]
    np.testing.assert_allclose(targets, expected[:, :2], rtol=1e-6)
    assert node.said["/joint_targets"][0].name == ["arm_1", "arm_1_2"]
    thrust = [message.data for message in node.said["/thruster_commands"]]
    np.testing.assert_allclose(thrust, expected[:, 2:], atol=1e-7)
