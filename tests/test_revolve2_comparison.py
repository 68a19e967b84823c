"""The comparison with revolve2: the same brains and robots, and what its script reads and says."""

from __future__ import annotations

import os

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from experiments import revolve2_comparison as comparison
from experiments.common import write_results
from mjx_revolve import build_robot, load_world, make_cpg
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.inputs.errors import InputError

PYTHON = os.environ.get("REVOLVE2_PYTHON", "")


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


def test_a_python_without_revolve2_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"--python .*: expected a Python; found No such file"):
        comparison.run_revolve2(tmp_path / "python", {})


def test_results_name_versions_seeds_and_machine(tmp_path):
    path = write_results("study", {"speed": 2.5}, [1, 2], tmp_path)
    assert path == tmp_path / "study.json"
    text = path.read_text()
    assert '"speed": 2.5' in text and '"jax": "' in text and '"cpu_count": ' in text


@pytest.mark.skipif(not PYTHON, reason="REVOLVE2_PYTHON names no Python that has revolve2")
def test_revolve2_simulates_the_same_robots():
    bodies = comparison.load_bodies()
    genes = comparison.make_population(bodies, len(bodies), seed=0)
    asked = {
        "robots": comparison.as_json(bodies), "seconds": 1, "rate": comparison.RATE,
        "timestep": comparison.TIMESTEP, "cores": 1,
        "individuals": [
            {"robot": k, "matrix": comparison.cpg_matrix(bodies[k], g).tolist()}
            for k, g in enumerate(genes)
        ],
    }  # fmt: skip
    found = comparison.run_revolve2(PYTHON, asked)
    assert found["versions"]["revolve2-simulation"] == "1.2.4" and len(found["ways"]) == len(bodies)
    bodies = comparison.load_bodies(found["robots"])
    mass, place = comparison.difference(bodies, found["robots"])
    assert mass < 1e-9 and place < 1e-5
    core = bodies[0].modules[0].kind.mass
    assert core > 0.47  # revolve2 loses its root's stated inertia; see `load_bodies`
