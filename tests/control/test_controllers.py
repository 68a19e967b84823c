"""Controllers from genes to targets, and the servos that follow them."""

import numpy as np
import pytest

from laboratory import WATER, at_rest, dry_robot, elbow_robot, march, play, read, world
from mjx_revolve.control.cpg import make_cpg
from mjx_revolve.control.gait import describe_gait
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sine import make_sine
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.config import ControllerConfig

SPEED = 5.235988
# What those that do not listen are told of their robot.
STILL = SensorReadings(0.0, 0.0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def drawn(controller, lanes=4, seed=0, scale=1.5):
    return scale * np.random.default_rng(seed).normal(size=(controller.num_genes, lanes))


MAKERS = {
    "cpg": make_cpg,
    "sine": make_sine,
    "sine3": lambda robot, **options: make_sine(robot, harmonics=3, **options),
}


@pytest.mark.parametrize("name", ["spider", "gecko", "snake", "centipede", "core"])
def test_the_number_of_genes_follows_from_the_body(name):
    robot = dry_robot(name)
    n, pairs = robot.num_hinges, len(robot.morphology.hinge_neighbours())
    assert make_cpg(robot).num_genes == n + pairs
    assert make_sine(robot).num_genes == 3 * n + 1
    assert make_sine(robot, harmonics=3).num_genes == 7 * n + 1


def described(robot, genes, **settings):
    return describe_gait(plant_of(robot), ControllerConfig(**settings), genes)


def test_a_sines_gait():
    """Two of eight hinges swing, a quarter of a turn apart, by sin .5 and sin .3 of their range."""
    robot = dry_robot("spider")
    genes = np.zeros(25)
    genes[0], genes[8 + 3], genes[-1] = 0.5, 0.3, np.pi / 6  # u of one, v of another, f = 1.5 Hz
    a, b = np.sin([0.5, 0.3]) * np.pi / 4
    assert described(robot, genes, type="sine") == pytest.approx(
        {
            "mean_period": 1 / 1.5,
            "spread_period": 0.0,
            "mean_phase_offset": np.pi / 4,
            "spread_phase_offset": np.sqrt(np.log(2)),  # R = cos(π/4)
            "mean_amplitude": (a + b) / 2,
            "spread_amplitude": (a - b) / 2,
        },
        rel=1e-5,
    )


def test_an_uncoupled_cpgs_gait():
    """x = sin(w t), half of it backwards; w = 2π f_max sin(gene)."""
    robot = dry_robot("spider")
    genes = np.zeros(18)
    genes[:2], genes[2] = np.pi / 6, -np.pi / 2  # 1 Hz, 1 Hz and 2 Hz backwards
    found = described(robot, genes, type="cpg", amplitude=0.5)
    assert found["mean_period"] == pytest.approx((1 + 1 + 1 / 2) / 3, rel=1e-5)
    assert found["spread_period"] == pytest.approx(np.std([1, 1, 0.5]), rel=1e-5)
    assert found["mean_phase_offset"] == pytest.approx(0.0, abs=1e-5)
    # Phases 0, 0 and π: R = 1/3.
    assert found["spread_phase_offset"] == pytest.approx(np.sqrt(2 * np.log(3)), rel=1e-5)
    assert found["mean_amplitude"] == pytest.approx(0.5 * np.pi / 4 * np.tanh(1), rel=1e-5)
    assert found["spread_amplitude"] == pytest.approx(0.0, abs=1e-6)


def test_two_coupled_oscillators_gait():
    """In p = x1 + i x2: p = A (exp(i α t) - exp(-i β t)), β - α = c, αβ = w², |A| = √2 w/(α + β).

    The faster counts: x1 = |A| sin(β t - π/4), x2 = |A| sin(β t + π/4).
    """
    robot = elbow_robot(world())
    w, c = 2 * np.pi * 2 * np.sin(0.5), np.pi * 2 * np.sin(0.4)
    both = np.sqrt(c**2 + 4 * w**2)
    found = described(robot, [0.5, 0.5, 0.4], type="cpg")
    assert found["mean_period"] == pytest.approx(4 * np.pi / (both + c), rel=1e-5)
    assert found["spread_period"] == pytest.approx(0.0, abs=1e-6)
    assert found["mean_phase_offset"] == pytest.approx(0.0, abs=1e-5)
    assert found["spread_phase_offset"] == pytest.approx(np.sqrt(np.log(2)), rel=1e-5)
    size = np.pi / 4 * np.tanh(np.sqrt(2) * w / both)
    assert found["mean_amplitude"] == pytest.approx(size, rel=1e-5)


@pytest.mark.parametrize("kind", MAKERS)
def test_targets_stay_within_the_range(kind):
    """CPG and plain sine by themselves; offsets and harmonics add up, and the servo clips them."""
    robot, amplitude = dry_robot("spider"), 0.4
    controller = MAKERS[kind](robot, amplitude=amplitude)
    targets, _ = play(controller, plant_of(robot), drawn(controller, 64, scale=5.0), 800, STILL)
    widest = {"cpg": 1.0, "sine": 1.5, "sine3": 0.5 + 1 + 1 / 2 + 1 / 3}[kind]
    assert np.abs(targets).max() <= widest * amplitude * np.pi / 4 + 1e-9
    assert np.abs(targets).max() > 0.5 * amplitude * np.pi / 4
    # No joint jumps: neither from rest nor later.
    fastest = 3 * 2 * np.pi * 2.0 * widest + 2 * widest
    moved = np.diff(targets, axis=0, prepend=np.zeros((1, 8, 64)))
    assert np.abs(moved).max() < 0.005 * fastest * amplitude * np.pi / 4


def test_sine_is_a_sine():
    """a sin(2π f t + φ) + offset after the fade: amplitude and phase from a point in the plane."""
    robot = dry_robot("spider")
    controller = make_sine(robot, max_frequency=1.2)
    genes = np.zeros((25, 1))
    genes[0], genes[8], genes[16], genes[24] = 0.5, -0.8, 0.3, 0.6
    targets, _ = play(controller, plant_of(robot), genes, 600, STILL)
    time = 0.005 * np.arange(600)
    size, phase = np.hypot(0.5, 0.8), np.arctan2(-0.8, 0.5)
    frequency = 1.2 * (1 + np.sin(0.6)) / 2
    wave = np.sin(size) * np.sin(2 * np.pi * frequency * time + phase)
    expected = np.pi / 4 * (0.5 * np.sin(0.3) + wave)
    assert targets[120:, 0, 0] == pytest.approx(expected[120:], abs=1e-9)
    assert not targets[:, 1:].any()


def test_a_hinge_at_its_top_speed_gets_no_more_push():
    """At 5.236 rad/s friction eats all that the motor gives; above, the servo brakes."""
    robot = elbow_robot(world())
    for factor, sign in ((0.5, 1), (1.0, 0), (1.1, -1)):
        qpos, qvel = at_rest(robot, 1)
        qvel[7] = factor * SPEED  # the outer hinge
        _, _, v, _ = march(robot, 0.005, qpos, qvel, np.array([[0.0], [0.7]]))
        gained = v[0, 7, 0] - qvel[7, 0]
        if sign:
            assert gained * sign > 0
        else:
            assert abs(gained) < 0.02 * SPEED


@pytest.mark.slow
def test_a_hinge_that_carries_nothing_comes_to_rest():
    """A hinge at the end of a limb, nudged by 1 mrad/s, as in the centipede's feet."""
    robot = build_robot(
        read("body: {type: Core, children: {1: {type: ActiveHinge}}}"), world(**WATER)
    )
    qpos, qvel = at_rest(robot, 2, -5.0)
    qvel[6] = 1e-3
    _, _, v, _ = march(robot, 2.0, qpos, qvel, np.array([[0.0, 0.1]]))
    assert np.abs(v[-20:, 6]).max() < 1e-2
