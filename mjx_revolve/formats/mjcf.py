"""A robot as MJCF that stock MuJoCo opens and simulates without this package.

The model is that of `robot.build_robot`, with the modules' meshes to look at, and with MuJoCo's own
fluid set as near to our water as it comes; a comment in the file says how near that is.
"""

from __future__ import annotations

import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import make_links, make_meshes, to_comment, to_list
from mjx_revolve.water.bed import Bed, bed_height

# A bed this far below the surface, or nearer, comes along [m]: a robot starts 1 m deep.
_NEAR = 5.0

# Groups that MuJoCo's viewer shows at first are 0 to 2.
_SEEN, _HIDDEN = 2, 3

# Mass of the bodies at which MuJoCo's water lifts: too little to be felt, enough to divide by [kg].
_FEATHER = 1e-8

_NOTE = """
  {title}, for MuJoCo {version} or newer: start `python -m mujoco.viewer` and drop this file in.
  The keyframe "start" puts it into the water, whose surface is at z = {surface:g} m.
  Rest pose, masses, inertias, joints, servos and their limits are those it evolved with. What is
  seen are meshes (group {seen}); boxes carry mass and contact (group {hidden}).

  The water is MuJoCo's own, which fills all space. It stands in for ours like this:
{water}
  What it cannot have:
{missing}
"""


def near_bed(robot: Robot) -> Bed | None:
    """The bed of a robot's world, where it is near enough to matter.

    Args:
        robot: that starts at the origin.

    Returns:
        The bed, or None.
    """
    bed = robot.world.bed
    if bed is None:
        return None
    deep = robot.world.surface_height - float(bed_height(bed, np.float64(0), np.float64(0)))
    return bed if deep <= _NEAR else None


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
    _keep_bed(robot, spec)
    _show_meshes(robot, spec)
    # What the viewer looks at: the robot, not the bed.
    spec.stat.center, spec.stat.extent = start[:3], 1.5 * robot.morphology.length
    water = _fill_water(robot, spec)
    spec.add_key(name="start", qpos=start, ctrl=np.zeros(robot.mj_model.nu))
    spec.compile()
    note = _NOTE.format(
        title=robot.morphology.name,
        version=mujoco.__version__,
        surface=robot.world.surface_height,
        seen=_SEEN,
        hidden=_HIDDEN,
        water=to_list(water),
        missing=to_list(_missing(robot)),
    )
    return to_comment(note) + "\n" + spec.to_xml()


def _keep_bed(robot: Robot, spec: mujoco.MjSpec) -> None:
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
    for link in make_links(robot):
        for shape in link.shapes:
            for geom in _geoms_of(robot, spec, shape.row):
                geom.contype = int(shape.part.contact)


def _geoms_of(robot: Robot, spec: mujoco.MjSpec, row: int) -> list[mujoco.MjsGeom]:
    """The boxes of a part, as `robot.py` names them."""
    names = [
        (f"{module.name}/{part.name}", len(part.boxes))
        for module in robot.morphology.modules
        for part in module.kind.parts
    ]
    name, count = names[row]
    return [spec.geom(f"{name}/{k}" if k else name) for k in range(count)]


def _show_meshes(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Adds the meshes, in the modules' colours, and hides the boxes behind them."""
    for name, mesh in make_meshes(robot.morphology).items():
        # Its inertia is never used; that of a surface exists for the thinnest of walls.
        spec.add_mesh(
            name=name,
            uservert=np.asarray(mesh.vertices, np.float64).ravel(),
            userface=np.asarray(mesh.faces, np.int32).ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
    for link in make_links(robot):
        body = spec.body(robot.mj_model.body(link.body).name)
        for shape in link.shapes:
            for geom in _geoms_of(robot, spec, shape.row):
                geom.group = _HIDDEN
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, np.ascontiguousarray(shape.rotation).ravel())
            body.add_geom(
                name=f"{shape.name}/mesh",
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=shape.mesh,
                pos=shape.position,
                quat=quat,
                mass=0.0,
                rgba=[*shape.rgb, 1.0],
                contype=0,
                conaffinity=0,
                group=_SEEN,
            )
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
    # From the right, behind and above.
    back = np.array([0.9, -1.3, 0.8])
    right = np.cross([0, 0, 1], back)
    spec.body(robot.mj_model.body(1).name).add_camera(
        name="track",
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=robot.morphology.length * back,
        xyaxes=[*right, *np.cross(back, right)],
    )


def _fill_water(robot: Robot, spec: mujoco.MjSpec) -> list[str]:
    """Sets MuJoCo's fluid and lift; returns what stands for what, a line each."""
    world = robot.world
    lines = []
    if _add_lift(robot, spec):
        lines.append(
            "the bodies whose names end in /lift weigh nothing (10 micrograms) and sit at the "
            "centres of buoyancy; their gravcomp lifts with the weight of the displaced water"
        )
    if robot.num_hinges:
        _limit_speed(robot, spec)
        lines.append(
            "the hinges' second damping coefficient holds them to the servos' top speed, at which "
            "it takes all of their effort"
        )
    if world.drag == "off":
        return [*lines, "there is no drag"]
    spec.option.density, spec.option.viscosity = world.density, world.viscosity
    spec.option.wind = world.current
    if "ellipsoid" in robot.fluid.drag:
        lines.append("drag and lift are MuJoCo's ellipsoid law, as it evolved with")
    elif set(robot.fluid.drag) == {"inertia_box"}:
        lines.append("drag is MuJoCo's inertia-box law, as it evolved with")
    else:
        lines.append(
            "drag is MuJoCo's inertia-box law: one box for all modules that are welded together, "
            "in place of the modules' own faces"
        )
    return lines


def _add_lift(robot: Robot, spec: mujoco.MjSpec) -> bool:
    """Adds bodies at the centres of buoyancy, since MuJoCo lifts at centres of mass only."""
    world, table, model = robot.world, robot.fluid, robot.mj_model
    floats = np.array([law != "off" for law in table.buoyancy]) & (table.volume > 0)
    if world.gravity == 0:
        return False
    center = table.position + np.einsum("pij,pj->pi", table.rotation, table.center_of_volume)
    for body in np.unique(table.body[floats]):
        rows = floats & (table.body == body)
        volume = table.volume[rows]
        spec.body(model.body(body).name).add_body(
            name=f"{model.body(body).name}/lift",
            pos=volume @ center[rows] / volume.sum(),
            explicitinertial=True,
            mass=_FEATHER,
            ipos=np.zeros(3),
            inertia=np.zeros(3),  # MuJoCo drags what has inertia as a box
            gravcomp=world.density * volume.sum() / _FEATHER,
        )
    return bool(floats.any())


def _limit_speed(robot: Robot, spec: mujoco.MjSpec) -> None:
    """Damping d q̇ + b |q̇| q̇ that meets the servo's effort at its top speed."""
    for link in make_links(robot)[1:]:
        joint = link.joint
        assert joint is not None
        top = joint.speed
        square = max(joint.effort - joint.damping * top, 0.0) / top**2
        name = robot.mj_model.body(link.body).name
        spec.joint(name).damping = [joint.damping, square, 0.0]


def _missing(robot: Robot) -> list[str]:
    """What MuJoCo lacks of this robot and its world, a line each."""
    world, table = robot.world, robot.fluid
    lines = []
    if table.carried_mass.any():
        share = world.density * table.carried_mass.mean(-1).sum() / robot.morphology.mass
        lines.append(
            "the inertia of the water that moves with the modules (added mass and what fills "
            f"them), here {share:.2g} times their mass"
        )
    lines.append("a surface: half out of the water it is held up as if it were below")
    if "lift_drag" in table.drag:
        lines.append("fins: their lift and stall are left out")
    if "off" in table.drag and world.drag != "off":
        lines.append("modules without drag next to others with it")
    if robot.num_thrusters:
        lines.append(
            "the thrusters' curves: thrust is the gain times the command, the same at both ends of "
            "its range; it stays when the thruster leaves the water"
        )
    lines += [
        f"the world's {name.replace('_', ' ')}"
        for name in ("shear", "current_field", "gust", "waves", "surface_tension")
        if getattr(world, name)
    ]
    if world.bed is not None and near_bed(robot) is None:
        lines.append("the bed, which is out of reach")
    return lines
