"""Declared sensors: noise, range, rate and delay by hand; and how they are read."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import OAR, ROOT, check_refused, read
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.body.sensors import SENSORS, Sensor, SensorRow
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.control.sensors import count_samples, make_observer
from mjx_revolve.inputs import schema
from mjx_revolve.inputs.errors import InputError

DT = 0.01


def watch(sensor, signal, noise=None):
    """`[T, ...]` of what one sensor gives while the core's height follows a signal `[T, lanes]`."""
    observer, joint = make_observer([sensor], DT), np.zeros((1, 1), np.int32)

    def step(state, now):
        k, height = now
        angle = jnp.broadcast_to(height, (joint.shape[0], *height.shape))
        sense = SensorReadings(height, height, (), (), angle=angle, noise=noise)
        state, found = observer.observe(state, k * DT, sense, joint)
        return state, jnp.stack([*found.robot, *found.joint])

    with jax.enable_x64(True):
        signal = jnp.asarray(signal, float)
        state = observer.init(jnp.zeros((joint.shape[0], signal.shape[1])))
        rows = jnp.arange(len(signal)), signal
        return np.asarray(jax.jit(lambda: jax.lax.scan(step, state, rows)[1])())[:, 0]


RAMP = 0.01 * np.arange(19)  # tells in which of the steps of 10 ms it was measured
GIVEN = {
    "over its range": ({"range": 2.0}, [0.5, -1.0, 3.0, -np.inf], [0.25, -0.5, 1.0, -1.0]),
    # 0 stays 0, and what lies below is clipped to it.
    "from 0 on": ({"type": "depth", "range": (0, 4)}, [-1.0, 0.5, -5.0], [0.25, 0.0, 1.0]),
    "around its middle": (
        {"type": "depth", "range": (1.5, 2.5)}, [-1.0, -2.0, -2.4, -9.0], [-1.0, 0.0, 0.8, 1.0],
    ),
    # Measured at 0, 30, 50, 80 and 100 ms.
    "40 Hz": ({"rate": 40.0}, RAMP[:12], RAMP[[0, 0, 0, 3, 3, 5, 5, 5, 8, 8, 10, 10]]),
    "faster than the steps": ({"rate": 1000.0}, RAMP[:5], RAMP[:5]),
    # Before that, the first value.
    "three steps late": ({"delay": 0.03}, 0.5 + RAMP[:7], 0.5 + RAMP[[0, 0, 0, 0, 1, 2, 3]]),
    "20 Hz, late": ({"rate": 20.0, "delay": 0.03}, RAMP[:14], RAMP[[0] * 8 + [5] * 5 + [10]]),
    # A sample of 50 ms is due at 125 ms: the step at 130 ms is the first to have it.
    "20 Hz, later": ({"rate": 20.0, "delay": 0.075}, RAMP, RAMP[[0] * 13 + [5] * 5 + [10]]),
}  # fmt: skip


@pytest.mark.parametrize("case", GIVEN)
def test_what_a_sensor_gives(case):
    sensor, signal, expected = GIVEN[case]
    found = watch(Sensor(**{"type": "climb"} | sensor), np.array(signal)[:, None])
    assert found[:, 0] == pytest.approx(expected)


@pytest.mark.parametrize(("dt", "duration"), [(0.005, 7200), (0.01, 7200), (0.02, 14400)])
def test_no_sample_is_missed_however_long_it_lasts(dt, duration):
    """By a float32 clock, at the rate of the steps and at 20 Hz, in the last minute."""
    steps = np.arange(round((duration - 60) / dt), round(duration / dt))
    for every in (1, round(0.05 / dt)):
        time = jnp.asarray(steps, jnp.float32) * jnp.float32(dt)
        found = count_samples(time, 1 / (every * dt))
        assert (np.diff(np.asarray(found)[::every]) == 1).all()


def test_noise_is_drawn_anew_for_each_sample_and_lane_and_stays_the_same():
    lanes, steps = 64, 400
    seeds = jnp.arange(lanes, dtype=jnp.uint32)
    still = np.zeros((steps, lanes))
    found = watch(Sensor(type="climb", noise=0.02, range=1.0), still, seeds)
    assert abs(found.mean()) < 4 * 0.02 / np.sqrt(found.size)
    assert found.std() == pytest.approx(0.02, rel=0.02)
    assert len(np.unique(found)) > 0.99 * found.size
    # Neighbouring samples and lanes know nothing of each other.
    for a, b in ((found[1:], found[:-1]), (found[:, 1:], found[:, :-1])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 4 / np.sqrt(found.size)
    # A lane's noise is its own, wherever it stands.
    some = watch(Sensor(type="climb", noise=0.02), still[:, :2], seeds[jnp.array([7, 3])])
    assert np.array_equal(some, found[:, [7, 3]])
    # With a rate, it is drawn with the sample.
    held = watch(Sensor(type="climb", noise=0.02, rate=10.0), still[:40, :2], seeds[:2])
    assert len(np.unique(held)) == 2 * 4


def test_a_sensor_of_bodies_speaks_of_core_and_hinges():
    observer = make_observer([Sensor(type="contact", range=(0, 10)), Sensor(type="gyro")], DT)
    touch = jnp.array([[1.0], [2.0], [30.0]])
    spin = tuple(jnp.full(1, x) for x in (1.0, 2.0, -3.0))
    sense = SensorReadings(0.0, 0.0, (), spin, touch=touch)
    _, found = observer.observe((), jnp.array(0.0), sense, np.zeros((2, 1), np.int32))
    assert np.concatenate(found.robot) == pytest.approx([0.1, 0.1, 0.2, -0.3])
    assert found.joint[0] == pytest.approx(np.array([[0.2], [1.0]]))
    assert observer.robot_names == ("contact", "gyro x", "gyro y", "gyro z")
    assert observer.joint_names == ("contact",) and observer.signals == ("touch",)


SENSED = f"""
{OAR}
sensors:
  - gyro
  - {{type: sonar, name: echo, unit: m, range: [0, 3], noise: 0.01, rate: 8, delay: 0.05}}
"""


def test_a_robots_sensors_are_read_and_saved(tmp_path):
    body = read(SENSED)
    assert body.sensors is not None
    gyro, echo = body.sensors
    assert gyro == Sensor(type="gyro") and gyro.limits == SENSORS["gyro"].range
    assert (echo.label, echo.limits, echo.noise, echo.rate) == ("echo", (0.0, 3.0), 0.01, 8.0)
    body.save(tmp_path / "again.yaml")
    again = load_morphology(tmp_path / "again.yaml")
    assert again == body.__class__(body.name, again.modules, sensors=body.sensors)
    assert again != body.__class__(body.name, again.modules)
    assert read(OAR).sensors is None


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
("gyro", "sensors: expected a list of sensors; found 'gyro'"),
(["gyr"], "sensors.0.type: expected one of depth, climb, tilt, "),
(["gyro", "gyro"], "sensors.1.name: expected names that differ (give one of them a `name`)"
         "; found 'gyro' twice"),
([{"type": "gyro", "unit": "m"}], "sensors.0.unit: expected 'rad/s', as of gyro; found"),
([{"type": "gyro", "rate": 0}], "sensors.0.rate: expected a number > 0 and <= 10000 [Hz]")
],
)  # fmt: skip
def test_wrong_sensors(sensors, message):
    check_refused(message, schema.read, SensorRow, sensors, "sensors")


def test_a_delay_of_too_many_samples():
    with pytest.raises(InputError, match=r"sensors.0.delay: expected at most 2.56 s at 100 Hz"):
        make_observer([Sensor(type="gyro", delay=4.0)], DT)


GUIDE = (ROOT / "docs" / "senses.md").read_text(encoding="utf-8")


def test_the_guides_table_of_sensors_is_the_codes():
    for name, kind in SENSORS.items():
        low, high = kind.range
        reach = f"±{high:.4g}" if low == -high else f"{low:g} to {high:g}"
        row = (
            f"| `{name}` | {len(kind.parts)} | {kind.unit} | {kind.where} | {reach} | {kind.what} |"
        )
        assert row in GUIDE


def test_noise_belongs_to_the_hinge_not_to_its_row():
    def noise(order):
        number = np.array(order, np.int32)[:, None]
        observer = make_observer([Sensor(type="angle", noise=0.1)], DT)
        angle = jnp.zeros((3, 4))
        sense = SensorReadings(0.0, 0.0, (), (), angle=angle, noise=jnp.arange(4, dtype=jnp.uint32))
        return np.asarray(observer.observe((), jnp.array(0.5), sense, number)[1].joint[0])

    assert np.array_equal(noise([2, 0, 1])[[1, 2, 0]], noise([0, 1, 2]))
    assert len(np.unique(noise([0, 1, 2]))) == 12
