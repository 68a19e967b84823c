"""The experiments: their closed forms, what they read from the thesis's data, their options."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from experiments import (
    bench,
    falling_spider,
    gpu,
    optimisers,
    policy_gradient,
    precision,
    senses,
    shipped,
    validation,
    validation_cases,
)
from experiments import revolve2_comparison as comparison
from experiments.falling_spider import (
    GAZEBO_GRAVITY,
    closed_form,
    fit,
    load_thesis,
    mean_acceleration,
    read_run,
)
from laboratory import ROOT, check_error
from mjx_revolve import build_robot, load_world, make_cpg
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.tasks import TASKS
from mjx_revolve.inputs.commands import run_command

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


def test_a_parabola_gives_its_own_acceleration_back():
    time = 0.2 * np.arange(30)
    found, square, rms = fit(time, 0.4 - 1.3 * time - 0.5 * 0.7 * time**2)
    assert found == pytest.approx(0.7)
    assert square == pytest.approx(1.3**2 + 2 * 0.7 * 0.4)
    assert rms < 1e-12
    heights = -0.5 * 0.7 * time**2
    assert mean_acceleration(heights, len(heights) - 2) == pytest.approx(0.7)


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


@pytest.mark.parametrize(("main", "arguments", "message"), [
    (falling_spider.main, ["--data", "nowhere"], "--data: expected air_heights.txt and"),
    (bench.main, ["--rounds", "two"], "expected a whole number >= 1; found 'two'"),
    (gpu.main, ["--robot", "tiger"], "--robot: expected a shipped morphology; found 'tiger'"),
    (shipped.main, ["--only", "moon"], "--only: expected any of auv_escape, "),
    (validation.main, ["--quick", "--results"], "--results: expected all of the study; found"),
    (senses.main, ["--only", "lake_target", "--results"], "--results: expected all"),
])  # fmt: skip
def test_bad_options_end_with_one_line_and_code_2(main, arguments, message, capsys):
    assert run_command(main, arguments) == 2
    captured = capsys.readouterr()
    check_error(captured, message)
    assert captured.out == ""


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
    assert precision.timed_steps({0.02: None, 0.01: 5.0, 0.002: 0.1}) == [0.002, 0.01]
    cost = precision.cost_of([0.002, 0.01], [2 + 5, 2 + 1])  # 2 s, and .01 s each step
    assert [cost(step) for step in (0.002, 0.005, 0.01, 0.02)] == pytest.approx([7, 4, 3, 1.5])


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


def test_the_quick_validation_passes_and_keeps_its_table(tmp_path, monkeypatch, capsys):
    """Of three cases; `tests/water/test_closed_forms.py` runs all."""
    few = {name: validation_cases.CASES[name] for name in ("plate", "Munk", "floating")}
    monkeypatch.setattr(validation_cases, "CASES", few)
    assert validation.main(["--quick", "--out", str(tmp_path / "out")]) == 0
    assert "all within their tolerances" in capsys.readouterr().out
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


@pytest.mark.long
def test_on_a_cpu_the_gpus_programs_run_without_our_annotations(tmp_path, monkeypatch):
    monkeypatch.setenv("MJX_REVOLVE_FUSE", "0")
    small = ["--robot", "core", "--population", "8", "--steps", "4", "--rounds", "1"]
    assert gpu.main([*small, "--out", str(tmp_path)]) == 0
    numbers = json.loads((tmp_path / "gpu.json").read_text())["numbers"]
    measured, missing = ({row["engine"] for row in numbers[k]} for k in ("rows", "missing"))
    assert measured | missing == set(gpu.ENGINES)
    assert measured >= {"ours, no water", "ours, default water"}
    assert all(row["steps_per_second"] > 0 for row in numbers["rows"])


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


def test_the_robots_are_made_of_revolve2s_modules():
    gecko = comparison.load_bodies()[0]
    # CoreV1, BrickV1 and ActiveHingeV1 state 0.25, 0.03 and 0.011 + 0.058 + 0.02 kg.
    assert gecko.mass == pytest.approx(0.25 + 6 * 0.03 + 6 * 0.089)
    hip = gecko.modules[gecko.hinges[0]]
    # Half a core, then the hinge's joint 22.6 + 11.9 mm further.
    anchor = hip.position + hip.rotation @ hip.kind.hinge.anchor
    assert np.linalg.norm(anchor) == pytest.approx(0.0445 + 0.022625 + 0.0119)
    heavier = comparison.load_bodies([{"mass": gecko.mass + 0.1}])
    assert heavier[0].mass == pytest.approx(gecko.mass + 0.1)
    assert heavier[0].num_modules == gecko.num_modules


def test_the_matrix_is_that_of_our_cpg():
    """Targets after k periods: middle + reach × tanh of the matrix exponential's x."""
    body = comparison.load_bodies()[1]
    [genes] = comparison.make_population([body], 1, seed=3)
    matrix, n = comparison.cpg_matrix(body, genes), body.num_hinges
    np.testing.assert_array_equal(matrix, -matrix.T)
    plant = plant_of(build_robot(body, load_world("lake")))
    cpg, dt = make_cpg(plant, comparison.FREQUENCY), plant.timestep
    parameters = cpg.decode(jnp.asarray(genes[:, None], jnp.float32), plant)
    state, x = cpg.init(parameters), np.repeat([0.0, 1.0], n)
    reach = body.modules[body.hinges[0]].kind.hinge.range[1]
    for k in range(1, 40):
        state, targets = cpg.step(parameters, state, jnp.float32(k * dt), None)
        x = expm(dt * matrix) @ x
        expected = reach * np.tanh(x[:n])
        np.testing.assert_allclose(np.ravel(targets), expected[plant.source[:n, 0]], atol=1e-4)
