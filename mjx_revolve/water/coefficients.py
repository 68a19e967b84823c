"""Every empirical coefficient of the water's laws, with its source; laws take them from here.

What follows from a theory alone (Lamb's ellipsoid, Airy's waves) is no coefficient and stands with
its law. Nothing here was chosen by how our water compares with measured swimmers. Where two sources
disagree, or say nothing, `decided` says which number holds and why. Those of chains, plates that
swing and fins were written down before any law that reads them was compared with a measurement;
they were read second hand, in texts and programs that quote them, so that most lack a page.
"""

from __future__ import annotations

from typing import NamedTuple


class Sourced(NamedTuple):
    """A number of a law.

    Attributes:
        value: the number.
        unit: its unit.
        meaning: of what.
        source: where it was read.
        decided: why this one, where sources disagree or say nothing.
    """

    value: float
    unit: str
    meaning: str
    source: str
    decided: str = ""


_HOERNER = "Hoerner, Fluid-Dynamic Drag, 1965, chapter 3"
_TORRES = "Torres and Mueller, AIAA Journal 42, 2004"
_SWIMMERS = "hydro.c of EPFL's chains, and FARMS"
_LIGHTHILL = "Lighthill, 1971"
_POREZ = "Porez, Boyer and Ijspeert, 2014"
_IKEDA = "Ikeda's bilge keels, ITTC's recommended procedure for roll damping"
_WAGNER = "R. T. Jones's two exponentials, fitted to Wagner's function"

TODAY: dict[str, Sourced] = {
    "cube_drag": Sourced(
        1.05, "-", "C_d of a face that meets the flow; drag: faces", f"{_HOERNER}: a cube",
        "one number for all shapes: plates have 1.17, long rods 2.0, streamlined bodies 0.1 to 0.4",
    ),
    "plate_drag": Sourced(1.17, "-", "C_d of a fin across the flow", f"{_HOERNER}: a square plate"),
    "fin_stall": Sourced(
        30.0, "deg", "angle at which a fin stalls", f"{_TORRES}: 30° to 40°",
        "the lower end, which claims the least lift",
    ),
    "fin_drag": Sourced(
        0.465, "1/rad", "slope of a fin's drag before the stall",
        "lift × tan α, which a force normal to the plate has, averaged up to the stall",
    ),
    "box_added_mass": Sourced(
        1.0, "-", "volume of the ellipsoid with a box's added mass, over the box's own",
        "DNV-RP-H103, table A-2",
        "volume and proportions kept: a cube then carries 0.50 of its volume, measured are 0.64 to "
        "0.68; the inscribed ellipsoid would carry 0.26",
    ),
    "chain_drag": Sourced(
        1.75, "-", "C_d across a rectangular part inside a chain", _SWIMMERS,
        "not the 2.0 of a rod from wall to wall (NACA TR-619): a chain has ends",
    ),
    "chain_head_drag": Sourced(
        1.0, "-", "C_d along a chain, on the area of its head (½ ρ w h |v| v)", _SWIMMERS
    ),
    "friction": Sourced(
        0.455, "-", "a in C_f = a / (log10 Re)^b on side faces", "Prandtl and Schlichting",
        "once, though hydro.c takes it twice: no reason for that is printed",
    ),
    "friction_exponent": Sourced(2.58, "-", "b of the same", "Prandtl and Schlichting"),
    "end_added_mass": Sourced(
        0.5, "-", "c_m: momentum shed at a trailing end, per c_m (π/4) ρ h² of its section",
        f"{_POREZ}, and hydro.c: 0.5; {_LIGHTHILL}: 1",
        "0.5. Lighthill's is a reactive theory, in which all momentum given to the water along the "
        "body reaches the end. Here drag across the flow acts as well, which is momentum that left "
        "along the edges: with 1 it would be shed twice. hydro.c has its 0.5 beside such a drag",
    ),
    "end_slenderness": Sourced(
        0.2, "-", "height over length up to which a body counts as slender", _LIGHTHILL
    ),
    "wave_share": Sourced(
        0.5, "-", "share of a floating section's added mass at high frequency that waves take "
        "at the frequency at which it heaves by itself; near_surface",
        "Kramers and Kronig's relation of the damping of Jensen, Mansour and Olsen, 2004",
        "computed: 0.52 to 0.47 for breadths of 4 to 0.5 draughts",
    ),
    "plate_drag_slope": Sourced(
        0.02, "-", "growth of a plate's C_d with its aspect ratio, from 1.17 of a square one",
        f"{_HOERNER}: 1.10 + 0.02 (A + 1/A)", "the same slope from the 1.17 in use",
    ),
    "long_plate_drag": Sourced(
        1.98, "-", "C_d of a long plate across the flow", f"{_HOERNER}; Matthews, Aeronautical "
        "Engineer's Data Book, p. 95",
    ),
    "plate_thinness": Sourced(
        0.1, "-", "thickness over width up to which a part's edges are sharp",
        "none; Graham (1980) has the two ends: thin edges KC^(-1/3), square corners KC^0",
        "a tenth, and none at two tenths: bilge keels are thinner, a limb's box is thicker",
    ),
    "swing_drag": Sourced(
        22.5, "-", "a in C_d = a / KC + b of a plate that swings", _IKEDA,
        "this fit and not max(10 KC^(-1/3), 1.95) of Luhar and Nepf (2016), chosen when no law "
        "read it; both agree within 5 % from KC 8 to 20",
    ),
    "swing_large_drag": Sourced(
        2.4, "-", "b of the same", _IKEDA,
        "where the fit ends, for flow that still turns round, and no plate's steady drag: what "
        "the fit is divided by is `long_plate_drag`, that of the same two-dimensional plate",
    ),
    "swing_most": Sourced(
        9.0, "-", "most of a / KC + b", "none", "its value near KC 3, below which few measured"
    ),
    "swing_memory": Sourced(
        2.0, "s", "τ over which a plate remembers its wake", "none",
        "one to two of the slowest periods; gaits here have about 1 Hz",
    ),
    "fin_efficiency": Sourced(
        1.0, "-", "e in C_D = C_D0 + C_L² / (π A e), for foils with a rounded nose", _LIGHTHILL,
        "1, which agrees with the momentum shed at an end. Plates with sharp edges have no suction "
        "there: theirs is lift × tan α, as `fin_drag` has it",
    ),
    "fin_incidence": Sourced(
        0.75, "-", "place along the chord where the angle of attack is taken",
        "thin-airfoil theory: the three-quarter chord point",
    ),
    "wagner_slow": Sourced(0.165, "-", "share of the lift that comes slowly", _WAGNER),
    "wagner_slow_rate": Sourced(0.0455, "-", "its rate, per half chord travelled", _WAGNER),
    "wagner_fast": Sourced(0.335, "-", "share of the lift that comes fast", _WAGNER),
    "wagner_fast_rate": Sourced(0.3, "-", "its rate, per half chord travelled", _WAGNER),
    "surface_tension": Sourced(0.0728, "N/m", "γ of clean water at 20 °C", "IAPWS R1-76"),
}  # fmt: skip
"""Of the laws in force. MuJoCo's two laws have MuJoCo's own (`mujoco_drag`)."""
