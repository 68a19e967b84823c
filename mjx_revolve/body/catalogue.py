"""The catalogue of module types, and users' own.

Users add their own types in YAML with `load_modules` and merge them:
`MODULES | load_modules("my_modules.yaml")`.

Frames follow Revolve: the front of core and brick is +y, that of all others +x. Slots are
0 back (-y, where a brick is attached), 1 front (+y), 2 (+x) and 3 (-x); a hinge has slot 1 only;
sensor, thrusters and fin have none.

Sources: boxes, masses, attachment faces, offsets and the servo's limits are those of Revolve
(github.com/ci-group/revolve, `pyrevolve/revolve_bot/revolve_module.py` and the SDF it writes);
mesh volumes are those of RoboGen's meshes as the thesis tabulates them (Table 1).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from mjx_revolve.body.module_files import read_modules
from mjx_revolve.body.module_types import Box, Hinge, ModuleType, Mount, Part, Slot
from mjx_revolve.inputs.errors import reading
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.plates import Fossen, LiftDrag
from mjx_revolve.water.propellers import Thruster

# ------------------------------------------------------------------------- the catalogue


def _with_aliases(*kinds: ModuleType) -> dict[str, ModuleType]:
    return {name: kind for kind in kinds for name in (kind.name, *kind.aliases)}


def _level_slots(reach: float) -> dict[int, Slot]:
    """Revolve's numbers of the four level faces, `reach` m from the centre."""
    directions = {0: (0, -1, 0), 1: (0, 1, 0), 2: (1, 0, 0), 3: (-1, 0, 0)}
    return {
        number: Slot((reach * d[0], reach * d[1], reach * d[2]), d)
        for number, d in directions.items()
    }


_CORE_REACH = 0.0445  # Revolve: half the core's edge
_BRICK_REACH = 0.019  # Revolve: SLOT_COORDINATES; the collision box stands 1.5 mm proud of it

_CORE = ModuleType(
    name="Core",
    aliases=("CoreComponent",),  # the name in Revolve's own code
    parts=(Part("core", (Box((0.089, 0.089, 0.045)),), mass=0.0900, volume=5.054e-5),),
    slots=_level_slots(_CORE_REACH),
)

_BRICK = ModuleType(
    name="FixedBrick",
    parts=(Part("brick", (Box((0.041, 0.041, 0.0355)),), mass=0.0102, volume=1.070e-5),),
    mount=Mount((0.0, -_BRICK_REACH, 0.0), (0.0, 1.0, 0.0)),
    slots={number: slot for number, slot in _level_slots(_BRICK_REACH).items() if number != 0},
)

# Places along the hinge's x, from the centre of its frame box, as in Revolve's SDF of the spider
# (there from the core's centre, .0555 m further).
_HINGE_ANCHOR = 0.00465  # .06015 - .0555
_SERVO = 0.015525  # .071025 - .0555
_PLATE = 0.01175  # from the servo's centre: COLLISION_BOX_SERVO_2 and its translation
_FRAME_BACK = 0.011  # half the frame box
_SERVO_FRONT = _SERVO + 0.01225  # half the servo box

_HINGE = ModuleType(
    name="ActiveHinge",
    parts=(
        Part("frame", (Box((0.022, 0.03575, 0.010)),), mass=0.0017, volume=3.032e-6),
        Part(
            "servo",
            # The plate weighs nothing in Revolve; its mass is the servo holder's.
            (Box((0.0245, 0.02575, 0.015)), Box((0.001, 0.034, 0.034), (_PLATE, 0.001, 0.0))),
            mass=0.0090,
            volume=1.014e-5,
            position=(_SERVO, 0.0, 0.0),
        ),
    ),
    mount=Mount((-_FRAME_BACK, 0.0, 0.0), (1.0, 0.0, 0.0)),
    slots={1: Slot((_SERVO_FRONT, 0.0, 0.0), (1.0, 0.0, 0.0))},
    hinge=Hinge(axis=(0.0, 1.0, 0.0), anchor=(_HINGE_ANCHOR, 0.0, 0.0)),
)

# Revolve gives no pose to its touch sensor; that the thin side looks outwards is a choice. Revolve
# names a FixedBrickSensor but never implemented it; reading it as a touch sensor is a choice too.
_TOUCH_SENSOR = ModuleType(
    name="TouchSensor",
    aliases=("FixedBrickSensor",),
    parts=(Part("sensor", (Box((0.0041, 0.031, 0.0155)),), mass=0.0030, volume=2.735e-6),),
    mount=Mount((-0.00205, 0.0, 0.0), (1.0, 0.0, 0.0)),
    sensor=True,
)

# Thrusters and fin are ours: Revolve has neither. Numbers without a source below are choices.

# A ducted propeller of the hobby class, 30 mm across: half a newton, for which an ideal propeller
# takes .3 W, with a lag of .1 s. Mesh volume: a duct with a wall of 2 mm (7.0 cm³) and a motor of
# 12 × 35 mm (4.0 cm³); half of the free volume is entrained water. Reaction torque:
# K_Q / K_T of about 1/7 at standstill (Carlton, Marine Propellers and Propulsion, chapter 6) times
# a propeller of 24.5 mm.
_DUCT, _DUCT_LENGTH = 0.030, 0.040
_PROPELLER = Thruster(axis=(1.0, 0.0, 0.0), gain=0.5, time_constant=0.1, torque_ratio=0.0035)
_THRUSTER = ModuleType(
    name="Thruster",
    parts=(
        Part(
            "duct",
            (Box((_DUCT_LENGTH, _DUCT, _DUCT)),),
            mass=0.025,
            volume=1.1e-5,
            entrained_water=0.5,
            thruster=_PROPELLER,
        ),
    ),
    mount=Mount((-_DUCT_LENGTH / 2, 0.0, 0.0), (1.0, 0.0, 0.0)),
)
# The same, held at its side: it pushes across the way in which it is mounted, along its own z,
# which is up where its parent is level, or level where it is turned by ±90°.
_LIFT_THRUSTER = ModuleType(
    name="LiftThruster",
    parts=(
        replace(
            _THRUSTER.parts[0],
            boxes=(Box((_DUCT, _DUCT, _DUCT_LENGTH)),),
            thruster=replace(_PROPELLER, axis=(0.0, 0.0, 1.0)),
        ),
    ),
    mount=Mount((-_DUCT / 2, 0.0, 0.0), (1.0, 0.0, 0.0)),
)

# Blue Robotics' T200 at 16 V: thrust over (PWM - 1500 µs) / 400 µs from their Public Performance
# Data 10-20V (September 2019), every 50 µs, as the BlueROV2 node of CentraleNantesROV has it in its
# map from thrust to PWM; a propeller 76 mm across, from their bluerov2_description. Mass and
# density, 0.3603 kg and 1880 kg/m³, from Blue Robotics' documentation as quoted in
# SSModelGit/TAMU_ROVm, T200Parameters.mo. Its length, and half of its free volume as entrained
# water, are choices; a lag and a torque of the propeller were not found.
_T200_LENGTH, _T200_ACROSS = 0.088, 0.076
_T200 = ModuleType(
    name="T200",
    parts=(
        Part(
            "duct",
            (Box((_T200_LENGTH, _T200_ACROSS, _T200_ACROSS)),),
            mass=0.3603,
            volume=0.3603 / 1880,
            entrained_water=0.5,
            thruster=Thruster(
                axis=(1.0, 0.0, 0.0),
                curve="interpolated",
                commands=(
                    -1, -0.875, -0.75, -0.625, -0.5, -0.375, -0.25, -0.125, -0.05,
                    0.05, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1,
                ),
                thrusts=(
                    -39.92, -34.2, -26.56, -20.14, -14.11, -9.06, -4.72, -1.13, 0,
                    0, 1.38, 5.92, 11.41, 17.89, 25.65, 33.55, 43.61, 51.45,
                ),
            ),
        ),
    ),
    mount=Mount((-_T200_LENGTH / 2, 0.0, 0.0), (1.0, 0.0, 0.0)),
)  # fmt: skip

# The frame of a BlueROV2 Heavy without its eight T200, front along +x: M. von Benzon et al., An
# Open-Source Benchmark Simulator: Control of a BlueROV2 Underwater Robot, JMSE 10 (2022), 1898,
# table A1: 13.5 kg, 13.4 l, centre of buoyancy 1 cm above that of mass, inertia 0.26, 0.23, 0.37
# kg m², added mass, damping, and the thrusters' places and directions, y and z turned to ours; as
# quoted in AndreasKing-Goks/0_THESIS, BlueROV2_param.m, and the same elsewhere. Three boxes have
# the mass and volume of the vehicle without its thrusters. Their sizes give the whole the published
# inertia and centres, within the vehicle's outer sizes, 0.457 × 0.575 × 0.254 m. The slots hold
# T200 by their backs.
_HALF = math.sqrt(0.5)
_BLUEROV2_THRUSTERS = (
    ((0.156, -0.111, -0.085), (_HALF, _HALF, 0.0)),
    ((0.156, 0.111, -0.085), (_HALF, -_HALF, 0.0)),
    ((-0.156, -0.111, -0.085), (-_HALF, _HALF, 0.0)),
    ((-0.156, 0.111, -0.085), (-_HALF, -_HALF, 0.0)),
    ((0.12, -0.218, 0.0), (0.0, 0.0, 1.0)),
    ((0.12, 0.218, 0.0), (0.0, 0.0, -1.0)),
    ((-0.12, -0.218, 0.0), (0.0, 0.0, -1.0)),
    ((-0.12, 0.218, 0.0), (0.0, 0.0, 1.0)),
)


def _t200_slot(place: tuple[float, ...], direction: tuple[float, float, float]) -> Slot:
    """The slot that holds a T200 with its middle at a point [m], core frame."""
    x, y, z = (p - _T200_LENGTH / 2 * d for p, d in zip(place, direction, strict=True))
    return Slot((x, y, z), direction, (1.0, 0.0, 0.0) if direction[2] else (0.0, 0.0, 1.0))


_BLUEROV2 = ModuleType(
    name="BlueROV2",
    parts=(
        Part(
            "hull",
            (Box((0.35684, 0.34, 0.088)),),
            mass=4.9384,
            volume=7.5374e-3,
            fossen=Fossen(
                added_mass=(6.3567, 7.1206, 18.6863, 0.1858, 0.1348, 0.2215),  # type: ignore[arg-type]
                linear_damping=(13.7, 0.0, 33.0, 0.0, 0.8, 0.0),  # type: ignore[arg-type]
                quadratic_damping=(141.0, 217.0, 190.0, 1.192, 0.47, 1.5),
                whole=True,
            ),
        ),
        Part(
            "float",
            (Box((0.35684, 0.46306, 0.083)),),
            mass=3.556,
            volume=3.3294e-3,
            position=(0.0, 0.0, 0.0855),
        ),
        Part(
            "skid",
            (Box((0.35684, 0.08, 0.083)),),
            mass=2.1232,
            volume=1.0e-3,
            position=(0.0, 0.0, -0.0855),
        ),
    ),
    slots={k: _t200_slot(*at) for k, at in enumerate(_BLUEROV2_THRUSTERS, 1)},
)

# A stiff plate of ABS (1050 kg/m³), 60 × 50 × 2 mm with corners rounded to 10 mm, mounted at its
# leading edge like a tail. Its area is taken as that of its box's face, 3 % too much.
# Lift before the stall: 2π A / (2 + √(A² + 4)) per rad (Helmbold 1942) for the aspect ratio
# A = 50/60, which makes 1.26. Such plates stall late, at 30° to 40° (Torres and Mueller, AIAA
# Journal 42, 2004): 30°; from there the lift falls to 0 at 90°. Drag: that of a force normal to the
# plate, lift × tan α, with the same mean before the stall as .465 |α|; then up to the 1.17 of a
# square plate across the flow (Hoerner, Fluid-Dynamic Drag, 1965, chapter 3). Two choices: friction
# is left out, as a tail works at large angles, and the centre of pressure stays in the middle.
_FIN_STALL = math.radians(TODAY["fin_stall"].value)
_FIN_LIFT = 2 * math.pi * (50 / 60) / (2 + math.hypot(50 / 60, 2))
_FIN_DRAG = TODAY["fin_drag"].value
_TO_ACROSS = math.pi / 2 - _FIN_STALL  # from the stall to a plate across the flow [rad]
_FIN = ModuleType(
    name="Fin",
    parts=(
        Part(
            "plate",
            (Box((0.060, 0.050, 0.002)),),
            mass=0.0061,
            volume=5.828e-6,
            lift_drag=LiftDrag(
                cla=_FIN_LIFT,
                cda=_FIN_DRAG,
                alpha_stall=_FIN_STALL,
                cla_stall=-_FIN_LIFT * _FIN_STALL / _TO_ACROSS,
                cda_stall=(TODAY["plate_drag"].value - _FIN_DRAG * _FIN_STALL) / _TO_ACROSS,
                forward=(-1.0, 0.0, 0.0),
                upward=(0.0, 0.0, 1.0),
            ),
        ),
    ),
    mount=Mount((-0.030, 0.0, 0.0), (1.0, 0.0, 0.0)),
)

MODULES: dict[str, ModuleType] = _with_aliases(
    _CORE, _BRICK, _HINGE, _TOUCH_SENSOR, _THRUSTER, _LIFT_THRUSTER, _FIN, _T200, _BLUEROV2
)
"""The catalogue by name and alias: Revolve's values, our thrusters and fin, T200 and BlueROV2."""

# The thesis's Table 1 prints the two hinge masses the other way round. It also gives the touch
# sensor the brick's box; that is not taken over, as the thesis does not say how it is attached.
THESIS_MODULES: dict[str, ModuleType] = MODULES | _with_aliases(
    replace(
        _HINGE, parts=(replace(_HINGE.parts[0], mass=0.009), replace(_HINGE.parts[1], mass=0.0017))
    )
)
"""The catalogue with the hinge masses of the thesis's Table 1."""


# ------------------------------------------------------------------------- users' own types


def load_modules(path: str | Path) -> dict[str, ModuleType]:
    """Reads module types from YAML.

    A file looks like this (SI units; three numbers are x, y, z in the module's or part's frame)::

        modules:
          Flipper:
            mount: -x                # or {position: [...], outward: [1, 0, 0]}; null: a core
            hinge:                   # leave out for a rigid module
              axis: [0, 1, 0]
              anchor: [0.00465, 0, 0]
              range: [-0.6, 0.6]                  # rad; default ±π/4, as Revolve's servo
              effort: 0.17658                     # N·m; default Revolve's servo
              speed: 5.235988                     # rad/s; default Revolve's servo
            parts:
              - name: holder                      # default: part0, part1, ...
                size: [0.022, 0.036, 0.010]       # a single box; or `boxes`
                mass: 0.002
              - name: blade
                position: [0.04, 0, 0]            # default [0, 0, 0]
                boxes:                            # the first is the main box, at [0, 0, 0]
                  - size: [0.06, 0.04, 0.002]
                  - {size: [0.002, 0.04, 0.01], position: [0.03, 0, 0]}
                mass: 0.006
                volume: 4.0e-6                    # default: that of the boxes, solid
                electronics_volume: 0.0           # default
                center_of_volume: [0, 0, 0]       # default
                ballast_mass: 0.0                 # default; a point mass
                ballast_volume: 0.0               # default; a point volume
                ballast_position: [0, 0, 0]       # default; of both
                entrained_water: 0.0              # default; share of the free volume, 0 to 1
                buoyancy: partial                 # or mask, off; default: the world's
                drag: lift_drag                   # or another law of docs/physics.md, or off;
                                                  # default: the world's, of a fin lift_drag
                added_mass: true                  # default: the world's
                coefficients: {}                  # default; of laws, by name
                drag_coefficient: 1.05            # default; or three, along the part's axes
                added_mass_coefficient: 1.0       # default; or three
                contact: true                     # default
            slots:                   # default: none
              1: +x                  # or {position: [...], direction: [...], up: [0, 0, 1]}
            sensor: false            # default
            aliases: [Paddle]        # default: those of the catalogue's type of that name, if any
            sensors:                 # default: none; on each module of the type, see docs/senses.md
              - {type: flow, noise: 0.01}
          PectoralFin:
            mount: -x
            parts:
              - size: [0.06, 0.04, 0.002]
                mass: 0.005
                lift_drag:           # makes it a fin; fields of `LiftDrag`
                  {cla: 2.0, cda: 0.3, alpha_stall: 0.5, forward: [0, 1, 0], upward: [0, 0, 1]}
          Pod:
            mount: -x
            parts:
              - size: [0.06, 0.04, 0.04]
                mass: 0.05
                fossen:              # known water, in place of our laws; fields of `Fossen`
                  added_mass: [0.01, 0.04, 0.04, 0, 2.0e-6, 2.0e-6]     # or six rows of six
                  linear_damping: [0.05, 0.1, 0.1, 0, 0, 0]             # or six rows of six
                  quadratic_damping: [0.4, 1.2, 1.2, 0, 1.0e-5, 1.0e-5]
          Jet:
            mount: -x
            parts:
              - size: [0.03, 0.02, 0.02]
                mass: 0.012
                volume: 4.0e-6
                thruster:            # makes it a thruster; fields of `Thruster`
                  axis: [1, 0, 0]                 # default
                  curve: dead_band                # or basic, interpolated
                  gain: 0.3                       # N at command 1
                  dead_band: [-0.05, 0.05]
                  range: [-1, 1]                  # default
                  time_constant: 0.05             # s; default 0
                  torque_ratio: 0.002             # m; default 0

    `-x`, `+y` and so on name a level face of a main box: of the first part for `mount`, and for
    `slots` of the last part with a hinge, of the first without. Unknown keys are refused.

    Args:
        path: the file.

    Returns:
        The types by name and alias, to be merged: `MODULES | load_modules(path)`.

    Raises:
        InputError: the file cannot be read or something in it is wrong; the message says where.
    """
    data = load_yaml(path)
    with reading(path):
        return read_modules(data, MODULES)
