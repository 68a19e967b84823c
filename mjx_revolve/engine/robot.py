"""A robot: a body and the world around it, and what follows from the two when somebody asks."""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.body.module_types import ModuleType, Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.engine.assembly import Assembly, assemble
from mjx_revolve.engine.fluid_table import FluidTable
from mjx_revolve.engine.mujoco_model import compile_model
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.world import World


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot in its world; tables and models are made at first use.

    Attributes:
        morphology: the tree of modules that it is built from.
        world: the water around it.
    """

    morphology: Morphology
    world: World

    def __reduce__(self) -> Any:
        """What it is made of; what follows from that is made anew."""
        return Robot, (self.morphology, self.world)

    @cached_property
    def assembly(self) -> Assembly:
        """Its moving bodies and hinges; the single source of numbers for every engine."""
        return assemble([self.morphology], self.world)

    @property
    def fluid(self) -> FluidTable:
        """Per-part tables."""
        return self.assembly.fluid

    @cached_property
    def _model(self) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
        return compile_model(self.assembly)

    @property
    def is_compiled(self) -> bool:
        """Whether MuJoCo's model was made, and may have been changed by hand."""
        return "_model" in self.__dict__

    @property
    def mj_spec(self) -> mujoco.MjSpec:
        """The editable MuJoCo model."""
        return self._model[0]

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model. Its own fluid (`opt.density`, `opt.viscosity`) is off.

        Masses, inertias, hinges and servos may be changed in it before an engine is made of the
        robot; batches of many robots take bodies as they are built.
        """
        return self._model[1]

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
        return [
            hinge
            for module in self.morphology.modules
            for hinge in (
                *((True,) if module.kind.hinge is not None else ()),
                *(False for part in module.kind.parts if part.thruster is not None),
            )
        ]

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


def import_mjx() -> Any:
    """MJX, imported late because it is slow, and without the lines that it prints about Warp.

    Returns:
        The module `mujoco.mjx`.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def build_robot(morphology: Morphology, world: World) -> Robot:
    """Puts a body into a world.

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
        _ = robot.mj_model  # MuJoCo says what it makes of it
    return robot


# Least mass [kg] and inertia [kg·m²] of a moving body for MuJoCo (mjMINVAL).
_LEAST = 1e-15


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
    return part.mass > _LEAST and part.mass / 12 * (x * x + y * y) > _LEAST


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
    table, world, assembly = robot.fluid, robot.world, robot.assembly
    explicit = np.array([law in ("ellipsoid", "inertia_box") for law in table.drag])
    for body in np.unique(table.body[explicit]):
        rows = explicit & (table.body == body)
        mass = assembly.mass[body] + world.density * table.carried_mass[rows].min(-1).sum()
        # Twice ½ C_d A v, the slope of the force: the two laws have a C_d of 1 of their own,
        # whatever the parts' coefficients are.
        slope = world.density * table.face_area[rows].max(-1).sum() * _BRISK
        longest = 2 * mass / max(slope, 1e-30)
        if world.timestep > longest:
            raise InputError(
                f"timestep: expected at most {longest:.2g} s, as drag: {world.drag} is explicit "
                f"and body {assembly.names[body]!r} of {mass:.3g} kg is light; found "
                f"{world.timestep:g} s (drag: faces bears any step)"
            )
