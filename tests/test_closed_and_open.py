"""The study of tasks that need senses: what is compared, and what its table says."""

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
