"""A robot: a body in a world, and the tables and MuJoCo models that follow from the two."""

from __future__ import annotations

import contextlib
import copy
import io
import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.body.module_types import ModuleType, Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.engine.assembly import Assembly, assemble
from mjx_revolve.engine.edited_model import check_edit, edited_assembly
from mjx_revolve.engine.fluid_table import FluidTable
from mjx_revolve.engine.mujoco_model import compile_model
from mjx_revolve.engine.step_constants import inertia_boxes
from mjx_revolve.inputs.errors import InputError, note
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.water.drag import drags_whole_bodies, find_drag_law
from mjx_revolve.water.mujoco_drag import ELLIPSOID, INERTIA_BOX
from mjx_revolve.water.world import World


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot in its world; tables and models are made at first use.

    Attributes:
        morphology: the tree of modules that it is built from.
        world: the water around it.
        edited_model: MuJoCo's model as a user has edited it, from `with_model`; None as built.
        edited_spec: the editable form of it, where there is one.
    """

    morphology: Morphology
    world: World
    edited_model: mujoco.MjModel | None = field(default=None, repr=False)
    edited_spec: mujoco.MjSpec | None = field(default=None, repr=False)

    def __reduce__(self) -> Any:
        """Pickles body, world and edited model; tables are made anew. A spec cannot be pickled."""
        return Robot, (self.morphology, self.world, self.edited_model)

    def with_model(self, model: mujoco.MjSpec | mujoco.MjModel) -> Robot:
        """The robot with an edited MuJoCo model: other masses, inertias, hinges and servos.

        Both engines use these numbers. The tables of water and contact points follow from the
        modules' shapes and are not changed; so an edit must not change bodies, hinges' positions
        and axes, thrusters, timestep or gravity. A hinge that it frees of its limits has no end
        stop, and modules that meet only beyond the range as built do not push each other apart.

        Args:
            model: `mj_spec` or a copy of `mj_model`, edited.

        Returns:
            A new robot; this one is not changed.

        Raises:
            InputError: MuJoCo refuses the model, or something else was edited.
        """
        spec = model.copy() if isinstance(model, mujoco.MjSpec) else None
        try:
            edited = copy.copy(model) if spec is None else spec.compile()
        except ValueError as error:
            reason = str(error).splitlines()[0]
            raise InputError(
                f"model of {self.morphology.name!r}: expected one that MuJoCo can compile; found: "
                f"{reason}"
            ) from None
        check_edit(edited, self.mj_model, str(self.morphology.name))
        return Robot(self.morphology, self.world, edited, spec)

    @cached_property
    def assembly(self) -> Assembly:
        """Its moving bodies and hinges; the single source of numbers for every engine."""
        built = assemble([self.morphology], self.world)
        if self.edited_model is None:
            return built
        return edited_assembly(built, self.edited_model, self.servos)

    @property
    def fluid(self) -> FluidTable:
        """Per-part tables."""
        return self.assembly.fluid

    @cached_property
    def _compiled(self) -> tuple[mujoco.MjSpec | None, mujoco.MjModel, bytes]:
        """The spec, the model, and the model's bytes before any edit in place."""
        if self.edited_model is None:
            spec, model = compile_model(self.assembly)
        else:
            spec, model = self.edited_spec, self.edited_model
        return spec, model, _bytes_of(model)

    @property
    def mj_spec(self) -> mujoco.MjSpec:
        """A copy of the editable MuJoCo model; edit it and give it to `with_model`.

        Raises:
            InputError: the robot has the model of an `MjModel`, which has no editable form.
        """
        spec = self._compiled[0]
        if spec is None:
            expected = "a robot as built, or from with_model(spec)"
            found = "one from with_model(model) or from another process"
            raise InputError(f"mj_spec of {self.morphology.name!r}", expected, found)
        return spec.copy()

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model, to be read. Its own fluid (`opt.density`, `opt.viscosity`) is off.

        To change it, edit `mj_spec` or a copy and use `with_model`. An edit in place counts from
        the next engine on, with a warning (for one more release).
        """
        return self._compiled[1]

    def as_edited(self) -> Robot:
        """The robot with what was edited in place in `mj_model`; itself if nothing was.

        Raises:
            InputError: more was edited than `with_model` takes.
        """
        if "_compiled" not in self.__dict__:
            return self
        _, model, before = self._compiled
        now = _bytes_of(model)
        if now == before:
            return self
        found, edited = self.__dict__.get("_edited_in_place", (b"", self))
        if found != now:
            warnings.warn(
                f"mj_model of {self.morphology.name!r} was edited in place: edit a copy "
                "(copy.copy(robot.mj_model)) and use robot.with_model(model)",
                DeprecationWarning,
                stacklevel=3,
            )
            edited = Robot(self.morphology, self.world).with_model(model)  # checked as built
            self.__dict__["_edited_in_place"] = now, edited
        return edited

    @cached_property
    def mjx_model(self) -> Any:
        """The model on JAX's default device (`mujoco.mjx.Model`)."""
        return import_mjx().put_model(self.mj_model)

    @property
    def contact_body(self) -> np.ndarray:
        """`[npoint]` body of each point that may touch the bed."""
        return self.assembly.points[0]

    @property
    def contact_position(self) -> np.ndarray:
        """`[npoint, 3]` the point, body frame [m]."""
        return self.assembly.points[1]

    @cached_property
    def servos(self) -> tuple[int, ...]:
        """Actuators of the model that turn hinges, in the order of the modules."""
        return tuple(k for k, hinge in enumerate(self._actuators) if hinge)

    @cached_property
    def thrusters(self) -> tuple[int, ...]:
        """Actuators of the model that are thrusters, in the order of the modules."""
        return tuple(k for k, hinge in enumerate(self._actuators) if not hinge)

    @property
    def _actuators(self) -> list[bool]:
        """Which actuators turn hinges; they stand in the order of the modules."""
        found: list[bool] = []
        for module in self.morphology.modules:
            found += [True] * (module.kind.hinge is not None)
            found += [False for part in module.kind.parts if part.thruster is not None]
        return found

    @property
    def thruster_row(self) -> tuple[int, ...]:
        """Row of the fluid table of each thruster's part."""
        return tuple(self.assembly.thruster_row.tolist())

    @property
    def thruster_part(self) -> tuple[Part, ...]:
        """Each thruster's part."""
        return self.assembly.thruster_part

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
        return np.eye(1, 7 + self.num_hinges, 3)[0]

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


def _bytes_of(model: mujoco.MjModel) -> bytes:
    """The model, binary, without what concerns MuJoCo's own steps only."""
    model = copy.copy(model)
    model.opt.density = model.opt.viscosity = model.opt.integrator = model.opt.enableflags = 0
    model.opt.wind[:] = 0.0
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def import_mjx() -> Any:
    """The module `mujoco.mjx`, imported late because it is slow, without its lines about Warp.

    Raises:
        InputError: it is not installed.
    """
    check_package("engine: mjx", "mujoco.mjx")
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def build_robot(morphology: Morphology, world: World) -> Robot:
    """A robot: a body in a world.

    Args:
        morphology: the robot's modules.
        world: the water, and the bed if there is one.

    Returns:
        The robot.

    Raises:
        InputError: MuJoCo refuses the model (a massless moving part, say).
    """
    robot = Robot(morphology, world)
    kinds = {id(module.kind): module.kind for module in morphology.modules}
    if not all(map(_is_sound, kinds.values())):
        _ = robot.mj_model  # raises where MuJoCo refuses it
    _note_soft_bed(morphology, world)
    if world.drag in (INERTIA_BOX.name, ELLIPSOID.name):
        _note_factors(kinds.values(), world)
    return robot


def _note_factors(kinds: Iterable[ModuleType], world: World) -> None:
    """A remark where parts have factors on drag, which MuJoCo's laws take as they are."""
    parts = (part for kind in kinds for part in kind.parts if part.drag is None)
    found = {name for part in parts for name, _ in part.factors} - _OF_ADDED_MASS
    for name in sorted(found):
        note(f"factors on {name} have no effect: drag: {world.drag} is MuJoCo's, as it is")


# Factors that all drag laws leave to what parts carry.
_OF_ADDED_MASS = {"added_mass", "added_mass_coefficient", "entrained_water"}


def _note_soft_bed(morphology: Morphology, world: World) -> None:
    """A remark where a robot on four corners sinks into the bed by a tenth of its largest box."""
    bed, weight = world.bed, world.gravity * (morphology.mass - world.density * morphology.volume)
    height = max(min(part.boxes[0].size) for m in morphology.modules for part in m.kind.parts)
    if bed is not None and bed.contact == "penalty" and weight / 4 > 0.1 * height * bed.stiffness:
        # A power of ten: bodies of one evolution, each of another weight, are noted once.
        enough = 10.0 ** math.ceil(math.log10(weight / (0.04 * height)))
        note(
            f"{morphology.name}: sinks by more than a tenth of its largest box into a bed of "
            f"{bed.stiffness:g} N/m, on four corners: set bed.stiffness to {enough:g} N/m or more"
        )


# Least mass [kg] and inertia [kg·m²] of a moving body for MuJoCo (mjMINVAL).
_MIN_MASS = 1e-15


def _is_sound(kind: ModuleType) -> bool:
    """Whether MuJoCo takes bodies of such modules, whatever they carry."""
    jointed = kind.hinge is not None
    if jointed + sum(part.thruster is not None for part in kind.parts) > 1:
        return False  # two actuators of one name
    if kind.mount is not None and not jointed:
        return True
    return any(map(_is_heavy, kind.parts[1:] if jointed else kind.parts))


def _is_heavy(part: Part) -> bool:
    """Whether its main box alone makes a body heavy enough."""
    x, y, _ = sorted(part.boxes[0].size)
    return part.mass > _MIN_MASS and part.mass / 12 * (x * x + y * y) > _MIN_MASS


def export_mjcf(robot: Robot, path: str | Path) -> None:
    """Writes the model that the engines step as MJCF that stock MuJoCo opens, without any water.

    `formats.mjcf.make_mjcf`, which run folders and `mjx_revolve.export` have, adds MuJoCo's own
    water, meshes and a start.

    Args:
        robot: the robot.
        path: the XML file to write.
    """
    Path(path).write_text(robot.mj_spec.to_xml(), encoding="utf-8")


# The speed at which a law that a step takes explicitly must still be stable [m/s]; servos, weight
# and currents lead to a few tenths.
_REFERENCE_SPEED = 1.0


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
        InputError: the bed's contact is not the engine's, or self-contact of modules that can
            meet; or the step is too long, and the message names the body and the largest stable
            step.
    """
    bed = robot.world.bed
    if bed is not None and bed.contact == "mjx" and engine != "mjx":
        found = "'mjx' (choose engine: mjx, or contact: penalty)"
        raise InputError("bed.contact", f"'penalty' with engine: {engine}", found)
    meeting = robot.assembly.meeting_pairs
    if len(meeting) and engine == "mjx":
        rows = robot.fluid.module[meeting[0]]
        first, second = (robot.morphology.modules[k].name for k in rows)
        raise InputError(
            "self_contact: expected false with engine: mjx, which has no such contact, as modules "
            f"{first!r} and {second!r} can meet; found true (choose engine: population)"
        )
    table, world, assembly = robot.fluid, robot.world, robot.assembly
    explicit = np.array([find_drag_law(name).explicit for name in table.drag])
    if drags_whole_bodies(world.drag):
        areas = np.sort(inertia_boxes(assembly)[0])[:, 1:].prod(1)
    else:
        areas = np.bincount(table.body, explicit * table.face_area.max(-1), len(assembly.mass))
    longest: list[tuple[float, float, str]] = []
    for body in np.unique(table.body[explicit]):
        rows = explicit & (table.body == body)
        mass = assembly.mass[body] + world.density * table.carried_mass[rows].min(-1).sum()
        # Twice ½ C_d A v, the derivative of the force by the speed: both laws have a C_d of 1,
        # whatever the parts' coefficients are.
        derivative = world.density * areas[body] * _REFERENCE_SPEED
        longest.append((2 * mass / max(derivative, 1e-30), mass, assembly.names[body]))
    most, mass, name = min(longest, default=(np.inf, 0.0, ""))
    if world.timestep > most:
        digit = 10.0 ** (np.floor(np.log10(most)) - 1)
        raise InputError(
            f"timestep: expected at most {digit * np.floor(most / digit):.2g} s, as drag: "
            f"{world.drag} is explicit and body {name!r} of {mass:.3g} kg is light; found "
            f"{world.timestep:g} s (drag: faces bears any step)"
        )
