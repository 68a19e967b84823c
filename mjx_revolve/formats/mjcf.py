"""A robot as MJCF that stock MuJoCo opens and simulates without this package.

The model is that of `robot.build_robot`, with the modules' meshes for display, and with MuJoCo's
own fluid set as close to our water as possible; a comment in the file lists the differences.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import (
    Link,
    make_links,
    make_meshes,
    missing_flow,
    near_bed,
    unique_names,
    words_on_laws,
)
from mjx_revolve.formats.xml_text import to_comment, to_list
from mjx_revolve.numerics.spatial import matrix_to_quat
from mjx_revolve.water.buoyancy import find_buoyancy_law

# Groups that MuJoCo's viewer shows at first are 0 to 2.
_SEEN, _HIDDEN = 2, 3

# Mass of the bodies for MuJoCo's buoyancy [kg]: negligible, but not zero.
_FEATHER = 1e-8

_NOTE = """
  {title}, for MuJoCo {version} or newer: start `python -m mujoco.viewer` and drop this file in.
  The keyframe "start" puts it into the water; the surface is at z = {surface:g} m.
  Rest pose, masses, inertias, joints, servos and their limits are those it evolved with. What is
  seen are meshes (group {seen}); boxes carry mass and contact (group {hidden}).

  The water is MuJoCo's own, which fills all space. It stands in for ours like this:
{water}
  What it cannot have:
{missing}
"""


def make_mjcf(robot: Robot, start: np.ndarray | None = None) -> str:
    """The robot as MJCF of its own.

    Args:
        robot: from `build_robot`.
        start: `[nq]` pose of the keyframe "start"; by default the rest pose 1 m deep.

    Returns:
        The XML text; meshes are in it.
    """
    spec = robot.mj_spec.copy()
    start = robot.start_qpos() if start is None else np.asarray(start, np.float64)
    links = make_links(robot)
    _keep_bed(robot, spec, links)
    _show_meshes(robot, spec, links)
    _light(robot, spec)
    # Centre and extent of the viewer's camera: the robot, without the bed.
    spec.stat.center, spec.stat.extent = start[:3], 1.5 * robot.morphology.length
    _lift(robot, spec)
    for link in links[1:]:
        _limit_speed(spec.joint(robot.mj_model.body(link.body).name), link)
    if robot.world.drag != "off":
        spec.option.density, spec.option.viscosity = robot.world.density, robot.world.viscosity
        spec.option.wind = robot.world.current
    spec.add_key(name="start", qpos=start, ctrl=np.zeros(robot.mj_model.nu))
    spec.compile()
    note = _NOTE.format(
        title=robot.morphology.name,
        version=mujoco.__version__,
        surface=robot.world.surface_height,
        seen=_SEEN,
        hidden=_HIDDEN,
        water=to_list(_water(robot)),
        missing=to_list(_missing(robot)),
    )
    return to_comment(note) + "\n" + spec.to_xml()


def _keep_bed(robot: Robot, spec: mujoco.MjSpec, links: tuple[Link, ...]) -> None:
    """Drops a bed out of reach; lets MuJoCo's solver keep the robot off one that is near."""
    bed = robot.world.bed
    if bed is None:
        return
    geom = spec.geom("bed")
    if near_bed(robot) is None:
        spec.delete(geom)
        if bed.kind != "flat":
            spec.delete(spec.hfield("bed"))
        return
    # Its priority makes the bed's friction count, not the larger of the two.
    geom.conaffinity, geom.priority, geom.friction = 1, 1, [bed.friction, 0.005, 0.0001]
    for part in (part for link in links for part in link.parts):
        for name in part.geoms:
            spec.geom(name).contype = int(part.part.contact)


def _show_meshes(robot: Robot, spec: mujoco.MjSpec, links: tuple[Link, ...]) -> None:
    """Adds the meshes, in the modules' colours, and hides the boxes behind them."""
    for name, mesh in make_meshes(robot.morphology).items():
        # Its inertia is never used; that of a surface exists for the thinnest of walls.
        spec.add_mesh(
            name=name,
            uservert=np.asarray(mesh.vertices, np.float64).ravel(),
            userface=np.asarray(mesh.faces, np.int32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
    parts = [(link.body, part) for link in links for part in link.parts]
    names = [f"{part.name}/mesh" for _, part in parts]
    names = unique_names(names, taken={geom.name for geom in spec.geoms})
    for (body, part), seen in zip(parts, names, strict=True):
        for name in part.geoms:
            spec.geom(name).group = _HIDDEN
        spec.body(robot.mj_model.body(body).name).add_geom(
            name=seen,
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=part.mesh,
            pos=part.position,
            quat=matrix_to_quat(part.rotation),
            mass=0.0,
            rgba=[*part.rgb, 1.0],
            contype=0,
            conaffinity=0,
            group=_SEEN,
        )


def _light(robot: Robot, spec: mujoco.MjSpec) -> None:
    """The colours of water and sun, and a camera that follows from the right, behind and above."""
    spec.visual.headlight.ambient = [0.4, 0.4, 0.4]
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.add_texture(
        name="water",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.55, 0.78, 0.85],
        rgb2=[0.05, 0.22, 0.33],
        width=128,
        height=128,
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0, 0, 3],
        dir=[-0.4, 0.5, -1.0],
        diffuse=[0.5, 0.5, 0.5],
        castshadow=False,
    )
    back = np.array([0.9, -1.3, 0.8])
    right = np.cross([0, 0, 1], back)
    spec.body(robot.mj_model.body(1).name).add_camera(
        name="track",
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=robot.morphology.length * back,
        xyaxes=[*right, *np.cross(back, right)],
    )


def _floats(robot: Robot) -> np.ndarray:
    """`[npart]` whether water lifts a part."""
    lifts = np.array([find_buoyancy_law(name).lifts for name in robot.fluid.buoyancy])
    return lifts & (robot.fluid.volume > 0) & (robot.world.gravity != 0)


def _lift(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Adds bodies at the centres of buoyancy, since MuJoCo lifts at centres of mass only."""
    world, table, model, floats = robot.world, robot.fluid, robot.mj_model, _floats(robot)
    center = table.position + np.einsum("pij,pj->pi", table.rotation, table.center_of_volume)
    bodies = [model.body(body) for body in np.unique(table.body[floats])]
    names = [f"{body.name}/lift" for body in bodies]
    names = unique_names(names, taken={body.name for body in spec.bodies})
    for body, name in zip(bodies, names, strict=True):
        rows = floats & (table.body == body.id)
        volume = table.volume[rows]
        spec.body(body.name).add_body(
            name=name,
            pos=volume @ center[rows] / volume.sum(),
            explicitinertial=True,
            mass=_FEATHER,
            ipos=np.zeros(3),
            inertia=np.zeros(3),  # MuJoCo drags what has inertia as a box
            gravcomp=world.density * volume.sum() / _FEATHER,
        )


def _limit_speed(joint: mujoco.MjsJoint, link: Link) -> None:
    """Damping d q̇ + b |q̇| q̇ that equals the servo's effort at its top speed."""
    assert link.joint is not None
    top, damping = link.joint.speed, link.joint.damping
    if math.isfinite(top) and math.isfinite(link.joint.effort):
        joint.damping = [damping, max(link.joint.effort - damping * top, 0.0) / top**2, 0.0]


def _water(robot: Robot) -> list[tuple[object, str]]:
    """Substitutes in MuJoCo's water: for each, whether it is used, and a description."""
    lift, drag, _ = words_on_laws(robot, lambda law: law.mjcf)
    return [
        *((_floats(robot).any(), note) for note in lift),
        (
            robot.num_hinges,
            "the hinges' second damping coefficient holds them to the servos' top speed, at which "
            "it takes all of their effort",
        ),
        (robot.world.drag == "off", "there is no drag"),
        *((True, note) for note in drag),
    ]


def _missing(robot: Robot) -> list[tuple[object, str]]:
    """Properties that MuJoCo lacks: for each, whether robot or world has it, and a description."""
    world, table = robot.world, robot.fluid
    share = world.density * table.carried_mass.mean(-1).sum() / robot.morphology.mass
    return [
        (
            table.carried_mass.any(),
            "the inertia of the water that moves with the modules (added mass and what fills "
            f"them), here {share:.2g} times their mass",
        ),
        (True, "a surface: half out of the water it is held up as if it were below"),
        *((world.drag != "off", note) for note in words_on_laws(robot, lambda law: law.mjcf)[2]),
        (
            robot.num_thrusters,
            "the thrusters' curves: thrust is the gain times the command, the same at both ends of "
            "its range; it stays when the thruster leaves the water",
        ),
        *missing_flow(world),
        (world.bed is not None and near_bed(robot) is None, "the bed, which is out of reach"),
    ]
