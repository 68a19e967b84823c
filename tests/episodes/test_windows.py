"""Slopes by genes through sensors, networks, servos and water, whole episodes and windows."""

import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import OAR, fork, need_mjx, swimmer
from mjx_revolve import InputError, make_fitness
from mjx_revolve.episodes.scoring import WORST
from mjx_revolve.episodes.windows import make_windows

KEY = jax.random.key(3)
TASK = {
    "type": "directed_swim", "duration": 0.6, "settle": 0.2, "trials": 2, "energy_weight": 0.5,
    "start_yaw": 1.0,
}  # fmt: skip
# Noise follows from the episode's number, so it is the same on both sides of a difference.
SENSORS = ["tilt", {"type": "gyro", "noise": 0.1}, "depth", {"type": "angle", "noise": 0.05},
           "load", "battery", "accelerometer"]  # fmt: skip
BRAINS = {
    "mlp": {"sensors": SENSORS, "hidden": 3},
    "rnn": {"sensors": SENSORS, "hidden": 3},
    "sensory_cpg": {"sensors": SENSORS},
    "feedback": {},
}
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return swimmer(tmp_path_factory.mktemp("windows"), f"id: oar\n{OAR}", TASK)


def listening(settings, kind):
    return settings | {"controller": {"type": kind, **BRAINS[kind]}}


def drawn(count, num_genes, scale=0.4):
    return jnp.asarray(scale * np.random.default_rng(0).normal(size=(count, num_genes)))


def check_gradient(value, genes, gradient, count=6):
    """A gradient against central differences, along single genes and along a direction of all."""
    draw = np.random.default_rng(1)
    picked = draw.choice(len(genes), min(count, len(genes)), replace=False)
    ways = [np.eye(len(genes))[k] for k in picked] + [draw.normal(size=len(genes))]
    size = np.abs(gradient).max()
    assert np.count_nonzero(gradient) > len(gradient) // 2 and size > 1e-4
    for way in ways:
        ahead, behind = (float(value(genes + s * 1e-6 * way)) for s in (1, -1))
        # Differences over 2 µ leave 1e-10 of the value, and what bends within them.
        assert gradient @ way == pytest.approx((ahead - behind) / 2e-6, rel=1e-4, abs=1e-4 * size)


@pytest.fixture(scope="module")
def whole(settings):
    """Makes windows of all of 0.4 s for a brain; two individuals share a program."""
    return cache(
        lambda kind: make_windows(make_fitness(listening(settings, kind), **{"task.duration": 0.4}))
    )


def mean_gain(windows, episodes, other):
    """Genes → the mean gain of a window beside another individual, for differences."""
    return lambda genes: np.mean(windows.step(jnp.stack([genes, other]), episodes)[0].gain[0])


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", BRAINS)
def test_closed_loop_gradients_are_those_of_differences(whole, kind):
    """Through sensors with noise, brain, servos and water, in float64, over 0.4 s."""
    with jax.enable_x64(True):
        windows = whole(kind)
        genes = drawn(2, windows.fitness.num_genes)
        episodes = windows.init(genes, KEY)
        gradients, _ = windows.step(genes, episodes)
        gradient = np.asarray(gradients.gradient).mean(1)[0]
        check_gradient(mean_gain(windows, episodes, genes[1]), np.asarray(genes[0]), gradient)


@pytest.fixture(scope="module")
def brain(settings):
    """A recurrent network with samples that are held and late, gusts and waves around it."""
    sensors = ["tilt", {"type": "gyro", "rate": 20, "delay": 0.1}, "flow", "load"]
    sea = {"name": "lake", "gust": {"std": 0.1}, "waves": [{"amplitude": 0.05, "wavelength": 2.0}]}
    controller = {"type": "rnn", "sensors": sensors, "hidden": 3}
    return make_fitness(settings | {"controller": controller, "world": sea})


@pytest.fixture(scope="module")
def windows(brain):
    return make_windows(brain, 0.2)


@pytest.mark.long
def test_windows_carried_on_are_one_long_rollout(brain, windows):
    """The program of the fitness knows of no windows: the same scores, to rounding in float64.

    And the gradient of the last window takes what came before it as given, though that came of
    other genes: differences of that window alone.
    """
    assert repr(windows) == "TruncatedBPTT(directed_swim in lake, 3 of 0.2 s)"
    assert windows.count == 3
    with jax.enable_x64(True):
        genes = drawn(2, brain.num_genes)
        episodes, gains = windows.init(genes, KEY), []
        for _ in range(windows.count):
            before = episodes
            gradients, episodes = windows.step(genes, before)
            gains.append(np.asarray(gradients.gain))
        expected = np.asarray(brain(genes, KEY))
        assert np.mean(np.sum(gains, 0), 1) == pytest.approx(expected, abs=1e-12)
        # Until the settling time is over nothing counts, and so nothing has a gradient.
        assert not gains[0].any() and gains[1].any()
        with pytest.raises(InputError, match=r"^episodes: expected some under way; found their"):
            windows.step(genes, episodes)
        new = genes[::-1]
        gradient = np.asarray(windows.step(new, before)[0].gradient).mean(1)[0]
        check_gradient(mean_gain(windows, before, new[1]), np.asarray(new[0]), gradient, 3)


@pytest.mark.long
def test_gradients_go_through_modules_that_touch(tmp_path):
    """XLA aborted over the derivative of the loops over robots and their contacts."""
    jaw = swimmer(tmp_path, json.dumps(fork(3, 1).to_mapping()), TASK | {"trials": 1})
    windows = make_windows(make_fitness(jaw))
    with jax.enable_x64(True):
        draw = np.random.default_rng(7)
        inwards = np.array([0.0, 0.0, 0.5, -0.5, 1.2, -1.2, -1.0])  # u, v, offsets, frequency
        genes = jnp.asarray(inwards + 0.05 * draw.normal(size=(8, len(inwards))))
        step = lambda x: windows.step(x, windows.init(x, KEY))[0]  # noqa: E731
        gain, gradient = (np.asarray(x)[:, 0] for x in step(genes)[:2])
        free = make_fitness(jaw, **{"world.self_contact": False})(genes, KEY)
        touched = np.abs(np.asarray(free) - gain) > 1e-9
        assert touched.sum() > 3
        way = draw.normal(size=genes.shape[1])
        change = np.subtract(step(genes + 1e-6 * way).gain, step(genes - 1e-6 * way).gain)[:, 0]
        error = np.abs(change / 2e-6 - gradient @ way) / np.abs(gradient).max(1)
        # A touch that begins or ends within the difference bends it.
        assert np.median(error[touched]) < 1e-5


@pytest.mark.slow
def test_what_blows_up_has_no_gradient_and_spreads_none(whole):
    with jax.enable_x64(True):
        windows = whole("mlp")
        genes = drawn(2, windows.fitness.num_genes)
        broken = genes.at[1].set(jnp.nan)
        (one, _), (other, _) = (windows.step(x, windows.init(x, KEY)) for x in (genes, broken))
        assert np.all(other.gain[1] == WORST) and not np.any(other.gradient[1])
        np.testing.assert_array_equal(one.gain[0], other.gain[0])
        np.testing.assert_array_equal(one.gradient[0], other.gradient[0])


def test_what_is_refused(settings):
    fitness = make_fitness(settings)
    for horizon in (0.4, 0, True, "long"):
        with pytest.raises(InputError, match=r"^horizon: expected one of 0\.1, 0\.2, 0\.3, 0\.6 s"):
            make_windows(fitness, horizon)
    assert make_windows(fitness, 0.3).count == 2
    windows = make_windows(fitness)
    with pytest.raises(InputError, match=r"^population: expected \[P, 4\]; found \[1, 3\]$"):
        windows.init(np.zeros((1, 3)), KEY)
    with pytest.raises(InputError, match=r"^key: expected jax\.random\.key"):
        windows.init(np.zeros((1, 4)), 3)
    need_mjx()
    with pytest.raises(InputError, match="engine: expected population, to go back"):
        make_windows(make_fitness(settings, engine="mjx"))
