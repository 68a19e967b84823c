"""The fitness function: pure, batched, safe from one individual's failure. Known answers."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import check_refused, make_track, refusal, swimmer
from mjx_revolve import InputError, load_world, make_fitness
from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.scoring import WORST, Scores, average_trials, max_distance
from mjx_revolve.episodes.tasks import TASKS, find_task, score_unit, shown_measure
from mjx_revolve.numerics.xla import compiler_options
from mjx_revolve.water.currents import CurrentField

KEY = jax.random.key(7)
# The smallest robot with joints: compiles fast.
_ARM = "{type: ActiveHinge, orientation: 90, children: {1: {type: FixedBrick, orientation: -90}}}"
ROBOT = f"body: {{type: Core, children: {{1: {_ARM}}}}}"
TASK = {"type": "speed", "duration": 1.0, "settle": 0.2, "trials": 2}
pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return swimmer(tmp_path_factory.mktemp("fitness"), ROBOT, TASK)


@pytest.fixture(scope="module")
def fitness(settings):
    return make_fitness(settings)


@pytest.fixture(scope="module")
def population(fitness):
    return 0.5 * jax.random.normal(jax.random.key(0), (70, fitness.num_genes))


@pytest.fixture(scope="module")
def scores(fitness, population):
    return np.asarray(fitness(population, KEY))


@pytest.mark.slow
def test_one_score_each_and_the_same_again(fitness, population, scores):
    assert scores.shape == (70,) and np.all(np.isfinite(scores))
    np.testing.assert_array_equal(scores, fitness(population, KEY))
    assert not np.array_equal(scores, fitness(population, jax.random.key(8)))


@pytest.mark.slow
def test_an_individual_does_not_feel_the_population_around_it(fitness, population, scores):
    """70 individuals of 2 episodes are 3 chunks of 64 lanes, 40 are two, the last one padded."""
    few = np.asarray(fitness(population[:40], KEY))
    np.testing.assert_array_equal(few, scores[:40])


@pytest.mark.slow
def test_a_blown_up_individual_scores_worst_and_spreads_nothing(fitness, population, scores):
    broken = population.at[3].set(jnp.nan)
    found = np.asarray(fitness(broken, KEY))
    assert found[3] == WORST == fitness.worst_score
    others = np.arange(70) != 3
    np.testing.assert_array_equal(found[others], scores[others])


def test_what_the_water_carries_off_does_not_blow_up(fitness):
    figure, task = body_geometry(fitness.robot), fitness.settings
    still = max_distance(task, load_world("empty_underwater"), figure)
    field = CurrentField([0.0], [0.0], [0.0], np.reshape([4.0, 0, 3.0], (1, 1, 1, 3)))
    for motion in (
        {"current": (0, 5, 0)},
        {"shear": {"velocity": [5, 0, 0]}},
        {"gust": {"std": [0, 1.25, 0]}},
        {"current_field": field},
    ):
        moved = max_distance(task, load_world("empty_underwater", **motion), figure)
        assert moved == pytest.approx(still + 5 * task.duration)


@pytest.mark.long
def test_mjx_scores_the_same(settings, population, scores):
    slow = make_fitness(settings, engine="mjx")
    np.testing.assert_allclose(slow(population[:2], KEY), scores[:2], atol=2e-4)


def test_wrong_populations_are_refused(fitness):
    check_refused("population: expected [P, 4]; found [3, 9]", fitness, jnp.zeros((3, 9)), KEY)
    check_refused("key: expected jax.random.key(SEED); found 1", fitness, jnp.zeros((3, 4)), 1)


def test_a_crawler_needs_a_bed(settings):
    with pytest.raises(InputError, match=r"task\.type: crawl expected a world with a bed; found"):
        make_fitness(settings, **{"task.type": "crawl", "world": {"name": "lake", "bed": False}})


def track(x, z=None, clearance=1.0, drift=0.0):
    """One individual that moves along x in steps of 1 s, in water that does, too [m/s]."""
    rows, z = np.ones(len(x)), np.zeros(len(x)) if z is None else z
    water = np.outer(rows, [drift, 0, 0])
    return make_track(np.c_[x, 0 * rows, z], clearance=clearance * rows, water_velocity=water)


def turned(yaws, roll=0.3):
    """One individual that stays and heads so far from the x axis [rad], rolled as well."""
    yaws = np.asarray(yaws, np.float32)
    c, s = np.cos(yaws / 2), np.sin(yaws / 2)
    quat = [c * np.cos(roll / 2), c * np.sin(roll / 2), s * np.sin(roll / 2), s * np.cos(roll / 2)]
    found = track(np.zeros(len(yaws)), z=np.full(len(yaws), 0.5))
    return replace(found, quat=jnp.asarray(np.stack(quat, 1)[:, :, None]))


SETTINGS = SimpleNamespace(
    direction=(2.0, 0.0, 0.0), depth_tolerance=0.1, target=(4.0, 0.0, 0.0), height=0.4,
    horizon=None,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("task", "given", "score"), [
    ("directed_swim", track([0, 1, 2]), 2.0),  # 1 m/s, half a metre long
    ("directed_swim", track([0, -1, -2]), -2.0),
    ("directed_swim", track([0, 1, 2], z=[-1, -1, -1]), 0.0),  # not at its depth
    ("directed_swim", track([0, 1, 2], z=[0, 0, 2]), 1.0),  # for the first metre only
    ("directed_swim", track([0, -1, -2], z=[-1, -1, -1]), -2.0),  # lost at any depth
    ("crawl", track([0, -1, -2], clearance=0.5), -2.0),
    ("speed", track([0, -1, -2]), 2.0),
    ("speed", track([0, 1, 2], drift=1.0), 0.0),  # it drifted
    ("speed", track([0, 0, 0], drift=0.5), 1.0),  # it held its own
    ("speed", track([0, 1, 0], z=[0, 0, 2]), 0.0),  # a loop whose way back is off its depth
    ("reach_target", track([0, 1, 3]), 6.0),  # from 4 m away to 1 m
    ("hold_depth", track([0, 1], z=[0.5, 0.5]), -1.0),
    ("hold_heading", turned([0, 0]), -1.0),  # off its depth alone
    ("hold_heading", turned([0.3, -0.3, 0.3]), -1.3),
    ("follow_bed", track([0, 1, 2], clearance=0.45), 2.0),
    ("follow_bed", track([0, 1, 2], clearance=0.05), 0.0),  # too low
    ("crawl", track([0, 1, 2], clearance=0.05), 2.0),
    ("crawl", track([0, 1, 2], clearance=0.5), 0.0),  # it swam
])  # fmt: skip
def test_tasks_with_known_scores(task, given, score):
    assert float(TASKS[task].score(given, SETTINGS)[0]) == pytest.approx(score, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "rows"), [(0.0, 21), (-0.6, 21), (0.1, 20), (-0.04, 10)])
def test_a_horizon_foretells_the_way_of_a_circle(rate, rows):
    """At 1 m/s and so many rad/s: from some 20 s the net way of 120 s, by the chord of the arc."""
    time = np.arange(float(rows))
    angle = rate * time
    x, y = (time, 0 * time) if rate == 0 else (np.sin(angle) / rate, (1 - np.cos(angle)) / rate)
    given = track(x)
    given = replace(given, position=given.position.at[:, 1, 0].set(y.astype(np.float32)))
    expected = 2.0 if rate == 0 else 2 * abs(2 * np.sin(60 * rate) / rate) / 120
    far, near, ahead, slopes = _of_a_horizon(given.position)
    assert float(far) == pytest.approx(expected, rel=1e-3)
    assert float(near) >= expected - 1e-5
    # Along a direction, from the heading in which it began: the arc's own way along it.
    along = 2.0 if rate == 0 else 2 * np.sin(120 * rate) / rate / 120
    assert float(ahead) == pytest.approx(along, abs=2e-3)
    assert np.isfinite(slopes).all()
    for half in (0, 1):  # at rest all along, and as windows see it: from its middle on
        rested = given.position.at[len(x) // 2 * half :].set(given.position[len(x) // 2 * half])
        assert np.isfinite(_of_a_horizon(rested)[3]).all()


@jax.jit
def _of_a_horizon(position):
    """Scores of a track with a horizon, without, and along x; and the first's gradient."""
    settings = SimpleNamespace(horizon=120.0, depth_tolerance=0.1, direction=(3.0, 0.0, 0.0))
    near = SimpleNamespace(horizon=None, depth_tolerance=0.1)
    given = replace(track(np.zeros(len(position))), position=position)
    score = lambda name, p, how: TASKS[name].score(replace(given, position=p), how)[0]  # noqa: E731
    far, slopes = jax.value_and_grad(lambda p: score("speed", p, settings))(position)
    return far, score("speed", position, near), score("directed_swim", position, settings), slopes


def test_a_horizon_foretells_when_depth_is_left():
    """Rising 2 mm/s leaves the 0.1 m that count after 50 s, and what lies beyond after 100 s."""
    time = np.arange(21.0)
    far = SimpleNamespace(horizon=120.0, depth_tolerance=0.1)
    score = float(TASKS["speed"].score(track(time, z=0.002 * time), far)[0])
    assert score == pytest.approx(2.0 * 0.6, rel=0.1)
    assert float(TASKS["speed"].score(track(time, z=0.002 * time), SETTINGS)[0]) == 2.0
    back = SimpleNamespace(horizon=120.0, depth_tolerance=0.1, direction=(-1.0, 0.0, 0.0))
    lost = float(TASKS["directed_swim"].score(track(time, z=0.002 * time), back)[0])
    assert lost == pytest.approx(-2.0, rel=1e-5)  # the whole way, at any depth


def test_scores_in_metres_leave_the_body_length_out():
    given = track([0, 1, 2])
    swim = find_task(TaskConfig(type="directed_swim", unit="m"))
    assert float(swim.score(given, SETTINGS)[0]) == pytest.approx(1.0) and swim.unit == "m/s"
    assert score_unit("hold_heading", "m") == "m + rad"
    assert shown_measure("speed", "m") == "speed_bl_s" != shown_measure("speed")
    search = TaskConfig(type="search", unit="m", target_distance=1, sight=1)
    assert refusal(find_task, search, "my.yaml") == (
        "my.yaml: task.unit: expected body_lengths, as the scores of search do not say that they "
        "are in body lengths; found m"
    )


@pytest.mark.parametrize("trials", [5, 31, 32, 100])
def test_means_over_trials_do_not_depend_on_the_population(trials):
    values = np.random.default_rng(0).normal(size=(2, 130, trials)).astype(np.float32)

    def mean(score, measure):
        found = Scores(score, jnp.isfinite(score), {"depth_m": measure})
        return average_trials(found, trials)

    mean = jax.jit(mean, compiler_options=compiler_options())
    score, measures = mean(*values.reshape(2, -1))
    found = np.stack([score, measures["depth_m"]])
    np.testing.assert_allclose(found, values.mean(2), atol=1e-6)
    for count in (1, 3, 17):
        alone, own = mean(*values[:, :count].reshape(2, -1))
        np.testing.assert_array_equal(alone, score[:count])
        np.testing.assert_array_equal(own["depth_m"], measures["depth_m"][:count])
