"""Tasks and controllers in users' own files: every mistake is one line, and runs keep the code."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import ELBOW, check_refused
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.evolution.fingerprints import settings_hash
from mjx_revolve.evolution.run import check_unchanged
from mjx_revolve.inputs import user_code as own_code
from mjx_revolve.view.report.data import read_run

OWN = '''
"""A task and a controller of one's own."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.controller import Controller


@dataclass(frozen=True)
class Wish:
    height: float


def rise(track, settings):
    """How far the robot ends above where it began, beyond a wish [m]. Not [kg].

    Further [words].
    """
    wish = Wish(settings.params.get("height", 0.0))
    return track.position[-1, 2] - track.start_height - wish.height


def bare(track, settings):
    return rise(track, settings)


def make_hold(plant, settings):
    """Each actuator holds an angle of its own."""
    n = plant.num_actuators
    share = settings.amplitude

    def decode(genes, plant):
        return share * plant.reach(genes) * plant.arrange(jnp.sin(genes))

    def step(parameters, state, time, sense):
        return state + 1, parameters + 0 * state

    names = tuple(f"angle {i}" for i in range(n))
    return Controller(n, names, decode, lambda parameters: jnp.zeros_like(parameters[0]), step)
'''
SETTINGS = {
    "morphology": "elbow.yaml",
    "world": "lake",
    "controller": {"type": "mine/own.py:make_hold"},
    "task": {"type": "mine/own.py:rise", "duration": 0.2, "settle": 0.0, "trials": 1},
    "evolution": {"population_size": 4, "generations": 2, "checkpoint_every": 1},
}
GENES = jnp.array([[0.3, -0.7], [0.0, 0.0]])


def fill(folder):
    """A folder with a configuration that names own code."""
    (folder / "mine").mkdir()
    (folder / "mine" / "own.py").write_text(OWN)
    (folder / "elbow.yaml").write_text(ELBOW)
    (folder / "swim.yaml").write_text(json.dumps(SETTINGS))
    return folder


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Such a folder, current."""
    monkeypatch.chdir(tmp_path)
    return fill(tmp_path)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The fitness of such a configuration, compiled once."""
    folder = fill(tmp_path_factory.mktemp("own"))
    return make_fitness(folder / "swim.yaml", **{"task.params": {"height": 0.25}})


@pytest.mark.slow
def test_an_own_task_scores_what_an_own_controller_does(lab):
    scores, measures = lab.evaluate(GENES, jax.random.key(0))
    # In a fifth of a second the robot sinks by some millimetres below where it began.
    fallen = np.asarray(measures["depth_error_m"])
    assert (fallen > 1e-4).all() and (fallen < 0.05).all()
    assert (np.asarray(scores) < -0.25 - fallen).all()
    assert (np.asarray(scores) > -0.25 - 2 * fallen).all()


def test_targets_stand_in_the_order_that_is_asked_for(lab):
    reach = lab.robot.mj_model.actuator_ctrlrange[:, 1]
    angles = reach * np.sin(np.asarray(GENES[0]))
    for order in ([0, 1], [1, 0]):
        parameters = lab.controller.decode(GENES.T, plant_of(lab.robot, order))
        state = lab.controller.init(parameters)
        _, targets = lab.controller.step(parameters, state, 0.0, None)
        assert np.asarray(targets)[:, 0] == pytest.approx(angles[order], rel=1e-6)


def test_a_changed_file_is_read_anew_and_an_unchanged_one_is_not(folder):
    name = f"{folder / 'mine' / 'own.py'}:rise"
    first = own_code.load_user_function(name, "task.type")
    assert own_code.load_user_function(name, "task.type") is first
    (folder / "mine" / "own.py").write_text(OWN.replace("wish.height", "2 * wish.height"))
    assert own_code.load_user_function(name, "task.type") is not first


@pytest.mark.parametrize(
    ("text", "message"),
    [
("", "override task.type: expected a function rise in {own}; found no function in it"),
("raise SystemExit(3)", "{own}: line 1: expected Python that runs; found SystemExit: 3"),
("def rise(track, settings):\n    raise SystemExit", "line 2: expected rise to score a track"),
("def rise(track, settings):\n    return track.height", "{own}: line 2: expected rise to "
         "score a track; found AttributeError: 'Track' object has no attribute 'height'"),
("def rise(track, settings):\n    return track.position[:, 2]", "{own}: rise: expected a "
         "score for each lane, [3] for a position of [7, 3, 3]; found [7, 3]")
],
)  # fmt: skip
def test_wrong_tasks(folder, text, message):
    own = folder / "mine" / "task.py"
    own.write_text(text)
    settings = {"task.type": "mine/task.py:rise"}
    check_refused(message.format(own=own), lambda: make_fitness("swim.yaml", **settings))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
("Controller(n,", "Controller(n + 1,", "{own}: make_hold: gene_names: expected 3 of them, "
         "as num_genes says; found 2"),
("jnp.sin(genes)", "jnp.sin(gene)", "{own}: line 36: expected make_hold's decode, init and "
         "step to give targets; found NameError: name 'gene' is not defined")
],
)  # fmt: skip
def test_wrong_controllers(folder, old, new, message):
    own = folder / "mine" / "own.py"
    assert old in OWN
    own.write_text(OWN.replace(old, new))
    check_refused(message.format(own=own), lambda: make_fitness("swim.yaml"))


def test_a_run_keeps_the_code(folder):
    config = load_config("swim.yaml")
    run, kept = runs.create_run_folder("run", config, config_file=config.source, settings=[])
    run.close()
    copy = folder / "run" / "inputs" / "own.py"
    assert copy.read_text() == OWN
    assert kept.task.type == f"{copy}:rise" and kept.controller.type == f"{copy}:make_hold"
    assert settings_hash(kept) == settings_hash(config)
    text = (folder / "run" / "config.yaml").read_text()
    assert "type: inputs/own.py:rise" in text and "type: inputs/own.py:make_hold" in text
    shutil.move("run", "moved")
    again = load_config("moved/config.yaml")
    assert again.task.type == f"{folder / 'moved' / 'inputs' / 'own.py'}:rise"
    assert settings_hash(again) == settings_hash(config)
    record = read_run("moved")
    assert record.unit == "kg" and record.task.startswith("rise ")
    check_unchanged(again, config, "--resume run")
    (folder / "mine" / "own.py").write_text(OWN + "\n")
    changed, message = load_config("swim.yaml"), "--resume run: controller.type: expected '"
    assert settings_hash(changed) != settings_hash(again)
    check_refused(message, check_unchanged, again, changed, "--resume run")
