"""Morphology and world to MuJoCo: one model, and per-part tables for the water.

Modules that are welded together become one MuJoCo body, so a spider has 9 moving bodies, but every
part keeps its own geom and its own row in the fluid table. The compiled model is the single source
of masses, inertias, axes, limits and gains for every engine.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.body.module_types import Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.engine.fluid_table import FluidTable, drag_law, make_fluid_table
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.bed import sample_bed
from mjx_revolve.water.drag import ELLIPSOID_COEFFICIENTS
from mjx_revolve.water.thrusters import thrust as thruster_curve
from mjx_revolve.water.world import World

# Error at which the servo gives its full torque [rad]. A choice: hobby servos are stiff.
FULL_TORQUE_ERROR = 0.05
# Share of the servo's effort that its gears' viscous friction takes at the speed limit [-]. A
# choice; it is also what damps the servo, which has no velocity gain of its own.
FRICTION = 1 / 5

# Cells of a bed that MuJoCo's solver meets [m], and the most points along its side. A choice: in
# the lake, chords of 1 m miss the dunes by 4 mm at most; a finer grid would fill megabytes.
_GRID, _MOST_POINTS = 1.0, 1001
# Contacts that MJX's solver has room for, if the robot does not lie on more. A choice.
_LEAST_CONTACTS = 32
# Corners within this of the outermost lie flush with it [m].
_FLUSH = 1e-3

# Colour of a module whose YAML gives none (Revolve's default grey).
_GREY = (0.5, 0.5, 0.5)


@dataclass(frozen=True, eq=False)
class Robot:
    """A compiled robot in its world.

    Attributes:
        morphology: the tree of modules that it was built from.
        world: the water around it.
        mj_spec: the editable MuJoCo model.
        mj_model: the compiled model. Its own fluid (`opt.density`, `opt.viscosity`) is off.
        fluid: per-part tables.
        contact_body: `[npoint]` body of each point that may touch the bed.
        contact_position: `[npoint, 3]` the point, body frame [m].
        servos: actuators of the model that turn hinges, in the order of the modules.
        thrusters: actuators of the model that are thrusters, in the order of the modules.
        thruster_row: row of the fluid table of each thruster's part.
        thruster_part: each thruster's part.
    """

    morphology: Morphology
    world: World
    mj_spec: mujoco.MjSpec
    mj_model: mujoco.MjModel
    fluid: FluidTable
    contact_body: np.ndarray
    contact_position: np.ndarray
    servos: tuple[int, ...]
    thrusters: tuple[int, ...]
    thruster_row: tuple[int, ...]
    thruster_part: tuple[Part, ...]

    @cached_property
    def mjx_model(self) -> Any:
        """The model on JAX's default device (`mujoco.mjx.Model`); made at first use."""
        return import_mjx().put_model(self.mj_model)

    @property
    def part_geoms(self) -> tuple[str, ...]:
        """`[npart]` names of the parts' main geoms, which may carry MuJoCo's ellipsoid."""
        return tuple(
            f"{module.name}/{part.name}"
            for module in self.morphology.modules
            for part in module.kind.parts
        )

    @property
    def num_hinges(self) -> int:
        """Number of actuated hinges."""
        return len(self.servos)

    @property
    def num_thrusters(self) -> int:
        """Number of thrusters; with the hinges, the length of `ctrl`."""
        return len(self.thrusters)

    @property
    def qpos0(self) -> np.ndarray:
        """`[nq]` the rest pose at the world's origin, joints at 0."""
        return self.mj_model.qpos0.copy()

    def start_qpos(self, depth: float = 1.0) -> np.ndarray:
        """The rest pose at a depth.

        Args:
            depth: of the core's centre below the surface [m].

        Returns:
            `[nq]` qpos.
        """
        qpos = self.qpos0
        qpos[2] = self.world.surface_height - depth
        return qpos


def import_mjx() -> Any:
    """MJX, imported late because it is slow, and without the lines that it prints about Warp.

    Returns:
        The module `mujoco.mjx`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def build_robot(morphology: Morphology, world: World) -> Robot:
    """Compiles a morphology in a world.

    Args:
        morphology: the robot's modules.
        world: the water, and the bed if there is one.

    Returns:
        The robot.

    Raises:
        InputError: MuJoCo refuses the model (a massless moving part, say).
    """
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
    _add_bed(spec, morphology, world)
    rows, points = _add_modules(spec, morphology, world)
    try:
        model = spec.compile()
    except ValueError as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{morphology.path or morphology.name}: expected a body that MuJoCo can simulate; "
            f"found: {reason}"
        ) from None
    _limit_stiffness(spec, model)
    body = {model.body(i).name: i for i in range(model.nbody)}
    parts = [row["part"] for row in rows]
    pushing = tuple(k for k, part in enumerate(parts) if part.thruster is not None)
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    return Robot(
        morphology=morphology,
        world=world,
        mj_spec=spec,
        mj_model=model,
        fluid=make_fluid_table(
            parts,
            [body[row["body"]] for row in rows],
            [row["module"] for row in rows],
            [row["at"] for row in rows],
            [row["turn"] for row in rows],
            morphology.exposed,
            world,
        ),
        contact_body=np.array([body[name] for name, _ in points], int),
        contact_position=np.array([p for _, p in points], float).reshape(-1, 3),
        servos=tuple(map(int, np.flatnonzero(on_joint))),
        thrusters=tuple(map(int, np.flatnonzero(~on_joint))),
        thruster_row=pushing,
        thruster_part=tuple(parts[k] for k in pushing),
    )


def export_mjcf(robot: Robot, path: str | Path) -> None:
    """Writes the model as MJCF that stock MuJoCo opens.

    Args:
        robot: the robot.
        path: the XML file to write.
    """
    Path(path).write_text(robot.mj_spec.to_xml(), encoding="utf-8")


def _quat(rotation: np.ndarray) -> np.ndarray:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation, np.float64).ravel())
    return quat


def _add_bed(spec: mujoco.MjSpec, morphology: Morphology, world: World) -> None:
    """The ground as a geom: to be seen, and with `contact: mjx` to be met by MuJoCo's solver."""
    bed = world.bed
    if bed is None:
        return
    half, points = bed.extent / 2, 201
    common: dict[str, Any] = {"name": "bed", "contype": 0, "conaffinity": 0}
    common["rgba"] = [0.76, 0.70, 0.50, 1.0]
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
        most = max(_LEAST_CONTACTS, _flush_corners(morphology))
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


def _flush_corners(morphology: Morphology) -> int:
    """Most corners that touch a plane on which the robot lies, as it is at rest."""
    corners = []
    for module in morphology.modules:
        for part in (part for part in module.kind.parts if part.contact):
            for box in part.boxes:
                signs = np.array(list(np.ndindex(2, 2, 2))) - 0.5
                place = np.asarray(part.position) + box.position + signs * box.size
                corners.append(module.position + place @ module.rotation.T)
    if not corners:
        return 0
    place = np.concatenate(corners)
    high, low = place > place.max(0) - _FLUSH, place < place.min(0) + _FLUSH
    return int(max(high.sum(0).max(), low.sum(0).max()))


@dataclass
class _Link:
    """A MuJoCo body under construction and its pose at rest, world frame."""

    body: Any
    name: str
    position: np.ndarray
    rotation: np.ndarray


def _add_modules(
    spec: mujoco.MjSpec, morphology: Morphology, world: World
) -> tuple[list[dict[str, Any]], list[tuple[str, np.ndarray]]]:
    """Adds bodies, joints, servos and geoms; returns the fluid rows and the contact points."""
    rows: list[dict[str, Any]] = []
    points: list[tuple[str, np.ndarray]] = []
    link_of: list[_Link] = []  # the link that carries a module's children
    for index, module in enumerate(morphology.modules):
        kind = module.kind
        if module.parent < 0:
            body = spec.worldbody.add_body(name=module.name)
            body.add_freejoint(name="root")
            link = _Link(body, module.name, np.zeros(3), np.eye(3))
        else:
            link = link_of[module.parent]
        still = link
        if kind.hinge is not None:
            link = _add_hinge(spec, still, module)
        for k, part in enumerate(kind.parts):
            carrier = still if k == 0 else link
            place = carrier.rotation.T @ (
                module.position + module.rotation @ np.asarray(part.position) - carrier.position
            )
            turn = carrier.rotation.T @ module.rotation
            _add_geoms(carrier, module, part, place, turn, world)
            if part.thruster is not None:
                _add_thruster(spec, carrier, f"{module.name}/{part.name}", part, place, turn)
            rows.append(
                {"body": carrier.name, "module": index, "part": part, "at": place, "turn": turn}
            )
            if part.contact:
                low, high = (np.asarray(x) for x in part.bounds)
                for corner in np.ndindex(2, 2, 2):
                    at = np.where(corner, high, low)
                    points.append((carrier.name, place + turn @ at))
        link_of.append(link)
    return rows, points


def _add_hinge(spec: mujoco.MjSpec, parent: _Link, module: Any) -> _Link:
    """The body that a hinge moves: its frame is the module's, at the hinge's anchor."""
    hinge = module.kind.hinge
    anchor = module.position + module.rotation @ np.asarray(hinge.anchor)
    body = parent.body.add_body(
        name=module.name,
        pos=parent.rotation.T @ (anchor - parent.position),
        quat=_quat(parent.rotation.T @ module.rotation),
    )
    body.add_joint(
        name=module.name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=list(hinge.axis),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=list(hinge.range),
        damping=FRICTION * hinge.effort / hinge.speed,
        # MuJoCo has no speed limit; `servos.servo` reads it from here.
        userdata=[hinge.speed],
    )
    stiffness = hinge.effort / FULL_TORQUE_ERROR
    spec.add_actuator(
        name=module.name,
        target=module.name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=[stiffness] + [0.0] * 9,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=[0.0, -stiffness, 0.0] + [0.0] * 7,
        ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        ctrlrange=list(hinge.range),
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=[-hinge.effort, hinge.effort],
    )
    return _Link(body, module.name, anchor, module.rotation)


def _add_thruster(
    spec: mujoco.MjSpec, link: _Link, name: str, part: Part, place: np.ndarray, turn: np.ndarray
) -> None:
    """A thruster as stock MuJoCo can have it: a filtered force at a site, linear in the command.

    Our engines take lag and limits from here and thrust from the thruster's own curve, which
    MuJoCo cannot hold; its gain is the curve's slope between the ends of the command's range.
    """
    thruster = part.thruster
    assert thruster is not None
    axis = turn @ np.asarray(thruster.axis)
    link.body.add_site(name=name, pos=place + turn @ np.asarray(thruster.position))
    low, high = thruster.range
    ends = thruster_curve(thruster, np.array([low, high]))
    lag = thruster.time_constant > 0
    spec.add_actuator(
        name=name.split("/")[0],
        target=name,
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


def _limit_stiffness(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Softens servos that are too stiff for the limb that they move and the time step.

    MuJoCo's Euler step takes the servo's spring explicitly and the joint's friction d implicitly;
    it is well damped while k dt² is at most 1.5 (I + d dt). Only hinges that carry next to nothing
    are touched.
    """
    driven = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    joint = model.actuator_trnid[driven, 0]
    body, axis, dt = model.jnt_bodyid[joint], model.jnt_axis[joint], model.opt.timestep
    turn = np.zeros((len(driven), 9))
    for matrix, quat in zip(turn, model.body_iquat[body], strict=True):
        mujoco.mju_quat2Mat(matrix, quat)
    along = np.einsum("kji,kj->ki", turn.reshape(-1, 3, 3), axis)
    arm = np.cross(axis, model.body_ipos[body])
    inertia = np.sum(model.body_inertia[body] * along**2, 1)
    inertia += model.body_mass[body] * np.sum(arm**2, 1)
    most = 1.5 * (inertia / dt**2 + model.dof_damping[model.jnt_dofadr[joint]] / dt)
    for index, stiffness in zip(driven, most, strict=True):
        if stiffness < model.actuator_gainprm[index, 0]:
            actuator = spec.actuators[index]
            actuator.gainprm[0], actuator.biasprm[1] = stiffness, -stiffness
            # In the compiled model too: no need for another.
            model.actuator_gainprm[index, 0] = stiffness
            model.actuator_biasprm[index, 1] = -stiffness


def _add_geoms(
    link: _Link, module: Any, part: Part, place: np.ndarray, turn: np.ndarray, world: World
) -> None:
    """One geom for each box; the first carries the part's mass and MuJoCo's ellipsoid."""
    rgb = module.rgb if module.rgb is not None else _GREY
    for k, box in enumerate(part.boxes):
        geom = link.body.add_geom(
            name=f"{module.name}/{part.name}" + (f"/{k}" if k else ""),
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in box.size],
            pos=place + turn @ np.asarray(box.position),
            quat=_quat(turn),
            mass=part.mass if k == 0 else 0.0,
            rgba=[*rgb, 1.0],
            contype=int(part.contact and world.bed is not None and world.bed.contact == "mjx"),
            conaffinity=0,
        )
        if k == 0 and drag_law(part, world) == "ellipsoid":
            geom.fluid_ellipsoid = 1
            geom.fluid_coefs = list(ELLIPSOID_COEFFICIENTS)
    if part.ballast_mass > 0:
        # A point mass; MuJoCo wants some size, and a millimetre turns nothing.
        link.body.add_geom(
            name=f"{module.name}/{part.name}/ballast",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-3, 0, 0],
            pos=place + turn @ np.asarray(part.ballast_position),
            mass=part.ballast_mass,
            rgba=[*rgb, 0.0],
            contype=0,
            conaffinity=0,
        )


# The speed at which a law that a step takes explicitly must still be stable [m/s]; servos, weight
# and currents lead to a few tenths.
_BRISK = 1.0


def check_timestep(robot: Robot, engine: str = "population") -> None:
    """Refuses a world that an engine cannot step.

    MuJoCo's contact solver is in no engine but MJX's. And MuJoCo's explicit fluid laws cannot bear
    every step: the default drag, contact and end stops are implicit and can. MuJoCo's own laws
    stay explicit, as MuJoCo's Euler step has them: the step must stay below m / (c v), with c the
    drag of the largest face of a body of mass m (its carried water included), at v = 1 m/s.

    Args:
        robot: from `build_robot`.
        engine: "population" or "mjx".

    Raises:
        InputError: the bed's contact is not the engine's; or the step is too long, and the message
            names the body and the largest stable step.
    """
    bed = robot.world.bed
    if bed is not None and bed.contact == "mjx" and engine != "mjx":
        raise InputError(
            f"bed.contact: expected 'penalty' with engine: {engine}; found 'mjx' (choose engine: "
            "mjx, or contact: penalty)"
        )
    table, world, model = robot.fluid, robot.world, robot.mj_model
    explicit = np.array([law in ("ellipsoid", "inertia_box") for law in table.drag])
    for body in np.unique(table.body[explicit]):
        rows = explicit & (table.body == body)
        mass = model.body_mass[body] + world.density * table.carried_mass[rows].min(-1).sum()
        # Twice ½ C_d A v, the slope of the force: the two laws have a C_d of 1 of their own,
        # whatever the parts' coefficients are.
        slope = world.density * table.face_area[rows].max(-1).sum() * _BRISK
        longest = 2 * mass / max(slope, 1e-30)
        if world.timestep > longest:
            raise InputError(
                f"timestep: expected at most {longest:.2g} s, as drag: {world.drag} is explicit "
                f"and body {model.body(body).name!r} of {mass:.3g} kg is light; found "
                f"{world.timestep:g} s (drag: faces bears any step)"
            )
