"""Passports: what drifts, chatters or overlaps fails where it should; same seed, same bits."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from laboratory import OAR, QUICK, body, check_refused, swimmer
from mjx_revolve import make_fitness
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes import passport
from mjx_revolve.episodes.fitness import fit_body
from mjx_revolve.episodes.passport import Check, Passport, count_reversals, load_passport
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.evolution.generations import choose_candidate
from mjx_revolve.inputs.errors import InputError

TASK = {"type": "directed_swim", "duration": 0.6, "settle": 0.2, "trials": 1}


@pytest.mark.long
def test_what_only_drifts_fails_without_its_brain_alone(tmp_path, monkeypatch):
    """A robot that a current carries keeps its score in all other trials."""
    monkeypatch.setattr(passport, "_MIDDLE", 0.8)  # seconds, not minutes, compiled in haste
    monkeypatch.setattr(passport, "LONG", 1.2)
    monkeypatch.setattr("mjx_revolve.numerics.xla.compiler_options", lambda fast=False: QUICK)
    settings = swimmer(tmp_path, OAR, TASK) | {"world": {"name": "lake", "current": [0.2, 0, 0]}}
    fitness = make_fitness(settings)
    genes = np.zeros(fitness.num_genes, np.float32)
    found = passport.make_passport(fitness, genes, 3)
    assert found.failed == ("brainless",) and "brainless" in found.mark
    checks = found.checks
    assert checks["brainless"].value == pytest.approx(1.0, abs=1e-3)
    assert checks["kept_0.8_s"].passed and checks["kept_1.2_s"].passed
    assert {"drag_less", "drag_more", "added_mass_less", "motor_more"} <= set(checks)
    # In the current a robot takes up its speed the sooner the more drag it has.
    assert checks["drag_less"].value < 1 < checks["drag_more"].value
    assert checks["step_over_4"].value < 0.01
    again = passport.make_passport(make_fitness(settings), genes, 3)
    assert again == found
    assert passport.make_passport(fitness, genes, 4).checks["score"] != checks["score"]
    # The same starts by the fitness's own program, without lanes of other coefficients.
    lanes = passport._Lanes(np.arange(8), np.ones(8, int), None)
    key = jax.random.fold_in(jax.random.key(3), passport.PASSPORT_STREAM)
    varied = passport._all_lanes(passport._variants())
    own = passport._scores(fitness, genes, key, lanes, False)[0.6]
    wide = passport._scores(fitness, genes, key, varied, True)[0.6]
    np.testing.assert_allclose(wide[:8], own, atol=1e-5)
    np.testing.assert_allclose(wide[64 + 6 * 8 :], own, atol=1e-5)  # nothing to silence
    # What is swum for longer than the task lasts is not foretold.
    near = make_fitness(settings | {"task": TASK | {"horizon": 2.4}})
    both = (passport._scores(x, genes, key, lanes, True)[1.2] for x in (fitness, near))
    np.testing.assert_allclose(*both, rtol=1e-5)


@pytest.mark.parametrize(("rest", "worst"), [
    (-1.5, 0.3 / 1.37),  # most of what the brain adds is lost in the worst tenth
    (-9.0, 7.8 / 8.87),
    (-0.02, np.nan),  # it adds nothing, of which there are no shares
])  # fmt: skip
def test_scores_that_are_no_rates_are_judged_by_what_the_brain_adds(
    tmp_path, monkeypatch, rest, worst
):
    """As minus the root mean square error of a depth: none of them is above zero."""
    fitness = make_fitness(swimmer(tmp_path, OAR, TASK | {"type": "hold_depth"}))
    own = np.full(64, -0.02)
    own[20:26] = -1.2
    lanes = np.concatenate([own, np.full(48, -0.02), np.full(8, rest)])
    scores = {0.6: lanes, 30.0: 9 * own, 120.0: 9 * own}
    monkeypatch.setattr(passport, "_scores", lambda *given: scores)
    found = Passport(dict(passport._swim(fitness, np.zeros(1), jax.random.key(0))))
    assert found.checks["worst_tenth"].value == pytest.approx(worst, rel=2e-3, nan_ok=True)
    assert ("worst_tenth" in found.failed) == (not worst > 0.5)
    assert ("drag_less" in found.failed) == np.isnan(worst)
    for name, value in (("kept_120_s", 9 * own.mean()), ("brainless", rest)):
        assert found.checks[name].value == pytest.approx(value)
        assert not found.checks[name].judged


def test_courses_and_gusts_are_the_same_for_all_times_and_steps():
    task = TASK | {"type": "follow_course", "course_spread": 1.0, "course_changes": 2}
    own = {"name": "lake", "gust": {"std": 0.1, "time": 1.0}}
    make = [
        make_fitness({"morphology": "auv", "world": own | {"timestep": dt}, "task": task | more})
        for dt, more in ((0.01, {}), (0.01, {"duration": 6.0}), (0.005, {}), (0.01 / 3, {}))
    ]
    own = make[0], make[0].world, jax.random.key(1)
    starts = [passport.fresh_starts(x, *own) for x in make]
    assert np.max(starts[0].course.moments) < 0.6
    for other in starts[1:]:
        jax.tree.map(np.testing.assert_array_equal, other.course, starts[0].course)
    np.testing.assert_array_equal(starts[1].gusts[:61], starts[0].gusts)
    np.testing.assert_allclose(starts[2].gusts[::2], starts[0].gusts, atol=1e-7)
    for fine, found in zip(make[2:], starts[2:], strict=True):
        assert len(found.gusts) == fine.num_timesteps + 1


@pytest.mark.parametrize(("wave", "expected"), [
    (lambda t: np.sin(2 * np.pi * t), 2.0),  # once a second to and fro
    (lambda t: 0.013 * (-1.0) ** np.arange(len(t)), 200.0),  # every step, as fast as it can
    (lambda t: t + 0.009 * (-1.0) ** np.arange(len(t)), 0.0),  # within the servo's play
    (lambda t: np.floor(t), 0.0),  # stop and go, one way
])  # fmt: skip
def test_reversals_are_counted(wave, expected):
    time = 0.005 * np.arange(2000)
    found = count_reversals(wave(time)[:, None]) / 10.0
    assert found[0] == pytest.approx(expected, abs=0.2)


def test_a_robot_that_folds_into_itself_and_chatters_fails(tmp_path):
    snake = body("snake")
    fitness = fit_body(make_fitness(swimmer(tmp_path, OAR, TASK)).config, snake)
    count, steps = fitness.robot.num_hinges, 100

    def swims(angle, shake):
        qpos, qvel = np.tile(fitness.robot.start_qpos(), (steps, 1)), np.zeros((steps, 6 + count))
        qpos[:, 7:] = angle + shake * (-1.0) ** np.arange(steps)[:, None]
        time = 0.2 + 0.005 * np.arange(1, steps + 1)
        return trajectory_of(time, qpos, qvel, qpos[:, 7:])

    def judge(trajectory):
        return Passport(dict(passport.joint_checks(fitness.robot, trajectory, 0.2)))

    good = judge(swims(np.zeros(count), 0.0))
    assert not good.failed and good.checks["overlap"].value == 0
    curled = swims(np.full(count, 1.5), 0.02)
    bad = judge(curled)
    assert {"overlap", "reversals"} <= set(bad.failed)
    assert bad.checks["overlap"].value > 10 and bad.checks["overlap_time"].value == 1
    assert bad.checks["reversals"].value == pytest.approx(200, rel=0.02)


def test_joints_are_judged_by_the_motors_of_the_episode(tmp_path):
    robot = make_fitness(swimmer(tmp_path, OAR, TASK)).robot
    (top,), (effort,) = (
        x[robot.assembly.moved] for x in (robot.assembly.speed, robot.assembly.effort)
    )
    qpos, qvel = np.tile(robot.start_qpos(), (9, 1)), np.zeros((9, 7))
    qvel[:, 6:] = 1.2 * top
    usual = trajectory_of(np.arange(9) * 0.005, qpos, qvel, qpos[:, 7:] + 1.0)
    for motor, speed in ((1.0, 1.2), (1.5, 0.8)):
        varied = replace(usual, variation=Variation(motor=motor))
        checks = dict(passport.joint_checks(robot, varied, 0.0))
        assert checks["speed"].value == pytest.approx(speed)
        # From all of the effort at 3/4 of the top speed to what friction takes at it.
        friction = robot.mj_model.dof_damping[6] * motor * top / effort
        torque = 1 - (1 - friction) * (speed - 0.75) / 0.25
        assert checks["torque"].value == pytest.approx(abs(torque), rel=1e-4)


def trajectory_of(time, qpos, qvel, ctrl):
    none = np.zeros(len(time))
    return Trajectory(time=time, qpos=qpos, qvel=qvel, xpos=none, ctrl=ctrl, power=none)


def made(**values):
    """A passport of shares, of which at least a half is required."""
    return Passport({name: Check(name, value, least=0.5) for name, value in values.items()})


def test_a_passport_comes_back_from_its_file(tmp_path):
    path = tmp_path / "passport.yaml"
    found = made(kept=0.9, drag=0.2)
    found = replace(found, checks=found.checks | {"score": Check("score", 0.1, "m/s")})
    path.write_text(found.to_text())
    assert load_passport(path) == found and found.failed == ("drag",)
    assert [row[3] for row in found.rows] == ["passes", "FAILS", ""]
    path.write_text(found.to_text().replace("0.9", "much"))
    check_refused("checks.kept.value: expected a number; found 'much'", load_passport, path)
    path.write_text("checks: 3")
    check_refused("checks: expected a mapping; found 3", load_passport, path)
    assert made(kept=float("nan")).failed == ("kept",)  # what could not be computed passes nothing


@pytest.mark.parametrize(
    ("shares", "winner", "tried"),
    [([0.1, 0.9, 0.9], 1, 2), ([0.1, 0.2, 0.3], 0, 3), ([0.9, 0.9, 0.9], 0, 1)],
)
def test_where_a_passport_is_required_the_best_that_passes_wins(shares, winner, tried):
    judged = []

    def score(indices, key):
        return np.array([[3.0, 2.0, 1.0][k] for k in indices]), {}

    def judge(k):
        judged.append(k)
        return made(kept=shares[k])

    found, facts = choose_candidate(score, np.ones(3, bool), 0, judge)
    assert found == winner and len(judged) == tried
    assert facts["passport"] == made(kept=shares[winner])
    assert choose_candidate(score, np.ones(3, bool), 0)[1]["passport"] is None


def test_a_task_that_does_not_suit_other_times_costs_the_passport_not_the_champion():
    def fails(*_):
        raise ValueError("100 rows")

    settings = SimpleNamespace(is_user_code=True, type="mine.py:follow", duration=30.0)
    chunk = SimpleNamespace(position=0, geometry=0, rollout=SimpleNamespace(context=0))
    spec = SimpleNamespace(settings=settings, score=fails)
    why = "mine.py: expected follow to score 30 s, as passports do; found ValueError: 100 rows"
    check_refused(why, passport._score, spec, chunk, {})

    def judge(_):
        raise InputError(why)

    found, facts = choose_candidate(lambda *_: (np.ones(1), {}), np.ones(1, bool), 0, judge)
    assert found == 0 and facts["passport"] is None
