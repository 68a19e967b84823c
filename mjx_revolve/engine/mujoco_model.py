"""A robot as MuJoCo has it: the assembly written into a spec, and that compiled.

Modules that are welded together become one MuJoCo body, so a spider has 9 moving bodies, but every
part keeps its own geom. The models are for MJX, viewers and files; our own step takes its numbers
from the assembly.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjx_revolve.body.module_types import Part
from mjx_revolve.body.placement import Module
from mjx_revolve.engine.assembly import BALLAST_RADIUS, Assembly
from mjx_revolve.engine.fluid_table import drag_law
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import matrix_to_quat
from mjx_revolve.water.bed import sample_bed
from mjx_revolve.water.drag import find_drag_law
from mjx_revolve.water.thrusters import thrust as thruster_curve
from mjx_revolve.water.world import World

# Cells of a bed that MuJoCo's solver meets [m], and the most points along its side. A choice: in
# the lake, chords of 1 m miss the dunes by 4 mm at most; a finer grid would fill megabytes.
_GRID, _MOST_POINTS = 1.0, 1001
# Contacts that MJX's solver has room for, if the robot does not lie on more. A choice.
_LEAST_CONTACTS = 32
# Corners within this of the outermost lie flush with it [m].
_FLUSH = 1e-3

# Colour of a module without one in its YAML (Revolve's default grey).
GREY = (0.5, 0.5, 0.5)
# Colour of a bed; a choice.
SAND = (0.76, 0.70, 0.50)


def compile_model(assembly: Assembly) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Writes one robot's model and compiles it.

    Args:
        assembly: of the robot.

    Returns:
        The editable model, and the compiled one.

    Raises:
        InputError: MuJoCo refuses the model (a massless moving part, say).
    """
    [morphology], world = assembly.morphologies, assembly.world
    spec = mujoco.MjSpec()
    spec.modelname = str(morphology.name)
    spec.compiler.degree = False
    spec.nuser_jnt = 1
    spec.option.timestep = world.timestep
    spec.option.gravity = [0.0, 0.0, -world.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # MuJoCo's own fluid stays off in every engine: hydrodynamics owns the water.
    spec.option.density = 0.0
    spec.option.viscosity = 0.0
    try:
        _add_bed(spec, assembly)
        _add_bodies(spec, assembly)
        _add_pairs(spec, assembly)
        return spec, spec.compile()
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{morphology.path or morphology.name}: expected a body that MuJoCo can simulate; "
            f"found: {reason}"
        ) from None


def _add_bed(spec: mujoco.MjSpec, assembly: Assembly) -> None:
    """The ground as a geom: to be seen, and with `contact: mjx` to be met by MuJoCo's solver."""
    bed = assembly.world.bed
    if bed is None:
        return
    half, points = bed.extent / 2, 201
    common: dict[str, Any] = {"name": "bed", "contype": 0, "conaffinity": 0}
    common["rgba"] = [*SAND, 1.0]
    if bed.contact == "mjx":
        # Modules (contype 1) meet the bed (conaffinity 1), not each other. Its priority makes the
        # bed's friction count, not the larger of the two.
        common |= {"conaffinity": 1, "priority": 1, "friction": [bed.friction, 0.0, 0.0]}
        # MuJoCo's least friction is 1e-5; MJX divides by it.
        rough = bed.friction > 1e-5
        common["condim"] = 3 if rough else 1
        if rough:  # a round cone: the default pyramid loses 30 % of the friction across its edges
            spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        # MJX's cost grows with the square of it; the deepest contacts are those that are kept.
        most = max(_LEAST_CONTACTS, _flush_corners(assembly))
        spec.add_numeric(name="max_contact_points", data=[most], size=1)
        points = int(np.clip(bed.extent / _GRID + 1, points, _MOST_POINTS))
    if bed.kind == "flat":
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[half, half, 1.0],
            pos=[0, 0, bed.height],
            **common,
        )
        return
    heights = sample_bed(bed, points)
    span = bed.highest - bed.height
    spec.add_hfield(
        name="bed",
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        size=[half, half, span, 1.0],
        userdata=((heights - bed.height) / span).ravel(),
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="bed", pos=[0, 0, bed.height], **common
    )


def _flush_corners(assembly: Assembly) -> int:
    """Most corners that touch a plane on which the robot lies, as it is at rest."""
    layout = assembly.layout
    boxes = np.flatnonzero(assembly.touching[layout.box_part])
    if not len(boxes):
        return 0
    signs, turn = 2 * np.array(list(np.ndindex(2, 2, 2))) - 1, layout.rotation[layout.box_part]
    corners = signs * layout.box_half[:, None] @ turn.swapaxes(1, 2)
    place = (layout.box_centers()[:, None] + corners)[boxes].reshape(-1, 3)
    high, low = place > place.max(0) - _FLUSH, place < place.min(0) + _FLUSH
    return int(max(high.sum(0).max(), low.sum(0).max()))


def _add_bodies(spec: mujoco.MjSpec, assembly: Assembly) -> None:
    """Bodies with their joints and servos, parts and thrusters, module by module."""
    [morphology], table = assembly.morphologies, assembly.fluid
    place, turn = assembly.from_parents()
    bodies, names = [spec.worldbody], iter(morphology.thruster_names)
    row = 0
    for index, module in enumerate(morphology.modules):
        if index == 0:
            bodies.append(spec.worldbody.add_body(name=module.name))
            bodies[1].add_freejoint(name="root")
        if module.kind.hinge is not None:
            number = len(bodies)
            above = bodies[assembly.parent[number]]
            quat = matrix_to_quat(turn[number])
            bodies.append(above.add_body(name=module.name, pos=place[number], quat=quat))
            _add_hinge(spec, assembly, number, bodies[number])
        for part in module.kind.parts:
            carrier = bodies[table.body[row]]
            pose = table.position[row], table.rotation[row]
            _add_geoms(carrier, module, part, *pose, assembly.world)
            if part.thruster is not None:
                _add_thruster(spec, carrier, next(names), module, part, *pose)
            row += 1


def _add_pairs(spec: mujoco.MjSpec, assembly: Assembly) -> None:
    """Pairs of main boxes that meet in MuJoCo's solver, as they do in our step; no friction."""
    [morphology] = assembly.morphologies
    names = [f"{m.name}/{part.name}" for m in morphology.modules for part in m.kind.parts]
    for first, second in assembly.meeting_pairs:
        spec.add_pair(geomname1=names[first], geomname2=names[second], condim=1)


def _add_hinge(spec: mujoco.MjSpec, assembly: Assembly, number: int, body: Any) -> None:
    """The hinge that moves a body, and its servo."""
    name, low_high = assembly.names[number], list(assembly.range[number])
    effort, stiffness = assembly.effort[number], assembly.stiffness[number]
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=list(assembly.axis[number]),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=list(assembly.stops[number]),
        damping=assembly.damping[number],
        # MuJoCo has no speed limit; ours stands here for readers of the model.
        userdata=[assembly.speed[number]],
    )
    spec.add_actuator(
        name=name,
        target=name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=[stiffness] + [0.0] * 9,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=[0.0, -stiffness, 0.0] + [0.0] * 7,
        ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        ctrlrange=low_high,
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-effort, effort],
    )


def _add_thruster(
    spec: mujoco.MjSpec,
    body: Any,
    name: str,
    module: Module,
    part: Part,
    place: np.ndarray,
    turn: np.ndarray,
) -> None:
    """A thruster as stock MuJoCo can have it: a filtered force at a site, linear in the command.

    Our engines take lag and limits from here and thrust from the thruster's own curve, which
    MuJoCo cannot represent; its gain is the mean gradient of the curve over the command's range.
    """
    thruster, site = part.thruster, f"{module.name}/{part.name}"
    assert thruster is not None
    axis = turn @ np.asarray(thruster.axis)
    body.add_site(name=site, pos=place + turn @ np.asarray(thruster.position))
    low, high = thruster.range
    ends = thruster_curve(thruster, np.array([low, high]))
    lag = thruster.time_constant > 0
    spec.add_actuator(
        name=name,
        target=site,
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        gear=[*axis, *(-thruster.torque_ratio * axis)],
        dyntype=mujoco.mjtDyn.mjDYN_FILTEREXACT if lag else mujoco.mjtDyn.mjDYN_NONE,
        dynprm=[thruster.time_constant] + [0.0] * 9,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=[float((ends[1] - ends[0]) / (high - low))] + [0.0] * 9,
        biastype=mujoco.mjtBias.mjBIAS_NONE,
        ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        ctrlrange=[low, high],
    )


def _add_geoms(
    body: Any, module: Module, part: Part, place: np.ndarray, turn: np.ndarray, world: World
) -> None:
    """One geom for each box; the first carries the part's mass and MuJoCo's ellipsoid."""
    rgb = module.rgb if module.rgb is not None else GREY
    for k, box in enumerate(part.boxes):
        geom = body.add_geom(
            name=f"{module.name}/{part.name}" + (f"/{k}" if k else ""),
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in box.size],
            pos=place + turn @ np.asarray(box.position),
            quat=matrix_to_quat(turn),
            mass=part.mass if k == 0 else 0.0,
            rgba=[*rgb, 1.0],
            contype=int(part.contact and world.bed is not None and world.bed.contact == "mjx"),
            conaffinity=0,
        )
        own = find_drag_law(drag_law(part, world)).mj_fluidcoef
        if k == 0 and own:
            geom.fluid_ellipsoid, geom.fluid_coefs = 1, own
    if part.ballast_mass > 0:
        body.add_geom(
            name=f"{module.name}/{part.name}/ballast",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[BALLAST_RADIUS, 0, 0],
            pos=place + turn @ np.asarray(part.ballast_position),
            mass=part.ballast_mass,
            rgba=[*rgb, 0.0],
            contype=0,
            conaffinity=0,
        )
