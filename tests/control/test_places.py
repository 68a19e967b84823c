"""What is felt at modules: MuJoCo's own sensors at sites, for one body, in a batch, and in MJX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import laboratory as lab
from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.sensors import Sensor, SensorRow
from mjx_revolve.control.readings import EpisodeContext
from mjx_revolve.control.sensors import DEFAULT_SENSORS, make_observer, resolve_sensors
from mjx_revolve.engine.batch import fit_capacity
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.config import OLDER, OLDER_TASK, make_config
from mjx_revolve.evolution.fingerprints import settings_hash
from mjx_revolve.inputs import schema
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.flow import water_of
from references import mujoco_sensors

DT, LANES = 1e-4, 2
# A current along x, and one along y that fades to nothing 20 m down.
SHEAR = {"velocity": (0.0, 0.5, 0.0), "depth": 20.0, "profile": "linear"}
SEA = lab.world(**lab.WATER | {
    "current": (0.3, 0.0, 0.0), "shear": SHEAR, "bed": {"height": -9.0}, "timestep": DT,
})  # fmt: skip
TARGET = np.array([1.0, 2.0, -4.0])
FEET = ("back_foot", "right_thigh", "left_knee", "core")
PLACES = tuple(f"at {name}" for name in FEET)
ASKED = ("forces", "load", *PLACES, "each FixedBrick")
RIGID = ("up", "north", "angular_velocity", "flow", "target", "force")  # vectors of a place
ALONE = ("height", "climb", "altitude")


@pytest.fixture(scope="module")
def robot():
    return build_robot(lab.body("spider"), SEA)


def moving(robot, seed):
    """Two states, a step apart: `[nq, lanes]`, `[nv, lanes]` twice, and the acceleration."""
    model, (qpos, qvel) = robot.mj_model, lab.random_states(robot, LANES, seed)
    qacc = 5 * np.random.default_rng(seed).normal(size=qvel.shape)
    after, speed = qpos.copy(), qvel + DT * qacc
    for lane in range(LANES):
        own = after[:, lane].copy()
        mujoco.mj_integratePos(model, own, speed[:, lane], DT)
        after[:, lane] = own
    return (qpos, qvel), (after, speed), qacc


def felt(engine_of, before, after, ctrl, signals=ASKED):
    cues = EpisodeContext(target=tuple(TARGET))
    return lab.sensed(engine_of, SEA, after, ctrl, signals, cues, before)


def expected(sensors, name):
    """The senses at a module, `[lanes, ...]`, from what MuJoCo's sensors say there."""
    of = lambda kind: sensors[name, kind]  # noqa: E731
    place, velocity = of("framepos"), of("framelinvel")
    axes = np.stack([of(f"frame{x}axis") for x in "xyz"], -1)  # world from module
    seen = lambda x: np.einsum("lij,li->lj", axes, x)  # noqa: E731
    water = np.array([[0.3, 0.5 * (1 + z / 20), 0.0] for z in place[:, 2]])
    return {
        "up": axes[:, 2], "north": axes[:, 0], "angular_velocity": of("gyro"),
        "flow": seen(water) - of("velocimeter"), "target": seen(TARGET - place),
        "force": of("accelerometer"), "height": place[:, 2], "climb": velocity[:, 2],
        "altitude": of("rangefinder")[:, 0],
    }  # fmt: skip


# Rounding alone, but for the specific force: it is the mean over a step, half a step old. In
# .05 ms a force of 50 m/s2 turns by 3 rad/s and changes by some 100 m/s3: .01 m/s2.
TOLERANCE = {"force": 0.02}


def compare(place, wanted, pick):
    for name in (*RIGID, *ALONE):
        value = getattr(place, name)
        found = np.stack([pick(x) for x in value], -1) if name in RIGID else pick(value)
        close = TOLERANCE.get(name, 1e-9)
        assert found == pytest.approx(wanted[name], abs=close), name
        assert np.abs(found).max() > 20 * close, name


@pytest.fixture(scope="module")
def spiders(robot):
    """A moving spider, and what MuJoCo's sensors say of its modules."""
    before, after, qacc = moving(robot, 1)
    ctrl = after[0][7:] + np.random.default_rng(0).uniform(-0.03, 0.03, (8, LANES))
    bricks = [m.name for m in robot.morphology.modules if m.type == "FixedBrick"]
    names = dict.fromkeys((*FEET, *bricks, "left_knee"))
    return before, after, ctrl, mujoco_sensors(robot, names, after, qacc, ctrl)


@pytest.mark.parametrize("kind", ["population", pytest.param("mjx", marks=pytest.mark.slow)])
def test_modules_of_a_moving_spider_feel_what_mujocos_sensors_do(kind, robot, spiders):
    before, after, ctrl, sensors = spiders
    found, source = felt(lambda: make_engine(robot, kind), before, after, ctrl)
    for name in FEET:
        compare(found.modules[f"at {name}"], expected(sensors, name), lambda x: x)
    knee = found.modules["at left_knee"]
    for name, kind in (("angle", "pos"), ("speed", "vel"), ("load", "actuatorfrc")):
        wanted = sensors["left_knee", f"joint{kind}"][:, 0]
        assert getattr(knee, name) == pytest.approx(wanted, abs=1e-9)
        assert np.abs(wanted).max() > 0.01
    compare_bricks(found.modules["each FixedBrick"], source, sensors, range(LANES))


def compare_bricks(place, source, sensors, lanes):
    """On each body that a hinge of the spider carries, the first brick; none on the core."""
    limbs = ("back", "front", "right", "left")
    for lane in lanes:
        column = source[:, lane if source.shape[1] > 1 else 0]
        for k in range(8):
            name = f"{limbs[k // 2]}_{('thigh', 'foot')[k % 2]}"
            row = 1 + int(np.flatnonzero(column == k)[0])
            wanted = {key: x[lane] for key, x in expected(sensors, name).items()}
            assert place.present[row, lane] == 1
            compare(place, wanted, lambda x, row=row, lane=lane: x[row, lane])
        assert place.present[:, lane].sum() == 8 and place.present[0, lane] == 0


@pytest.mark.slow
def test_in_a_batch_of_different_bodies_they_feel_the_same(robot, spiders):
    before, after, ctrl, sensors = spiders
    robots = [robot, lab.elbow_robot(SEA)]
    capacity = fit_capacity([*robots, lab.arm_robot(SEA)], sites=("FixedBrick", "Fin"))
    signals = ("forces", "load", "each FixedBrick", "each Fin")
    engine = lambda: lab.batch_engine(robots, capacity, LANES)  # noqa: E731
    found, source = felt(engine, before, after, ctrl, signals)
    bricks = found.modules["each FixedBrick"]
    compare_bricks(bricks, source, sensors, [0])
    # The elbow's are its two, whatever else stands in its rows.
    assert bricks.present[:, 1].sum() == 2
    assert not found.modules["each Fin"].present.any()
    # Bodies of a batch have no names of their own.
    with pytest.raises(InputError, match="expected `each` a type of modules in place of `at`"):
        capacity.plant.site("at back_foot")


PADS = """
body:
  type: Core
  children:
    0: {id: rear, type: FixedBrick, children: {1: {id: pad, type: TouchSensor}}}
    1: {id: arm, type: ActiveHinge, children: {1: {id: hand, type: FixedBrick}}}
    2: {id: side, type: FixedBrick}
    3: {id: other, type: FixedBrick}
"""
GROUND = lab.world(gravity=9.81, bed={"height": -1.0})
STIFF = GROUND.bed.stiffness


def touched(engine_of, qpos, what):
    """What the bed does to bodies at rest, in float64."""
    with jax.enable_x64(True):

        def run(qpos):
            engine = engine_of()
            state = engine.init(qpos, jnp.zeros_like(qpos[1:]))
            return getattr(engine, what)(state, water_of(GROUND)), engine.plant.source

        found = jax.jit(run, compiler_options=lab.QUICK)(jnp.asarray(qpos, jnp.float64))
        return jax.tree.map(np.asarray, found)


@pytest.mark.parametrize("kind", ["population", pytest.param("mjx", marks=pytest.mark.slow)])
def test_a_pads_cells_are_its_left_and_its_right_half(kind):
    """Deep in the bed, level; then rolled about the way in which the pad is attached."""
    robot = build_robot(lab.read(PADS), GROUND)
    pad = robot.morphology.modules[2]
    assert pad.name == "pad"
    half = np.array(pad.kind.parts[0].boxes[0].size) / 2
    # It looks along -y of the core: its left is +x. At rest in the core's frame.
    angles = np.array([0.0, 0.05, -0.05])
    qpos = np.zeros((robot.mj_model.nq, 3))
    qpos[3], qpos[5] = np.cos(angles / 2), np.sin(angles / 2)  # about y: +x goes down
    qpos[2] = -1.0 + half[2] - 5e-4
    cells, _ = touched(lambda: make_engine(robot, kind), qpos, "contact_by_half")
    left, right = cells[2]
    for lane, angle in enumerate(angles):
        for found, x in ((left, half[1]), (right, -half[1])):
            # Both corners of either end, above and below, in front and behind.
            depth = [-1 - (qpos[2, lane] - x * np.sin(angle) + z * np.cos(angle))
                     for z in (-half[2], half[2])]  # fmt: skip
            assert found[lane] == pytest.approx(2 * STIFF * np.maximum(depth, 0).sum(), rel=1e-9)
    assert left[0] == right[0] > 1 and left[1] > right[1] == 0 and right[2] > left[2] == 0


@pytest.mark.slow
def test_a_box_at_rest_presses_its_halves_by_their_levers():
    """A ballast of half the box's weight off its middle: the lever says how the halves share it."""
    ballast = {"ballast_mass": 0.5, "ballast_position": (0.05, 0.0, 0.0)}
    robot = lab.box_robot((0.2, 0.1, 0.05), 1.0, GROUND, **ballast)
    weight = 1.5 * 9.81
    lever = weight * (0.5 + np.array([-1, 1]) * (0.5 * 0.05 / 1.5) / 0.2)
    _, qpos, qvel, _ = lab.march(robot, 1.0, *lab.at_rest(robot, height=-1 + 0.025), every=200)
    assert np.abs(qvel[-1]).max() < 1e-6
    [cells], _ = touched(lambda: make_engine(robot), qpos[-1], "contact_by_half")
    # Half a millimetre deeper on one side, it stands a little aslant.
    assert np.concatenate(cells) == pytest.approx(lever, rel=1e-3)


@pytest.mark.parametrize(("sensor", "message"), [
    ({"type": "gyro", "at": "a", "each": "Core"}, "0.each: expected none, as there is `at`"),
    ({"type": "touch"}, "0.at: expected the id of a module, as touch sits on one; found"),
])  # fmt: skip
def test_sensors_that_cannot_sit_there(sensor, message):
    lab.check_refused(f"sensors.{message}", schema.read, SensorRow, [sensor], "sensors")


def test_a_module_that_is_not_there_is_refused():
    plant = plant_of(build_robot(lab.read(PADS), GROUND))
    for sensor, message in (
        (Sensor(type="flow", at="tail"), "sensors.0.at: expected the id of a module; found 'tail'"),
        (Sensor(type="angle", at="hand"), "sensors.0.at: expected a module with a hinge, as angle"),
    ):
        lab.check_refused(message, make_observer, [sensor], DT, plant)
    assert Sensor(type="flow", at=3).to_mapping() == {"type": "flow", "at": "3"}


FISHY = """
modules:
  FixedBrick:
    mount: {position: [0, -0.019, 0], outward: [0, 1, 0]}
    parts: [{size: [0.041, 0.041, 0.0355], mass: 0.0102, volume: 1.07e-5}]
    slots: {1: +y}
    sensors: [{type: flow, range: 2}, {type: gyro, name: turn}]
"""


def test_types_of_modules_bring_their_sensors(tmp_path):
    (tmp_path / "modules.yaml").write_text(FISHY)
    modules = MODULES | load_modules(tmp_path / "modules.yaml")
    found = resolve_sensors([Sensor(type="tilt")], modules)
    assert [s.label for s in found] == ["tilt", "FixedBrick flow", "turn"]
    assert [s.where for s in found] == ["robot", "body", "body"]
    assert resolve_sensors(None, modules)[: len(DEFAULT_SENSORS)] == DEFAULT_SENSORS
    assert resolve_sensors(None, MODULES) is None
    # An alias is as good as a name; what is no type is refused, and so is one name twice.
    assert resolve_sensors([Sensor(type="gyro", each="CoreComponent")], MODULES)[0].each == "Core"
    message = "config: sensors.0.each: expected a type of modules, one"
    lab.check_refused(message, resolve_sensors, [Sensor(type="gyro", each="Brick")], MODULES)
    with pytest.raises(InputError, match=r"config: sensors.2.name: expected names that differ"):
        resolve_sensors([Sensor(type="tilt", name="turn")], modules)
    (tmp_path / "modules.yaml").write_text(FISHY.replace("type: gyro", "type: angle"))
    with pytest.raises(InputError, match=r"sensors.1: expected a kind that may sit on modules"):
        load_modules(tmp_path / "modules.yaml")


def test_a_runs_fingerprint_knows_the_sensors_of_types(tmp_path):
    """And runs from before there were any keep theirs."""
    (tmp_path / "oar.yaml").write_text(lab.OAR)
    base = {
        "morphology": str(tmp_path / "oar.yaml"),
        "modules": str(tmp_path / "modules.yaml"),
        "world": "lake",
        # Those had no rate, and measured cores and lengths at rest.
        "controller": {
            "type": "mlp",
            "sensors": ["tilt", {"type": "gyro", "range": 5}],
            **OLDER["controller"],
        },
        "task": {"type": "directed_swim", **OLDER_TASK},
    }

    def of(text, **changes):
        (tmp_path / "modules.yaml").write_text(text)
        return settings_hash(make_config(base | changes, source="run.yaml"))

    bare = FISHY[: FISHY.index("    sensors:")]
    assert of(bare) == of(bare, modules=None) == "cadb858f78c37cb4"
    assert of(FISHY) == of(FISHY) != of(bare)
    assert of(FISHY.replace("range: 2", "range: 3")) != of(FISHY)
    placed = {"type": "mlp", "sensors": ["tilt", {"type": "gyro", "range": 5, "each": "Core"}]}
    assert of(bare, controller=placed) != of(bare)
