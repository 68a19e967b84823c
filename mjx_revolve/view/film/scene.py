"""The robot as it is drawn: modules' meshes, the bed, light and haze, in a MuJoCo model of its own.

The model has the bodies and joints of `robot.mj_model`, so the same qpos poses it, but meshes in
place of the boxes that the physics weighs. It is for looking at, in MuJoCo's viewer or through
`painter`; its geoms touch nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np
from scipy.ndimage import gaussian_filter

from mjx_revolve.engine.robot import Robot
from mjx_revolve.view.pictures import Piece, make_pieces
from mjx_revolve.water.bed import bed_height

# What is hidden of the model by default in MuJoCo's viewer is drawn in none of these groups.
MODULES, SURFACE, _WEIGHTS = 0, 1, 4
# Of the camera, upright [deg].
FOVY = 40.0
# Towards the light, world frame: high, from one side.
SUN = np.array([-0.42, -0.28, 0.86]) / np.linalg.norm([-0.42, -0.28, 0.86])
# What is drawn offscreen where nothing is: a colour of water, for the edges of things mix with it.
BACKGROUND = (36 / 255, 110 / 255, 146 / 255)
# The haze's colour where one looks straight ahead, for MuJoCo's viewer.
_WATER = (0.09, 0.40, 0.55)

# Edges of a part are sharp where its faces turn by more than this.
_CREASE = math.cos(math.radians(35.0))
# The bed is drawn on rings around the middle of the way; its texture repeats after a tile.
_RINGS, _SECTORS = 64, 96
_TILE, _TEXELS = 1.6, 1024  # m, and texels along it


def build_scene(
    robot: Robot,
    size: tuple[int, int] = (640, 480),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    way: float = 1.0,
    sight: float = 10.0,
    shade: float = 1.0,
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
        shade: radius around the light's target within which things cast shadows [m].
        plain: whether the background has one colour, for a film that paints the water itself.

    Returns:
        The model; `qpos` means the same as in `robot.mj_model`, but for the origin.
    """
    spec = robot.mj_spec.copy()
    spec.modelname = f"{robot.morphology.name} to look at"
    for geom in list(spec.geoms):
        if geom.name == "bed":
            spec.delete(geom)
        else:  # they carry the masses, without which MuJoCo has no body
            geom.group = _WEIGHTS
            geom.contype = geom.conaffinity = 0
    for field in list(spec.hfields):
        spec.delete(field)
    _add_pieces(spec, robot)
    place = np.asarray(origin, float)
    if robot.world.bed is not None:
        _add_bed(spec, robot, place, way, sight)
    _add_surface(spec, robot, place, way + 4.0 * sight)
    _add_light(spec, size, way, sight, shade, plain)
    return spec.compile()


def _add_pieces(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Meshes of all parts, each fixed to the body that carries its part's box."""
    modules, fluid = robot.morphology.modules, robot.fluid
    row = np.cumsum([0] + [len(module.kind.parts) for module in modules])
    spec.add_material(name="module", specular=0.35, shininess=0.35, rgba=[1, 1, 1, 1])
    bodies = {body.name: body for body in spec.bodies}
    names: dict[int, str] = {}  # modules of a kind share their parts' triangles
    for number, piece in enumerate(_parts(robot)):
        if id(piece.corners) not in names:
            names[id(piece.corners)] = f"piece {number}"
            _add_mesh(spec, f"piece {number}", piece)
        k = row[piece.module] + piece.part
        part = modules[piece.module].kind.parts[piece.part]
        # The table has the centre of the part's main box; meshes are in their module's frame.
        center = np.asarray(part.position) + np.asarray(part.boxes[0].position)
        rotation = fluid.rotation[k]
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
        bodies[robot.mj_model.body(fluid.body[k]).name].add_geom(
            name=f"drawn {number}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=names[id(piece.corners)],
            pos=fluid.position[k] - rotation @ center,
            quat=quat,
            material="module",
            rgba=[*piece.color, 1.0],
            group=MODULES,
            mass=0.0,
            contype=0,
            conaffinity=0,
        )


def _parts(robot: Robot) -> list[Piece]:
    """The pieces that are there to touch: no axes of hinges, no arrows of thrusters."""
    pieces = make_pieces(robot.morphology)
    modules = [piece.module for piece in pieces]
    # Of each module its parts come first.
    rank = [number - modules.index(module) for number, module in enumerate(modules)]
    kinds = [module.kind for module in robot.morphology.modules]
    return [p for p, k in zip(pieces, rank, strict=True) if k < len(kinds[p.module].parts)]


def _add_mesh(spec: mujoco.MjSpec, name: str, piece: Piece) -> None:
    """A piece's triangles, smooth but for its edges."""
    corners = piece.corners
    count = len(corners)
    spec.add_mesh(
        name=name,
        uservert=corners.ravel(),
        userface=np.arange(3 * count),
        usernormal=corner_normals(corners).ravel(),
        userfacenormal=np.arange(3 * count),
        # Thin or open parts have no volume to speak of; nothing asks for their inertia.
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def corner_normals(corners: np.ndarray) -> np.ndarray:
    """Normals for shading: the mean of the faces at a corner, but not across an edge.

    Args:
        corners: `[m, 3, 3]` triangles [m].

    Returns:
        `[m, 3, 3]` a unit normal for each corner of each triangle.
    """
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(area, axis=1, keepdims=True)
    face = area / np.maximum(length, 1e-30)
    points = corners.reshape(-1, 3)
    # Corners within a hundredth of a millimetre are one.
    _, point = np.unique(np.round(points / 1e-5).astype(np.int64), axis=0, return_inverse=True)
    point = point.ravel()
    order = np.argsort(point, kind="stable")
    owner = order // 3
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    normals = np.repeat(face, 3, axis=0)
    for begin, end in zip(starts, [*starts[1:], len(order)], strict=True):
        around = owner[begin:end]
        alike = face[around] @ face[around].T > _CREASE
        mean = alike @ area[around]
        size = np.linalg.norm(mean, axis=1, keepdims=True)
        normals[order[begin:end]] = np.where(size > 1e-30, mean / np.maximum(size, 1e-30),
                                             face[around])  # fmt: skip
    return normals.reshape(-1, 3, 3)


def _add_bed(
    spec: mujoco.MjSpec, robot: Robot, origin: np.ndarray, way: float, sight: float
) -> None:
    """The bed, if it is in sight, on rings that widen from the middle of the way."""
    bed = robot.world.bed
    assert bed is not None
    near = max(way, 1.0)
    radius = np.concatenate([
        np.linspace(0.0, near, _RINGS // 2, endpoint=False),
        np.geomspace(near, near + 4.0 * sight, _RINGS // 2),
    ])  # fmt: skip
    angle = 2 * np.pi * np.arange(_SECTORS) / _SECTORS
    xy = np.stack([radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)], axis=-1)
    world = (xy + origin[:2]).astype(np.float32)
    height = np.asarray(bed_height(bed, world[..., 0], world[..., 1]), float) - origin[2]
    if height.max() < -way - 4.0 * sight:
        return
    points = np.concatenate([xy, height[..., None]], axis=-1).reshape(-1, 3)
    ring, sector = np.meshgrid(np.arange(_RINGS - 1), np.arange(_SECTORS), indexing="ij")
    beyond = (sector + 1) % _SECTORS
    a, b = ring * _SECTORS + sector, ring * _SECTORS + beyond
    c, d = a + _SECTORS, b + _SECTORS
    faces = np.stack([np.stack([a, c, d], -1), np.stack([a, d, b], -1)], axis=2).reshape(-1, 3)
    # The innermost ring is a point.
    faces = faces[(ring > 0).ravel().repeat(2) | (np.arange(len(faces)) % 2 == 0)]
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
    spec.add_mesh(
        name="sand",
        uservert=points.ravel(),
        userface=faces.ravel(),
        usertexcoord=((xy + origin[:2] % _TILE) / _TILE).ravel(),
        userfacetexcoord=faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        name="sand",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname="sand",
        material="sand",
        group=MODULES,
        contype=0,
        conaffinity=0,
    )


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


def _add_surface(spec: mujoco.MjSpec, robot: Robot, origin: np.ndarray, reach: float) -> None:
    """The still surface for MuJoCo's viewer; films draw their own, which moves."""
    spec.add_material(name="surface", specular=0.9, shininess=0.9, rgba=[0.55, 0.85, 0.95, 0.22])
    spec.worldbody.add_geom(
        name="surface",
        type=mujoco.mjtGeom.mjGEOM_BOX,  # a plane is invisible from below
        size=[reach, reach, 5e-4],
        pos=[0.0, 0.0, robot.world.surface_height - origin[2]],
        material="surface",
        group=SURFACE,
        contype=0,
        conaffinity=0,
    )


def _add_light(
    spec: mujoco.MjSpec, size: tuple[int, int], way: float, sight: float, shade: float, plain: bool
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
    getattr(visual, "global").fovy = FOVY
    getattr(visual, "global").offwidth, getattr(visual, "global").offheight = size
    fine.shadowsize, fine.offsamples = 2048, 4
    # Nothing is drawn in the last part of what lies before the far plane, but for the sky.
    visual.map.znear, visual.map.zfar = 0.02, 20.0 * (way + sight)
    visual.map.fogstart, visual.map.fogend = 0.15 * sight, 1.5 * sight
    visual.map.shadowclip = shade
    visual.rgba.fog = [*_WATER, 1.0]
    visual.rgba.haze = [*_WATER, 1.0]
