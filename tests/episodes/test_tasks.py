"""Tasks own their starts, unit, and what they have recorded; one body and many see the same."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from laboratory import ELBOW, body, make_track, read
from mjx_revolve import InputError, make_fitness, make_mixed_fitness
from mjx_revolve.body.edits import add_module
from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.scoring import may_touch_bed
from mjx_revolve.episodes.starts import draw_starts, episode_context, start_pose, target_path
from mjx_revolve.episodes.tasks import RECORDS, TASKS, Task, start_on_bed
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.world import load_world

KEY, G, RHO = jax.random.key(0), 9.81, 999.1026
OWN = """
import jax.numpy as jnp
from mjx_revolve.episodes.tasks import Task, start_on_bed


def lift(track, settings):
    return track.water_force[-1, 2]


def stand(track, settings):
    return track.bed_force[-1, 2]


def bend(track, settings):
    # Also that all fields are there, and of one length.
    rows = {x.shape[0] for x in (track.position, track.quat, track.spin, track.velocity)}
    assert rows == {track.angle.shape[0], track.speed.shape[0]}
    return jnp.sum(track.angle[-1], 0) + 0 * jnp.sum(track.quat[-1] ** 2, 0)


lifting = Task(lift, "N", records=("forces",))
standing = Task(stand, "N", records=("contacts",), start=start_on_bed, on_bed=True)
bending = Task(bend, "rad", records=("core", "joints"))
"""
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "own.py").write_text(OWN)
    body("core").save(folder / "core.yaml")
    task = {"duration": 1.0, "settle": 0.2, "trials": 1, "start_tilt": 0.0}

    def make(name, **more):
        return {
            "morphology": str(folder / "core.yaml"),
            "world": {"name": "lake", "bed": False, **more.pop("world", {})},
            "controller": {"type": "sine"},
            "task": task | {"type": f"{folder / 'own.py'}:{name}"},
        } | more

    return make


def score(config):
    """Of zero genes, by the fitness of one body."""
    fitness = make_fitness(config)
    return fitness, float(fitness(jnp.zeros((1, fitness.num_genes)), KEY)[0])


@pytest.mark.slow
def test_the_waters_force_on_a_neutral_body_is_its_weight(settings):
    fitness, found = score(settings("lifting", trim="neutral"))
    assert found == pytest.approx(fitness.robot.morphology.mass * G, rel=1e-4)
    assert fitness.task.unit == "N"


@pytest.mark.long
def test_the_beds_force_on_a_body_at_rest_is_what_the_water_leaves_of_its_weight(settings):
    tank = {"bed": {"kind": "flat", "height": -2.0}}
    fitness, found = score(settings("standing", world=tank))
    core = fitness.robot.morphology
    assert found == pytest.approx((core.mass - RHO * core.volume) * G, rel=0.02)
    # A champion's own trajectory says the same as its score.
    genes = np.zeros(fitness.num_genes, np.float32)
    judged, _ = fitness.judge(fitness.replay(genes, KEY), KEY)
    assert judged == pytest.approx(found, rel=1e-3)


@pytest.mark.long
def test_joints_are_recorded_for_one_body_and_for_many(settings, tmp_path):
    """Held at their offsets, in the robot's own order, whatever the engine's."""
    elbow = read(ELBOW)
    elbow.save(tmp_path / "elbow.yaml")
    config = settings("bending", morphology=str(tmp_path / "elbow.yaml"))
    one = make_fitness(config)
    names = list(one.controller.gene_names)
    genes = np.zeros((1, one.num_genes), np.float32)
    genes[0, [k for k, name in enumerate(names) if name.startswith("offset")]] = 0.3
    expected = one.robot.num_hinges * 0.5 * np.pi / 4 * np.sin(0.3)
    found = float(one(genes, KEY)[0])
    assert found == pytest.approx(expected, rel=0.05)
    many = make_mixed_fitness(config, [elbow, body("core")])
    robots = [many.build(body("core")), many.build(elbow)]
    wide = jnp.concatenate([jnp.zeros((1, many.num_genes)), many.pad_genes(genes, robots[1])])
    assert np.asarray(many(robots, wide, KEY)) == pytest.approx([0.0, found], abs=1e-4)


def test_what_may_be_recorded_is_named():
    with pytest.raises(InputError, match=f"records: expected any of {', '.join(RECORDS)}; found"):
        Task(lambda track, settings: track.position[-1, 2], records=("thoughts",))


def lopsided():
    """A core with a brick on one side: its centre of mass is off, and its buoyancy elsewhere."""
    return add_module(body("core"), 0, 1, "FixedBrick")


def righted(settings, **task):
    return settings("lifting", trim="neutral") | {
        "task": {"type": "speed", "duration": 3.0, "settle": 0.5, "trials": 3, **task}
    }


@pytest.mark.slow
def test_a_righted_body_starts_with_its_centre_of_mass_below_that_of_its_volume(settings):
    config = righted(settings, start_attitude="righted", start_tilt=0.0, start_yaw=1.0)
    many = make_mixed_fitness(config, [lopsided(), body("core")])
    robots = [many.build(lopsided()), many.build(body("core"))]
    for robot, figure in zip(robots, figures_alone_and_in_a_batch(many, robots), strict=True):
        modules = robot.morphology.modules
        parts = [(m.position + m.rotation @ part.position, m.rotation, part)
                 for m in modules for part in m.kind.parts]  # fmt: skip
        mass, volume = (np.array([getattr(p, x) for *_, p in parts])
                        for x in ("mass", "total_volume"))  # fmt: skip
        # By MuJoCo, and by hand.
        model = robot.mj_model
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        weighs = data.subtree_com[1] - data.xpos[1]
        floats = volume @ [o + r @ part.displaced_center for o, r, part in parts] / volume.sum()
        lever = floats - weighs
        # The core alone balances in any attitude, and so stays level.
        expected = lever / np.linalg.norm(lever) if lever.any() else np.array([0.0, 0.0, 1.0])
        assert mass.sum() == pytest.approx(volume.sum() * RHO, rel=1e-4)
        pose = start_pose(TASKS["speed"], many.config.task, many.world, figure,
                          many.draw_starts(KEY))  # fmt: skip
        for quat in np.asarray(pose[3:].T, float):
            turned = np.zeros(3)
            mujoco.mju_rotVecQuat(turned, expected, quat)
            assert turned == pytest.approx([0, 0, 1], abs=1e-5)


def figures_alone_and_in_a_batch(many, robots):
    """Each robot's figure, once it was seen that a batch has the same numbers."""
    together = many.pack(robots).figure
    for k, robot in enumerate(robots):
        alone = body_geometry(robot)
        for name in alone._fields:
            batch = np.asarray(getattr(together, name), float)[..., k]
            assert batch == pytest.approx(np.asarray(getattr(alone, name), float), rel=1e-6), name
        yield alone


def test_what_points_down_is_turned_half_way_round(settings):
    config = righted(settings, start_attitude="righted", start_tilt=0.0)
    fitness = make_fitness(config)
    figure = body_geometry(fitness.robot)._replace(up=[0.0, 0.0, -1.0])
    pose = start_pose(fitness.task, fitness.settings, fitness.robot.world, figure,
                      fitness.draw_starts(KEY))  # fmt: skip
    down = np.zeros(3)
    mujoco.mju_rotVecQuat(down, np.array([0.0, 0.0, -1.0]), np.asarray(pose[3:, 0], float))
    assert down == pytest.approx([0, 0, 1], abs=1e-6)


def test_what_starts_on_a_slope_starts_outside_it():
    """Wherever the core stands, no corner is in the bed."""
    lake = load_world("lake", bed={"kind": "lake", "height": -0.3, "highest": 0.15, "extent": 1.8})
    figure = body_geometry(build_robot(body("spider"), lake))
    around = figure.radius * np.exp(1j * np.linspace(0, 2 * np.pi, 100))
    for x in np.linspace(-0.7, 0.7, 9):
        place = jnp.array([x, 0.2, 0.0])
        lowest = start_on_bed(TaskConfig(type="crawl"), lake, figure, place)[2] - figure.lowest
        assert lowest > np.max(bed_height(lake.bed, x + around.real, 0.2 + around.imag))
    # A start of one's own may be anywhere.
    swim, given = TASKS["speed"], (TaskConfig(type="speed"), load_world("lake"), 0.1)
    assert not may_touch_bed(swim, *given)
    assert may_touch_bed(Task(lambda *_: 0.0, "m", start=start_on_bed), *given)


def test_what_starts_on_the_bed_starts_level(settings):
    config = settings("standing", world={"bed": {"kind": "flat", "height": -2.0}})
    config["task"] = config["task"] | {"start_attitude": "righted"}
    with pytest.raises(InputError, match=r"start_attitude: expected level, as .* starts on"):
        make_fitness(config)


@pytest.mark.slow
def test_targets_are_drawn_anew_for_each_episode_and_move():
    settings = TaskConfig(type="reach_target", target_distance=1.5, target_speed=0.2, trials=64)
    starts = draw_starts(settings, load_world("lake"), jax.random.key(0), 10)
    place = jnp.ones((3, 64))
    cues = episode_context(settings, starts, place)
    away = np.stack(cues.target) - 1
    assert np.hypot(*away[:2]) == pytest.approx(1.5) and not away[2].any()
    bearing = np.arctan2(away[1], away[0])
    assert bearing.min() < -2 and bearing.max() > 2 and len(set(bearing)) == 64
    path = np.asarray(target_path(cues, jnp.array([0.0, 0.5, 2.0])))
    assert path[0] == pytest.approx(np.stack(cues.target))
    moved = path[2] - path[0]
    assert np.hypot(*moved[:2]) == pytest.approx(0.4, rel=1e-5) and not moved[2].any()
    # Another key, other targets and noise; a narrower spread, nearer to the x axis.
    other = draw_starts(settings, load_world("lake"), jax.random.key(1), 10)
    assert not np.any(other.towards[:2] == starts.towards[:2])
    assert not np.any(other.noise == starts.noise) and len(set(starts.noise.tolist())) == 64
    narrow = settings.model_copy(update={"target_spread": 0.3})
    towards = draw_starts(narrow, load_world("lake"), jax.random.key(0), 10).towards
    assert np.abs(np.arctan2(towards[1], towards[0])).max() <= 0.3 + 1e-6


def test_what_is_drawn_for_a_start_is_independent():
    """No two of the tilt, the first gust, the heading and the time of the sea are the same draw."""
    world = load_world("lake", gust={"std": 1}, waves=[{"amplitude": 0.1, "period": 2}])
    task = TaskConfig(type="speed", start_tilt=0.01, start_yaw=0.01, start_position=1, trials=500)
    starts = draw_starts(task, world, jax.random.key(0), 1)
    w, x, y, z = np.asarray(starts.quat)
    rows = [x / w, y / w, z / w, *starts.place, *starts.gusts[0, :2], starts.water.time]
    ranks = np.argsort(np.argsort([*rows, starts.noise], axis=1), axis=1)
    assert np.abs(np.corrcoef(ranks) - np.eye(len(ranks))).max() < 0.2


def test_a_target_that_flees_must_be_followed():
    """From 4 m away to 1 m, while the target goes 1 m further."""
    row = np.array([0.0, 1.0, 4.0])
    zero = np.zeros_like(row)
    target = np.stack([4 + row / 4, zero, zero], 1)
    track = make_track(np.stack([row, zero, zero], 1), interval=0.1, target=target)
    found = TASKS["reach_target"].score(track, TaskConfig(type="reach_target", target_distance=4.0))
    assert found == pytest.approx((4 - 1) / 0.5)


@pytest.mark.slow
def test_a_target_is_recorded_as_it_is_felt(settings):
    """A robot at rest far away: the score of an episode is that of its trajectory."""
    task = {"type": "reach_target", "target_distance": 1.0, "target_speed": 0.5, "duration": 1.0}
    task |= {"settle": 0.0, "depth": 1.0, "trials": 1, "start_tilt": 0.0}
    fitness = make_fitness(settings("lifting", task=task, trim="neutral"))
    key, genes = jax.random.key(4), np.zeros(fitness.num_genes)
    score = fitness(genes[None], key)
    assert fitness.judge(fitness.replay(genes, key), key)[0] == pytest.approx(float(score[0]))
    cues = fitness.context(key)
    away = [np.linalg.norm(np.stack(cues.target_at(t)) - [0, 0, -1]) for t in (0.1, 1.0)]
    length = fitness.robot.morphology.length
    assert score[0] == pytest.approx((away[0] - away[1]) / length, abs=0.05)


@pytest.mark.parametrize(("name", "task", "genes"), [
    ("lake_target", "reach_target", 8 * (1 + 3 * 2 + 1 + 3) + 10 + 1),
    ("auv_follow_bed", "follow_bed", 1 + 4 * (1 + 1 + 1 + 3 + 3 + 3)),
])  # fmt: skip
def test_shipped_configurations_of_tasks_that_need_senses(name, task, genes):
    """Per hinge A, B and three answers to each number; per thruster B and answers; f."""
    fitness = make_fitness(name)
    assert fitness.config.task.type == task
    assert fitness.num_genes == genes
