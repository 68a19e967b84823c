"""Grids of settings: where values are cut, what combinations there are, and their names."""

import pytest

from laboratory import check_refused
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.grids import combine, read_axes, split_values


@pytest.mark.parametrize(
    ("text", "values"),
    [
("a.yaml,b.yaml", ["a.yaml", "b.yaml"]),
("[0,0,0],[0.1, 0, 0]", ["[0,0,0]", "[0.1, 0, 0]"]),
("{name: lake, bed: {height: -2}},{}", ["{name: lake, bed: {height: -2}}", "{}"]),
("'it''s, here',don't,can't", ["'it''s, here'", "don't", "can't"])
],
)  # fmt: skip
def test_commas_separate_values_outside_of_brackets_and_quotes(text, values):
    assert split_values(text, "--set a") == values


def test_a_grid_has_all_combinations_by_names_that_folders_may_have():
    axes = read_axes(
        ["morphology=my/spider.yaml,gecko", "task.duration=5", "evolution.population_size=8,16"]
    )
    assert combine(axes, "lake_swim") == {
        "morphology=spider+population_size=8":
            ("morphology=my/spider.yaml", "task.duration=5", "evolution.population_size=8"),
        "morphology=spider+population_size=16":
            ("morphology=my/spider.yaml", "task.duration=5", "evolution.population_size=16"),
        "morphology=gecko+population_size=8":
            ("morphology=gecko", "task.duration=5", "evolution.population_size=8"),
        "morphology=gecko+population_size=16":
            ("morphology=gecko", "task.duration=5", "evolution.population_size=16"),
    }  # fmt: skip
    assert combine(read_axes(["task.duration=5"]), "lake_swim") == {
        "lake_swim": ("task.duration=5",)
    }
    assert combine([], "lake_swim") == {"lake_swim": ()}


@pytest.mark.parametrize(("settings", "message"), [
    (["a.b"], "--set a.b: expected KEY.PATH=VALUE; found 'a.b'"),
    (["a=1,,2"], "--set a: expected YAML values between commas; found '1,,2'"),
    (["a=[1,2"], "expected YAML values between commas"),
    (["a=1,2,1.0"], "--set a: expected each value once; found '1.0' twice"),
    (["a=1", "a=2"], "--set a: expected each setting once, with commas between its values"),
])  # fmt: skip
def test_what_is_no_grid_is_refused_in_one_line(settings, message):
    check_refused(message, read_axes, settings)


def test_true_is_not_one_and_a_million_combinations_are_a_mistake():
    assert read_axes(["a=1,true"])[0].texts == ("1", "true")
    numbers = ",".join(map(str, range(11)))
    with pytest.raises(InputError, match="expected at most 1000 combinations; found 1331"):
        combine(read_axes([f"{key}={numbers}" for key in "abc"]), "")
