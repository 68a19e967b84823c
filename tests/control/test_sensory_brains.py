"""Brains that listen, and splines: what all of them promise, and each by hand."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from laboratory import dry_robot, elbow_robot, play, world
from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.controller import gene_indices
from mjx_revolve.control.gait import describe_gait
from mjx_revolve.control.joint_network import make_joint_network
from mjx_revolve.control.kinds import find_controller
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensory_cpg import make_sensory_cpg
from mjx_revolve.control.splines import make_splines
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.episodes.config import ControllerConfig
from mjx_revolve.inputs.errors import InputError

DT, REACH = 0.005, np.pi / 4
SENSORS = tuple(Sensor(type=name) for name in ("gyro", "depth", "angle", "speed", "contact"))
KINDS = ("cpg", "sine", "mlp", "rnn", "sensory_cpg", "splines")


def make(kind, plant, **settings):
    """Brains that act at every step; those with a rate are in `test_rate`."""
    settings.setdefault("rate", None)
    if kind in ("mlp", "rnn", "sensory_cpg"):
        settings.setdefault("sensors", SENSORS)
    return find_controller(plant, ControllerConfig(type=kind, **settings))


def sense_of(rows):
    """Anything, of one lane."""
    draw = np.random.default_rng(0).normal
    one, three = draw(size=1), tuple(draw(size=(3, 1)))
    angle, speed, touch = (np.abs(draw(size=(n, 1))) for n in (rows, rows, 1 + rows))
    return SensorReadings(one, one, three, three, angle=angle, speed=speed, touch=touch)


def targets(*given, start=0):
    return play(*given, start)[0]


def drawn(controller, lanes=1, seed=0, scale=1.0):
    return scale * np.random.default_rng(seed).normal(size=(controller.num_genes, lanes))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["auv", "spider"])
def test_zero_genes_keep_still_whatever_is_felt(kind, name):
    robot = dry_robot(name)
    plant = plant_of(robot)
    controller = make(kind, plant)
    sense = sense_of(robot.num_hinges)
    found = targets(controller, plant, np.zeros((controller.num_genes, 1)), 150, sense)
    assert not (found - np.asarray(plant.low + plant.high)[None] / 2).any()
    busy = targets(controller, plant, drawn(controller), 150, sense)
    assert np.abs(busy - found).max() > 1e-4  # a cpg's thrusters run at a constant command
    if kind not in ("splines", "sine"):  # which the servo clips
        assert np.all(busy <= np.asarray(plant.high) + 1e-9)
    # No joint jumps: a full stroke takes 50 ms or more.
    moved = np.diff(busy[:, : robot.num_hinges], axis=0, prepend=0)
    assert not moved.size or np.abs(moved).max() < 2 * REACH / 10


@pytest.mark.parametrize("kind", KINDS)
def test_a_middle_that_is_not_where_hinges_begin_fades_in(kind):
    plant = plant_of(dry_robot("spider"))
    plant = replace(plant, low=plant.low / 4)
    controller = make(kind, plant)
    found = targets(controller, plant, np.zeros((controller.num_genes, 1)), 150, sense_of(8))
    middle = np.asarray(plant.low + plant.high) / 2
    assert not found[0].any() and np.abs(np.diff(found, axis=0)).max() < middle.max() / 50
    assert found[-1] == pytest.approx(middle, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_genes_have_names_of_their_own_and_places(kind):
    controller = make(kind, plant_of(dry_robot("spider")))
    assert len(set(controller.gene_names)) == controller.num_genes == len(set(controller.genes))
    unclear = make_joint_network(plant_of(dry_robot("spider")), (Sensor(type="depth", name="z"),))
    with pytest.raises(InputError, match=r"^controller.sensors: .*; found two genes z>h1$"):
        gene_indices(unclear, unclear)
    alike = (Sensor(type="climb", name="joint angle"), Sensor(type="angle"))
    with pytest.raises(InputError, match=r"two genes phase joint angle$"):
        make_sensory_cpg(plant_of(dry_robot("spider")), alike)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_at_zero_genes(kind):
    plant = plant_of(elbow_robot(world()))
    controller, sense = make(kind, plant), jax.tree.map(jnp.asarray, sense_of(2))

    def last(genes):
        parameters = controller.decode(genes, plant)
        state = controller.init(parameters)
        for k in range(3):
            state, target = controller.step(parameters, state, jnp.asarray(0.3 * k), sense)
        return jnp.sum(target)

    slope = jax.jit(jax.grad(last))(jnp.zeros((controller.num_genes, 1)))
    assert jnp.all(jnp.isfinite(slope))


@pytest.mark.parametrize("kind", ["mlp", "rnn"])
def test_a_shared_network_fits_any_body(kind):
    plants = [plant_of(dry_robot(name)) for name in ("spider", "snake", "centipede")]
    assert len({make(kind, plant).num_genes for plant in plants}) == 1
    assert all(gene.place == "robot" for gene in make(kind, plant_of(dry_robot("snake"))).genes)


def test_what_a_controller_asks_to_feel():
    plant = plant_of(dry_robot("spider"))
    assert make("mlp", plant).signals == ("touch",)
    assert make("rnn", plant, sensors=None).signals == ()


def network(robot, seed, **settings):
    """A network of three units and one message that feels climb and angle, and its weights."""
    sensors = [Sensor(type="climb"), Sensor(type="angle", range=1.0)]
    controller = make_joint_network(robot, sensors, hidden=3, messages=1, **settings)
    genes = drawn(controller, seed=seed)
    named = dict(zip(controller.gene_names, genes[:, 0], strict=True))
    inputs = ["one", "x", "y", "z", "away", "axis x", "axis y", "axis z", "climb", "joint angle",
              "sine", "cosine", "message1"]  # fmt: skip
    units = ["h1", "h2", "h3"]
    layer = np.array([[2 * np.sin(named[f"{x}>{h}"]) for x in inputs] for h in units])
    out = np.array([[2 * np.sin(named[f"{h}>{x}"]) for h in units] for x in ("target", "message1")])
    return controller, genes, named, layer, out


@pytest.mark.parametrize("recurrent", [False, True])
def test_the_shared_network_by_hand(recurrent):
    robot = elbow_robot(world())
    controller, genes, named, layer, out = network(robot, 3, recurrent=recurrent)
    plant = plant_of(robot)
    place, axis = np.asarray(plant.place)[..., 0] / 0.1, np.asarray(plant.axis)[..., 0]
    assert np.abs(axis) == pytest.approx(np.array([[0, 0, 1], [0, 1, 0]]), abs=1e-9)
    away = np.linalg.norm(place, axis=1)
    slope = [np.pi * np.sin(named[f"phase {x}"]) for x in ("x", "y", "z", "away")]
    late = np.column_stack([place, away]) @ slope
    rate = 2 * np.pi * 2.0 * (1 + np.sin(named["frequency"])) / 2
    sense = SensorReadings(np.array([0.3]), np.array([0.4]), (), (), angle=np.c_[[0.5, -0.2]])
    found = targets(controller, plant, genes, 120, sense)[..., 0]
    said, memory = np.zeros(2), np.zeros((2, 3))
    units = range(1, 4)
    for k in range(120):
        time = k * DT
        x = np.column_stack([
            np.ones(2), place, away, axis, np.full(2, 0.4), [0.5, -0.2],
            np.sin(rate * time + late), np.cos(rate * time + late), said[::-1],
        ])  # fmt: skip
        activity = x @ layer.T
        if recurrent:
            back = [[2 * np.sin(named[f"h{b}>h{a}"]) for b in units] for a in units]
            share = (1 + np.sin([named[f"h{a} time"] for a in units])) / 2
            tau = 0.02**share  # from 1 s to .02 s
            activity = activity + memory @ np.array(back).T
            memory = memory + np.minimum(DT / tau, 1) * (np.tanh(activity) - memory)
            h = memory
        else:
            h = np.tanh(activity)
        expected = min(time / 0.5, 1) * REACH * np.tanh(h @ out[0])
        assert found[k] == pytest.approx(expected, abs=1e-9), k
        said = said + DT / 0.05 * (h @ out[1] - said)


@pytest.mark.slow
def test_messages_travel_from_neighbour_to_neighbour():
    """A step per joint: the tail hears of what the head feels as many steps later."""
    robot = dry_robot("snake")
    plant, n = plant_of(robot), robot.num_hinges
    pairs = {(int(i), int(j)) for i, j in zip(plant.first[:, 0], plant.second[:, 0], strict=True)}
    assert (0, 1) in pairs and (1, 2) in pairs and (0, 2) not in pairs
    controller = make_joint_network(plant, [Sensor(type="angle")], hidden=4, messages=2)
    genes = drawn(controller)
    calm = SensorReadings(0.0, 0.0, (), (), angle=np.zeros((n, 1)))
    moved = calm._replace(angle=np.eye(n)[:, :1])
    a, b = (targets(controller, plant, genes, 6, x, start=200) for x in (calm, moved))
    heard = np.abs(a - b)[..., 0] > 1e-12
    assert heard[:, 0].all() and heard[0].sum() == 1
    assert heard[1, 1] and not heard[1, 2] and heard[2, 2] and not heard[2, 3]


@pytest.mark.slow
def test_oscillators_settle_at_their_lags_and_answer_to_sensors():
    robot = elbow_robot(world())
    plant = plant_of(robot)
    controller = make_sensory_cpg(plant, [Sensor(type="climb")], max_frequency=2.0)
    names = controller.gene_names
    genes = np.zeros((controller.num_genes, 1))
    first, second = plant.names
    genes[names.index(f"amplitude {first}")] = 0.6
    genes[names.index(f"amplitude {second}")] = 0.3
    genes[names.index(f"lag {first}~{second}")] = 0.25
    quiet = SensorReadings(np.zeros(1), np.zeros(1), (), ())
    found = targets(controller, plant, genes, 1600, quiet)[..., 0]
    time, rate = DT * np.arange(1600), 2 * np.pi * 1.0
    late = found[1200:]
    wave = np.exp(-1j * rate * time[1200:]) @ late / 200
    assert np.abs(wave) == pytest.approx(REACH * np.sin([0.6, 0.3]), rel=0.01)
    lag = np.angle(wave[1] / wave[0])
    assert lag == pytest.approx(np.pi * np.sin(0.25), abs=0.02)
    gait = describe_gait(
        plant, ControllerConfig(type="sensory_cpg", sensors=["climb"]), genes[:, 0]
    )
    assert gait["mean_period"] == pytest.approx(1.0)
    assert gait["mean_amplitude"] == pytest.approx(REACH * np.sin([0.6, 0.3]).mean())
    assert gait["spread_phase_offset"] == pytest.approx(
        np.sqrt(-2 * np.log(np.cos(np.pi * np.sin(0.25) / 2))), rel=0.01
    )

    # One answer at a time to a climb of half the sensor's range, of the first joint alone.
    def answer(gene):
        changed = genes.copy()
        changed[names.index(f"lag {first}~{second}")] = 0.0
        changed[names.index(f"{gene} {first}")] = np.pi / 2
        felt = quiet._replace(climb=np.full(1, 0.5))
        return targets(controller, plant, changed, 1600, felt)[1200:, 0, 0] / REACH

    assert answer("offset climb").mean() == pytest.approx(0.5 * (1 - np.sin(0.6) ** 2 / 2), rel=0.2)
    assert np.abs(answer("amplitude climb")).max() == pytest.approx(1.0, rel=0.01)
    crossings = np.sum(np.diff(np.sign(answer("phase climb"))) != 0)
    # Half of 2 Hz more for one of two that pull each other: 1.5 Hz together.
    assert crossings == pytest.approx(2 * 1.5 * 2, abs=1)


def test_phases_of_hours_lose_whole_turns():
    plant = plant_of(elbow_robot(world()))
    controller = make_sensory_cpg(plant, [Sensor(type="climb")])
    parameters = controller.decode(jnp.asarray(drawn(controller)), plant)
    quiet = SensorReadings(np.zeros(1), np.zeros(1), (), ())
    samples, (phase, swing), offset = controller.init(parameters)
    found = []
    for turns in (0, 2000):
        begun = samples, (phase + 2 * np.pi * turns, swing), offset
        found.append(controller.step(parameters, begun, jnp.asarray(1.0), quiet)[0][1][0])
    np.testing.assert_allclose(*found, atol=3e-3)
    assert np.abs(found[0]).min() > 0


def test_splines_go_through_their_points():
    robot = elbow_robot(world())
    plant = plant_of(robot)
    for points in (3, 4, 8):
        controller = make_splines(plant, points, max_frequency=2.0)
        genes = drawn(controller, seed=points, scale=0.4)
        genes[-1] = 0.0  # 1 Hz
        found = targets(controller, plant, genes, 400, sense_of(2), start=200)[..., 0]
        knots = np.sin(genes[:-1, 0]).reshape(points, 2)
        curve = CubicSpline(np.arange(points + 1) / points, [*knots, knots[0]], bc_type="periodic")
        assert found == pytest.approx(REACH * curve((DT * np.arange(200, 600)) % 1), abs=1e-9)
