"""The comparison with revolve2: the same brains and robots, and what its script reads and says."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from experiments import revolve2_comparison as comparison
from mjx_revolve import build_robot, load_world, make_cpg
from mjx_revolve.engine.plant import plant_of


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
