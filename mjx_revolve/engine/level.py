"""The constants of a step: bodies that move together, as pytrees of numbers.

A `Level` holds some bodies with their hinges, their parts and their contact points. In the step of
one robot it is a level of its tree, and its numbers are Python floats or NumPy arrays that fold
away while the step is traced; in the step of many different robots it is a row of theirs, one body
of each, and its numbers are arrays with the population on the last axis.

Each moving body's frame is turned so that its hinge is its z axis, which makes the joint's motion
subspace constant (Featherstone 2008, Rigid Body Dynamics Algorithms, § 4.4).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.spatial import Mat, Scalar, Sym, Vec, is_present
from mjx_revolve.water.added_mass import CarriedWater
from mjx_revolve.water.buoyancy import find_buoyancy_law
from mjx_revolve.water.drag import OFF, find_drag_law
from mjx_revolve.water.laws import PartDragLaw, law_numbers, part_field

# Why no factor of `Variation` multiplies a number.
_SHAPE = "the robot's shape, which is known"
_MEASURED = "thrusters keep their curves, which are measured"
_INSIDE = "its own fields say"


class DragBound(NamedTuple):
    """Sums over all parts of a body, which bound the gradient of its drag; body frame.

    They belong to the body as a whole, however its parts are shared out among rows. No factor of
    `Variation` multiplies them: bounds have a margin.

    Attributes:
        steep: Σ s of the parts' s, bounds of the gradient over the speed [kg/m]; next to endless
            without a bound.
        moment: Σ s x with the centres x of the parts' boxes [kg].
        inertia: Σ s (x² 1 - x xᵀ) [kg·m].
        corners: Σ s r with half the diagonals r of the boxes [kg].
        mass: of the body, with the least that the water which its parts carry weighs; less for a
            body that turns easily for its mass [kg].
    """

    steep: Scalar
    moment: Vec
    inertia: Sym
    corners: Scalar
    mass: Scalar


class PartLaws(NamedTuple):
    """What parts of one group have in common.

    Attributes:
        buoyancy: name of the buoyancy law.
        drag: name of the drag law.
        pushes: whether they are thrusters.
        coupled: whether they may carry more water than a diagonal in their axes, as stated.
        stated: whether they state the water that they carry.
    """

    buoyancy: str
    drag: str
    pushes: bool = False
    coupled: bool = False
    stated: bool = False

    @property
    def idle(self) -> bool:
        """Whether nothing acts on such parts, unless they carry water along."""
        lifts = find_buoyancy_law(self.buoyancy).lifts
        return not (lifts or self.pushes) and find_drag_law(self.drag) is OFF

    @property
    def memory(self) -> int:
        """How many numbers their drag law keeps of the past for each part."""
        law = find_drag_law(self.drag)
        return law.memory if isinstance(law, PartDragLaw) else 0


class Hinges(NamedTuple):
    """Of the hinges that carry the bodies of a level, `[nbody, lanes]` or a number each.

    Attributes:
        rotation: parent from child where the hinge stands at the angle `-offset`; the same for all
            hinges that point the same way, so that it mostly folds away.
        offset: cosine and sine of the angle that is added to the joint angle [-].
        position: of the joint in the parent's frame [m].
        armature: [kg·m²].
        damping: passive [N·m·s/rad].
        gain: of the servo, per target angle [N·m/rad].
        stiffness: of the servo, per joint angle [N·m/rad].
        implicit_stiffness: the part of it that acts on the angle at the end of the step
            [N·m/rad].
        servo_damping: of the servo, per joint speed [N·m·s/rad].
        effort: torque limits of the servo, low and high [N·m].
        target: limits of the servo's target, low and high [rad].
        range: limits of the joint, low and high [rad].
        stop: stiffness of the end stops [N·m/rad].
        motor: the line between speed and torque near the top speed, far above any torque where
            a servo has none: torque at the top speed [N·m], gradient [N·m·s/rad], top speed
            [rad/s].
        base_inertia: of all that is on the parent's side of the hinge, about its axis, at rest
            [kg·m²].
        lever: how far boxes of the robot can move for each radian, one seen from another [m]; 0
            where modules do not meet.
    """

    rotation: Mat
    offset: tuple[Scalar, Scalar]
    position: Vec
    armature: Scalar
    damping: Scalar
    gain: Scalar
    stiffness: Scalar
    implicit_stiffness: Scalar
    servo_damping: Scalar
    effort: tuple[Scalar, Scalar]
    target: tuple[Scalar, Scalar]
    range: tuple[Scalar, Scalar]
    stop: Scalar
    motor: tuple[Scalar, Scalar, Scalar]
    base_inertia: Scalar
    lever: Scalar


class InertiaBox(NamedTuple):
    """Of MuJoCo's inertia-box law, `[nbody, lanes]` or a number each.

    Attributes:
        rotation: body from inertial frame.
        position: centre of mass, body frame [m].
        size: edges of the box of equal inertia [m].
    """

    rotation: Mat
    position: Vec
    size: Vec


@law_numbers
class ThrusterMounts:
    """Where thrusters push, `[npart, nbody, lanes]` or a number each.

    Attributes:
        which: of the robot's thrusters, -1 for none; whole numbers.
        axis: of the thrust, unit vector in the body's frame.
        position: where it pushes, body frame [m].
        torque_ratio: reaction torque per thrust [m].
    """

    which: Any = part_field("-", blank=-1, fixed=_MEASURED)
    axis: Vec = part_field("-", fixed=_MEASURED)
    position: Vec = part_field("m", fixed=_MEASURED)
    torque_ratio: Scalar = part_field("m", fixed=_MEASURED)


@law_numbers
class Parts:
    """Those parts of the bodies of a level that obey the same laws.

    `[npart, nbody, lanes]` or a number each, in the bodies' frames; None where no law reads it. A
    part that stands square on its body is described along the body's axes, so that its rotation
    folds away. This is the one list of a part's numbers; each law adds its own.

    Attributes:
        laws: which they obey.
        count: npart, how many a body has.
        position: centre of the box [m].
        rotation: body from the axes that describe the part.
        half_size: half edges of the box [m].
        center_position: centre of the displaced volume [m].
        volume: displaced [m³].
        bulk: volume of the box [m³], for drag laws of whole bodies.
        exposed: share of each pair of faces that the water reaches [-], for surface tension.
        drag: numbers of their drag law; in `StepConstants`, those of all laws by name.
        carried: the water that they carry along.
        mounts: where thrusters push.
    """

    laws: PartLaws
    count: int
    position: Vec = part_field("m", fixed=_SHAPE)
    rotation: Mat = part_field("-", blank=np.eye(3), fixed=_SHAPE)
    half_size: Vec = part_field("m", axes="size", blank=1.0, fixed=_SHAPE)
    center_position: Vec = part_field("m", fixed=_SHAPE)
    volume: Scalar = part_field("m3", varied=("density",))
    bulk: Any = part_field("m3", fixed=_SHAPE, default=None)
    exposed: Any = part_field("-", axes="size", fixed=_SHAPE, default=None)
    drag: Any = part_field("-", fixed=_INSIDE, default=None)
    carried: CarriedWater | None = part_field("-", fixed=_INSIDE, default=None)
    mounts: ThrusterMounts | None = part_field("-", fixed=_INSIDE, default=None)

    @property
    def carries(self) -> bool:
        """Whether any of them may carry water along."""
        return self.carried is not None and any(
            map(is_present, jax.tree.leaves(self.carried.inertia))
        )

    @property
    def saves(self) -> bool:
        """Whether a step leaves something of them to the next one."""
        return self.carries or self.laws.memory > 0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Points:
    """What may touch the bed, `[npoint, nbody, lanes]` or a number each.

    Attributes:
        count: npoint, how many a body has.
        position: body frame [m].
        mass: each point's share of its body's mass [kg]; 0 for padding.
        fall: acceleration at which its body or the robot would begin to sink in water [m/s²].
    """

    count: int = field(metadata={"static": True})
    position: Vec
    mass: Scalar
    fall: Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shells:
    """Boxes that may meet others of the same robot, `[nshell, nbody, lanes]` or a number each.

    Attributes:
        count: nshell, how many a body has.
        position: of their centres, body frame [m].
        rotation: body from box.
        half_size: half edges [m].
    """

    count: int = field(metadata={"static": True})
    position: Vec
    rotation: Mat
    half_size: Vec


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Level:
    """Bodies that move together, `[nbody, lanes]` or a number each.

    Attributes:
        count: nbody, how many they are.
        hinges: that carry them; None for the root.
        mass: [kg].
        moment: mass times centre of mass, body frame [kg·m].
        inertia: about the body's origin [kg·m²].
        box: for MuJoCo's inertia-box law, else None.
        bound: of the drag's gradient.
        parts: what the water acts on, in groups that obey the same laws.
        points: what may touch the bed, or None.
        shells: what may meet other bodies of the same robot, or None.
    """

    count: int = field(metadata={"static": True})
    hinges: Hinges | None
    mass: Scalar
    moment: Vec
    inertia: Sym
    box: InertiaBox | None
    bound: DragBound
    parts: tuple[Parts, ...]
    points: Points | None
    shells: Shells | None = None

    def at_first(self, axes: int, shape: tuple[int, ...], dtype: Any) -> tuple[jax.Array, ...]:
        """`State.submerged` of groups wholly under water, without a past; `[n, *shape]` each.

        Args:
            axes: how many shares a part has that carries water along.
            shape: behind the parts.
            dtype: of the numbers.
        """
        found = []
        for parts in self.parts:
            wet, past = axes * parts.count * parts.carries, parts.count * parts.laws.memory
            first = [jnp.ones((wet, *shape), dtype)] if wet else []
            first += [jnp.zeros((past, *shape), dtype)] if past else []
            found += [jnp.concatenate(first) if past and wet else first[0]] if first else []
        return tuple(found)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Thrusters:
    """The thrusters of a robot, `[nthruster, lanes]` each.

    Attributes:
        count: nthruster.
        low: least command [-].
        high: greatest command [-].
        kept: share of a command behind its lag that is still there after a step [-].
        delayed: whether there is a lag.
        backward: thrust per command squared, astern [N].
        forward: thrust per command squared, ahead [N].
        dead_low: lower end of the dead band [-].
        dead_high: its upper end [-].
        line: (commands, thrusts, whether the curve is such a broken line), points on the first
            axis; None where no thruster has one.
        disc: area of the propeller's disc [m²].
    """

    count: int = field(metadata={"static": True})
    low: Any
    high: Any
    kept: Any
    delayed: Any
    backward: Any
    forward: Any
    dead_low: Any
    dead_high: Any
    line: Any
    disc: Any
