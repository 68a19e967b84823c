"""Studies of many evolutions: run, stopped and continued, what few seeds say, the reports."""

import csv
import json

import numpy as np
import pytest

from experiments import budgets, environments, studies
from experiments.environments import ENVIRONMENTS
from experiments.random_bodies import random_body
from laboratory import ROOT
from mjx_revolve.episodes.run_reader import RunReader
from mjx_revolve.evolution.run_folder import RunFolder
from mjx_revolve.evolution.sweeps import Plan
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.body_pictures import plot_bodies
from mjx_revolve.view.outcomes import Outcome, by_case
from toys import contents, make_toy_bodies

TINY = [
    f"--set={setting}"
    for setting in (
        "evolution.population_size=6", "bodies.selection.offspring=4",
        "bodies.learning.population_size=2", "bodies.learning.generations=1",
        "bodies.learning.strategy=SNES", "bodies.max_modules=8", "bodies.max_hinges=4",
    )
]  # fmt: skip


@pytest.fixture
def started(monkeypatch):
    """A fitness that costs nothing; what was run."""
    monkeypatch.setattr(studies, "MAKE_FITNESS", make_toy_bodies)
    commands = []
    run_plans = studies.run_plans

    def run(steps, *arguments):
        commands.extend((plan.name, step) for plan, step in steps.items() if step != "finished")
        return run_plans(steps, *arguments)

    monkeypatch.setattr(studies, "run_plans", run)
    monkeypatch.setattr(
        environments, "write_report", lambda *_: {"runs": []}
    )  # its pictures take a while
    return commands


write_report = environments.write_report


def study(folder, *options):
    return environments.main(["--out", str(folder), *TINY, "--seeds", "1", *options])


@pytest.mark.long
def test_a_study_runs_what_is_left_and_reports_it(tmp_path, started, monkeypatch, capsys):
    two = ("--only", "bed,open_water")
    assert study(tmp_path, *two, "--generations", "2") == 0
    assert len(started) == 2
    assert "2 of 2 runs" in capsys.readouterr().out

    # Again: nothing to do. Another case: only its runs.
    assert study(tmp_path, *two, "--generations", "2") == 0
    assert len(started) == 2
    assert capsys.readouterr().out.count("finished before") == 2

    # More generations: each goes on, to where it would have come at once.
    assert study(tmp_path, *two, "--generations", "3") == 0
    assert started[2:] == [("open_water/seed_0", "continue"), ("bed/seed_0", "continue")]
    once = tmp_path / "once"
    assert study(once, "--only", "bed", "--generations", "3") == 0
    assert contents(once / "bed" / "seed_0") == contents(tmp_path / "bed" / "seed_0")

    # What would be another study is refused, before anything runs.
    count = len(started)
    for options, message in (
        (("--generations", "2"), "expected a run of 2 generations at most; found 3"),
        (("--generations", "3", "--set", "task.duration=7"), "task.duration: expected 12"),
        (("--generations", "3", "--set", "world.timestep=0.01"), "--set world.timestep: expected"),
    ):
        with pytest.raises(InputError, match=message):
            study(tmp_path, *two, *options)
    assert len(started) == count

    # A champion's figures are the run's, a population's the means over those that live.
    monkeypatch.setattr(environments, "write_report", write_report)
    assert study(tmp_path, *two, "--generations", "3", "--report") == 0
    assert len(started) == count
    with (tmp_path / "environments.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["environment"], row["seed"], row["of"]) for row in rows[:3]] == [
        ("open_water", "0", "champion"), ("open_water", "0", "population"),
        ("bed", "0", "champion"),
    ]  # fmt: skip
    folder = tmp_path / "bed" / "seed_0"
    assert float(rows[2]["score"]) == RunFolder(folder).info["champion"]["score"]
    living = json.loads((folder / "generations.jsonl").read_text().splitlines()[-1])["living"]
    lives = map(json.loads, (folder / "individuals.jsonl").read_text().splitlines())
    hinges = [life["descriptors"]["num_hinges"] for life in lives if life["id"] in living]
    assert len(hinges) == 6
    assert float(rows[3]["num_hinges"]) == pytest.approx(np.mean(hinges))
    for name in ("bodies", "figures", "curves"):
        picture = tmp_path / f"environments_{name}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_champions_are_judged_at_rest_and_over_the_horizon(tmp_path, started, monkeypatch):
    made, found = [], []

    def make_fitness(config):
        made.append((config.task.duration, config.task.horizon))
        return make_toy_bodies(config)

    shore = environments.ENVIRONMENTS["shore"]._replace(settings=())  # with the horizon of all
    monkeypatch.setitem(environments.ENVIRONMENTS, "shore", shore)
    monkeypatch.setattr(studies, "MAKE_FITNESS", make_fitness)
    monkeypatch.setattr(
        environments, "write_report", lambda _, outcomes: found.extend(outcomes) or {"runs": []}
    )
    assert study(tmp_path, "--only", "shore", "--generations", "2", "--seeds", "2") == 0
    assert made[-2:] == [(12, 60), (60, None)]
    assert len(found) == 2
    for outcome in found:
        genes = RunReader(outcome.plan.folder).load_champion().genes
        hinges = -((outcome.champion["num_hinges"] - 3) ** 2)
        # What toys score, but for noise: a hundredth, less by the mean over eight starts.
        expected = np.array([hinges - 0.25, hinges - np.mean((genes - 0.5) ** 2)])
        scores = np.array([outcome.champion[name] for name in ("still_score", "swum_score")])
        assert scores == pytest.approx(expected, abs=0.02)
        assert np.diff(scores) == pytest.approx(np.diff(expected), abs=1e-5)


def test_environments_are_what_they_are_called():
    plans = {
        name: Plan(name, 3, ROOT, studies.BASE, case.settings).config
        for name, case in ENVIRONMENTS.items()
    }
    assert {plan.evolution.seed for plan in plans.values()} == {3}
    assert plans["open_water"].world == "empty_underwater"
    pond = plans["shore"].world["bed"]
    assert pond["height"] < -plans["shore"].task.depth < 0 < pond["highest"]
    assert (plans["bed"].trim, plans["bed"].task.type) == ("none", "crawl")
    against = np.dot(plans["current"].world["current"], plans["current"].task.direction)
    assert against == pytest.approx(-environments.CURRENT)
    figures = {"score": 0.1, "speed_bl_s": 0.12, "speed_m_s": 0.06}
    assert environments.through_water("current", figures)["water_speed_bl_s"] == pytest.approx(0.2)
    assert environments.through_water("shore", figures)["water_speed_bl_s"] == 0.1


@pytest.mark.parametrize("settings", [(), ("evolution.generations=7",)])
def test_budgets_are_equal(settings):
    cases = budgets.make_cases(settings)
    configs = {
        name: Plan(name, 0, ROOT, studies.BASE, (*settings, *case.settings)).config
        for name, case in cases.items()
    }
    trials = budgets.count_trials(configs["coevolution"])
    assert trials == (32 + (6 if settings else 31) * 64) * 8
    assert budgets.count_trials(configs["random_search"]) == trials
    for robot in budgets.ROBOTS:
        assert configs[robot].bodies is None
        evolution = configs[robot].evolution
        tried = evolution.population_size * evolution.generations
        assert trials <= tried < trials + evolution.population_size
        assert configs[robot].task == configs["random_search"].task
        assert configs[robot].trim == "neutral"


def outcomes(values):
    """Of invented champions; `values` of all speeds and gaits by case, all bodies are the same."""
    found, one = [], random_body(0, 2, 1)
    for case, numbers in values.items():
        for seed, number in enumerate(numbers):
            figures = {name: number for name in environments.FIGURES}
            figures |= {"score": number, **one.descriptors}
            curve = {"evaluations": np.array([10.0, 20.0]), "champion": np.array([0.0, number])}
            plan = Plan(case, seed, ROOT / case / f"seed_{seed}", studies.BASE, ())
            found.append(Outcome(plan, figures, figures, curve | {"seconds": np.ones(2)}, one))
    return found


def test_champions_of_many_seeds_take_further_lines():
    cases = by_case(outcomes({"open_water": range(7), "shore": range(2)}), ENVIRONMENTS)
    figure = plot_bodies(cases)
    titles = [axes.get_title().partition(":")[0] for axes in figure.axes]
    assert titles == [
        *(f"seed {k}" for k in range(7)), *[""] * 3, "seed 0", "seed 1", *[""] * 3,
    ]  # fmt: skip


def test_a_difference_is_said_only_where_the_tests_bear_it():
    def said(values):
        cases = by_case(outcomes(values), ENVIRONMENTS)
        figures = environments.compare_figures(cases, "champion")
        return environments.describe_differences(figures, "champions"), figures

    low, middle = [0.1, 0.2, 0.3, 0.4, 0.5], [0.15, 0.25, 0.35, 0.45, 0.55]
    values = {"open_water": low, "shore": middle, "bed": [x + 1 for x in low], "current": middle}
    lines, figures = said(values)
    # All speeds and gaits, no descriptor.
    assert len(lines) == len(environments.FIGURES) - 8
    assert lines[0] == (
        "- water speed (body lengths/s) of champions: larger in `bed` (1.3) than in "
        "`open_water` (0.3), `shore` (0.35), `current` (0.35)"
    )
    # Benjamini and Hochberg: half of the figures have the same p, so it is doubled.
    assert figures[0].p == pytest.approx(2 * figures[0].comparison.p)
    assert figures[-1].p == 1
    row = environments.tabulate(figures)[0]
    assert row["name"] == "water speed (body lengths/s)"
    assert row["open_water"]["text"] == "0.30 ± 0.20"
    # Rank sums 35, 42.5, 90, 42.5 and five ties: of 9,999 permutations some forty part them so.
    assert row["p"] == "**.008**"

    # Not even then where pairs do not bear it: three seeds, however far they are apart.
    lines, figures = said({name: numbers[:3] for name, numbers in values.items()})
    assert lines == ["- No figure of champions tells two environments apart."]
    # Nor where all of them do not: one figure of many.
    assert environments.Compared("length", {}, 0.06, figures[0].comparison).differs == []
