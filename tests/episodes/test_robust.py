"""`task.robust`: coefficients drawn for each trial, for one body and for many."""

import jax
import numpy as np
import pytest

from laboratory import ELBOW, check_refused, swimmer
from mjx_revolve import InputError, load_morphology, make_fitness, make_mixed_fitness
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import RobustConfig, dump_config, load_config, make_config

KEY = jax.random.key(7)
TASK = {"type": "speed", "duration": 1.0, "settle": 0.2, "trials": 2}
WIDE = {"drag": 2.0, "added_mass": 1.5, "density": 1.01, "motor": 1.3}

pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return swimmer(tmp_path_factory.mktemp("robust"), ELBOW, TASK | {"robust": WIDE})


def test_what_may_stand_there(settings, tmp_path):
    read = lambda value: make_config(settings, overrides={"task.robust": value}).task.robust  # noqa: E731
    assert read(True) == RobustConfig() and read(False) is None and read("off") is None
    assert make_config({**settings, "task": TASK}).task.robust is None
    config = make_config(settings, overrides=["task.robust.drag=3"])
    assert config.task.robust == RobustConfig(**WIDE | {"drag": 3.0})
    (tmp_path / "config.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "config.yaml").task == config.task
    for wrong, key in (({"drag": 0.5}, r"\.drag"), ({"lift": 2.0}, "")):
        with pytest.raises(InputError, match=rf"task\.robust{key}"):
            read(wrong)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"engine": "mjx"}, "engine is mjx"), ({"world.drag": "ellipsoid"}, "found ellipsoid")],
)
def test_what_cannot_be_varied_is_refused(settings, change, words):
    with pytest.raises(InputError, match=rf"task\.robust: expected .*{words}"):
        make_fitness(settings, **change)


@pytest.mark.slow
def test_draws_are_the_keys_and_within_their_ranges(settings):
    fitness = make_fitness(settings, **{"task.trials": 200})
    drawn = fitness.draw_starts(KEY).variation
    for name, factor in drawn._asdict().items():
        share = np.sort(np.log(np.asarray(factor)) / np.log(WIDE[name]))
        assert np.all(np.abs(share) <= 1)
        # A Latin hypercube: one in each 200th of the range, in an order of its own.
        np.testing.assert_allclose(share, np.arange(-199, 200, 2) / 200, atol=0.0051)
    assert len({np.argsort(factor).tobytes() for factor in drawn}) == len(drawn)
    again, other = (fitness.draw_starts(key).variation for key in (KEY, jax.random.key(8)))
    np.testing.assert_array_equal(np.stack(drawn), np.stack(again))
    assert not np.any(np.stack(drawn) == np.stack(other))
    # Starts are drawn as they are without.
    plain = make_fitness(settings, **{"task.trials": 200, "task.robust": False}).draw_starts(KEY)
    np.testing.assert_array_equal(plain.quat, fitness.draw_starts(KEY).quat)
    assert plain.variation is None and Variation._fields == tuple(RobustConfig.model_fields)


@pytest.mark.long
def test_one_body_and_many_and_its_replay(settings):
    """The same scores from both programs, and from the trajectory of each trial."""
    fitness = make_fitness(settings)
    body = load_morphology(settings["morphology"])
    mixed = make_mixed_fitness(settings, [body])
    genes = 0.5 * jax.random.normal(jax.random.key(0), (3, fitness.num_genes))
    scores = np.asarray(fitness(genes, KEY))
    usual = make_fitness(settings, **{"task.robust": False})
    assert not np.allclose(scores, usual(genes, KEY), rtol=1e-3)
    robots = [mixed.build(body)] * 3
    np.testing.assert_allclose(mixed(robots, genes, KEY), scores, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(mixed(robots[0], genes, KEY), scores, rtol=1e-3, atol=1e-5)
    # Other draws, the same program.
    assert not np.allclose(fitness(genes, jax.random.key(8)), scores, rtol=1e-3)
    assert fitness.program(genes, KEY).cache_size() == 1
    one = make_fitness(settings, **{"task.trials": 1})
    swum = one.replay(genes[0], KEY)
    score, _ = one.judge(swum, KEY)
    assert swum.variation == one.variation(KEY) != Variation()
    assert mixed.replay(robots[:1], genes[:1], KEY, 1)[0].variation == mixed.variation(KEY, 1)
    for wrong in (-1, 2, True):
        check_refused("trial: expected a whole number from 0 to 1", mixed.variation, KEY, wrong)
    check_refused("key: expected jax.random.key", one.replay, np.zeros(one.num_genes), 0)
    assert score == pytest.approx(float(one(genes[:1], KEY)[0]), rel=1e-3)
    both = [fitness.judge(fitness.replay(genes[0], KEY, trial=k), KEY, k)[0] for k in (0, 1)]
    assert np.mean(both) == pytest.approx(float(scores[0]), rel=1e-3)
