"""The robot as it is drawn: modules' meshes, the bed, light and haze, in a MuJoCo model of its own.

The model has the bodies and joints of `robot.mj_model`, so the same qpos poses it, but meshes in
place of the boxes that the physics weighs. It is for looking at (`draw`); its geoms touch nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from mjx_revolve.engine.robot import Robot
from mjx_revolve.view.course import bed_rings
from mjx_revolve.view.film.camera import FOVY
from mjx_revolve.view.pieces import make_pieces, mount_piece
from mjx_revolve.water.world import World

# What is hidden of the model by default in MuJoCo's viewer is drawn in none of these groups.
MODULES, SURFACE, _WEIGHTS = 0, 1, 4
# Towards the light, world frame: high, from one side.
SUN = np.array([-0.42, -0.28, 0.86]) / np.linalg.norm([-0.42, -0.28, 0.86])
# What is drawn offscreen where nothing is: a colour of water, for the edges of things mix with it.
BACKGROUND = (36 / 255, 110 / 255, 146 / 255)
# The haze's colour where one looks straight ahead, for MuJoCo's viewer.
_WATER = (0.09, 0.40, 0.55)

# Edges of a part are sharp where its faces turn by more than this.
_CREASE = math.radians(35.0)
# The bed is drawn on rings around the middle of the way; its texture repeats after a tile.
_RINGS = 64
_TILE, _TEXELS = 1.6, 1024  # m, and texels along it


def build_stage(
    robot: Robot,
    size: tuple[int, int] = (640, 480),
    origin: ArrayLike = (0.0, 0.0, 0.0),
    way: float = 1.0,
    sight: float = 10.0,
    plain: bool = False,
) -> mujoco.MjModel:
    """Builds what is drawn of a robot and the world around it.

    Args:
        robot: from `build_robot`; it stays as it is.
        size: the largest picture that will be drawn offscreen [pixels].
        origin: the place in the world that is the model's origin [m]; the bed is drawn around it.
            Far from its origin OpenGL has too few digits for small robots.
        way: how far from there the robot gets [m].
        sight: how far one sees through the water [m].
        plain: whether the background has one colour, for a film that paints the water itself.

    Returns:
        The model; `qpos` means the same as in `robot.mj_model`, but for the origin.
    """
    spec = _dressed(robot)
    spec.modelname = f"{robot.morphology.name} to look at"
    _add_surroundings(spec, robot.world, size, np.asarray(origin, float), way, sight, plain)
    return spec.compile()


def build_shared_stage(
    robots: Mapping[int, Robot],
    world: World,
    way: float,
    sight: float,
    size: tuple[int, int] = (640, 480),
    plain: bool = False,
) -> mujoco.MjModel:
    """Builds what is drawn of many robots and the world around them.

    Args:
        robots: from `build_robot`, by number; they stay as they are.
        world: around them.
        way: how far from the world's origin they get [m].
        sight: see `build_stage`.
        size: see `build_stage`.
        plain: see `build_stage`.

    Returns:
        The model; robot k's free joint is called `k/root`, and its qpos begins there.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "robots to look at"
    spec.compiler.degree = False
    # As robots' own, or attaching them complains.
    spec.option.timestep, spec.option.gravity = world.timestep, [0.0, 0.0, -world.gravity]
    spec.nuser_jnt = 1
    for number, robot in robots.items():
        frame = spec.worldbody.add_frame()
        spec.attach(_dressed(robot), prefix=f"{number}/", frame=frame)
    _add_surroundings(spec, world, size, np.zeros(3), way, sight, plain)
    return spec.compile()


def _dressed(robot: Robot) -> mujoco.MjSpec:
    """A robot in meshes, without any world."""
    spec = robot.mj_spec.copy()
    for geom in list(spec.geoms):
        if geom.name == "bed":
            spec.delete(geom)
        else:  # they carry the masses, without which MuJoCo has no body
            geom.group = _WEIGHTS
    for field in list(spec.hfields):
        spec.delete(field)
    _add_pieces(spec, robot)
    return spec


def _add_surroundings(
    spec: mujoco.MjSpec,
    world: World,
    size: tuple[int, int],
    place: np.ndarray,
    way: float,
    sight: float,
    plain: bool,
) -> None:
    """Bed, surface and light; nothing touches anything."""
    _add_bed(spec, world, place, way, sight)
    # The still surface is for MuJoCo's viewer; films draw their own, which moves.
    spec.add_material(name="surface", specular=0.9, shininess=0.9, rgba=[0.55, 0.85, 0.95, 0.22])
    spec.worldbody.add_geom(
        name="surface",
        type=mujoco.mjtGeom.mjGEOM_BOX,  # a plane is invisible from below
        size=[way + 4.0 * sight, way + 4.0 * sight, 5e-4],
        pos=[0.0, 0.0, world.surface_height - place[2]],
        material="surface",
        group=SURFACE,
    )
    _add_light(spec, size, way, sight, plain)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0


def _add_pieces(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Meshes of all parts, each fixed to the body that carries its part's box."""
    spec.add_material(name="module", specular=0.35, shininess=0.35, rgba=[1, 1, 1, 1])
    bodies = {body.name: body for body in spec.bodies}
    names: dict[int, str] = {}  # modules of a kind share their parts' triangles
    parts = (piece for piece in make_pieces(robot.morphology) if not piece.mark)
    for number, piece in enumerate(parts):
        if id(piece.corners) not in names:
            names[id(piece.corners)] = name = f"piece {number}"
            mesh = smooth_mesh(piece.corners)
            _add_mesh(spec, name, mesh.vertices, mesh.faces, usernormal=mesh.vertex_normals.ravel())
        body, position, rotation = mount_piece(robot, piece)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
        bodies[robot.mj_model.body(body).name].add_geom(
            name=f"drawn {number}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=names[id(piece.corners)],
            pos=position,
            quat=quat,
            material="module",
            rgba=[*piece.color, 1.0],
            group=MODULES,
            mass=0.0,
        )


def _add_mesh(
    spec: mujoco.MjSpec, name: str, vertices: np.ndarray, faces: np.ndarray, **more: Any
) -> None:
    """Triangles `[m, 3]` between points `[n, 3]` [m]."""
    # Thin or open parts have no volume to speak of; nothing asks for their inertia.
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    points, faces = np.asarray(vertices).ravel(), np.asarray(faces).ravel()
    spec.add_mesh(name=name, uservert=points, userface=faces, inertia=shell, **more)


def smooth_mesh(corners: np.ndarray) -> trimesh.Trimesh:
    """A mesh for shading: smooth but for its edges, along which it is cut open.

    Args:
        corners: `[m, 3, 3]` triangles [m].

    Returns:
        The mesh; `vertex_normals` are those to shade with.
    """
    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    return trimesh.graph.smooth_shade(mesh, angle=_CREASE, facet_minarea=None)


def _add_bed(
    spec: mujoco.MjSpec, world: World, origin: np.ndarray, way: float, sight: float
) -> None:
    """The bed, if it is in sight, on rings that widen from the middle of the way."""
    if world.bed is None:
        return
    near, far = max(way, 1.0), max(way, 1.0) + 4.0 * sight
    inner = np.linspace(0.0, near, _RINGS // 2, endpoint=False)
    radius = np.concatenate([inner, np.geomspace(near, far, _RINGS // 2)])
    rings = bed_rings(world.bed, origin[:2], radius)
    if rings[..., 2].max() - origin[2] < -way - 4.0 * sight:
        return
    a = np.arange(rings[..., 0].size).reshape(rings.shape[:2])
    a, b, c, d = a[:-1], np.roll(a, -1, axis=1)[:-1], a[1:], np.roll(a, -1, axis=1)[1:]
    # The innermost ring is a point.
    outward, inward = np.stack([a, c, d], -1), np.stack([a, d, b], -1)[1:]
    faces = np.concatenate([outward.reshape(-1, 3), inward.reshape(-1, 3)])
    texture = spec.add_texture(
        name="sand",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=_TEXELS,
        height=_TEXELS,
        nchannel=3,
    )
    texture.data = make_sand(_TEXELS).tobytes()
    material = spec.add_material(name="sand", specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "sand"
    points = rings.reshape(-1, 3)
    # Whole tiles less: near 0 single precision has more digits.
    texels = (points[:, :2] - _TILE * np.floor(origin[:2] / _TILE)) / _TILE
    _add_mesh(
        spec,
        "sand",
        points - origin,
        faces,
        usertexcoord=texels.ravel(),
        userfacetexcoord=faces.ravel(),
    )
    kind = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(name="sand", type=kind, meshname="sand", material="sand", group=MODULES)


@lru_cache(maxsize=2)
def make_sand(texels: int) -> np.ndarray:
    """A picture of sand that can be laid side by side.

    Args:
        texels: along each side.

    Returns:
        `[texels, texels, 3]` uint8.
    """
    random = np.random.default_rng(5)

    def noise(blur: float | tuple[float, float]) -> np.ndarray:
        rough = gaussian_filter(random.standard_normal((texels, texels)), blur, mode="wrap")
        return rough / rough.std()

    unit = texels / 1024
    hills = noise(60 * unit)
    # Ripples as waves leave them: crests that wander and fork, about every 6 cm.
    line = np.arange(texels) / texels
    phase = 2 * np.pi * 26 * line[:, None] + 2.2 * noise((30 * unit, 70 * unit))
    ripples = np.sin(phase) + 0.25 * np.sin(2 * phase + 0.6)
    grain = 0.7 * noise(0.8 * unit) + 0.5 * noise(3.0 * unit)
    shade = 1.0 + 0.045 * hills + 0.075 * ripples + 0.045 * grain
    shells = noise(2.2 * unit)
    shade += 0.30 * np.clip(shells - 3.1, 0.0, 1.0) - 0.55 * np.clip(-shells - 2.9, 0.0, 1.0)
    color = np.array([0.80, 0.72, 0.56]) * shade[..., None]
    color[..., 2] *= 1.0 - 0.02 * hills
    return np.round(255 * np.clip(color, 0.0, 1.0)).astype(np.uint8)


def _add_light(
    spec: mujoco.MjSpec, size: tuple[int, int], way: float, sight: float, plain: bool
) -> None:
    """Light from above, haze, and how finely things are drawn."""
    spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(20.0 * SUN).tolist(),
        dir=(-SUN).tolist(),
        castshadow=True,
        ambient=[0.0, 0.0, 0.0],
        diffuse=[0.80, 0.80, 0.80],
        specular=[0.5, 0.5, 0.5],
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=BACKGROUND if plain else [0.42, 0.78, 0.88],
        rgb2=BACKGROUND if plain else [0.01, 0.09, 0.18],
        width=256,
        height=256,
    )
    spec.stat.extent = 1.0
    spec.stat.meansize = 0.05
    visual = spec.visual
    headlight, fine = visual.headlight, visual.quality
    headlight.ambient, headlight.diffuse = [0.42] * 3, [0.16] * 3
    headlight.specular = [0.08] * 3
    getattr(visual, "global").fovy = math.degrees(FOVY)
    getattr(visual, "global").offwidth, getattr(visual, "global").offheight = size
    fine.shadowsize, fine.offsamples = 2048, 4
    # Nothing is drawn in the last part of what lies before the far plane, but for the sky.
    visual.map.znear, visual.map.zfar = 0.02, 20.0 * (way + sight)
    visual.map.fogstart, visual.map.fogend = 0.15 * sight, 1.5 * sight
    # Within this radius of the light's target things cast shadows.
    visual.map.shadowclip = sight / 6.0
    visual.rgba.fog = [*_WATER, 1.0]
    visual.rgba.haze = [*_WATER, 1.0]
