"""Buoyancy: the cut box against exact geometry, and robots that fall, hover, float and bob."""

import itertools
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import accelerate, at_rest, body, box_robot, march, world
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.water.buoyancy import BUOYANCY_LAWS, cut_box, displaced_water
from references import clip_box

WATER = 999.1026  # kg/m³, the thesis's
G = 9.81

BOXES = {
    f"{kind.name}-{part.name}": np.array(part.boxes[0].size) / 2
    for kind in MODULES.values()
    for part in kind.parts
} | {
    "cube": np.full(3, 0.5),
    "plank": np.array([0.5, 0.1, 0.02]),
    "sheet": np.array([0.5, 0.3, 5e-5]),
    "needle": np.array([5e-4, 0.5, 5e-4]),
}

# Of the share, and of each component of the moment over its half edge: rounding, of a handful of
# additions of numbers up to 2. Found: 1.2e-15 and 1.4e-7.
ERROR = {True: 1e-14, False: 1e-6}  # float64, float32


@lru_cache
def _cut(mode):
    """One program for all boxes."""
    return jax.jit(BUOYANCY_LAWS[mode].submersion)


def cut(up, depth, half, mode="partial", x64=True):
    """`cut_box` of many states of one box: `[n, 3]`, `[n]`, `[3]` to `[n]`, `[n, 3]`."""
    with jax.enable_x64(x64):
        up = tuple(jnp.asarray(x) for x in np.asarray(up, float).T)
        share, moment = _cut(mode)(up, jnp.asarray(depth), tuple(half))
        return np.asarray(share), np.stack(moment, -1)


def attitudes(n, seed=0):
    """`[n, 3]` verticals, half of them anywhere, half with one or two edges level or nearly so."""
    draw = np.random.default_rng(seed)
    up = draw.normal(size=(n, 3))
    for k in range(2):
        rows = np.arange(k * n // 4, n // 2)
        up[rows, draw.integers(0, 3, len(rows))] *= 10 ** draw.uniform(-12, 0, len(rows))
    return up / np.linalg.norm(up, axis=1)[:, None]


# Level, on edge and on corner, where the heights of edges vanish or are equal; signs too.
SPECIAL = [n / np.linalg.norm(n) for n in itertools.product((0.0, -1.0, 1.0), repeat=3) if any(n)]


def assert_exact(up, depth, half):
    """Against tetrahedra, in both precisions."""
    for x64 in (True, False):
        # Both cut what the precision can say of the state: rounding it is no error of the cut's.
        kind = np.float64 if x64 else np.float32
        state = np.asarray(up, kind).astype(float), np.asarray(depth, kind).astype(float)
        exact = [clip_box(u, d, half) for u, d in zip(*state, strict=True)]
        share, moment = cut(*state, half, x64=x64)
        assert share.dtype == moment.dtype == kind
        assert share.min() >= 0
        assert share.max() <= 1
        assert np.abs(share - [s for s, _ in exact]).max() < ERROR[x64]
        assert np.abs((moment - [m for _, m in exact]) / half).max() < ERROR[x64]


@pytest.mark.slow
@pytest.mark.parametrize("name", BOXES)
def test_share_and_moment_of_a_cut_box(name):
    half, n = BOXES[name], 300
    up = attitudes(n)
    depth = np.random.default_rng(1).uniform(-1.05, 1.05, n) * (np.abs(up) @ half)
    assert_exact(up, depth, half)


@pytest.mark.parametrize("name", ["cube", "plank", "needle", "TouchSensor-sensor"])
def test_share_and_moment_on_face_edge_and_corner(name):
    half = BOXES[name]
    # Tilts by a rounding error too: no step between level and nearly level.
    near = [n + 1e-7 * np.roll(n, 1) - 1e-9 * np.roll(n, 2) for n in SPECIAL]
    up = np.array(SPECIAL + [n / np.linalg.norm(n) for n in near])
    # Not level with a face to the last digit: there a reference has to choose a side.
    for level in (-0.999, -0.5, 0.0, 0.1, 1 / 3, 0.999):
        assert_exact(up, level * (np.abs(up) @ half), half)


@pytest.mark.parametrize("mode", ["partial", "mask"])
def test_far_above_and_below_the_surface_nothing_is_cut(mode):
    half, up = BOXES["cube"], attitudes(50)
    for depth, expected in ((-3.0, 0.0), (3.0, 1.0)):
        share, moment = cut(up, np.full(50, depth), half, mode)
        assert np.all(share == expected)
        assert not moment.any()


def test_mask_is_all_or_nothing():
    up = attitudes(4)
    depth = np.array([-1e-6, 1e-6, -0.2, 0.2])
    share, moment = cut(up, depth, BOXES["cube"], "mask")
    assert share.tolist() == [0, 1, 0, 1]
    assert not moment.any()


def everything(state, half):
    """Share and moment at a depth and a vertical."""
    share, moment = cut_box(tuple(state[1:]), state[0], tuple(half))
    return jnp.stack([share, *moment])


@jax.jit
def table(depth, angle, half):
    """Share, moment and slopes by depth and angle; all edges see the vertical but at angle 0."""

    def tilted(depth, angle):
        up = (0.6 * jnp.sin(angle), 0.8 * jnp.sin(angle), jnp.cos(angle))
        share, *moment = everything((depth, *up), half)
        return jnp.stack([share, *(m / half.max() for m in moment)])

    rows = jax.vmap(tilted, (0, None))(depth, angle)
    slope = jax.vmap(jax.jacfwd(tilted, (0, 1)), (0, None))(depth, angle)
    return rows, jnp.concatenate([slope[0] * half.max(), slope[1]], 1)


@pytest.mark.parametrize("name", ["cube", "TouchSensor-sensor"])
def test_force_moment_and_gradients_are_continuous_through_the_surface(name):
    """Halving the spacing of the samples halves the largest jump; a jump would stay."""
    half = BOXES[name]
    depth = np.linspace(-1.2, 1.2, 8001) * np.linalg.norm(half)
    for tilt in (0.0, 1e-3, 0.02, 0.3, np.pi / 4):
        with jax.enable_x64(True):
            tables = table(depth, tilt, half)
        # Tilted by 1e-3, the slopes' ramp is a few samples wide; for 0 see the next test.
        for rows in map(np.asarray, tables if tilt > 0.01 else tables[:1]):
            fine = np.abs(np.diff(rows, axis=0)).max(0)
            coarse = np.abs(np.diff(rows[::2], axis=0)).max(0)
            assert np.all(fine < 0.7 * coarse + 1e-9), tilt


LEVEL, EDGE, CORNER = (0.0, 0.0, 1.0), (0.0, -(0.5**0.5), 0.5**0.5), (3**-0.5,) * 3
STATES = {
    # up, depth over the height from centre to the top
    "level": (LEVEL, 0.3),
    "level, centre at the surface": (LEVEL, 0.0),
    "upside down": ((0.0, 0.0, -1.0), -0.4),
    "on edge": (EDGE, -0.2),
    "on edge, centre at the surface": (EDGE, 0.0),
    "edge at the surface": (EDGE, -1.0),
    "edge just under": (EDGE, 1.0),
    "on corner": (CORNER, 0.1),
    "on corner, centre at the surface": (CORNER, 0.0),
    "corner at the surface": (CORNER, -1.0),
    "three corners at the surface": (CORNER, 1 / 3),
    "nearly level": ((1e-9, 0.0, 1.0), 0.5),
    "anywhere": ((0.36, -0.48, 0.8), 0.2),
    "under": ((0.36, -0.48, 0.8), 1.5),
    "out": ((0.36, -0.48, 0.8), -1.5),
    "level and under": (LEVEL, 2.0),
    "level and out": (LEVEL, -2.0),
}


run, *slopes = map(jax.jit, (everything, jax.jacfwd(everything), jax.jacrev(everything)))


@pytest.mark.slow
@pytest.mark.parametrize("name", STATES)
@pytest.mark.parametrize("half", [(0.5, 0.5, 0.5), (0.3, 0.2, 0.1)])
def test_gradients_against_differences(name, half):
    """Forward and backward, share and moment by depth and vertical, also where edges are equal."""
    up, level = STATES[name]
    state, step = np.array([level * (np.abs(up) @ np.array(half)), *up]), 1e-6
    with jax.enable_x64(True):
        value = lambda state: np.asarray(run(state, half))  # noqa: E731
        rows = [(value(state + e) - value(state - e)) / (2 * step) for e in step * np.eye(4)]
        expected = np.stack(rows, -1)
        for slope in slopes:
            # Third slopes of W jump at the edges of a cut: differences there err by the step.
            assert np.asarray(slope(state, half)) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("x64", [True, False])
def test_gradients_are_finite_everywhere(x64):
    """Faces flush, far away, any of the special attitudes; float32 too."""
    half = (0.05, 0.03, 5e-4)
    kind = np.float64 if x64 else np.float32
    up = np.concatenate([SPECIAL, attitudes(40)]).astype(kind)
    reach = np.abs(up) @ np.array(half, kind)
    with jax.enable_x64(x64):
        at = lambda depth, up: everything((depth, *up), half)  # noqa: E731
        slopes = jax.jit(jax.vmap(jax.jacrev(at, (0, 1))))
        for level in (-1e6, -1, -half[0], 0, half[0], 1, 1e6):
            depth = (np.sign(level) * abs(level) * reach).astype(kind)
            by_depth, by_up = slopes(depth, up)
            assert np.all(np.isfinite(by_depth))
            assert np.all(np.isfinite(by_up))
            if abs(level) > 1:
                assert not np.any(by_depth)
                assert not np.any(by_up)


def test_archimedes_and_the_lever_of_the_centre_of_volume():
    center, moment = (0.003, 0.0, 0.01), (0.0, 0.0, -0.01)
    weight, first = displaced_water(0.5, moment, 2e-4, center, WATER * G)
    lift = 0.5 * WATER * G * 2e-4
    assert weight == pytest.approx(lift)
    assert first == pytest.approx(lift * (np.array(center) + np.array(moment) / 0.5))


@pytest.mark.slow
def test_a_neutral_spider_stays_put_for_ten_seconds():
    tank = world(gravity=G, buoyancy="partial", drag="faces", added_mass=True)
    robot = build_robot(trim_neutral(body("spider"), tank.density), tank)
    start, still = at_rest(robot, 1, -1.0)
    _, qpos, _, _ = march(robot, 10.0, start, still, every=20, x64=False)
    # The legs float and the core sinks by what the servos give, a tenth of a millimetre.
    assert np.abs(qpos[:, :3] - start[:3]).max() < 5e-4
    assert np.abs(qpos[:, 4:7]).max() < 1e-4


def test_a_box_is_cut_where_it_is_wherever_its_volume_has_its_centre():
    """A half-dense cube whose volume has its centre off the box's: half wet at half its height.

    Upright it floats there; on its side it is turned by ½ ρ V g times the lever, and deep by all of
    it. With the mask the box's centre counts, too.
    """
    size, lever, half = 0.1, 0.02, 0.5**0.5
    mass = 0.5 * WATER * size**3
    qpos = np.zeros((7, 5))
    qpos[2] = 0.0, 0.0, -1.0, 0.01, -0.01
    qpos[3:7] = np.array([[1, 0, 0, 0], *2 * [[half, half, 0, 0]], *2 * [[1, 0, 0, 0]]]).T
    box = partial(box_robot, (size,) * 3, mass, center_of_volume=(0.0, 0.0, lever))
    found = accelerate(box(world(gravity=G, buoyancy="partial")), qpos, np.zeros((6, 5)))
    assert found[2] == pytest.approx([0, 0, G, -0.2 * G, 0.2 * G], abs=1e-12)
    torque = WATER * size**3 * G * lever * np.array([0, 0.5, 1, 0, 0])
    # The volume's centre lies to the side of the mass's, and the water lifts it up.
    assert -found[3] == pytest.approx(torque / (mass * size**2 / 6), abs=1e-9)
    found = accelerate(box(world(gravity=G, buoyancy="mask")), qpos, np.zeros((6, 5)))
    assert found[2, 3:] == pytest.approx([-G, G], abs=1e-12)
