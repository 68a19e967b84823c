"""Controllers at a rate of their own: what is commanded depends on no timestep of the world."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import elbow_robot, world
from mjx_revolve.control.kinds import find_controller
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.episodes.config import ControllerConfig

BLIND = SensorReadings(np.zeros(3), np.zeros(3), (), ())
GENES = np.random.default_rng(0).normal(size=(40, 3))
LENGTH = 3.0


@pytest.fixture(scope="module")
def plant():
    return plant_of(elbow_robot(world()))


def commands(plant, times, dt, **settings):
    """`[T, n, 3]` ctrl at times `[T]` or `[T, 3]`, in float64, at a timestep; held, unless told."""
    settings = {"between": "hold"} | settings
    plant = replace(plant, timestep=dt)
    with jax.enable_x64(True):
        controller = find_controller(plant, ControllerConfig(**settings))
        parameters = controller.decode(jnp.asarray(GENES[: controller.num_genes]), plant)
        step = lambda state, t: controller.step(parameters, state, t, BLIND)  # noqa: E731
        run = jax.jit(lambda x: jax.lax.scan(step, controller.init(parameters), x)[1])
        return np.asarray(run(jnp.asarray(times)))


@pytest.mark.parametrize("kind", ["sine", "cpg", "splines"])
def test_commands_are_the_same_at_any_step_and_held_between(plant, kind):
    """Those of instants k / rate, also where no steps fall on them (3 and 12.5 ms)."""
    instants = np.arange(int(20 * LENGTH)) / 20
    every = commands(plant, instants, 1 / 20, type=kind)
    assert np.ptp(every, axis=0).min() > 0.05
    for dt in (0.0125, 0.003):
        times = np.arange(0, LENGTH, dt)
        found = commands(plant, times, dt, type=kind)
        number = np.floor(times * 20 + 1e-9).astype(int)
        assert found == pytest.approx(every[number], abs=1e-12)
        assert len(np.unique(number)) == len(instants)


def test_a_ramp_leads_from_the_last_command_to_this_one(plant):
    """A period late, without jumps, at any step; the first command stands until the second."""
    instants = np.arange(int(20 * LENGTH)) / 20
    held = commands(plant, instants, 0.05, type="sine")
    for dt in (0.0125, 0.003):
        times = np.arange(0.05, LENGTH - 0.1, dt)
        found = commands(plant, np.arange(0, LENGTH - 0.1, dt), dt, type="sine", between="ramp")
        found = found[-len(times) :]
        times = np.arange(0, LENGTH - 0.1, dt)[-len(times) :]
        late = [
            [np.interp(times - 0.05, instants, x) for x in joint.T] for joint in held.swapaxes(0, 1)
        ]
        assert found == pytest.approx(np.moveaxis(np.array(late), -1, 0), abs=1e-9)


def test_robots_of_different_ages_are_each_commanded_from_their_birth(plant):
    """Lanes with times of their own, as in a colony, have what lanes with one time have."""
    times = np.arange(0, LENGTH, 0.0125)
    born = np.array([0, 2, 5])  # steps after the first time, each at its own time 0
    apart = commands(plant, np.maximum(times[:, None] - 0.0125 * born, 0), 0.0125, type="sine")
    together = commands(plant, times, 0.0125, type="sine")
    for lane, steps in enumerate(born):
        own = apart[steps:, :, lane]
        assert own == pytest.approx(together[: len(own), :, lane], abs=1e-12)


def test_a_cpgs_frequency_depends_neither_on_the_rate_nor_on_the_step(plant):
    """x at the instants that rates of 10, 20 and 50 Hz share, against the matrix exponential."""
    from scipy.linalg import expm

    w, c = 4 * np.pi * np.sin(GENES[:2]), 2 * np.pi * np.sin(GENES[2])
    for rate in (10.0, 20.0, 50.0):
        times = np.arange(0, 20, 1 / rate)
        found = commands(plant, times, 1 / rate, type="cpg", rate=rate)[:: round(rate / 10)]
        for lane in range(3):
            a, b = w[:, lane]
            k = c[lane]
            matrix = np.array([[0, k, a, 0], [-k, 0, 0, b], [-a, 0, 0, 0], [0, -b, 0, 0]])
            for number in (1, 77, 199):
                x = (expm(matrix * number / 10) @ [0, 0, 1, 1])[:2]
                assert found[number, :, lane] == pytest.approx(np.pi / 4 * np.tanh(x), abs=1e-8)
