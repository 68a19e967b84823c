"""The water's own motion against its closed forms: waves, shear, velocities on a grid, gusts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from mjx_revolve.water.currents import CurrentField, Gust, Shear, Wave
from mjx_revolve.water.flow import (
    Water,
    flow,
    gust_path,
    is_uniform,
    needs_horizontal_position,
    surface,
    water_of,
    wave_convection,
)
from mjx_revolve.water.world import make_world

G = 9.81
SEA = [
    {"amplitude": 0.06, "wavelength": 2.5, "direction": 0.4, "phase": 0.3},
    {"amplitude": 0.03, "period": 0.9, "direction": -2.1, "phase": -1.0},
    {"amplitude": 0.2, "wavelength": 30.0, "direction": np.pi / 2},
]
DEPTHS = [None, 25.0, 1.5]


def places(n=200, seed=0, deepest=-1.5):
    """`[3, n]` within a few metres of the origin, under the still surface."""
    draw = np.random.default_rng(seed)
    return np.stack([*draw.uniform(-4, 4, (2, n)), draw.uniform(deepest, 0, n)])


def moving(world, place, time=0.0, **water):
    """`[3, n]` velocity and acceleration in float64."""
    with jax.enable_x64(True):
        at = water_of(world)._replace(time=time, **water)
        x, y, z = (jnp.asarray(p) for p in place)
        wide = lambda v: np.stack([np.broadcast_to(c, z.shape) for c in v])  # noqa: E731
        return tuple(wide(v) for v in flow(world, at, x, y, z))


def top(world, place, time=0.0):
    """`[n]` height and `[2, n]` slope in float64."""
    with jax.enable_x64(True):
        x, y, _ = (jnp.asarray(p) for p in place)
        height, slope = surface(world, water_of(world)._replace(time=time), x, y)
        return np.asarray(height), np.stack([np.broadcast_to(s, x.shape) for s in slope])


def differences(function, place, d=1e-5):
    """Central differences by x, y and z: `[3 directions, ...]`; in error by d² ≈ 1e-10."""
    steps = d * np.eye(3)[:, :, None]
    return np.stack([(function(place + s) - function(place - s)) / (2 * d) for s in steps])


def test_still_water_costs_nothing():
    """Plain numbers in, plain numbers out: nothing reaches the compiled step."""
    world = make_world(waves={"amplitude": 0, "wavelength": 3})
    for still in (make_world(), world):
        water = water_of(still)
        jaxpr = jax.make_jaxpr(lambda x, w=still, at=water: flow(w, at, x, x, x))(jnp.ones(3))
        assert not jaxpr.eqns
        assert surface(still, water, 1.0, 2.0) == (0.0, None)
    assert flow(make_world(current=(1, 0, 2)), Water(0.0, (1.0, 0.0, 2.0)), 0, 0, 0) == (
        (1.0, 0.0, 2.0),
        (0.0, 0.0, 0.0),
    )


def test_what_a_step_asks_of_a_world():
    still, drifting = make_world(), make_world(current=(0, 0.1, 0))
    assert (is_uniform(still), needs_horizontal_position(still)) == (True, False)
    assert not needs_horizontal_position(drifting)
    field = CurrentField([0.0], [0.0], [0.0], np.zeros((1, 1, 1, 3)))
    for fields in ({"waves": SEA}, {"shear": {"velocity": [1, 0, 0]}}, {"current_field": field}):
        world = make_world(**fields)
        assert (is_uniform(world), needs_horizontal_position(world)) == (False, True)


def test_all_motion_adds_up():
    shear, field = Shear((0.3, 0.1, 0.0)), grid(EVEN)
    parts = {"shear": shear, "current_field": field, "waves": SEA}
    place = places()
    zero = moving(make_world(), place)[0]
    alone = [moving(make_world(**{k: v}), place, 2.0) for k, v in parts.items()]
    current, acceleration = np.array([[0.1], [0.2], [0.0]]), np.array([[0.0], [3.0], [1.0]])
    water = {"current": tuple(current[:, 0]), "acceleration": tuple(acceleration[:, 0])}
    velocity, push = moving(make_world(**parts), place, 2.0, **water)
    assert zero.any() == 0
    assert np.allclose(velocity, current + sum(v for v, _ in alone), rtol=0, atol=1e-14)
    assert np.allclose(push, acceleration + alone[2][1], rtol=0, atol=1e-13)

    def all_of(sea):
        world = make_world(waves=sea, water_depth=1.5)
        return *moving(world, place, 2.0), *top(world, place, 2.0)

    for found, *waves in zip(all_of(SEA), *map(all_of, SEA), strict=True):
        assert np.allclose(found, sum(waves), rtol=0, atol=1e-13)


@pytest.mark.parametrize("relative", [1e-3, 0.5, 3.0, 30.0])
def test_dispersion(relative):
    """ω² = g k tanh(k h), from length to frequency and from period back to length."""
    h = 2.0
    wave = Wave(0.0, wavelength=2 * np.pi * h / relative)
    k, omega = wave.wavenumber(G, h), wave.frequency(G, h)
    assert k == pytest.approx(relative / h, rel=1e-15)
    assert omega**2 == pytest.approx(G * k * np.tanh(k * h), rel=1e-14)
    again = Wave(0.0, period=2 * np.pi / omega)
    assert again.wavenumber(G, h) == pytest.approx(k, rel=1e-13)
    assert again.frequency(G, h) == pytest.approx(omega, rel=1e-15)
    if relative < 0.01:  # long waves all run at √(g h)
        assert omega / k == pytest.approx(np.sqrt(G * h), rel=relative**2)
    if relative > 20:
        assert omega == pytest.approx(Wave(0.0, 2 * np.pi / k).frequency(G, None), rel=1e-13)


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("wave", SEA)
def test_a_wave_runs_at_its_phase_speed(wave, depth):
    """Where it is said to run to, and its surface is a cosine of its height."""
    world = make_world(waves=wave, water_depth=depth, surface_height=1.0)
    k, omega = (getattr(Wave(**wave), f)(G, depth) for f in ("wavenumber", "frequency"))
    towards = np.array([np.cos(wave.get("direction", 0)), np.sin(wave.get("direction", 0)), 0])
    place, time = places(), 1.7
    along = towards @ place
    expected = wave["amplitude"] * np.cos(k * along + wave.get("phase", 0))
    assert np.allclose(top(world, place)[0], 1 + expected, rtol=0, atol=1e-13)
    carried = place + (omega / k * time * towards)[:, None]
    for first, later in zip(top(world, place), top(world, carried, time), strict=True):
        assert np.allclose(first, later, rtol=0, atol=1e-13)


@pytest.mark.parametrize("depth", DEPTHS)
def test_slope_of_the_surface(depth):
    world, place = make_world(waves=SEA, water_depth=depth), places()
    found = differences(lambda p: top(world, p, 0.6)[0], place)
    assert np.allclose(top(world, place, 0.6)[1], found[:2], rtol=0, atol=1e-8)


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("wave", SEA)
def test_orbital_velocity_is_the_gradient_of_the_textbooks_potential(wave, depth):
    """Φ = a g/ω cosh k(h + z)/cosh(k h) sin θ: the same law by another formula."""
    world, place, time = make_world(waves=wave, water_depth=depth), places(), 0.6
    k, omega = (getattr(Wave(**wave), f)(G, depth) for f in ("wavenumber", "frequency"))
    angle, phase = wave.get("direction", 0), wave.get("phase", 0)

    def potential(p, t=time):
        theta = k * (np.cos(angle) * p[0] + np.sin(angle) * p[1]) - omega * t + phase
        h = 100.0 if depth is None else depth
        fade = np.cosh(k * (h + p[2])) / np.cosh(k * h) if k * h < 300 else np.exp(k * p[2])
        return wave["amplitude"] * G / omega * fade * np.sin(theta)

    velocity, acceleration = moving(world, place, time)
    assert np.allclose(velocity, differences(potential, place), rtol=0, atol=1e-8)
    d = 1e-5
    change = (moving(world, place, time + d)[0] - moving(world, place, time - d)[0]) / (2 * d)
    assert np.allclose(acceleration, change, rtol=0, atol=1e-8)


def test_above_the_surface_and_below_the_bed():
    world, place = make_world(waves=SEA, water_depth=1.5), places()
    for outside, edge in ((0.7, 0.0), (-4.0, -1.5)):
        far, near = place.copy(), place.copy()
        far[2], near[2] = outside, edge
        for a, b in zip(moving(world, far, 0.6), moving(world, near, 0.6), strict=True):
            assert np.array_equal(a, b)


def test_waves_are_carried_by_the_worlds_current():
    """Galileo: who drifts with the current sees waves in still water."""
    place, time, drift = places(), 3.1, np.array([[0.3], [-0.2], [0.0]])
    still = make_world(waves=SEA, water_depth=3.0)
    world = make_world(waves=SEA, water_depth=3.0, current=drift[:, 0])
    carried = place + time * drift
    for a, b in zip(top(world, carried, time), top(still, place, time), strict=True):
        assert np.allclose(a, b, rtol=0, atol=1e-13)
    velocity, acceleration = moving(world, carried, time)
    assert np.allclose(velocity - drift, moving(still, place, time)[0], rtol=0, atol=1e-13)
    assert np.allclose(acceleration, moving(still, place, time)[1], rtol=0, atol=1e-12)


def test_water_accelerates_along_its_own_path():
    """∂u/∂t + u·∇u of the waves, with what a gust adds, and in a current that rises."""
    world = make_world(waves=SEA, water_depth=3.0, current=(0.3, -0.2, 0.1))
    own = 0.35, -0.1, 0.08
    place, time, d = places(deepest=-1.0) - [[0], [0], [0.01]], 3.1, 1e-5
    before, after = (moving(world, place, t, current=own)[0] for t in (time - d, time + d))
    velocity, push = moving(world, place, time, current=own)
    gradient = differences(lambda p: moving(world, p, time, current=own)[0], place)
    whole = (after - before) / (2 * d) + np.einsum("ijn,in->jn", gradient, velocity)
    with jax.enable_x64(True):
        water = water_of(world)._replace(time=time, current=own)
        convected = np.stack(wave_convection(world, water, *map(jnp.asarray, place)))
    assert np.allclose(push + convected, whole, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("shear", "depth", "share"), [
    (Shear((1, 2, 0), 4.0), [-1, 0, 1, 2, 3.9, 4, 9], [1, 1, 0.75, 0.5, 0.025, 0, 0]),
    (Shear((1, 2, 0), 4.0, "power", 0.5), [-1, 0, 3, 3.75, 4, 9], [1, 1, 0.5, 0.25, 0, 0]),
    (Shear((1, 2, 0), 4.0, "power"), [0, 2, 4], [1, 0.5 ** (1 / 7), 0]),
    (Shear((1, 2, 0), 4.0, "exponential"), [-1, 0, 4, 8, 400], [1, 1, *np.exp([-1, -2, -100])]),
])  # fmt: skip
def test_shear_profiles(shear, depth, share):
    """On top of the uniform current, below a surface that need not be at 0."""
    world = make_world(shear=shear, current=(0.5, 0, 0.1), surface_height=2.0)
    z = 2.0 - np.asarray(depth, float)
    velocity, acceleration = moving(world, (0 * z, 0 * z, z))
    expected = np.array([[0.5], [0.0], [0.1]]) + np.array([[1.0], [2.0], [0.0]]) * share
    assert np.allclose(velocity, expected, rtol=0, atol=1e-14)
    assert not acceleration.any()
    # Each lane has its own surface.
    z = 0 * z - 7
    lanes = {"surface_height": jnp.asarray(z + np.asarray(depth), float)}
    assert np.allclose(moving(world, (0 * z, 0 * z, z), **lanes)[0], expected, rtol=0, atol=1e-6)


EVEN = (np.linspace(-5, 5, 11), np.linspace(-3, 6, 4), np.linspace(-8, 0, 5))
UNEVEN = (np.array([-5, -4.9, -1, 0, 0.5, 3, 5]), np.array([-3.0, 6.0]), np.array([-8, -2, 0.0]))


def grid(axes, seed=0):
    """Random velocities on it."""
    shape = (*map(len, axes), 3)
    return CurrentField(*axes, np.random.default_rng(seed).normal(size=shape))


@pytest.mark.parametrize("axes", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_interpolation_and_edges_against_scipy(axes):
    """Anywhere, at the grid's own points, and beyond its edges, where the edge's value holds."""
    field = grid(axes)
    low, high = (np.array([a[i] for a in axes]) for i in (0, -1))
    draw = np.random.default_rng(2)
    knots = np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")])
    place = np.concatenate([draw.uniform(low - 3, high + 3, (2000, 3)).T, knots], 1)
    inside = np.clip(place.T, low, high)
    expected = RegularGridInterpolator(axes, field.velocity)(inside).T
    found = moving(make_world(current_field=field), place)[0]
    assert np.allclose(found, expected, rtol=0, atol=1e-12)
    assert np.allclose(found[:, 2000:], field.velocity.reshape(-1, 3).T, rtol=0, atol=1e-12)


def test_a_component_that_is_nowhere_costs_nothing():
    field = CurrentField(*EVEN, grid(EVEN).velocity * [1.0, 1.0, 0.0])
    world = make_world(current_field=field)
    velocity, _ = flow(world, water_of(world), *jnp.asarray(places()))
    assert isinstance(velocity[2], float)


WORLDS = {
    "waves": {"waves": SEA}, "shallow waves": {"waves": SEA, "water_depth": 1.5},
    "linear": {"shear": Shear((1, 2, 0), 2.0)}, "power": {"shear": Shear((1, 2, 0), 2.0, "power")},
    "exponential": {"shear": Shear((1, 2, 0), 2.0, "exponential")},
    "even": {"current_field": grid(EVEN)}, "uneven": {"current_field": grid(UNEVEN)},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("x64", [False, True])
@pytest.mark.parametrize("name", WORLDS)
def test_values_and_gradients_are_finite_and_of_the_inputs_type(name, x64):
    """At the surface, at the bed, at the end of a shear, on the grid's planes, far away."""
    world, kind = make_world(**WORLDS[name]), np.float64 if x64 else np.float32
    edges = [0.0, -1.5, -2.0, -8.0, 5.0, -5.0, -4.9, 1e4, -1e4, 1e-30, np.nextafter(-2, 0)]
    place = np.stack([m.ravel() for m in np.meshgrid(edges, edges, edges)])
    with jax.enable_x64(True):  # float32 inputs must stay float32 even where float64 is allowed

        def everything(x, y, z, height, time):
            water = Water(height, (0.0,) * 3, (0.0,) * 3, time)
            height, slope = surface(world, water, x, y)
            velocity, acceleration = flow(world, water, x, y, z)
            found = jax.tree.leaves((height, slope, velocity, acceleration))
            return [v for v in found if hasattr(v, "dtype")]  # others are plain zeros

        inputs = [np.asarray(p, kind) for p in place]
        inputs += [np.zeros_like(inputs[0]), np.full_like(inputs[0], 3.0)]
        compiled = jax.jit(everything)
        values = compiled(*inputs)
        assert {v.dtype for v in values} == {np.dtype(kind)}
        assert all(np.all(np.isfinite(v)) for v in values)
        total = lambda *inputs: sum(map(jnp.sum, everything(*inputs)))  # noqa: E731
        slopes = jax.jit(jax.grad(total, argnums=range(5)))(*inputs)
        assert all(np.all(np.isfinite(s)) and s.dtype == kind for s in slopes)
        # A robot that has diverged must not take its neighbours with it.
        inputs[0][0] = np.nan
        for lost in compiled(*inputs):
            if lost.shape:
                assert np.all(np.isfinite(lost[1:]))


@pytest.mark.parametrize("name", WORLDS)
def test_single_precision(name):
    """Within 1e-3 of the largest velocity, acceleration and height after a quarter of an hour.

    Then the phase is some thousand radians, which float32 knows to 2e-4; in the beginning 1e-6.
    """
    world, place = make_world(**WORLDS[name]), places()
    for time, tolerance in ((0.0, 2e-6), (900.0, 1e-3)):
        exact = (*moving(world, place.astype(np.float32).astype(float), time),)
        water = water_of(world)._replace(time=np.float32(time))
        found = flow(world, water, *(jnp.asarray(p, jnp.float32) for p in place))
        for a, b in zip(exact, found, strict=True):
            wide = np.stack([np.broadcast_to(c, a.shape[1:]) for c in b])
            assert np.abs(wide - a).max() <= tolerance * max(np.abs(a).max(), 1e-30)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_gradients_against_differences(name):
    world, place = make_world(**WORLDS[name]), places(50)
    with jax.enable_x64(True):
        x, y, z = jnp.asarray(place)

        def velocity(x, y, z):
            return jnp.stack([c + 0 * z for c in flow(world, water_of(world), x, y, z)[0]])

        found = jnp.stack(jax.vmap(jax.jacfwd(velocity, argnums=(0, 1, 2)))(x, y, z))
    expected = differences(lambda p: moving(world, p)[0], place)
    assert np.allclose(np.moveaxis(found, 1, 2), expected, rtol=0, atol=1e-7)


STD = np.array([0.3, 0.1, 0.02])


@pytest.mark.slow
@pytest.mark.parametrize("relative", [0.01, 0.1, 5.0])
def test_gusts_have_the_mean_variance_and_memory_that_were_asked_for(relative):
    """At any time step, within 4.5 standard errors of each estimate: 1 in 150,000 by chance."""
    gust, trials = Gust(tuple(STD), time=4.0), 3000
    steps = max(4, round(min(1.5 / relative, 1500)))
    path = gust_path(gust, jax.random.key(round(1e3 * relative)), steps, 4.0 * relative, trials)
    assert path.shape == (steps + 1, 3, trials)
    u = np.asarray(path, float) / STD[:, None]
    n = 3 * trials
    for row in (0, 1, steps // 2, steps):
        assert abs(u[row].mean()) < 4.5 / np.sqrt(n)
        assert abs(u[row].var() - 1) < 4.5 * np.sqrt(2 / n)
        for component in u[row]:
            assert abs(component.var() - 1) < 4.5 * np.sqrt(2 / trials)
        # Axes and trials are independent.
        assert np.abs(np.corrcoef(u[row]) - np.eye(3)).max() < 4.5 / np.sqrt(trials)
        assert abs(np.mean(u[row][:, 1:] * u[row][:, :-1])) < 4.5 / np.sqrt(n)
    for first, lag in ((0, 1), (0, steps // 2), (steps // 2, steps // 2), (0, steps)):
        expected = np.exp(-lag * relative)
        found = np.mean(u[first] * u[first + lag])
        assert abs(found - expected) < 4.5 * np.sqrt((1 + expected**2) / n)
    # What each step adds is fresh and of just the right size, over all steps: far closer.
    kept, fresh = np.exp(-relative), np.sqrt(-np.expm1(-2 * relative))
    added = (u[1:] - kept * u[:-1]) / fresh
    assert abs(added.mean()) < 4.5 / np.sqrt(added.size)
    assert abs(added.var() - 1) < 4.5 * np.sqrt(2 / added.size)
    assert abs(np.mean(added[1:] * added[:-1])) < 4.5 / np.sqrt(added.size)
    assert abs(np.mean(added * u[:-1])) < 4.5 / np.sqrt(added.size)
