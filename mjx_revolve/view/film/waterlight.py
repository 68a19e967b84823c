"""Shading of rendered frames as under water.

MuJoCo draws bodies and the bed in clear air, with the distance of every pixel. This adds the water:
it absorbs red first and scatters blue, light comes from above in shafts and caustics, and the
surface is seen from below or from above, with the world's waves and small ripples. Pure JAX, one
compiled function for a frame. Distances are relative to the camera's distance from the robot, so
that small and large robots are seen equally well: it is no physical model of visibility.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.spatial import Scalar, Vec, sincos
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
_BODY = np.array([0.03, 0.29, 0.37])  # of water that is looked into from above
_SKY, _ZENITH, _SUN = np.array(SKY_LOW), np.array(SKY_HIGH), np.array(SUN)
_WINDOW = np.array([0.74, 0.95, 1.0])  # the sky through the surface, from below
_SHINE = np.array([0.62, 0.95, 1.0])  # of shafts of light
_INDEX = 1.333  # of refraction
# Ripples: wavelength in camera distances, direction [rad], steepness [-], phase [rad].
_RIPPLES = (
    (0.83, 0.3, 0.050, 0.0), (0.57, 1.4, 0.050, 1.9), (0.41, -0.8, 0.050, 4.0),
    (0.29, 2.3, 0.045, 2.2), (0.21, 0.9, 0.045, 5.1), (0.155, -1.9, 0.040, 0.7),
    (0.12, 2.9, 0.030, 3.3),
)  # fmt: skip
# Beyond this many camera distances the surface is lost from sight.
_HORIZON = 25.0
# How strongly ripples gather light into lines, and how bright these are.
_FOCUS, _LINES = 0.2, 0.55
_SHAFTS, _SAMPLES, _COARSE = 0.5, 10, 4  # brightness, points along each ray, pixels per ray
# Their pattern: waves per camera distance [rad], direction [rad], speed [rad/s].
_BEAMS = ((2.1, 0.4, 0.23), (3.7, 1.9, -0.31), (5.3, -0.7, 0.41))

Shader = Callable[..., jax.Array]


class _View(NamedTuple):
    """A camera, the world and the water of a frame."""

    world: World
    origin: tuple[float, float]  # x and y in the world of the place from which all is counted [m]
    distance: float  # of the camera from the robot [m]
    water: Water
    position: jax.Array  # [3] of the camera [m]
    ray: jax.Array  # [height, width, 3] unit vectors

    def along(self, s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """x, y and z of the points at distances along the rays [m]."""
        x, y, z = (self.position[i] + s * self.ray[..., i] for i in range(3))
        return x, y, z

    def depth(self, z: jax.Array) -> jax.Array:
        """Below the still surface [m]."""
        return self.water.surface_height - z

    @property
    def own_light(self) -> jax.Array:
        """Daylight where the camera is."""
        return daylight(self.depth(self.position[2]))


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
    # A little darker towards the corners, as lenses are.
    corners = 1 - 0.05 * ((u / u.max())[None, :] ** 2 + (v**2)[:, None])[..., None]
    opening = math.tan(FOVY / 2)

    def shade(
        color: jax.Array, depth: jax.Array, position: jax.Array, axes: jax.Array, water: Water
    ) -> jax.Array:
        along = axes[2] + opening * (u[None, :, None] * axes[0] + v[:, None, None] * axes[1])
        length = jnp.linalg.norm(along, axis=-1)
        place = (float(origin[0]), float(origin[1]))
        view = _View(world, place, distance, water, position, along / length[..., None])
        screen = _soften(color.astype(jnp.float32) / 255, depth)
        light, clear = (_from_air if above else _in_water)(view, _to_light(screen), depth * length)
        # Where nothing is, the edges of things have left a trace in the plain background.
        trace = jnp.where(jnp.isinf(depth), clear, 0.0)[..., None]
        picture = _to_screen(light) + trace * (screen - np.asarray(BACKGROUND, np.float32))
        return jnp.round(255 * jnp.clip(picture * corners, 0.0, 1.0)).astype(jnp.uint8)

    shader: Shader = jax.jit(shade)
    return shader


def _soften(color: jax.Array, depth: jax.Array) -> jax.Array:
    """Mixes pixels with their neighbours across hard edges on one face: MuJoCo's shadows."""
    sides = [jnp.roll(color, step, axis) for axis in (0, 1) for step in (1, -1)]
    depths = [jnp.roll(depth, step, axis) for axis in (0, 1) for step in (1, -1)]
    # Faces have no steps: the middle lies between its neighbours.
    bent = jnp.maximum(
        jnp.abs(depths[0] + depths[1] - 2 * depth), jnp.abs(depths[2] + depths[3] - 2 * depth)
    )
    contrast = jnp.maximum(
        jnp.abs(sides[0][..., 1] - sides[1][..., 1]), jnp.abs(sides[2][..., 1] - sides[3][..., 1])
    )
    flat = bent < 2e-3 * depth  # not where nothing is, either
    share = jnp.where(flat, _step(contrast, 0.04, 0.15), 0.0)[..., None]
    mean = 0.5 * color + 0.125 * (sides[0] + sides[1] + sides[2] + sides[3])
    return color + share * (mean - color)


def _to_light(color: jax.Array | np.ndarray) -> jax.Array:
    """Screen colours to linear light; a square is close to sRGB's curve and quick."""
    return jnp.square(color)


def _to_screen(light: jax.Array) -> jax.Array:
    """Linear light to screen colours; too bright colours fade to white."""
    light = jnp.maximum(light, 0.0)
    over = jnp.maximum(light - 1.0, 0.0).mean(-1, keepdims=True)
    return jnp.sqrt(jnp.clip(light + 0.5 * over, 0.0, 1.0))


def open_water(up: jax.Array) -> jax.Array:
    """Light of water without end, `[..., 3]`, by the sine of the angle at which one looks up."""
    up = jnp.asarray(up)[..., None]
    rising = 1 - jnp.exp(-1.6 * jnp.maximum(up, 0.0))
    falling = 1 - jnp.exp(2.4 * jnp.minimum(up, 0.0))
    ahead, top, low = (_to_light(np.array(c)) for c in (WATER_AHEAD, WATER_UP, WATER_DOWN))
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
) -> tuple[Vec, Vec]:
    """Gradient of the ripples, and the second derivatives xx, xy, yy of their height."""
    total: list[Scalar] = [0.0] * 5
    for share, angle, steep, phase in _RIPPLES:
        k = 2 * math.pi / (share * distance)
        # They run as waves do, but no faster than the eye can follow around a small robot.
        omega = math.sqrt(max(gravity, 1.0) * k) / max(1.0, math.sqrt(1.5 / distance))
        c, s = math.cos(angle), math.sin(angle)
        sine, cosine = sincos(jnp.asarray(k * (c * x + s * y) - omega * time + phase))
        rise, bent = -steep * sine, -steep * k * distance * cosine
        own = (c * rise, s * rise, c * c * bent, c * s * bent, s * s * bent)
        total = [a + b for a, b in zip(total, own, strict=True)]
    return tuple(total[:2]), tuple(total[2:])


def bright_lines(
    distance: float, gravity: float, time: jax.Array, x: jax.Array, y: jax.Array
) -> jax.Array:
    """Brightness, about 1 on average, of sunlight that ripples have gathered into lines.

    Rays that a surface of height h bends land at x + f ∇h, so light is denser by 1 / |det(1 + f
    ∇∇h)|; f is chosen for looks. The determinant is taken where the ray lands, not where it
    entered at x, y [m]: the lines are bent a little otherwise than true ones.
    """
    _, (xx, xy, yy) = _ripples(distance, gravity, time, x, y)
    density = (1 + _FOCUS * xx) * (1 + _FOCUS * yy) - (_FOCUS * xy) ** 2
    return jnp.minimum(1.0 / (jnp.abs(density) + 0.22), 4.0) * 0.95


def _meet_surface(view: _View, most: float) -> tuple[jax.Array, Vec]:
    """Distance at which rays meet the surface, infinite beyond `most`, and its gradient there."""
    world, water = view.world, view.water
    still, up = view.depth(view.position[2]), view.ray[..., 2]
    towards = up * still > 0
    safe = jnp.where(towards, up, 1.0)
    s = jnp.clip(still / safe, 0.0, most)
    gradient: Vec = (0.0, 0.0)
    if any(wave.amplitude > 0 for wave in world.waves):
        for _ in range(3):
            x, y, _ = view.along(s)
            height, gradient = surface(world, water, x + view.origin[0], y + view.origin[1])
            s = jnp.clip((height - view.position[2]) / safe, 0.0, most)
    return jnp.where(towards & (s < most), s, jnp.inf), gradient


def _surface_normal(view: _View, near: jax.Array, gradient: Vec, rough: float) -> jax.Array:
    """Upward unit normal of the surface at distances along the rays, with waves and ripples.

    Both are left out where a pixel covers more than they are long, or they would glitter.
    """
    world, distance = view.world, view.distance
    # A pixel of a picture 480 high; finer pictures are a little calmer than they need be.
    covers = near * 1.5e-3 / jnp.maximum(jnp.abs(view.ray[..., 2]), 1e-3)
    lengths = [2 * math.pi / wave.wavenumber(world.gravity, world.water_depth)
               for wave in world.waves if wave.amplitude > 0]  # fmt: skip
    waves = 1 / (1 + (4 * covers / min(lengths, default=distance)) ** 2)
    ripples = rough / (1 + (12 * covers / distance) ** 2)
    x, y, _ = view.along(near)
    fine, _ = _ripples(distance, world.gravity, view.water.time, x, y)
    dx, dy = (waves * gradient[i] + ripples * fine[i] for i in (0, 1))
    size = jax.lax.rsqrt(1 + dx * dx + dy * dy)
    return jnp.stack([-dx * size, -dy * size, size], axis=-1)


def _facing_up(view: _View, far: jax.Array) -> jax.Array:
    """How far the faces that are seen look up, from the distances of neighbouring pixels."""
    place = jnp.minimum(far, 1e3)[..., None] * view.ray
    right = jnp.diff(place, axis=1, append=place[:, -1:])
    down = jnp.diff(place, axis=0, append=place[-1:])
    normal = jnp.cross(down, right)
    return normal[..., 2] * jax.lax.rsqrt((normal**2).sum(-1) + 1e-20)


def _step(value: jax.Array, low: float, high: float) -> jax.Array:
    """0 below low, 1 above high, smooth between."""
    value = jnp.clip((value - low) / (high - low), 0.0, 1.0)
    return value * value * (3 - 2 * value)


def _under_sun(
    view: _View, x: jax.Array, y: jax.Array, depth: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Where the sunlight on points at a depth has entered through the surface."""
    return x + depth * SUN[0] / SUN[2], y + depth * SUN[1] / SUN[2]


def _sunlit(view: _View, far: jax.Array) -> jax.Array:
    """Light on objects under water, relative to MuJoCo's own lighting."""
    x, y, z = view.along(jnp.minimum(far, 1e3))
    depth = view.depth(z)
    through = _under_sun(view, x, y, depth)
    lines = bright_lines(view.distance, view.world.gravity, view.water.time, *through)
    share = _LINES * _step(_facing_up(view, far), 0.0, 0.8)
    share = share * jnp.exp(-far / (5 * view.distance)) * _step(depth, 0.0, 0.15 * view.distance)
    return daylight(depth) * (1 + share * (lines - 1))[..., None]


def _in_water(view: _View, scene: jax.Array, far: jax.Array) -> tuple[jax.Array, float]:
    """Colours seen by a camera in the water, and the visibility of edges."""
    ahead = open_water(view.ray[..., 2]) * view.own_light
    s, gradient = _meet_surface(view, _HORIZON * view.distance)
    backdrop = jax.lax.cond(
        jnp.isfinite(s).any(), lambda: _ceiling(view, s, gradient, ahead), lambda: ahead
    )
    through = transmission(jnp.minimum(far, s), view.distance)
    things = scene * _sunlit(view, far) * through + ahead * (1 - through)
    picture = jnp.where((far < s)[..., None], things, backdrop)
    return picture + _shafts(view, jnp.minimum(far, s)) * view.own_light, 1.0


def _ceiling(view: _View, s: jax.Array, gradient: Vec, ahead: jax.Array) -> jax.Array:
    """The surface from below: a bright window where light gets in, elsewhere a mirror."""
    near = jnp.minimum(s, _HORIZON * view.distance)
    normal = _surface_normal(view, near, gradient, 1.6)
    cosine = jnp.clip((view.ray * normal).sum(-1), 0.0, 1.0)
    # Snell: above 1 the ray cannot leave the water. The window's rim is softer than true ones.
    outside = 1 - _INDEX**2 * (1 - cosine**2)
    window = _step(outside, -0.25, 0.6)[..., None]
    mirrored = view.ray[..., 2] - 2 * cosine * normal[..., 2]
    lining = open_water(0.8 * mirrored + 0.45) * view.own_light
    sky = 1.25 * _to_light(_WINDOW)
    seen = lining + (sky - lining) * window
    through = transmission(0.7 * near, view.distance)
    return jnp.where(jnp.isfinite(s)[..., None], seen * through + ahead * (1 - through), ahead)


def _shafts(view: _View, far: jax.Array) -> jax.Array:
    """Light that the water scatters out of the sun's beams, on a coarse grid of rays."""
    half, distance = _COARSE // 2, view.distance
    some = view._replace(ray=view.ray[half::_COARSE, half::_COARSE])
    reach = jnp.minimum(far[half::_COARSE, half::_COARSE], 6 * distance)
    total: Scalar = 0.0
    for j in range(_SAMPLES):
        s = reach * (j + 0.5) / _SAMPLES
        x, y, z = some.along(s)
        depth = view.depth(z)
        x, y = _under_sun(view, x, y, depth)
        # Wide and slow: what is left of the lines after a way through the water.
        beam: Scalar = 0.0
        for k, angle, rate in _BEAMS:
            turn = k / distance * (math.cos(angle) * x + math.sin(angle) * y)
            beam = beam + jnp.sin(turn + rate * view.water.time + 1.7 * k)
        beam = jnp.maximum(beam, 0.0) ** 2 / 2
        total = total + beam * jnp.exp(-s / (2.5 * distance) - depth / (9 * distance))
    total = total * reach / (6 * distance) / _SAMPLES
    fine = jax.image.resize(total, far.shape, "linear")
    return _SHAFTS * fine[..., None] * _to_light(_SHINE)


def _sky(up: jax.Array) -> jax.Array:
    """The sky, by the sine of the angle at which one looks up."""
    low, high = _to_light(_SKY), _to_light(_ZENITH)
    return low + (high - low) * (1 - jnp.exp(-3.0 * jnp.clip(up, 0.0, 1.0)))[..., None]


def _from_air(view: _View, scene: jax.Array, far: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Colours seen by a camera in the air, and the visibility of edges."""
    distance, most = view.distance, 400 * view.distance
    s, gradient = _meet_surface(view, most)
    near = jnp.minimum(s, most)
    normal = _surface_normal(view, near, gradient, 1.0)
    cosine = jnp.clip(-(view.ray * normal).sum(-1), 0.0, 1.0)
    mirrored = view.ray + 2 * cosine[..., None] * normal
    # Schlick's approximation of what a surface mirrors.
    share = (0.02 + 0.98 * (1 - cosine) ** 5)[..., None]
    glint = jnp.maximum((mirrored * _SUN).sum(-1), 0.0)
    mirror = _sky(mirrored[..., 2]) + (2.5 * glint**240 + 0.25 * glint**24)[..., None]
    # Through the surface: things, lit and dimmed by the water over and before them.
    path = jnp.maximum(far - near, 0.0)
    through = transmission(0.4 * distance + path, distance) ** 1.5
    below = scene * _sunlit(view, far) * through + _to_light(_BODY) * (1 - through)
    below = jnp.where(jnp.isfinite(far)[..., None], below, _to_light(_BODY))
    wet = below * (1 - share) + mirror * share
    haze = jnp.exp(-near / (60 * distance))[..., None]
    wet = wet * haze + _to_light(_SKY) * (1 - haze)
    hit = jnp.isfinite(s)
    backdrop = jnp.where(hit[..., None], wet, _sky(view.ray[..., 2]))
    return jnp.where((far < s)[..., None], scene, backdrop), jnp.where(hit, 0.3, 1.0)
