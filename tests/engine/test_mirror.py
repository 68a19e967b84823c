"""Mirror images: a robot, its start and its gait mirrored swim the mirror image, to rounding."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from laboratory import QUICK, body
from mjx_revolve import build_robot, load_world
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.engine.population import make_population_engine
from mjx_revolve.numerics.xla import fuse
from mjx_revolve.water.flow import water_of

# Sines and sums in another order: some hundred steps of float64.
ROUNDING = 1e-12


@lru_cache(maxsize=8)
def load(name, **world):
    return build_robot(body(name), load_world("lake", **world))


class Mirror:
    """What mirroring about the plane across an axis (0: x, 1: y) does to a robot's coordinates."""

    def __init__(self, robot, axis):
        model = robot.mj_model
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self.flip = np.ones(3)
        self.flip[axis] = -1
        anchors, axes = data.xanchor[1:] - data.xpos[1], data.xaxis[1:]
        # An axis of rotation is mirrored as a spin is.
        apart = np.linalg.norm(anchors * self.flip - anchors[:, None], axis=-1)
        self.twin = apart.argmin(0)
        self.sign = np.einsum("ij,ij->i", -axes * self.flip, axes[self.twin])
        assert apart.min(0).max() < 1e-9, "the robot is not symmetric"
        np.testing.assert_allclose(abs(self.sign), 1.0, atol=1e-9)

    def hinges(self, x):
        """`[..., n]` angles, speeds or targets."""
        image = np.empty_like(x)
        image[..., self.twin] = x * self.sign
        return image

    def pose(self, qpos):
        """`[..., nq]`; a quaternion's vector part is mirrored as a spin is."""
        moved, w, spun = qpos[..., :3] * self.flip, qpos[..., 3:4], -qpos[..., 4:7] * self.flip
        return np.concatenate([moved, w, spun, self.hinges(qpos[..., 7:])], -1)

    def velocity(self, qvel):
        """`[..., nv]`."""
        moved, spun = qvel[..., :3] * self.flip, -qvel[..., 3:6] * self.flip
        return np.concatenate([moved, spun, self.hinges(qvel[..., 6:])], -1)


@lru_cache(maxsize=8)
def swimmer(robot):
    engine, water = make_population_engine(robot, contact=False), water_of(robot.world)

    def step(state, row):
        state, _ = engine.step(state, row, water)
        return state, engine.observe(state)[0]

    def run(qpos, qvel, ctrl):
        return jax.lax.scan(fuse(step, inline=True), engine.init(qpos, qvel), ctrl)[1]

    return engine, jax.jit(run, compiler_options=QUICK)


def swim(robot, qpos, qvel, ctrl):
    """Lanes side by side, `[lanes, nq]`, `[lanes, nv]`, `[lanes, T, nu]` → `[lanes, T, nq]`."""
    engine, run = swimmer(robot)
    with jax.enable_x64(True):
        own = np.asarray(ctrl)[..., actuators_of(robot)].transpose(2, 1, 0)
        asked = jnp.moveaxis(engine.plant.arrange(jnp.asarray(own)), 0, 1)  # [T, nu, lanes]
        way = run(jnp.asarray(qpos).T, jnp.asarray(qvel).T, asked)
        return np.moveaxis(np.asarray(way), -1, 0)


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "name, axes, world",
    [
        ("spider", (0, 1), {}),
        pytest.param("fish", (0,), {"current": (0.0, 0.1, 0.0)}, marks=pytest.mark.slow),
        pytest.param("gecko", (0,), {"drag": "lift_drag"}, marks=pytest.mark.slow),
    ],
)
def test_the_mirror_image_swims_the_mirror_image(name, axes, world):
    """From anywhere, tumbling, half out of the water: nothing in the step has a handedness."""
    robot, draw = load(name, **world), np.random.default_rng(3)
    count, steps = robot.mj_model.nu, 200
    qpos = robot.start_qpos(-0.03)
    qpos[3:7] = draw.normal(size=4)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    qpos[7:] = 0.5 * draw.normal(size=count)
    qvel = 0.5 * draw.normal(size=6 + count)
    phase = 2 * np.pi * 1.5 * robot.world.timestep * np.arange(steps)[:, None]
    ctrl = draw.uniform(0.3, 1.5, count) * np.sin(phase + draw.uniform(-3, 3, count))
    mirrors = [Mirror(robot, axis) for axis in axes]
    ways = swim(
        robot,
        np.stack([qpos, *(m.pose(qpos) for m in mirrors)]),
        np.stack([qvel, *(m.velocity(qvel) for m in mirrors)]),
        np.stack([ctrl, *(m.hinges(ctrl) for m in mirrors)]),
    )
    assert np.abs(ways[0, -1, :3] - qpos[:3]).max() > 0.05
    for way, mirror in zip(ways[1:], mirrors, strict=True):
        np.testing.assert_allclose(way, mirror.pose(ways[0]), atol=ROUNDING)
