"""Robots as they are drawn: meshes, the bed and light, in a MuJoCo model of their own.

The model has the bodies and joints of each `robot.mj_model`, so the same qpos poses them, but
meshes in place of the boxes that the physics weighs. Nothing touches: it is for `draw` alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import matrix_to_quat
from mjx_revolve.view.film.camera import FOVY
from mjx_revolve.view.palette import SAND, SUN
from mjx_revolve.view.pieces import make_pieces, mount_piece, smooth_mesh
from mjx_revolve.view.surroundings import bed_rings
from mjx_revolve.water.world import World

# Groups of geoms: those that are drawn, and one of those that MuJoCo hides by default.
MODULES, _WEIGHTS = 0, 4
# What is drawn where nothing is: a colour of water, for the edges of things mix with it.
BACKGROUND = (36 / 255, 110 / 255, 146 / 255)

# The bed is drawn on rings around the middle of the way; its texture repeats after a tile.
_RINGS = 64
_TILE, _TEXELS = 1.6, 1024  # m, and texels along it


def build_stage(
    robots: Mapping[int, Robot],
    world: World,
    size: tuple[int, int] = (640, 480),
    origin: ArrayLike = (0.0, 0.0, 0.0),
    way: float = 1.0,
    sight: float = 10.0,
) -> mujoco.MjModel:
    """Builds what is drawn of robots and the world around them.

    Args:
        robots: from `build_robot`, by number; they stay as they are.
        world: around them.
        size: the largest picture that will be drawn offscreen [pixels].
        origin: the place in the world that is the model's origin [m]; the bed is drawn around it.
            Far from its origin OpenGL has too few digits for small robots.
        way: how far from there robots get [m].
        sight: range of sight through the water [m].

    Returns:
        The model; names of robot k begin with `k/`, its free joint is `k/root` (see `robot_qpos`).
    """
    spec = mujoco.MjSpec()
    spec.modelname = "robots to look at"
    spec.compiler.degree = False
    # As robots' own, or MuJoCo warns when they are attached.
    spec.option.timestep, spec.option.gravity = world.timestep, [0.0, 0.0, -world.gravity]
    spec.nuser_jnt = 1
    for number, robot in robots.items():
        frame = spec.worldbody.add_frame()
        spec.attach(_dressed(robot), prefix=f"{number}/", frame=frame)
    _add_bed(spec, world, np.asarray(origin, float), way, sight)
    _add_light(spec, size, way, sight)
    for geom in spec.geoms:  # nothing touches anything
        geom.contype = geom.conaffinity = 0
    return spec.compile()


def robot_qpos(data: mujoco.MjData, number: int) -> np.ndarray:
    """A view of a robot's qpos in the data of a model from `build_stage`."""
    model, root = data.model, data.model.joint(f"{number}/root")
    begin, owner = int(root.qposadr[0]), model.body_rootid[model.jnt_bodyid]
    count = 6 + int((owner == owner[root.id]).sum())
    return data.qpos[begin : begin + count]


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
        bodies[robot.mj_model.body(body).name].add_geom(
            name=f"drawn {number}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=names[id(piece.corners)],
            pos=position,
            quat=matrix_to_quat(rotation),
            material="module",
            rgba=[*piece.color, 1.0],
            group=MODULES,
            mass=0.0,
        )


def _add_mesh(
    spec: mujoco.MjSpec, name: str, vertices: np.ndarray, faces: np.ndarray, **more: object
) -> None:
    """Triangles `[m, 3]` between points `[n, 3]` [m]."""
    # Thin or open parts have no volume to speak of; their inertia is not used.
    shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    points, faces = np.asarray(vertices).ravel(), np.asarray(faces).ravel()
    spec.add_mesh(name=name, uservert=points, userface=faces, inertia=shell, **more)


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
    kind = mujoco.mjtTexture.mjTEXTURE_2D
    texture = spec.add_texture(name="sand", type=kind, width=_TEXELS, height=_TEXELS, nchannel=3)
    texture.data = make_sand(_TEXELS).tobytes()
    material = spec.add_material(name="sand", specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "sand"
    points = rings.reshape(-1, 3)
    # Whole tiles less: near 0 single precision has more digits.
    texels = (points[:, :2] - _TILE * np.floor(origin[:2] / _TILE)) / _TILE
    lies = {"usertexcoord": texels.ravel(), "userfacetexcoord": faces.ravel()}
    _add_mesh(spec, "sand", points - origin, faces, **lies)
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
    color = np.array(SAND) * shade[..., None]
    color[..., 2] *= 1.0 - 0.02 * hills
    return np.round(255 * np.clip(color, 0.0, 1.0)).astype(np.uint8)


def _add_light(spec: mujoco.MjSpec, size: tuple[int, int], way: float, sight: float) -> None:
    """Light from above, and how finely things are drawn."""
    spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[20.0 * x for x in SUN],
        dir=[-x for x in SUN],
        castshadow=True,
        ambient=[0.0, 0.0, 0.0],
        diffuse=[0.80, 0.80, 0.80],
        specular=[0.5, 0.5, 0.5],
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=BACKGROUND,
        rgb2=BACKGROUND,  # of the lowest face
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
    # Within this radius of the light's target things cast shadows.
    visual.map.shadowclip = sight / 6.0
