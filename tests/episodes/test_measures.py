"""Measures of episodes: tracks made by hand, for one robot and for several with fewer hinges."""

import json
import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import ELBOW, ROOT, body, make_track, refusal
from mjx_revolve import InputError, make_fitness, make_mixed_fitness
from mjx_revolve.episodes.config import load_config, make_config
from mjx_revolve.episodes.measure_table import MEASURES, records_of
from mjx_revolve.episodes.measures import measure
from mjx_revolve.episodes.tasks import RECORDS

ALWAYS = {name for name, entry in MEASURES.items() if not entry.record}
GAIT = ["gait_frequency_hz", "gait_phase_spread_rad", "gait_phase_lag_rad", "joint_amplitude_rad"]
TIME = 0.1 * np.arange(90)  # of most tracks here [s]
track = partial(make_track, interval=0.1)


def still(**more):
    """One that stays where it is, for as many rows as what is given has."""
    return track(np.zeros((len(next(iter(more.values()))), 3)), **more)


def read(given, *names):
    return {name: float(x[0]) for name, x in measure(given, names).items()}


def swing(frequency):
    """`[S, 3]` angles, each 0.7 rad behind the one before."""
    return 0.4 * np.sin(2 * np.pi * frequency * TIME[:, None] + 0.2 - 0.7 * np.arange(3))


@pytest.mark.slow
def test_every_measure_is_made_and_in_the_tables_order():
    given = still(
        angle=swing(1.0),
        quat=np.tile([1.0, 0, 0, 0], (90, 1)),
        bed_force=np.zeros((90, 3)),
        water_velocity=np.zeros((90, 3)),
    )
    assert list(measure(given, MEASURES)) == list(MEASURES)
    assert {*measure(given)} == ALWAYS
    assert {entry.record for entry in MEASURES.values()} - {""} <= {*RECORDS}
    assert records_of(MEASURES) == ("contacts", "core", "joints", "water")
    for name, (_, unit, _) in MEASURES.items():  # those that name their unit name that one
        ends = {"m/s": "_m_s", "rad/s": "_rad_s", "Hz": "_hz", "J": "_j", "N": "_n", "rad": "_rad"}
        assert unit not in ends or name.endswith(ends[unit]), name


def test_speed_through_the_water_leaves_drift_out():
    """Over ground 0.5 m/s along x; the water goes along at 0.3, or across."""
    path = np.outer(TIME, [0.5, 0, 0])
    along, across = np.tile([0.3, 0, 0], (90, 1)), np.tile([0, 0.5, 0], (90, 1))
    found = read(track(path, water_velocity=along), "water_speed_m_s")
    assert found["water_speed_m_s"] == pytest.approx(0.2, rel=1e-4)
    assert found["speed_m_s"] == pytest.approx(0.5, rel=1e-4)
    found = read(track(path, water_velocity=across), "water_speed_m_s")
    assert found["water_speed_m_s"] == pytest.approx(math.hypot(0.5, 0.5), rel=1e-4)
    # A gust to and fro, in which it drifts.
    gust = np.outer(np.cos(TIME), [0.2, 0, 0])
    drift = np.outer(np.sin(TIME), [0.2, 0, 0])
    found = read(track(drift, water_velocity=gust), "water_speed_m_s")
    assert found["water_speed_m_s"] < 1e-3


def test_there_and_back_again():
    """2 m ahead, 1 m back, 2 m ahead, in 3 s; half a metre long, 2 N heavy, 3 J spent."""
    found = read(track([[0, 0, 1], [2, 0, 1], [1, 0, 1], [3, 0, 1]], interval=1.0))
    assert found == pytest.approx({
        "speed_bl_s": 2.0, "speed_m_s": 1.0, "path_speed_m_s": 5 / 3, "displacement_m": 3.0,
        "path_length_m": 5.0, "straightness": 3 / 5, "energy_j": 3.0,
        "cost_of_transport": 3 / (2 * 3), "depth_m": 2.0, "depth_error_m": 1.0,
    }, rel=1e-5)  # fmt: skip


def test_a_circle():
    """Half a turn of 1 m radius, counter-clockwise, in 9 s, looking ahead all the way."""
    turn = np.pi * np.arange(91) / 90
    way = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    heading = turn + np.pi / 2
    quat = np.stack([np.cos(heading / 2), 0 * turn, 0 * turn, np.sin(heading / 2)], 1)
    found = read(track(way, quat=quat), "turn_rate_rad_s", "tilt_rad", "balance")
    assert found["displacement_m"] == pytest.approx(2.0)
    assert found["path_length_m"] == pytest.approx(np.pi, rel=1e-4)
    assert found["straightness"] == pytest.approx(2 / np.pi, rel=1e-4)
    assert found["path_speed_m_s"] == pytest.approx(np.pi / 9, rel=1e-4)
    assert found["turn_rate_rad_s"] == pytest.approx(np.pi / 9, rel=1e-4)
    assert found["tilt_rad"] == pytest.approx(0.0, abs=1e-3) and found["balance"] == 1.0
    # The other way round, past the seam at ±π.
    back = read(track(way[::-1], quat=quat[::-1]), "turn_rate_rad_s")
    assert back["turn_rate_rad_s"] == pytest.approx(-np.pi / 9, rel=1e-4)


@pytest.mark.parametrize("axis", [1, 2])
def test_a_core_that_leans(axis):
    """Level for half of the time, rolled or pitched by 0.6 rad for the other."""
    quat = np.tile([1.0, 0, 0, 0], (90, 1))
    quat[45:, 0], quat[45:, axis] = np.cos(0.3), np.sin(0.3)
    found = read(still(quat=quat), "tilt_rad", "balance", "turn_rate_rad_s")
    assert found["tilt_rad"] == pytest.approx(0.3, abs=1e-3)
    assert found["balance"] == pytest.approx(1 - 0.3 / (2 * np.pi), rel=1e-4)
    assert found["turn_rate_rad_s"] == pytest.approx(0.0, abs=1e-5)


def test_a_jump():
    """In the air for 30 of 90 rows; on the bed it weighs 0.5 N, and lands on it with 5 N."""
    force = np.zeros((90, 3))
    force[:, 2] = 0.5
    force[30:60] = 0.0
    force[60] = 3.0, 0.0, 4.0
    found = read(still(bed_force=force), "bed_contact", "bed_force_n")
    assert found["bed_contact"] == pytest.approx(60 / 90)
    assert found["bed_force_n"] == pytest.approx((59 * 0.5 + 5) / 90)


@pytest.mark.parametrize("frequency", [0.5, 3.9])
def test_a_wave_along_the_joints(frequency):
    found = read(still(angle=swing(frequency)), *GAIT)
    assert found["gait_frequency_hz"] == pytest.approx(frequency, abs=2e-3)
    assert found["gait_phase_lag_rad"] == pytest.approx(0.7, abs=5e-3)
    # Three phases 0.7 rad apart: R = (1 + 2 cos 0.7) / 3.
    spread = math.sqrt(-2 * math.log((1 + 2 * math.cos(0.7)) / 3))
    assert found["gait_phase_spread_rad"] == pytest.approx(spread, abs=5e-3)
    assert found["joint_amplitude_rad"] == pytest.approx(0.4, rel=0.02)


def test_the_stronger_of_two_frequencies_is_the_gaits():
    found = read(still(angle=swing(1.3) + 0.6 * swing(2.6) + 0.3), *GAIT)
    assert found["gait_frequency_hz"] == pytest.approx(1.3, abs=5e-3)
    assert found["gait_phase_lag_rad"] == pytest.approx(0.7, abs=0.02)


@pytest.mark.parametrize("angle", [
    np.full((90, 3), 0.4),  # held
    np.linspace(0, 1, 90)[:, None],  # turned once
    swing(1.0)[:3],  # too short a record
    np.zeros((90, 0)),  # no joints
], ids=["held", "turned", "short", "none"])  # fmt: skip
def test_what_is_no_gait_has_no_frequency(angle):
    found = read(still(angle=angle), *GAIT)
    assert [found[name] for name in GAIT[:3]] == [0.0, 0.0, 0.0]
    assert 0 <= found["joint_amplitude_rad"] < 1


def test_measures_leave_the_scores_gradient_whole():
    """Joints in all phases or none, a core that stands upright: no NaN comes back."""
    given = still(
        angle=np.zeros((90, 3)), quat=np.tile([1.0, 0, 0, 0], (90, 1)), bed_force=np.zeros((90, 3)),
        water_velocity=np.zeros((90, 3)),
    )  # fmt: skip

    def loss(angle, quat, force):
        found = measure(replace(given, angle=angle, quat=quat, bed_force=force), MEASURES)
        return sum(jnp.sum(x) for x in found.values()) + jnp.sum(angle)

    slopes = jax.grad(loss, (0, 1, 2))(given.angle, given.quat, given.bed_force)
    assert np.all(np.asarray(slopes[0]) == 1)
    assert all(np.all(np.isfinite(x)) for x in slopes)


def test_names_are_read_written_and_checked(tmp_path):
    base = ROOT / "configs" / "smoke.yaml"
    config = load_config(base, ["task.measures=[gait_frequency_hz, tilt_rad]"])
    assert config.task.measures == ("gait_frequency_hz", "tilt_rad")
    json.dumps(config.model_dump())
    assert make_config(config.model_dump(), "/").task == config.task
    assert load_config(base).task.measures == ()
    found = refusal(load_config, base, ["task.measures=[gait_frequency]"])
    assert found.startswith("--set task.measures.0: expected one of speed_bl_s, ")
    assert found.endswith("; found 'gait_frequency'; did you mean gait_frequency_hz?")
    with pytest.raises(InputError, match=r"task\.measures: expected a list .*; found 'tilt_rad'"):
        load_config(base, ["task.measures=tilt_rad"])


@pytest.mark.slow
def test_one_body_and_many_are_measured_alike(tmp_path, quick_compiles):
    """An arm of two hinges, its wave of 1 Hz, alone and beside a core without joints."""
    (tmp_path / "arm.yaml").write_text(ELBOW)
    config = {
        "morphology": str(tmp_path / "arm.yaml"),
        "world": "lake",
        "trim": "neutral",
        "controller": {"type": "sine"},
        "task": {"type": "speed", "duration": 4.0, "settle": 1.0, "trials": 1,
                 "measures": [name for name in MEASURES if name not in ALWAYS]},
    }  # fmt: skip
    one = make_fitness(config)
    assert {*one.task.records} == {"core", "joints", "contacts", "water"}
    genes, lag = np.zeros((1, 7), np.float32), np.pi / 3
    genes[0, :4] = 0.5, 0.5 * np.cos(lag), 0.0, -0.5 * np.sin(lag)  # f = f_max (1 + sin 0) / 2
    key = jax.random.key(0)
    found = {name: float(x[0]) for name, x in one.evaluate(genes, key)[1].items()}
    assert found["gait_frequency_hz"] == pytest.approx(1.0, abs=0.02)
    assert found["gait_phase_lag_rad"] == pytest.approx(lag, abs=0.05)
    # The servos follow 0.38 rad closely.
    assert found["joint_amplitude_rad"] == pytest.approx(np.pi / 4 * np.sin(0.5), rel=0.05)
    assert found["bed_contact"] == found["bed_force_n"] == 0.0  # far above the bed
    many = make_mixed_fitness(config, [one.robot.morphology, body("core")])
    robots = [many.build(body("core")), many.build(one.robot.morphology)]
    wide = jnp.concatenate([jnp.zeros((1, many.num_genes)), many.pad_genes(genes, robots[1])])
    both = many.evaluate(robots, wide, key)[1]
    assert {name: float(x[1]) for name, x in both.items()} == pytest.approx(
        found, rel=1e-2, abs=1e-3
    )
    assert [float(both[name][0]) for name in GAIT] == [0.0] * 4
