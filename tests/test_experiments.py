"""The experiments: their closed forms, what they read from the thesis's data, their options."""

import contextlib
import io
import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import (
    bench,
    falling_spider,
    gpu,
    gradient_learning,
    optimisers,
    policy_gradient,
    precision,
    sensitivity,
    shipped,
    validation,
    validation_cases,
)
from experiments.falling_spider import (
    GAZEBO_GRAVITY,
    RUNS,
    TICK,
    acceleration,
    closed_form,
    fit,
    load_thesis,
    mean_acceleration,
    read_run,
    read_tables,
    row_ticks,
)
from laboratory import QUICK, ROOT
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError

THESIS = ROOT.parent / "shared" / "thesis"
SHARE = 0.93818  # ρ V / m of the spider


@pytest.fixture(scope="module")
def readings():
    data = load_thesis(THESIS)
    if data is None:
        pytest.skip("the thesis's data are not beside the repository")
    return {
        kind: read_run(heights, closed_form(kind, GAZEBO_GRAVITY, SHARE))
        for kind, heights in data.items()
    }


# ------------------------------------------------------------------ falling spider


def test_the_closed_forms_height_and_time_are_inverse():
    form = closed_form("water", 9.81, SHARE)
    assert form.wet == pytest.approx(0.60648, abs=1e-4)
    time = np.linspace(0.3, 14, 50)
    np.testing.assert_allclose(form.time(form.height(time)), time, rtol=1e-12)
    # Dry, then wet, without a jump in height or speed.
    entry = form.entry_speed / 9.81
    assert form.height(np.array([0.0, entry])) == pytest.approx([0.25, 0.0], abs=1e-12)
    speeds = np.diff(form.height(entry + 1e-6 * np.arange(-1, 2)))
    assert speeds[0] == pytest.approx(speeds[1], rel=1e-5)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """The experiment's folder, what it printed, and its falls; compiled cheaply."""
    folder, falls, fall = tmp_path_factory.mktemp("falls"), [], falling_spider.fall
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mjx_revolve.numerics.xla.compiler_options", lambda fast=False: QUICK)
        patch.setattr(falling_spider, "fall", lambda *run: falls.append(fall(*run)) or falls[-1])
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert falling_spider.main(["--out", str(folder)]) == 0
    return folder, printed.getvalue(), dict(zip(RUNS, falls, strict=True))


@pytest.mark.long
@pytest.mark.parametrize(("run", "expected"), [("air", 9.81), ("mask", 0.60648)])
def test_the_spider_falls_as_fast_as_it_must(experiment, run, expected):
    _, _, falls = experiment
    assert acceleration(falls[run]) == pytest.approx(expected, abs=1e-4)


def test_a_parabola_gives_its_own_acceleration_back():
    time = 0.2 * np.arange(30)
    found, square, rms = fit(time, 0.4 - 1.3 * time - 0.5 * 0.7 * time**2)
    assert found == pytest.approx(0.7)
    assert square == pytest.approx(1.3**2 + 2 * 0.7 * 0.4)
    assert rms < 1e-12
    heights = -0.5 * 0.7 * time**2
    assert mean_acceleration(heights, len(heights) - 2) == pytest.approx(0.7)


def test_ticks_are_found_in_uneven_rows():
    form = closed_form("water", 9.8, SHARE)
    ticks = np.random.default_rng(0).choice([99, 100, 101, 102], 60)
    time = 0.8 + TICK * np.concatenate([[0], np.cumsum(ticks)])
    found, misfit = row_ticks(form.height(time), form)
    np.testing.assert_array_equal(found, ticks)
    assert misfit < 1e-8
    reading = read_run(form.height(time), form)
    assert reading.timed == pytest.approx(form.wet, rel=1e-9)
    assert reading.drop == pytest.approx(0.25, rel=1e-9)
    np.testing.assert_allclose(reading.time, time, atol=1e-9)


def test_the_thesis_data_read_with_its_errata(readings):
    air, water = readings["air"], readings["water"]
    assert air.printed == pytest.approx(9.28, abs=0.005)
    assert air.mended == pytest.approx(9.82, abs=0.005)
    assert water.printed == pytest.approx(0.608, abs=0.0005)
    assert water.mended == pytest.approx(0.617, abs=0.0005)
    assert water.fitted == pytest.approx(0.618, abs=0.0005)


def test_on_the_simulators_clock_the_data_are_the_closed_form(readings):
    air, water = readings["air"], readings["water"]
    assert air.misfit < 0.02
    assert air.timed == pytest.approx(9.8, abs=0.002)
    assert water.timed == pytest.approx(GAZEBO_GRAVITY * (1 - SHARE), abs=2e-4)
    assert water.drop == pytest.approx(0.25, abs=5e-4)
    assert abs(water.drop_short - 0.25) > 10 * abs(water.drop - 0.25)


def test_heights_that_are_none_are_refused(tmp_path):
    assert load_thesis(tmp_path) is None
    (tmp_path / "air_heights.txt").write_text("0.1\nx\n")
    (tmp_path / "water_heights.txt").write_text("0.1\n")
    message = r"air_heights\.txt: expected one number in each row; found"
    with pytest.raises(InputError, match=message):
        load_thesis(tmp_path)
    (tmp_path / "air_heights.txt").write_text("0.1\n0.2\n")
    with pytest.raises(InputError, match=r"air_heights\.txt: expected at least 19 rows; found"):
        load_thesis(tmp_path)


@pytest.mark.long
def test_falling_spider_writes_its_table_and_its_plot(experiment):
    folder, printed, _ = experiment
    for line in ("no buoyancy (air)", "thesis's buoyancy, no drag", "default water"):
        assert line in printed
    assert (folder / "falls.png").read_bytes().startswith(b"\x89PNG")
    rows = (folder / "falls.csv").read_text().splitlines()
    assert rows[0] == "time_s,air_m,mask_m,partial_m,default_m"
    # Drag ends the fall in the default water at the speed of the closed form.
    last, before = (float(row.split(",")[-1]) for row in (rows[-1], rows[-201]))
    assert before - last == pytest.approx(read_tables().terminal, rel=1e-3)


# ------------------------------------------------------------------ options


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (falling_spider.main, ["--speed"], "unrecognized arguments: --speed"),
        (falling_spider.main, ["--data", "nowhere"], "--data: expected air_heights.txt and"),
        (falling_spider.main, ["--out", "/dev/null/x"], "--out: expected a folder to write into"),
        (bench.main, ["--threads", "0"], "expected a whole number >= 1; found '0'"),
        (bench.main, ["--rounds", "two"], "expected a whole number >= 1; found 'two'"),
        (bench.main, ["--only", "tiger"], "--only: expected part of one of: spider, ellipsoid law"),
        (precision.main, ["--only", "tiger"], "--only: expected part of one of: spider, ellipsoid"),
        (gpu.main, ["--robot", "tiger"], "--robot: expected a shipped morphology; found 'tiger'"),
        (bench.main, ["spider"], "unrecognized arguments: spider"),
        (optimisers.main, ["--evaluations", "-3"], "expected a whole number >= 1; found '-3'"),
        (optimisers.main, ["--out"], "--out: expected one argument"),
        (validation.main, ["--out", "/dev/null/x"], "--out: expected a folder to write into"),
        (shipped.main, ["--only", "moon"], "--only: expected any of auv_escape, "),
    ],
)
def test_bad_options_end_with_one_line_and_code_2(main, arguments, message, capsys):
    assert run_command(main, arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert message in captured.err


# ------------------------------------------------------------------ benchmark


def _result(name, rates, population=2048, peak=2.0**20):
    row = bench.Row(name, "evaluation", "default", population=population)
    return bench.Result(row, rates=rates, cores=[1.0] * len(rates), peak=peak)


def test_a_case_is_held_against_the_best_of_its_opponents():
    results = [
        _result("ours", [30.0, 20.0, 10.0]),
        _result("rollout", [1.0, 3.0, 100.0]),
        _result("batch", [4.0]),
        _result("for information", [50.0]),
    ]
    group = bench.Group("case", tuple(r.row for r in results), 2, 6.0)
    assert results[0].rate == 20.0
    assert bench.ratio(group, results) == 5.0
    assert "5 (goal 6: not reached)" in bench.verdict(group, results)
    lines = bench.table(group, results).splitlines()
    assert len(lines) == 2 + len(results)
    assert "5.00" in lines[4]


def test_memory_of_an_individual():
    sizes = [_result("a", [1.0], 16384, 5e8), _result("b", [1.0], 384, 4.84e8)]
    assert bench.memory_per_individual(sizes) == pytest.approx(1000)


def test_work_at_an_error_lies_between_the_steps():
    points = [
        {"step_ms": 10.0, "error_percent": 4.0, "robot_seconds_per_core_second": 400.0},
        {"step_ms": 5.0, "error_percent": 1.0, "robot_seconds_per_core_second": 200.0},
        {"step_ms": 2.5, "error_percent": 0.25, "robot_seconds_per_core_second": 100.0},
    ]
    assert precision.work_at(points, 1.0) == pytest.approx(200)
    assert precision.work_at(points, 2.0) == pytest.approx(200 * 2**0.5)
    assert precision.work_at(points, 5.0) == 400  # no step is so bad
    assert precision.work_at(points, 0.1) is None
    assert precision.work_at([{**points[0], "error_percent": None}, *points[1:]], 2.0) == 200


def test_the_error_is_relative_to_the_way_and_blown_up_episodes_count():
    start, end = np.zeros((3, 3)), np.array([[2.0, 0, 0]] * 3)
    found = end + np.array([[0.0, 0, 0], [0, 0.02, 0], [np.nan, 0, 0]])
    assert precision.error_percent(found, start, end) == pytest.approx(1.0)
    assert precision.error_percent(np.full((3, 3), np.nan), start, end) is None


def test_a_population_is_stepped_as_one_program_and_what_is_missing_is_named():
    found = gpu.measure(gpu.make_ours, ("core", 8, 5), 1)
    assert found["robot_seconds_per_second"] == pytest.approx(0.005 * found["steps_per_second"])

    def lacking(*_):
        raise ImportError("no such module", name="mujoco_warp")

    assert gpu.measure(lacking, ("core", 8, 5), 1) == {"error": "not installed (mujoco_warp)"}


def test_every_row_of_the_benchmark_can_be_made():
    from experiments.bench_cases import MAKERS, PHYSICS

    for group in (*bench.GROUPS, bench.QUICK, bench.PARTS):
        assert len(group.rows) > group.against
        for row in group.rows:
            assert row.engine in MAKERS
            assert row.physics in PHYSICS
            assert (ROOT / "morphologies" / f"{row.robot}.yaml").is_file()


@pytest.mark.long
def test_a_quick_benchmark_runs_and_keeps_its_numbers(tmp_path, capsys, monkeypatch):
    # What its rows measure is not looked at: the older emitters take half of the time to compile.
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
    assert bench.main(["--quick", "--rounds", "2", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "times the best of C" in printed
    text = (tmp_path / "bench.json").read_text()
    assert str(ROOT) not in text
    report = json.loads(text)
    assert report["machine"]["cores"] >= 1
    (case,) = report["cases"]
    ours, *others = case["rows"]
    assert len(ours["steps_per_second"]) == 2
    assert case["ratio"] == ours["median"] / max(row["median"] for row in others[:2])
    assert 1e8 < ours["peak_bytes"] < 4 * 2**30


@pytest.mark.slow
def test_a_case_that_fails_says_why():
    with pytest.raises(RuntimeError, match="nonsense: KeyError"):
        bench.start(bench.Row("no such case", "nonsense", "default"), 1)


# ------------------------------------------------------------------ optimisers


def test_the_counter_keeps_the_best():
    counter = optimisers.Counter(lambda population: population[:, 0], np.zeros(2))
    counter(np.array([[1.0, 2.0], [3.0, 4.0]]))
    counter(np.array([[2.0, 0.0]]))
    np.testing.assert_array_equal(counter.best, [3.0, 4.0])
    assert (counter.best_score, counter.evaluations) == (3.0, 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", optimisers.OPTIMISERS)
def test_each_library_maximises(name):
    def score(population):
        assert population.shape == (20, 5)
        return -np.sum((population - 0.3) ** 2, axis=1)

    counter = optimisers.Counter(score, np.zeros(5))
    optimisers.OPTIMISERS[name](counter, 5, 20, 40)
    assert counter.evaluations == 20 * 40
    assert counter.best_score > -0.02


def test_a_step_along_the_gradient_never_lowers_the_score():
    """The longest that pays, of steps that are halved; none where none pays."""
    hill = lambda step: 1.0 - (step - 0.02) ** 2  # noqa: E731
    step, after = optimisers.line_search(hill, hill(0.0))
    assert step == pytest.approx(0.025) and after == hill(step) > hill(0.0)
    assert optimisers.line_search(lambda step: -step, 0.0) == (0.0, 0.0)
    assert optimisers.line_search(lambda step: float("nan"), 0.5) == (0.0, 0.5)


@pytest.mark.long
def test_the_three_optimisers_share_one_fitness(monkeypatch):
    # Half the hinges, half the time to compile.
    fish = str(ROOT / "morphologies" / "fish.yaml")
    monkeypatch.setitem(optimisers.CONFIG, "morphology", fish)
    told = []
    outcomes, still = optimisers.optimise(300, told.append)
    assert len(told) == 4 and told[0].startswith("compiling")
    assert still == pytest.approx(0.0, abs=0.02)
    assert len({outcome.evaluations for outcome in outcomes}) == 1
    assert all(outcome.score > still for outcome in outcomes)
    assert all(np.isfinite(outcome.fresh) for outcome in outcomes)


# ---------------------------------------------------------------------- validation


def test_the_quick_validation_passes_and_keeps_its_table(tmp_path, monkeypatch, capsys):
    """Of three cases; `tests/water/test_closed_forms.py` runs all."""
    few = {name: validation_cases.CASES[name] for name in ("plate", "Munk", "floating")}
    monkeypatch.setattr(validation_cases, "CASES", few)
    assert validation.main(["--quick", "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "all within their tolerances" in printed
    lines = (tmp_path / "out" / "validation.csv").read_text(encoding="utf-8").splitlines()
    assert {line.split(",")[0] for line in lines} == {"case", "plate", "Munk"}
    assert (tmp_path / "out" / "validation.png").read_bytes().startswith(b"\x89PNG")


def test_a_case_outside_its_tolerance_fails_the_validation(tmp_path, monkeypatch, capsys):
    row = validation_cases.Row("height", 1.0, 1.2, 0.1, "m")
    case = lambda: validation_cases.Result([row], [])  # noqa: E731
    monkeypatch.setattr(validation_cases, "CASES", {"too far": case})
    assert validation.main(["--out", str(tmp_path / "out")]) == 1
    assert "1 outside their tolerances" in capsys.readouterr().out
    assert "FAILS" in (tmp_path / "out" / "validation.csv").read_text(encoding="utf-8")


def test_every_quick_case_is_a_case():
    assert set(validation_cases.QUICK_CASES) < set(validation_cases.CASES)


# ------------------------------------------------------------------ sensitivity


def test_factors_stay_within_their_ranges_and_the_others_are_one():
    drawn = sensitivity.draw_factors(("drag",))
    assert np.all(drawn["motor"] == 1) and np.ptp(np.log(drawn["drag"])) > 1.5 * np.log(1.5)
    assert np.all(np.abs(np.log(drawn["drag"])) <= np.log(1.5))
    # What is drawn of a number does not depend on what else is.
    np.testing.assert_array_equal(
        sensitivity.draw_factors(tuple(sensitivity.RANGES))["drag"], drawn["drag"]
    )
    factor, factors = sensitivity.vary_one("density")
    assert factor[len(factor) // 2] == pytest.approx(1) and np.all(factors["drag"] == 1)


def test_a_swims_speed_is_that_behind_the_settling_time_along_the_direction():
    task = TaskConfig(type="directed_swim", duration=10.0, settle=2.0, direction=(0.0, 2.0, 0.0))
    time = 0.1 * np.arange(1, 101)
    # Fast while it settles, then 0.3 m/s along y, sideways and up.
    along = np.where(time <= 2, 5 * time, 10 + 0.3 * (time - 2))
    way = np.stack([time, along, 0.01 * time], 1)[:, :, None]
    found = sensitivity.measure(way, task)
    assert found.speed == pytest.approx([0.3]) and found.rise == pytest.approx([0.08])


def test_the_tables_and_the_picture_of_sensitivity():
    swim = sensitivity.Swim(np.array([0.05, 0.07]), np.array([0.1, -0.3]))
    rows = sensitivity.table(
        {"ours, all laws": swim, "no drag": swim._replace(speed=swim.speed / 2)}
    )
    assert rows[2][:2] == ["no drag", "3.00"] and rows[2][3] == "-50.0 %"
    curves = {name: (np.array([0.5, 1.0, 2.0]), swim._replace(speed=np.ones(3)))
              for name in sensitivity.RANGES}  # fmt: skip
    found = sensitivity.Sensitivity(0.06, curves, {"start": swim, "drag": swim})
    assert sensitivity.intervals(found, 0.25)[1][-1] == "50%"
    assert len(sensitivity.draw(found, {"other": found}).axes) == 2
    numbers = sensitivity.results_of({"ours, all laws": swim}, found, {"other": found})
    assert numbers["laws"][0]["speed"] == pytest.approx(6) and numbers["laws"][0]["change"] == 0
    assert [row["name"] for row in numbers["draws"]] == ["start", "drag"]
    for prefix in ("", "robust_"):
        assert numbers["draws"][1][f"{prefix}median"] == pytest.approx(6)
        assert numbers["draws"][1][f"{prefix}kept"] == pytest.approx(0.051 / 0.06)


def test_only_gaits_that_sense_nothing_can_be_played_to_mujoco(tmp_path):
    text = (ROOT / "configs" / "auv_hold_depth.yaml").read_text()
    text = text.replace("../morphologies", str(ROOT / "morphologies"))
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(InputError, match="sense nothing"):
        sensitivity.read_champion(tmp_path)


# ------------------------------------------------------------------ shipped configurations


def test_seeds_come_to_an_interval_and_a_count_of_passports(tmp_path, monkeypatch):
    calls, written = [], {}

    def evolve(name, folder, seed, cache):
        calls.append((folder.name, seed, cache.name))
        check = {"words": "", "value": 1.0}
        checks = {"a": check | {"passed": True}, "b": check | {"passed": seed != 1}, "c": check}
        passport = {"passed": seed != 1, "checks": checks} if seed < 3 else None
        return {"score": 1.0 + seed, "score_std": 0.0, "cpu_s": 2.0, "passport": passport}

    def write(name, numbers, seeds):
        written[name] = (numbers, seeds)

    monkeypatch.setattr(shipped, "evolve", evolve)
    monkeypatch.setattr(shipped, "write_results", write)
    options = ["--only", "fish_swim", "--seeds", "4", "--results", "--out", str(tmp_path)]
    assert shipped.main(options) == 0
    assert calls == [
        ("fish_swim", 0, "fish_swim_cache"),
        *((f"fish_swim_{seed}", seed, "fish_swim_cache") for seed in (1, 2, 3)),
    ]
    numbers, seeds = written["fish_swim"]
    assert seeds == [0, 1, 2, 3] and numbers["score"] == 1.0  # as it was with one seed
    found = numbers["over_seeds"]
    assert [row["failed"] for row in found["runs"]] == [[], ["b"], [], None]
    assert (found["passed"], found["size"], found["score"]["mean"]) == (2, 4, 2.5)
    assert found["failed"] == "seed 1: b"
    # Student's t(0.975, 3) = 3.182, the standard deviation of 1, 2, 3, 4 is 1.291
    assert found["score"]["half"] == pytest.approx(3.182 * 1.291 / 2, rel=1e-3)


# ------------------------------------------------------------------ policy gradient


def test_advantages_by_hand():
    """Two environments; the first one's episode is over after the second of three steps."""
    settings = policy_gradient.Settings(discount=0.5, trace=0.5)
    rewards = np.array([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]])
    values = np.array([[1.0, 1.0], [1.0, 1.0], [2.0, 2.0], [4.0, 4.0]])
    over = np.array([[0, 0], [1, 0], [0, 0]], bool)
    found = np.asarray(
        policy_gradient.advantages(*map(jnp.asarray, (rewards, values, over)), settings)
    )
    # Errors r + v'/2 - v of single steps: 0.5, 2 (1 where it is over), 4; each with a quarter of
    # the later one's advantage.
    assert found[:, 1].tolist() == [0.5 + 0.25 * 3.0, 2.0 + 0.25 * 4.0, 4.0]
    assert found[:, 0].tolist() == [0.5 + 0.25 * 1.0, 1.0, 4.0]


def test_the_policy_gradients_options_are_checked():
    for words in (["--seconds", "0"], ["--seed", "-1"]):
        with pytest.raises(InputError, match="found"):
            policy_gradient.main(words)


# ------------------------------------------------------------------ learning by gradients


def test_a_gradient_is_no_longer_than_the_median_of_its_individuals():
    """By hand: lengths 1, 5 and beyond float32; of the other individual all are 2."""
    slope = np.array([[[1, 0], [3, 4], [3e30, 0]], [[2, 0], [0, 2], [0, -2]]], np.float32)
    found = np.asarray(gradient_learning.clip_gradients(jnp.asarray(slope)))
    assert found[0] == pytest.approx(np.array([[1, 0], [0.6, 0.8], [0, 0]]), abs=1e-6)
    np.testing.assert_array_equal(found[1], slope[1])


def test_the_options_of_learning_by_gradients_are_checked():
    for words in (["--seconds", "0"], ["--seed", "-1"]):
        with pytest.raises(InputError, match="found"):
            gradient_learning.main(words)
