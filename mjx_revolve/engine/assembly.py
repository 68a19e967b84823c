"""Moving bodies and hinges of robots as arrays: what their MuJoCo models and their tables share.

Modules that are welded together are one moving body. All robots of a batch are assembled at once,
one behind the other, which costs little more than a single one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjx_revolve.body.module_types import Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.placement import Module, RestPose, rest_pose, turned
from mjx_revolve.engine.fluid_table import FluidTable, make_fluid_table
from mjx_revolve.engine.self_pairs import hinge_stops, meeting_pairs
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.water.drag import is_extrapolated
from mjx_revolve.water.world import World

# Error at which the servo gives its full torque [rad]. A choice: hobby servos are stiff.
FULL_TORQUE_ERROR = 0.05
# Share of the servo's effort that its gears' viscous friction takes at the speed limit [-]. A
# choice; it is also what damps the servo, which has no velocity gain of its own.
FRICTION = 1 / 5
# Share of the explicit springs with which a free robot at rest rings for ever that a step takes; in
# other poses up to a tenth less rings. A choice.
_CALM = 0.9
# A ballast is a point mass; MuJoCo needs some size, and a millimetre adds no inertia [m].
BALLAST_RADIUS = 1e-3


@dataclass(frozen=True, eq=False)
class Assembly:
    """Robots as moving bodies, at rest: hinges at 0, each core at the origin of its own frame.

    Moving bodies stand in preorder, those of one robot after those of another; 0 is the world. For
    a robot by itself these are MuJoCo's numbers. NumPy arrays.

    Attributes:
        morphologies: of the robots.
        world: around them.
        layout: their parts at rest.
        roots: `[robots]` the bodies that hold the cores; the hinges' bodies follow theirs in the
            order of the modules.
        robot: `[nbody]` the robot of each body, -1 for the world.
        names: `[nbody]` of the modules that the bodies are called after.
        parent: `[nbody]` bodies that carry them, 0 for roots.
        end: `[nbody]` behind the last body of each one's subtree.
        position: `[nbody, 3]` of the body's frame, core frame [m]: hinges lie at its origin.
        rotation: `[nbody, 3, 3]` core frame from body frame.
        mass: `[nbody]` [kg].
        center: `[nbody, 3]` centre of mass, body frame [m].
        inertia: `[nbody, 3, 3]` about it, body frame [kg·m²].
        axis: `[nbody, 3]` of the hinge, unit vector in the body's frame; anything for roots, as
            below.
        range: `[nbody, 2]` lowest and highest angle [rad].
        effort: `[nbody]` largest torque of the servo [N·m].
        speed: `[nbody]` its top speed [rad/s].
        damping: `[nbody]` friction of the hinge [N·m·s/rad].
        stiffness: `[nbody]` of the servo [N·m/rad].
        implicit_stiffness: `[nbody]` the part of it that is too stiff for an explicit step of the
            limb or the robot [N·m/rad].
        fluid: tables of the parts.
        thruster_row: `[nthruster]` their parts.
        inertia_axes: `[nbody, 3, 3]` principal axes, body frame, as an edited model gives them;
            None as built.
    """

    __repr__ = short_repr

    morphologies: tuple[Morphology, ...]
    world: World
    layout: RestPose
    roots: np.ndarray
    robot: np.ndarray
    names: tuple[str, ...]
    parent: np.ndarray
    end: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    mass: np.ndarray
    center: np.ndarray
    inertia: np.ndarray
    axis: np.ndarray
    range: np.ndarray
    effort: np.ndarray
    speed: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    implicit_stiffness: np.ndarray
    fluid: FluidTable
    thruster_row: np.ndarray
    inertia_axes: np.ndarray | None = None

    @cached_property
    def stops(self) -> np.ndarray:
        """`[nbody, 2]` where hinges end: their range, or where their own neighbours meet [rad]."""
        return hinge_stops(self) if self.world.self_contact else self.range

    @cached_property
    def meeting_pairs(self) -> np.ndarray:
        """`[pairs, 2]` parts of one robot that can meet; see `self_pairs.meeting_pairs`."""
        return meeting_pairs(self) if self.world.self_contact else np.zeros((0, 2), int)

    def with_split_springs(self, armature: float | np.ndarray = 0.0) -> Assembly:
        """The same with the implicit part of each servo's spring, from its hinge and its robot.

        MuJoCo's Euler step takes the servo's spring explicitly and the joint's friction d
        implicitly; with its parent held still, a limb is well damped while k dt² is at most 1.7
        (I + d dt). But nothing holds a robot: where what carries limbs is light, they swing
        against it with less inertia than their own. The hinges of a free robot ring for ever
        unless K dt² is less than 4 M + 2 D dt, with M the inertia that hinges move, all of them
        free and dry, as limbs may leave the water. Drag that is extrapolated explicitly feeds what
        rings in a few steps, so that springs are taken implicitly earlier there; a choice: with
        less nothing is won.

        Args:
            armature: `[nbody]` of the hinges [kg·m²].
        """
        about = self.inertia + _steiner(self.mass, self.center)
        inertia = np.sum(self.axis * turned(about, self.axis), 1) + armature
        dt, share = self.world.timestep, 0.5 if is_extrapolated(self.world.drag) else 1.7
        most = share * (inertia / dt**2 + self.damping / dt)
        explicit = np.minimum(self.stiffness, most)
        for root in self.roots:
            hinges = slice(root + 1, self.end[root])
            more = 4 * armature / dt**2 + 2 * self.damping / dt
            bound = 4 * hinge_inertias(self, root) / dt**2 + np.diag(more[hinges])
            rings = np.linalg.eigvals(np.linalg.solve(bound, np.diag(explicit[hinges])))
            explicit[hinges] *= _CALM / np.max(rings.real, initial=_CALM)
        return replace(self, implicit_stiffness=self.stiffness - explicit)

    @property
    def modules(self) -> list[Module]:
        """The modules of all robots."""
        return [module for body in self.morphologies for module in body.modules]

    @property
    def moved(self) -> np.ndarray:
        """`[nhinges]` the bodies that hinges carry."""
        return np.flatnonzero(self.parent)

    @property
    def thruster_part(self) -> tuple[Part, ...]:
        """Each thruster's part."""
        return tuple(self.layout.parts[k] for k in self.layout.kind[self.thruster_row])

    def from_parents(self) -> tuple[np.ndarray, np.ndarray]:
        """`[nbody, 3]` positions [m] and `[nbody, 3, 3]` rotations in the parents' frames."""
        up = self.rotation[self.parent].swapaxes(1, 2)
        return turned(up, self.position - self.position[self.parent]), up @ self.rotation

    @property
    def touching(self) -> np.ndarray:
        """`[npart]` whether a part touches anything."""
        return np.array([part.contact for part in self.layout.parts], bool)[self.layout.kind]

    @property
    def point_part(self) -> np.ndarray:
        """`[npoint]` the part of which each point is a corner."""
        return np.repeat(np.flatnonzero(self.touching), 8)

    @property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """`[npart, 3]` the way to each part's right, and `[npart]` its middle along that way [m].

        To the right of the way in which its module is attached, z up; a core looks along its y.
        Body frame.
        """
        layout, table, mounts = self.layout, self.fluid, [m.kind.mount for m in self.modules]
        ways = [(0.0, 1.0, 0.0) if mount is None else mount.outward for mount in mounts]
        right = np.cross(ways, (0.0, 0.0, 1.0))[layout.module]
        middle = table.position + turned(table.rotation, (layout.low + layout.high) / 2)
        right = turned(table.rotation, right)
        return right, (right * middle).sum(1)

    @property
    def point_right(self) -> np.ndarray:
        """`[npoint]` whether the points lie in the right half of their part."""
        (right, middle), part = self.halves, self.point_part
        return np.asarray((right[part] * self.points[1]).sum(1) > middle[part])

    @cached_property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """`[npoint]` body of each point that may touch the bed; `[npoint, 3]` body frame [m]."""
        layout, table, touching = self.layout, self.fluid, self.touching
        corners = layout.corners()[touching] @ table.rotation[touching].swapaxes(1, 2)
        place = table.position[touching, None] + corners
        return np.repeat(table.body[touching], 8), place.reshape(-1, 3)


def hinge_inertias(assembly: Assembly, root: int) -> np.ndarray:
    """`[n, n]` what the n hinges of a robot move at rest, its core free [kg·m²].

    The mass matrix without water, less what the core's own motion takes: Schur's complement.

    Args:
        assembly: of the robot.
        root: the body that holds its core.
    """
    own = slice(root, assembly.end[root])
    place, turn = assembly.position[own], assembly.rotation[own]
    center = place + turned(turn, assembly.center[own])
    # Spatial inertias about the core's origin, of each body and of its subtree, a run of bodies.
    x = np.cross(np.eye(3), center[:, None])
    linear = assembly.mass[own, None, None] * np.eye(3)
    angular = turn @ assembly.inertia[own] @ turn.swapaxes(1, 2) - x @ linear @ x
    each = np.block([[angular, x @ linear], [(x @ linear).swapaxes(1, 2), linear]])
    first, last = np.arange(len(place)), assembly.end[own] - root
    until = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(each, 0)])
    below = until[last] - until[first]
    spin = turned(turn, assembly.axis[own])
    moves = np.concatenate([spin, np.cross(place, spin)], 1)[1:]
    momentum = turned(below[1:], moves)
    carries = (first[:, None] <= first) & (first < last[:, None])
    upper = np.where(carries[1:, 1:], moves @ momentum.T, 0.0)
    whole = upper + np.triu(upper, 1).T
    return whole - momentum @ np.linalg.solve(below[0], momentum.T)


def assemble(morphologies: Sequence[Morphology], world: World) -> Assembly:
    """Assembles robots in a world.

    Args:
        morphologies: their bodies.
        world: the water.

    Returns:
        The assembly.
    """
    modules = [module for body in morphologies for module in body.modules]
    below: list[int] = []  # the moving body that each module is fixed to
    above: list[int] = []  # the one that carries its children
    parent, named, robot, roots = [0], [-1], [-1], []
    for r, morphology in enumerate(morphologies):
        first = len(above)
        roots.append(len(parent))
        for k, module in enumerate(morphology.modules, first):
            carrier = 0 if module.parent < 0 else above[first + module.parent]
            moves = module.parent < 0 or module.kind.hinge is not None
            above.append(len(parent) if moves else carrier)
            below.append(above[-1] if module.parent < 0 else carrier)
            if moves:
                parent.append(carrier)
                named.append(k)
                robot.append(r)
    end = list(range(1, len(parent) + 1))
    for k in reversed(range(1, len(parent))):
        end[parent[k]] = max(end[parent[k]], end[k])
    layout = rest_pose(*(body.modules for body in morphologies))
    # Of a module with a hinge, the first part stays with what it is attached to.
    stays = np.append(True, np.diff(layout.module) > 0)
    body = np.where(stays, np.array(below)[layout.module], np.array(above)[layout.module])
    hinges = [modules[k].kind.hinge if p else None for k, p in zip(named, parent, strict=True)]
    anchor = np.array([(0.0, 0.0, 0.0) if h is None else h.anchor for h in hinges])
    rotation = np.array([np.eye(3), *(modules[k].rotation for k in named[1:])])
    position = np.array([np.zeros(3), *(modules[k].position for k in named[1:])])
    position += turned(rotation, anchor)
    back = rotation[body].swapaxes(1, 2)
    place = turned(back, layout.position - position[body])
    turn = back @ layout.rotation
    mass, center, inertia = _weigh(layout, body, place, turn, len(parent))
    effort = np.array([1.0 if h is None else h.effort for h in hinges])
    speed = np.array([1.0 if h is None else h.speed for h in hinges])
    axis = np.array([(0.0, 0.0, 1.0) if h is None else h.axis for h in hinges])
    damping = FRICTION * effort / speed
    stiffness = effort / FULL_TORQUE_ERROR
    pushing = np.array([part.thruster is not None for part in layout.parts])[layout.kind]
    return Assembly(
        morphologies=tuple(morphologies),
        world=world,
        layout=layout,
        roots=np.array(roots),
        robot=np.array(robot),
        names=("world", *(modules[k].name for k in named[1:])),
        parent=np.array(parent),
        end=np.array(end),
        position=position,
        rotation=rotation,
        mass=mass,
        center=center,
        inertia=inertia,
        axis=axis,
        range=np.array([(0.0, 0.0) if h is None else h.range for h in hinges]),
        effort=effort,
        speed=speed,
        damping=damping,
        stiffness=stiffness,
        implicit_stiffness=np.zeros(len(parent)),
        fluid=make_fluid_table(layout, body, place, turn, world),
        thruster_row=np.flatnonzero(pushing),
    ).with_split_springs()


def _weigh(
    layout: RestPose, carrier: np.ndarray, place: np.ndarray, turn: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about it of moving bodies, from their parts."""
    parts, kind = layout.parts, layout.kind
    ballast = np.array([part.ballast_mass for part in parts])
    box = np.array([part.mass for part in parts])
    at = np.array([part.ballast_position for part in parts], float)
    own = np.array([part.center_of_mass for part in parts], float)
    square = np.array([part.boxes[0].size for part in parts]) ** 2
    around = box[:, None] / 12 * (square.sum(1, keepdims=True) - square)
    around += 2 / 5 * BALLAST_RADIUS**2 * ballast[:, None]
    inertias = around[:, None] * np.eye(3) + _steiner(box, own) + _steiner(ballast, at - own)

    def total(x: np.ndarray) -> np.ndarray:
        columns = x.reshape(len(x), -1).T
        found = [np.bincount(carrier, column, count) for column in columns]
        return np.stack(found, -1).reshape(count, *x.shape[1:])

    weight = (box + ballast)[kind]
    middle = place + turned(turn, own[kind])
    mass = total(weight)
    center = total(weight[:, None] * middle) / np.where(mass == 0, 1.0, mass)[:, None]
    inertia = turn @ inertias[kind] @ turn.swapaxes(1, 2)
    return mass, center, total(inertia + _steiner(weight, middle - center[carrier]))


def _steiner(mass: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """`[n, 3, 3]` inertias of point masses at `[n, 3]` arms."""
    square = np.sum(arm**2, 1)[:, None, None] * np.eye(3)
    return mass[:, None, None] * (square - arm[:, :, None] * arm[:, None])
