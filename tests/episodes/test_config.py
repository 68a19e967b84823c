"""The configuration: every wrong input with its message, paths, overrides, and the way back."""

import pytest

from laboratory import check_refused
from mjx_revolve.control.table import CONTROLLERS
from mjx_revolve.episodes import config, tasks
from mjx_revolve.episodes.config import dump_config, load_config, override_config

GOOD = """
morphology: robot.yaml
world: lake
task:
  type: directed_swim
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a valid config; the current folder is another one."""
    (tmp_path / "robot.yaml").write_text("id: robot\n")
    (tmp_path / "pond.yaml").write_text("density: 1000\n")
    (tmp_path / "good.yaml").write_text(GOOD)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return tmp_path


def test_defaults(folder):
    config = load_config(folder / "good.yaml")
    assert config.morphology == str(folder / "robot.yaml")
    assert config.source == str(folder / "good.yaml")
    assert config.name == "good"
    assert (config.world_name, config.world_overrides) == ("lake", {})
    assert (config.controller.type, config.controller.max_frequency) == ("cpg", 2.0)
    assert (config.task.duration, config.task.settle, config.task.trials) == (10.0, 1.0, 2)
    assert config.task.direction == (1.0, 0.0, 0.0)
    assert (config.evolution.strategy, config.evolution.population_size) == ("CMA_ES", 64)
    assert (config.trim, config.engine, config.modules) == ("none", "population", None)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
("task.settle=10", "task.settle: expected a time below task.duration (10 s); found 10"),
("task.type=swim", f"task.type: expected one of {', '.join(config.TASKS)}, or "
         "FILE.py:FUNCTION; found 'swim'"),
("task.type=follow_bed", "task.height: expected a number > 0 [m], because task.type is "
         "follow_bed; found none"),
("task={type: reach_target, target: [1, 0, 0], target_distance: 1}", "task.target: "
         "expected none, as there is a target_distance; found one"),
("task={type: follow_course, course_spread: 1, direction: [0, 0, 1]}", "task.direction: "
         "expected one that is not upright, as there is a course_spread, which is level; found"),
("colony={look: 4}", "colony.look: expected a whole part of the interval (10 s); found 4"),
("controller={type: sine, harmonics: 8}", "controller.max_frequency: expected at most half of "
         "controller.rate (20 Hz), to be sampled by it, of the last of 8 harmonics; found 2"),
("controller.harmonics=3", "--set controller.harmonics: expected 1, as only type sine has "
         "it (--set controller.harmonics=1); found 3"),
("task={type: speed, duration: 6, horizon: 3}", "--set task.horizon: expected a time >= "
         "task.duration (6 s); found 3"),
("bodies={archive: &a {axes: {a: {low: 0, high: 1, cells: 9999}, b: {low: 0, high: 1, cells: "
         "9999}}}}", "--set bodies.archive.axes: expected at most 10,000,000 cells; found 99,98"),
("bodies={selection: {type: map_elites, objectives: [-mass]}, archive: {axes: {a: {low: 0, "
         "high: 1}, b: {low: 0, high: 1}}}}", "bodies.selection.objectives: expected score, as"),
("task.durtion=5", "--set task.durtion: expected one of 32 keys; found an unknown key; "
         "did you mean task.duration?"),
("task.depth_tol=1", "; did you mean task.depth_tolerance?"),
("bodies.passport=required", "found an unknown key; did you mean bodies.selection.passport?"),
("world={density: 1}", "expected a `name` (a world's name or path) beside the overrides"),
],
)  # fmt: skip
def test_wrong_settings(folder, setting, message):
    check_refused(message, lambda: load_config(folder / "good.yaml", [setting]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
("body: {type: Core}", "bad.yaml: expected a configuration; found a robot"),
(GOOD + "  duration: -3", "bad.yaml: task.duration: expected a number > 0 and <="),
(GOOD.replace("lake", "no/pond.yaml"), "bad.yaml: world: expected a file; found none at"),
(GOOD.replace("type: directed_swim", "trials: 2"), "bad.yaml: task.type: expected one of")
],
)  # fmt: skip
def test_wrong_files(folder, text, message):
    (folder / "bad.yaml").write_text(text)
    check_refused(message, lambda: load_config(folder / "bad.yaml"))


def test_the_kinds_are_those_there_are():
    assert config.TASKS.keys() == tasks.TASKS.keys()
    needs = {name for names in config.TASKS.values() for name in names}
    assert needs <= config.TaskConfig.model_fields.keys()
    own = {name for kind in CONTROLLERS.values() for name in kind.settings}
    assert own <= config.ControllerConfig.model_fields.keys()


def test_settings_are_yaml(folder):
    settings = [
        "task.duration=20", "task.energy_weight=1e-3", "task.direction=[0, 1, 0]",
        "task.target=null", "evolution.strategy_params.std_min=0.1", "world.current=[0.1, 0, 0]",
    ]  # fmt: skip
    config = load_config(folder / "good.yaml", settings)
    assert config.task.duration == 20.0
    assert config.task.energy_weight == 1e-3
    assert config.task.direction == (0.0, 1.0, 0.0)
    assert config.evolution.strategy_params == {"std_min": 0.1}
    assert config.world_name == "lake"
    assert config.world_overrides == {"current": [0.1, 0, 0]}


def test_mappings_override_too(folder):
    config = load_config(folder / "good.yaml", {"task.trials": 3, "task": {"duration": 4.0}})
    assert (config.task.trials, config.task.duration, config.task.type) == (3, 4.0, "directed_swim")
    check_refused(
        "override task.trials: expected a whole number >= 1; found 0",
        lambda: load_config(folder / "good.yaml", {"task": {"trials": 0}}),
    )
    again = override_config(config, {"task.trials": 5, "task.direction": (0, 0, 1)})
    assert (again.task.trials, again.task.duration) == (5, 4.0)
    assert again.task.direction == (0, 0, 1)
    assert config.task.trials == 3


def test_typed_paths_start_from_the_current_folder(folder):
    config = load_config(folder / "good.yaml", ["morphology=../robot.yaml", "world=../pond.yaml"])
    assert config.morphology == str(folder / "robot.yaml")
    assert config.world == str(folder / "pond.yaml")


def test_settings_of_selection_without_effect_are_noted(caplog):
    odd = "bodies={selection: {type: random, tournament: 3, neighbours: 4}}"
    load_config("lake_map_elites", [odd])
    assert caplog.messages == [
        "bodies.selection.neighbours has no effect, as novelty is no objective",
        "bodies.selection.tournament has no effect: random holds none",
    ]


def test_written_paths_start_from_the_file(folder):
    (folder / "good.yaml").write_text(GOOD.replace("lake", "{name: pond.yaml, drag: mask}"))
    config = load_config(folder / "good.yaml")
    assert config.world_name == str(folder / "pond.yaml")
    assert config.world_overrides == {"drag": "mask"}


def test_dump_reads_back_equal(folder):
    settings = ["task.energy_weight=1e-5", "world.current=[0.1, 0, 0]", "task.target=[1, 2, 3]"]
    config = load_config(folder / "good.yaml", settings)
    (folder / "elsewhere" / "dumped.yaml").write_text(dump_config(config))
    assert load_config(folder / "elsewhere" / "dumped.yaml").model_dump() == config.model_dump()
    inside = dump_config(config, folder / ".." / folder.name)
    assert "morphology: robot.yaml" in inside
    (folder / "inside.yaml").write_text(inside)
    assert load_config(folder / "inside.yaml").model_dump() == config.model_dump()
    # Texts that look like numbers stay texts.
    (folder / "tasks.py").write_text("def score(track, settings):\n    return track.duration\n")
    own = ["task.type=../tasks.py:score", "task.params={tag: '1e3', word: '-.5'}"]
    config = load_config(folder / "good.yaml", own)
    (folder / "inside.yaml").write_text(dump_config(config, folder))
    assert load_config(folder / "inside.yaml").model_dump() == config.model_dump()


def test_own_functions_are_found_from_where_they_are_named(folder):
    """In a file from its folder, typed ones from the current folder."""
    (folder / "mine.py").touch()
    (folder / "elsewhere" / "mine.py").touch()
    (folder / "own.yaml").write_text(GOOD.replace("directed_swim", "mine.py:stay"))
    config = load_config(folder / "own.yaml", ["controller.type=mine.py:wave", "task.params.a=2"])
    assert config.task.type == f"{folder / 'mine.py'}:stay"
    assert config.controller.type == f"{folder / 'elsewhere' / 'mine.py'}:wave"
    assert (config.task.name, config.controller.name) == ("stay", "wave")
    assert config.task.params == {"a": 2}
    assert not load_config(folder / "good.yaml").task.is_user_code
    nested = load_config(folder / "own.yaml", {"task": {"type": "mine.py:go"}})
    assert nested.task.type == f"{folder / 'elsewhere' / 'mine.py'}:go"
    assert override_config(config, {"task.trials": 3}).task.type == config.task.type
    inside = dump_config(config, folder)
    assert "type: mine.py:stay" in inside and "type: elsewhere/mine.py:wave" in inside
    (folder / "inside.yaml").write_text(inside)
    assert load_config(folder / "inside.yaml").model_dump() == config.model_dump()


def test_older_run_folders_keep_the_values_of_their_worlds(tmp_path):
    """Unless they or their world's file state them; runs of this version do."""
    (tmp_path / "stated.yaml").write_text("density: 1000\nself_contact: true\ndrag: faces\n")
    (tmp_path / "left_out.yaml").write_text("density: 1000\n")
    old = {"drag": "faces", "self_contact": False}
    for world, expected in (
        ("lake", {"name": "lake", **old}),
        ("left_out.yaml", {"name": "left_out.yaml", **old}),
        ({"name": "lake", "density": 1025.0}, {"name": "lake", "density": 1025.0, **old}),
        ({"name": "lake", "self_contact": True}, {"name": "lake", **old, "self_contact": True}),
        ("stated.yaml", "stated.yaml"),
    ):
        assert config.with_older_values({"world": world}, tmp_path)["world"] == expected
    now = {"name": "lake", "drag": "cross_flow", "self_contact": True}
    assert config.state_world("lake") == now
