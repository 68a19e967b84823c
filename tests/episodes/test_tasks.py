"""Tasks own their starts, unit, and what they have recorded; one body and many see the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import QUICK, body
from mjx_revolve import InputError, make_fitness, make_mixed_fitness
from mjx_revolve.episodes.tasks import RECORDS, TASKS, Task, score_unit

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


@pytest.fixture(scope="module", autouse=True)
def quick_compiles():
    """Leaves out the compiler's optimisations: they cost more than these short runs save."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mjx_revolve.episodes.evaluation.compiler_options", lambda: QUICK)
        yield


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tasks")
    (folder / "own.py").write_text(OWN)
    body("core").save(folder / "core.yaml")
    task = {"duration": 1.0, "settle": 0.2, "trials": 1, "start_tilt": 0.0}

    def make(name, **more):
        return {
            "morphology": str(folder / "core.yaml"),
            "world": {"name": "lake", **more.pop("world", {})},
            "controller": {"type": "sine"},
            "task": task | {"type": f"{folder / 'own.py'}:{name}"},
        } | more

    return make


def score(config):
    """Of zero genes, by the fitness of one body."""
    fitness = make_fitness(config)
    return fitness, float(fitness(jnp.zeros((1, fitness.num_genes)), KEY)[0])


def test_the_waters_force_on_a_neutral_body_is_its_weight(settings):
    fitness, found = score(settings("lifting", trim="neutral"))
    assert found == pytest.approx(fitness.robot.morphology.mass * G, rel=1e-4)
    assert fitness.task.unit == "N"


def test_the_beds_force_on_a_body_at_rest_is_what_the_water_leaves_of_its_weight(settings):
    tank = {"bed": {"kind": "flat", "height": -2.0}}
    fitness, found = score(settings("standing", world=tank))
    core = fitness.robot.morphology
    assert found == pytest.approx((core.mass - RHO * core.volume) * G, rel=0.02)
    # A champion's own trajectory says the same as its score.
    genes = np.zeros(fitness.num_genes, np.float32)
    judged, _ = fitness.judge(fitness.replay(genes, KEY), KEY)
    assert judged == pytest.approx(found, rel=1e-3)


@pytest.mark.slow
def test_joints_are_recorded_for_one_body_and_for_many(settings, tmp_path):
    """Held at their offsets, in the robot's own order, whatever the engine's."""
    body("snake").save(tmp_path / "snake.yaml")
    config = settings("bending", morphology=str(tmp_path / "snake.yaml"))
    one = make_fitness(config)
    names = list(one.controller.gene_names)
    genes = np.zeros((1, one.num_genes), np.float32)
    genes[0, [k for k, name in enumerate(names) if name.startswith("offset")]] = 0.3
    expected = one.robot.num_hinges * 0.5 * np.pi / 4 * np.sin(0.3)
    found = float(one(genes, KEY)[0])
    assert found == pytest.approx(expected, rel=0.05)
    many = make_mixed_fitness(config, [body("snake"), body("core")])
    robots = [many.build(body("core")), many.build(body("snake"))]
    wide = jnp.concatenate([jnp.zeros((1, many.num_genes)), many.pad_genes(genes, robots[1])])
    assert np.asarray(many(robots, wide, KEY)) == pytest.approx([0.0, found], abs=1e-4)


def test_what_may_be_recorded_is_named():
    with pytest.raises(InputError, match=f"records: expected any of {', '.join(RECORDS)}; found"):
        Task(lambda track, settings: track.position[-1, 2], records=("thoughts",))


def test_units_are_those_of_the_first_lines():
    for name, task in TASKS.items():
        assert f"[{task.unit}]" in task.score.__doc__.splitlines()[0]
        assert score_unit(name) == task.unit
