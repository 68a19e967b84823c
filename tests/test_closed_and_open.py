"""The study of tasks that need senses: what is compared, and what its table says."""

import csv

import pytest

from experiments import senses
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.tasks import TASKS


@pytest.mark.parametrize("name", senses.CONFIGS)
def test_cases_differ_in_what_they_feel_only(name):
    cases = senses.make_cases(name, ["evolution.generations=7"])
    found = {case: load_config(name, settings) for case, settings in cases.items()}
    ours = found["closed"]
    assert ours.controller == load_config(name).controller
    assert set(found) - {"without"} == {"closed", *senses.OPEN}
    for case, config in found.items():
        assert config.task == ours.task and config.evolution == ours.evolution
        assert config.evolution.generations == 7
        assert config.world == ours.world and config.morphology == ours.morphology
        if case in senses.OPEN:
            assert config.controller.type == case and config.controller.sensors is None
    if "without" in found:
        kinds = {sensor.type for sensor in found["without"].controller.sensors}
        taken = {sensor.type for sensor in ours.controller.sensors} - kinds
        assert kinds and taken == set(senses.CONFIGS[name].settings)


def test_all_tasks_that_need_senses_are_compared():
    """All but those that are scored along a way that stays, as open loops can swim it."""
    compared = {load_config(name).task.type for name in senses.CONFIGS}
    assert compared == TASKS.keys() - {"directed_swim", "speed", "crawl"}


def test_the_best_open_loop_counts():
    scores = {"closed": [2.0, 3.0], "cpg": [0.0, 1.0], "sine": [1.0, 1.5], "still": [1.0]}
    assert senses.best_open(scores) == "sine"
    assert senses.compare(scores).mean == pytest.approx(1.25)
    # To do nothing is an open loop, too, and its score is the same for all seeds.
    lazy = scores | {"still": [1.3]}
    assert senses.best_open(lazy) == "still"
    found = senses.compare(lazy)
    # Student's t of one degree of freedom, 12.706, times the standard error of 2 and 3.
    assert found.mean == pytest.approx(1.2)
    assert found.low == pytest.approx(1.2 - 12.7062 * 0.5, abs=1e-3)
    assert senses.best_open({"closed": [1.0]}) == ""


def test_the_report_says_which_is_better(tmp_path):
    found = {
        name: (senses.plan_config(tmp_path, name, (), 3), scores)
        for name, scores in (
            ("auv_escape", {"closed": [0.9, 0.8, 0.9], "without": [0.4] * 3, "cpg": [0.5] * 3}),
            ("auv_search", {"closed": [0.5, 0.1, 0.3], "sine": [0.3, 0.2, 0.4], "still": [0.0]}),
        )
    }
    first, second = senses.write_report(tmp_path, found)
    assert (first["name"], first["unit"], first["budget"]) == (
        "auv_escape", "of the first distance", "60 × 64 × 8",
    )  # fmt: skip
    assert (first["closed"]["text"], first["best_open"]) == ("0.87 ± 0.14", "cpg")
    assert (first["open"]["text"], first["difference"]["text"]) == ("0.5", "0.37 ± 0.14")
    assert second["best_open"] == "sine"
    with (tmp_path / "senses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9 + 7 and rows[0]["case"] == "closed" and rows[1]["score"] == "0.8"
