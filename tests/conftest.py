"""Fixtures that several files share; whatever compiles is made once for the whole session."""

import atexit
import gc
import math
import os
import shutil
import tempfile
from collections import Counter
from pathlib import Path

# One cache of compiled programs for the session, its workers and the processes that they start; the
# user's own stays as it is. XLA's flags are part of a program's name there. Small ones are kept,
# too: there are thousands. Set before JAX is loaded, which reads it then.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="mjx_revolve_tests_")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

# What users have used before is remembered; not what tests use.
if "mjx_revolve_state_" not in os.environ.get("XDG_STATE_HOME", ""):
    os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="mjx_revolve_state_")
    atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

import jax
import pytest

from laboratory import WATER, body, compiled_quickly, elbow_robot, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.numerics import runtime
from mjx_revolve.water.world import load_world

# A trace makes millions of small objects of which few are garbage: a tenth of its time.
gc.set_threshold(200_000, 20, 20)


@pytest.fixture(scope="session")
def spider():
    """The spider in deep still water, everything on."""
    return build_robot(body("spider"), load_world("lake"))


@pytest.fixture(scope="session")
def elbow():
    """The smallest body with two hinges, in water."""
    return elbow_robot(world(**WATER))


@pytest.fixture(scope="module")
def quick_compiles():
    """Leaves out the compiler's optimisations: they cost more than short runs save."""
    with compiled_quickly():
        yield


@pytest.fixture
def no_pictures(monkeypatch):
    """Runs end without their plots, which take a second each."""
    monkeypatch.setattr("mjx_revolve.view.results.save_pictures", lambda run, champion: None)


@pytest.fixture
def float64():
    """What is compared is exact but for rounding."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(autouse=True)
def no_kept_programs(monkeypatch):
    """Tests change what programs are made of; processes that they start keep theirs."""
    monkeypatch.setattr(runtime, "program_folder", lambda: None)


def _memory() -> float:
    """What this process holds in memory [bytes]; infinite where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return math.inf
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


@pytest.fixture(scope="module", autouse=True)
def fresh_traces():
    """Forgets traces after a file where they hold much memory: the next file can use them."""
    yield
    if _memory() > 3e9:
        jax.clear_caches()


# Files are dealt out whole, the longest first, so that no worker is left alone at the end.
_LONGEST = (
    "test_step", "test_self_contact", "test_coevolution", "test_docs", "test_examples",
    "test_bodies_end_to_end", "test_fit", "test_end_to_end", "test_many_bodies", "test_energy",
    "test_executor", "test_dynamics", "test_brain", "test_colony", "test_rollout",
    "test_collisions", "test_vector_env", "test_report", "test_fuzz", "test_cluster",
    "test_gene_search", "test_tank", "test_tasks", "test_measured", "test_servos",
    "test_closed_forms", "test_fit_recordings",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    place = {name: number for number, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))
    seen: Counter[str] = Counter()
    for item in items:
        if (sampled := item.get_closest_marker("sampled")) is not None:
            name = item.nodeid.partition("[")[0]
            seen[name] += 1
            if seen[name] > sampled.args[0]:
                item.add_marker(pytest.mark.long)
