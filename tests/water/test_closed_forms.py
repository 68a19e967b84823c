"""The water against closed forms, through the engine: the cases of `experiments.validation`."""

import pytest

from experiments.validation_cases import CASES, QUICK_CASES

# Those of whole rollouts are what `tests/episodes` and `tests/engine/test_step.py` are about.
NAMES = [
    name if name in QUICK_CASES else pytest.param(name, marks=pytest.mark.slow)
    for name in CASES
    if name not in ("gradient", "time step")
]


@pytest.mark.parametrize("name", NAMES)
def test_the_water_obeys_its_closed_forms(name):
    result = CASES[name]()
    assert result.rows
    assert [row for row in result.rows if not row.passed] == []
