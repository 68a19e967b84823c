"""Shading of rendered frames as under water: haze, daylight that fades, and the surface.

MuJoCo draws bodies and the bed in clear air, with the distance of every pixel. This adds the water:
it absorbs red first and scatters blue, and the surface is seen from below or from above, with the
world's waves and small ripples. Pure JAX, one compiled function for a frame. Distances are relative
to the camera's distance from the robot, so that small and large robots are seen equally well: it is
no physical model of visibility.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.view.film.camera import FOVY
from mjx_revolve.view.film.stage import BACKGROUND
from mjx_revolve.view.palette import SKY_HIGH, SKY_LOW, SUN, WATER_AHEAD, WATER_DOWN, WATER_UP
from mjx_revolve.water.flow import Water, surface
from mjx_revolve.water.world import World

# Share of light absorbed along the camera's distance from the robot, red, green and blue [-].
_LOSS = np.array([0.40, 0.19, 0.15])
# What daylight loses with depth [1/m], as in clear lakes, and the least that is left: pictures from
# the bottom would be black.
_FADING = np.array([0.14, 0.040, 0.028])
_LEAST_LIGHT = np.array([0.30, 0.52, 0.60])
# Linear light is the square of a screen's colour, which is close to sRGB's curve.
_SKY, _ZENITH = np.square(SKY_LOW), np.square(SKY_HIGH)
_BODY = np.square([0.03, 0.29, 0.37])  # of water that is looked into from above
_WINDOW = 1.25 * np.square([0.74, 0.95, 1.0])  # the sky through the surface, from below
_INDEX = 1.333  # of refraction
# Ripples: wavelength in camera distances, direction [rad], steepness [-], phase [rad].
_RIPPLES = (
    (0.83, 0.3, 0.050, 0.0), (0.57, 1.4, 0.050, 1.9), (0.41, -0.8, 0.050, 4.0),
    (0.29, 2.3, 0.045, 2.2), (0.21, 0.9, 0.045, 5.1), (0.155, -1.9, 0.040, 0.7),
)  # fmt: skip
# Beyond this many camera distances the surface is lost from sight, in the water and in the air.
_HORIZON, _SHORE = 25.0, 400.0

Shader = Callable[..., jax.Array]


def make_shader(
    world: World,
    size: tuple[int, int],
    distance: float,
    above: bool,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> Shader:
    """Compiles the shader of a world's water.

    Args:
        world: surface, waves, gravity.
        size: width and height of the pictures [pixels].
        distance: of the camera from the robot [m].
        above: whether the camera stands in the air.
        origin: place in the world from which positions and the surface's height are counted [m].

    Returns:
        A function of colours `[height, width, 3]` uint8, depths along the view `[height, width]`
        (infinite where nothing is) [m], the camera's position `[3]` [m], its axes `[3, 3]` (rows
        right, up, along the view) and the water (surface, current, time); it returns colours
        `[height, width, 3]` uint8.
    """
    width, height = size
    u = (np.arange(width, dtype=np.float32) + 0.5) * 2 / height - width / height
    v = 1 - (np.arange(height, dtype=np.float32) + 0.5) * 2 / height
    opening, most = math.tan(FOVY / 2), (_SHORE if above else _HORIZON) * distance
    waves = [2 * math.pi / wave.wavenumber(world.gravity, world.water_depth)
             for wave in world.waves if wave.amplitude > 0]  # fmt: skip

    def shade(
        color: jax.Array, depth: jax.Array, position: jax.Array, axes: jax.Array, water: Water
    ) -> jax.Array:
        along = axes[2] + opening * (u[None, :, None] * axes[0] + v[:, None, None] * axes[1])
        length = jnp.linalg.norm(along, axis=-1)
        ray, far = along / length[..., None], depth * length
        still = water.surface_height - position[2]

        # Where rays meet the surface, infinite beyond `most`, and its gradient there.
        towards = ray[..., 2] * still > 0
        safe = jnp.where(towards, ray[..., 2], 1.0)
        s, dx, dy = jnp.clip(still / safe, 0.0, most), jnp.float32(0.0), jnp.float32(0.0)
        for _ in range(3 if waves else 0):
            x, y = (position[i] + s * ray[..., i] + origin[i] for i in (0, 1))
            rise, (dx, dy) = surface(world, water, x, y)
            s = jnp.clip((rise - position[2]) / safe, 0.0, most)
        met = towards & (s < most)
        x, y = (position[i] + s * ray[..., i] for i in (0, 1))
        # Waves and ripples are left out where a pixel (of a picture 480 high) covers more than they
        # are long, or they would glitter.
        covers = s * 1.5e-3 / jnp.maximum(jnp.abs(ray[..., 2]), 1e-3)
        calm = 1 / (1 + (4 * covers / min(waves, default=distance)) ** 2)
        rough = (1.0 if above else 1.6) / (1 + (12 * covers / distance) ** 2)
        fine = _ripples(distance, world.gravity, water.time, x, y)
        dx, dy = calm * dx + rough * fine[0], calm * dy + rough * fine[1]
        normal = jnp.stack([-dx, -dy, jnp.ones_like(dx)], axis=-1)
        normal /= jnp.linalg.norm(normal, axis=-1, keepdims=True)
        cosine = jnp.clip((ray * normal).sum(-1) * (-1 if above else 1), 0.0, 1.0)
        mirrored = ray - 2 * (ray * normal).sum(-1, keepdims=True) * normal

        screen = color.astype(jnp.float32) / 255
        lit = jnp.square(screen) * daylight(still - jnp.minimum(far, 1e3) * ray[..., 2])
        if above:
            # Schlick's approximation of what a surface mirrors. Below it is the water's own colour,
            # and things dimmed by the water over and before them.
            share = (0.02 + 0.98 * (1 - cosine) ** 5)[..., None]
            glint = jnp.maximum((mirrored * np.array(SUN)).sum(-1), 0.0)
            mirror = _sky(mirrored[..., 2]) + (2.5 * glint**240 + 0.25 * glint**24)[..., None]
            path = jnp.where(jnp.isinf(far), jnp.inf, jnp.maximum(far - s, 0.0))
            through = transmission(0.4 * distance + path, distance) ** 1.5
            wet = (lit * through + _BODY * (1 - through)) * (1 - share) + mirror * share
            haze = jnp.exp(-s / (60 * distance))[..., None]
            backdrop = jnp.where(met[..., None], wet * haze + _SKY * (1 - haze), _sky(ray[..., 2]))
            things = jnp.square(screen)
        else:
            # Snell: the surface is a bright window where light gets in, elsewhere a mirror.
            own_light = daylight(still)
            ahead = open_water(ray[..., 2]) * own_light
            outside = 1 - _INDEX**2 * (1 - cosine**2)
            window = jnp.clip((outside + 0.25) / 0.85, 0.0, 1.0)[..., None]
            lining = open_water(0.8 * mirrored[..., 2] + 0.45) * own_light
            dim = transmission(0.7 * s, distance)
            ceiling = (lining + (_WINDOW - lining) * window) * dim + ahead * (1 - dim)
            backdrop = jnp.where(met[..., None], ceiling, ahead)
            through = transmission(far, distance)
            things = lit * through + ahead * (1 - through)
        light = jnp.where((far < jnp.where(met, s, jnp.inf))[..., None], things, backdrop)
        # Where nothing is, the edges of things have left a trace in the plain background.
        trace = jnp.where(jnp.isinf(depth), jnp.where(met & above, 0.3, 1.0), 0.0)[..., None]
        picture = jnp.sqrt(jnp.clip(light, 0.0, 1.0)) + trace * (screen - np.array(BACKGROUND))
        return jnp.round(255 * jnp.clip(picture, 0.0, 1.0)).astype(jnp.uint8)

    return jax.jit(shade)


def open_water(up: jax.Array) -> jax.Array:
    """Light of water without end, `[..., 3]`, by the sine of the angle at which one looks up."""
    up = jnp.asarray(up)[..., None]
    rising = 1 - jnp.exp(-1.6 * jnp.maximum(up, 0.0))
    falling = 1 - jnp.exp(2.4 * jnp.minimum(up, 0.0))
    ahead, top, low = map(np.square, (WATER_AHEAD, WATER_UP, WATER_DOWN))
    return ahead + (top - ahead) * rising + (low - ahead) * falling


def daylight(depth: jax.Array) -> jax.Array:
    """Share of the light that reaches a depth below the surface [m], `[..., 3]`; 1 above it."""
    left = jnp.exp(-_FADING * jnp.maximum(jnp.asarray(depth), 0.0)[..., None])
    return _LEAST_LIGHT + (1 - _LEAST_LIGHT) * left


def transmission(path: jax.Array, distance: float) -> jax.Array:
    """Share of light, `[..., 3]`, that passes through water of a length [m].

    Less of it is lost close to the camera than Beer and Lambert would have it, so that the robot
    keeps its colours while what lies behind it sinks into the haze. `distance` is that of the
    camera from the robot [m].
    """
    path = jnp.asarray(path) / distance
    beyond = jnp.maximum(path - 0.75, 0.0)
    return jnp.exp(-_LOSS * (0.27 * path + beyond)[..., None])


def _ripples(
    distance: float, gravity: float, time: jax.Array, x: jax.Array, y: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Gradient of the ripples along x and y."""
    total = [jnp.zeros_like(x), jnp.zeros_like(y)]
    for share, angle, steep, phase in _RIPPLES:
        k = 2 * math.pi / (share * distance)
        # They run as waves do, but no faster than the eye can follow around a small robot.
        omega = math.sqrt(max(gravity, 1.0) * k) / max(1.0, math.sqrt(1.5 / distance))
        ahead = math.cos(angle), math.sin(angle)
        rise = -steep * jnp.sin(k * (ahead[0] * x + ahead[1] * y) - omega * time + phase)
        total = [a + b * rise for a, b in zip(total, ahead, strict=True)]
    return total[0], total[1]


def _sky(up: jax.Array) -> jax.Array:
    """The sky, by the sine of the angle at which one looks up."""
    return _SKY + (_ZENITH - _SKY) * (1 - jnp.exp(-3.0 * jnp.clip(up, 0.0, 1.0)))[..., None]
