"""Studies of many evolutions: run, stopped and continued, what few seeds say, the reports."""

import csv
import json
import math
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from experiments import budgets, environments, statistics, studies
from experiments.environments import ENVIRONMENTS
from experiments.random_bodies import random_body
from laboratory import ROOT, body
from mjx_revolve import evolve
from mjx_revolve.evolution.runs import Run
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from toys import CLOCK, make_toy_bodies

# ------------------------------------------------------------------ statistics


def test_intervals_are_the_quantiles_of_resampled_means():
    # Of 0 and 1, a quarter of all resamples is (0, 0), a quarter (1, 1); of differences 1 in 16.
    assert statistics.interval([0, 1]) == (0.5, 0, 1)
    assert statistics.difference([10, 11], [0, 1]) == (10, 9, 11)
    assert statistics.interval([3, np.nan, 3]) == (3, 3, 3)
    assert str(statistics.interval([-2.0])) == "−2"
    assert str(statistics.interval([])) == "–"
    assert str(statistics.Interval(0.12345, -0.0, 1234.5)) == "0.123 [0, 1234]"


def test_rank_tests_are_exact_with_few_values_and_with_equal_ones():
    assert statistics.rank_test(range(5), range(5, 10)) == pytest.approx(2 / math.comb(10, 5))
    assert statistics.smallest_p(5, 5, 6) == pytest.approx(6 * 2 / 252)
    # Of the 20 ways to choose three of 1, 1, 2, 2, 3, 3, two have ranks as low as 1, 1, 2.
    assert statistics.rank_test([1, 1, 2], [2, 3, 3]) == pytest.approx(2 * 2 / 20)
    assert statistics.rank_test([1, 1], [1, 1, 1]) == 1


def test_holms_correction_by_hand():
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([0.6, 0.7]) == [1, 1]


def test_groups_are_compared_together_and_in_pairs():
    found = statistics.compare({"a": [1, 2, 3], "b": [4, 5, 6], "c": [7, 8, 9]})
    # Mean ranks 2, 5, 8: H = 12 / (9 · 10) · 3 (3² + 0 + 3²) = 7.2, of two degrees of freedom.
    assert found.p == pytest.approx(math.exp(-7.2 / 2))
    assert found.pairs == pytest.approx({("a", "b"): 0.3, ("a", "c"): 0.3, ("b", "c"): 0.3})
    assert statistics.compare({"a": [1, 1], "b": [1, 1]}).p == 1
    assert statistics.compare({"a": [1, 2]}) == (1, {})


# ------------------------------------------------------------------ runs

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
    """Commands run here, with a fitness that costs nothing; what was run."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    commands = []

    def run(arguments, log, interrupts):
        commands.append(arguments)
        log.parent.mkdir(parents=True, exist_ok=True)
        return run_command(lambda argv: evolve.main(argv, make_toy_bodies), arguments)

    monkeypatch.setattr(studies, "_run", run)
    monkeypatch.setattr(environments, "write_report", lambda *_: [])  # its pictures take a while
    monkeypatch.setattr(environments, "score_still", lambda outcomes: outcomes)
    return commands


write_report = environments.write_report


def study(folder, *options):
    return environments.main(["--out", str(folder), *TINY, "--seeds", "1", *options])


def metrics(folder):
    """What is reproducible of them."""
    found = Run(folder).load_metrics()
    return {name: values.tolist() for name, values in found.items() if name not in CLOCK}


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
    assert [command[0] for command in started[2:]] == ["--resume"] * 2
    once = tmp_path / "once"
    assert study(once, "--only", "bed", "--generations", "3") == 0
    assert metrics(once / "bed" / "seed_0") == metrics(tmp_path / "bed" / "seed_0")

    # What would be another study is refused, before anything runs.
    count = len(started)
    for options, message in (
        (("--generations", "2"), "expected a run of 2 generations at most; found 3"),
        (("--generations", "3", "--set", "task.duration=13"), "task.duration: expected 12"),
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
    assert float(rows[2]["score"]) == Run(folder).info["champion"]["score"]
    living = json.loads((folder / "generations.jsonl").read_text().splitlines()[-1])["living"]
    lives = map(json.loads, (folder / "individuals.jsonl").read_text().splitlines())
    hinges = [life["descriptors"]["num_hinges"] for life in lives if life["id"] in living]
    assert len(hinges) == 6
    assert float(rows[3]["num_hinges"]) == pytest.approx(np.mean(hinges))
    text = (tmp_path / "environments.md").read_text()
    for name in ("bodies", "figures", "curves"):
        assert f"(environments_{name}.png)" in text
        picture = tmp_path / f"environments_{name}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_no_checkpoint_is_of_begins_anew(tmp_path, started):
    options = environments.study_parser("environments", "", ENVIRONMENTS).parse_args(
        ["--out", str(tmp_path), *TINY, "--seeds", "1", "--only", "bed", "--generations", "1"]
    )
    _, (plan,) = studies.make_plans(ENVIRONMENTS, options, "environments")
    new = studies.next_command(plan)
    assert new[1:5] == ["--seed", "0", "--out", str(plan.folder)]
    assert studies.run_study([plan], "environments", []) == 0
    assert studies.next_command(plan) is None

    run = Run(plan.folder)
    run.update_info(finished=None)
    assert studies.next_command(plan)[0] == "--resume"
    for path in run.checkpoints():
        path.unlink()
    assert studies.next_command(plan) == new
    assert not plan.folder.exists()
    plan.folder.mkdir()
    (plan.folder / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"expected a run folder; found no config\.yaml"):
        studies.next_command(plan)


def test_a_run_that_fails_says_why(tmp_path, monkeypatch, capsys):
    words = "print('error: the pond is dry'); raise SystemExit(2)"
    monkeypatch.setattr(studies, "COMMAND", (sys.executable, "-c", words))
    assert study(tmp_path, "--only", "shore") == 1
    captured = capsys.readouterr()
    assert "[1/1] shore/seed_0: running ... failed: exit code 2" in captured.out
    assert captured.err.startswith("error: the pond is dry (all of it: ")


_SLOW = """
import sys, time
sys.path.insert(0, {tests!r})
import toys
from mjx_revolve import evolve
from mjx_revolve.inputs.commands import run_command

class Slow(toys.BodyToy):
    def evaluate(self, *block):
        time.sleep(0.01)
        return super().evaluate(*block)

def make(config):
    made = toys.make_toy_bodies(config)
    return Slow(made.config, made.genotype, made.mixed, made.brains, made.seeds)

sys.exit(run_command(lambda argv: evolve.main(argv, make), [*sys.argv[1:], "--workers", "1"]))
"""


@pytest.mark.slow
def test_ctrl_c_stops_a_study_and_it_goes_on(tmp_path, monkeypatch, capsys, request):
    """Real processes: the run under way is told, saves and ends; the next call finishes it."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    (tmp_path / "slow.py").write_text(_SLOW.format(tests=str(ROOT / "tests")))
    monkeypatch.setattr(studies, "COMMAND", (sys.executable, str(tmp_path / "slow.py")))
    out, folder = tmp_path / "out", tmp_path / "out" / "bed" / "seed_0"

    def interrupt():
        while not (folder / "metrics.csv").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    options = ("--only", "bed", "--generations", "400")
    assert study(out, *options) == 130
    printed = capsys.readouterr().out
    assert "stopped\ngo on: python -m experiments.environments --out" in printed
    assert 1 <= len(metrics(folder)["generation"]) < 400
    assert Run(folder).checkpoints()

    request.getfixturevalue("started")  # the rest without sleep
    settings = ["bed", "--generations", str(len(metrics(folder)["generation"]) + 1)]
    assert study(out, "--only", *settings) == 0
    assert study(tmp_path / "once", "--only", *settings) == 0
    assert metrics(folder) == metrics(tmp_path / "once" / "bed" / "seed_0")


# ------------------------------------------------------------------ what is compared


def test_environments_are_what_they_are_called():
    plans = {
        name: studies.Plan(name, 3, ROOT, case.settings).config
        for name, case in ENVIRONMENTS.items()
    }
    assert {plan.evolution.seed for plan in plans.values()} == {3}
    assert plans["open_water"].world == "empty_underwater"
    pond = plans["shore"].world["bed"]
    assert pond["height"] < -plans["shore"].task.depth < 0 < pond["highest"]
    assert (plans["bed"].trim, plans["bed"].task.type) == ("none", "crawl")
    against = np.dot(plans["current"].world["current"], plans["current"].task.direction)
    assert against == pytest.approx(-environments.CURRENT)
    figures = {"score": 0.1, "length": 0.5}
    assert environments.through_water("current", figures)["water_speed_bl_s"] == pytest.approx(0.2)
    assert environments.through_water("shore", figures)["water_speed_bl_s"] == 0.1


@pytest.mark.parametrize("settings", [(), ("evolution.generations=7",)])
def test_budgets_are_equal(settings):
    cases = budgets.make_cases(settings)
    configs = {
        name: studies.Plan(name, 0, ROOT, (*settings, *case.settings)).config
        for name, case in cases.items()
    }
    trials = budgets.count_trials(configs["coevolution"])
    assert trials == (24 + 6 * 16 if settings else 24 + 23 * 16) * 32
    assert budgets.count_trials(configs["random_search"]) == trials
    for robot in budgets.ROBOTS:
        assert configs[robot].bodies is None
        evolution = configs[robot].evolution
        tried = evolution.population_size * evolution.generations
        assert trials <= tried < trials + evolution.population_size
        assert (configs[robot].task, configs[robot].trim) == (
            configs["random_search"].task,
            "neutral",
        )


@pytest.mark.slow
def test_what_a_body_scores_at_rest_is_told():
    """A spider hangs as it starts; a crooked body turns at first, and its core moves."""
    case = ENVIRONMENTS["open_water"]
    settings = (*case.settings, "task.settle=1.0", "task.duration=3.0")
    plan = studies.Plan("open_water", 0, ROOT, settings)
    bodies = [body("spider"), random_body(1, 4, 3)]
    given = [studies.Outcome(plan, {"score": 1.0}, {}, {}, each) for each in bodies]
    level, crooked = (o.champion["still_score"] for o in studies.score_still(given))
    assert abs(level) < 0.01
    assert crooked > 0.03

    robot = budgets.make_cases()["spider"].settings
    plan = studies.Plan("spider", 0, ROOT, (*robot, *settings))
    (outcome,) = studies.score_still([given[0]._replace(plan=plan)])
    assert outcome.champion == {"score": 1.0, "still_score": pytest.approx(level, abs=1e-4)}


# ------------------------------------------------------------------ reports


def outcomes(values):
    """Of invented champions; `values` of all speeds and gaits by case, all bodies are the same."""
    found, one = [], random_body(0, 2, 1)
    for case, numbers in values.items():
        for seed, number in enumerate(numbers):
            figures = {name: number for name in environments.FIGURES}
            figures |= {"score": number, **one.descriptors}
            curve = {"evaluations": np.array([10.0, 20.0]), "champion": np.array([0.0, number])}
            plan = studies.Plan(case, seed, ROOT / case / f"seed_{seed}", ())
            found.append(
                studies.Outcome(plan, figures, figures, curve | {"seconds": np.ones(2)}, one)
            )
    return found


def test_a_difference_is_said_only_where_the_tests_bear_it():
    def said(values):
        cases = studies.by_case(outcomes(values), ENVIRONMENTS)
        figures = environments.compare_figures(cases, "champion")
        return environments.describe_differences(figures, "champions"), figures

    low, middle = [0.1, 0.2, 0.3, 0.4, 0.5], [0.15, 0.25, 0.35, 0.45, 0.55]
    values = {"open_water": low, "shore": middle, "bed": [x + 1 for x in low], "current": middle}
    lines, figures = said(values)
    # All speeds and gaits, no descriptor.
    assert len(lines) == len(environments.FIGURES) - 8
    assert lines[0] == (
        "- speed through the water (body lengths/s) of champions: larger in `bed` (1.3) than in "
        "`open_water` (0.3), `shore` (0.35), `current` (0.35)"
    )
    # Benjamini and Hochberg: half of the figures have the same p, so it is doubled.
    assert figures[0].p == pytest.approx(2 * figures[0].comparison.p)
    assert figures[-1].p == 1
    _, _, row, *_ = environments.tabulate(figures)
    assert row.startswith("| speed through the water (body lengths/s) | 0.3 [0.1")
    # Rank sums 35, 42.5, 90, 42.5 and five ties: H = 10.97, of three degrees of freedom.
    assert row.endswith(" **.024** |")

    # Not even then where pairs do not bear it: three seeds, however far they are apart.
    lines, figures = said({name: numbers[:3] for name, numbers in values.items()})
    assert lines == ["- No figure of champions tells two environments apart."]
    # Nor where all of them do not: one figure of many.
    assert environments.Compared("length", {}, 0.06, figures[0].comparison).differs == []


def test_budgets_say_by_how_much_coevolution_is_better(tmp_path):
    values = {"coevolution": [0.3, 0.3], "random_search": [0.1, 0.1], "fish": [0.1, 0.5]}
    lines = budgets.write_report(tmp_path, outcomes(values))
    assert lines[2:] == [
        "| `coevolution` − `random_search` | 0.2 [0.2, 0.2] | no | 0.67 |",
        "| `coevolution` − `fish` | 0 [−0.2, 0.2] | yes | 1 |",
    ]
    text = (tmp_path / "budgets.md").read_text()
    assert "The fastest of all: 0.5 body lengths/s, `fish`, seed 1." in text
    for name in ("budgets.png", "budgets_bodies.png"):
        assert f"({name})" in text
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (environments.main, ["--only", "bed,moon"], "expected any of open_water, shore, bed, curr"),
        (environments.main, ["--seeds", "0"], "expected a whole number >= 1; found '0'"),
        (environments.main, ["--report"], "--report: expected runs that are finished; found none"),
        (environments.main, ["--set", "task.x=1"], "task.x"),
        (budgets.main, ["--only", "tiger"], "expected any of coevolution, random_search, spider"),
        (budgets.main, ["--set", "bodies.learning.population_size=0"], "expected a whole number"),
    ],
)
def test_bad_options_end_with_one_line_and_code_2(main, arguments, message, tmp_path, capsys):
    assert run_command(main, ["--out", str(tmp_path), *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert message in captured.err
