"""Numbers that others have measured and published, with where we read them.

Only what was read stands here; each table says whose measurement it is and in whose words or file
we found it. Nothing in this file is used to choose a number of ours.
"""

from __future__ import annotations

from typing import NamedTuple

# ------------------------------------------------------------------------- steady drag

STEADY_DRAG = {
    "square plate, broadside": ("SquarePlate", 0.0, 0.01, 1.16),
    "disc, broadside": ("SquarePlate", 0.0, 0.01, 1.17),
    "square rod, face on": ("SquareRod", 0.0, 1.0, 2.0),
    "square rod, edge on": ("SquareRod", 45.0, 2**0.5, 1.6),
    "REMUS 100, ahead": ("Remus100", 0.0, 0.028353, 0.42),
}
"""Module, angle about y [deg], frontal area [m²] and C_d on it [-].

Plate and disc: NACA TR-513; rod: NACA TR-619, Reynolds numbers of 10⁴ to 5·10⁴; both as tabulated
in the repository kdusling/kdusling.github.io, teaching/Applied-Fluids/Notes/DragAndLift.md (commit
0c4707e). A disc is to us a square plate of the same area. REMUS: B. Allen, W. S. Vorus and T.
Prestero, Propulsion system performance enhancements on REMUS AUVs, OCEANS 2000, as quoted in the
repository cybergalactic/PythonVehicleSimulator, src/python_vehicle_simulator/vehicles/remus100.py
(commit 7e1db8e): 1.6 m long, 0.19 m across, C_d on the circle."""


# ------------------------------------------------------------------------- plates at an angle


class Polar(NamedTuple):
    """A plate in a wind tunnel.

    Attributes:
        module: its type in measured.yaml.
        aspect: span² over area [-].
        angle: of attack [deg].
        lift: coefficient [-].
        drag: likewise.
    """

    module: str
    aspect: float
    angle: tuple[float, ...]
    lift: tuple[float, ...]
    drag: tuple[float, ...]


POLARS = (
    Polar(
        "PlateOfAspect1", 1.0,
        (0, 3, 6, 8, 10, 15, 20, 25, 28),
        (0, 0.075, 0.15, 0.2, 0.25, 0.5, 0.7, 0.85, 0.8),
        (0.015, 0.02, 0.03, 0.04, 0.06, 0.15, 0.28, 0.42, 0.48),
    ),
    Polar(
        "PlateOfAspect2", 2.0,
        (0, 3, 6, 8, 10, 15, 20, 25),
        (0, 0.15, 0.3, 0.4, 0.5, 0.7, 0.75, 0.67),
        (0.015, 0.02, 0.03, 0.06, 0.08, 0.18, 0.28, 0.33),
    ),
)  # fmt: skip
"""A. Pelletier and T. J. Mueller, Low Reynolds Number Aerodynamics of Low-Aspect-Ratio,
Thin/Flat/Cambered-Plate Wings, Journal of Aircraft 37 (5), 2000; flat plates, semi-span aspect
ratios .5 and 1, Reynolds number 1.4·10⁵. As read off their figures, rounded, in the repository
thomasfox/boatcalculator, hulls/flatPlate_140000_ar05.txt and _ar1.txt (commit 2a2c776)."""


# ------------------------------------------------------------------------- coins that fall


class Coin(NamedTuple):
    """A coin that is let go flat at the surface of a tank.

    Attributes:
        module: its type in measured.yaml.
        diameter: [m].
        speed: downwards between 10 and 30 cm of depth, of the mean track of all drops [m/s].
        reynolds: with the diameter, as the authors give it from their own speeds [-].
        landing: median distance from where it was let go, at the bottom in 38 cm [cm].
    """

    module: str
    diameter: float
    speed: float
    reynolds: float
    landing: float


COINS = (
    Coin("Coin2", 0.0215, 0.409, 9337, 16.4),
    Coin("Coin5", 0.0230, 0.440, 10488, 16.1),
    Coin("Coin10", 0.0245, 0.512, 11760, 15.1),
    Coin("Coin50", 0.0275, 0.475, 10904, 14.3),
)
"""O. Novotný, Autumn Coin, 16 to 19 drops each, in the repository ondrej-cloud/autumn-coin (MIT):
README.md (masses, diameters, landings), results/*/TRACKING_data_*.csv (mean tracks, from which we
took the times at 10 and 30 cm), analysis/phase_diagram.py (Reynolds numbers); commits 48096c2 and
12fee40. Of two more coins, 1 and 20 Kč, tracks and Reynolds numbers differ by a factor of two: left
out. The tank's walls stood 16 and 19 cm away."""
VISCOSITY = 1.0e-6  # kinematic, of water at 20 °C [m²/s]


# ------------------------------------------------------------------------- oscillating plates


def plate_drag(number: float) -> float:
    """C_d of a flat plate in an oscillating flow, by its Keulegan-Carpenter number U T / b [-].

    Fitted by Luhar and Nepf (2016) and Luhar (2012) to what Keulegan and Carpenter (1958) and
    Sarpkaya and O'Keefe (1996) measured; as in the repository
    lzhu7/waveAttenuationByFlexibleVegetation, CdLN2016.m (commit 05fe9c0).
    """
    return max(10 * number ** (-1 / 3), 1.95)


# ------------------------------------------------------------------------- BlueROV2 Heavy

ROV_DRAG = {"surge": (13.7, 141.0), "sway": (0.0, 217.0), "heave": (33.0, 190.0)}
"""Linear [N·s/m] and quadratic [N·s²/m²] damping; the force on v is (a + b |v|) v."""
ROV_ADDED_MASS = {"surge": 6.3567, "sway": 7.1206, "heave": 18.6863}
"""[kg]. Both: M. von Benzon et al., An Open-Source Benchmark Simulator: Control of a BlueROV2
Underwater Robot, 2022; as given in the repository AndreasKing-Goks/0_THESIS,
RESULTS/Util/BlueROV2_param.m (commit a3a3347), with the outer sizes."""


# ------------------------------------------------------------------------- a ship's section

SECTION_BREADTH, FLUME_DEPTH, WAVE_AMPLITUDE = 0.4, 1.0, 0.012  # [m]
SECTION_PERIODS = {"heave": 1.17, "roll": 1.26}
"""Natural periods in decay tests [s]."""


class Motion(NamedTuple):
    """What the section did in regular waves of `WAVE_AMPLITUDE`.

    Attributes:
        xi: ω² B / 2 g [-].
        heave: amplitude [mm].
        roll: amplitude [deg]; None where it was held.
    """

    xi: float
    heave: float
    roll: float | None


SECTION_FREE = (
    Motion(0.525, 18.4, 13.5),
    Motion(0.55, 19.3, 11.6),
    Motion(0.6, 20.3, 6.4),
    Motion(1.0, 3.3, 1.0),
    Motion(1.25, 1.6, 0.74),
)
"""Free in sway, heave and roll."""
SECTION_HELD = (
    Motion(0.5, 18.8, None),
    Motion(0.55, 20.8, None),
    Motion(0.6, 21.2, None),
    Motion(0.7, 14.9, None),
    Motion(1.0, 3.5, None),
    Motion(1.25, 1.8, None),
    Motion(1.75, 0.66, None),
    Motion(0.55, 19.4, 13.4),
    Motion(0.6, 19.3, 9.3),
    Motion(0.7, 13.5, 4.95),
    Motion(0.75, 10.4, 3.9),
    Motion(1.0, 3.25, 1.6),
    Motion(1.25, 1.54, 0.86),
    Motion(1.5, 0.91, 0.68),
)
"""Held in roll, or in sway. All of it: K. R. Sundsdal, M. Greco, F.-C. Hanssen and C. Lugni, An
experimental investigation of drift forces and coupled-motion effects for a 2D ship cross-section in
regular waves, 2025; data in the repository KRSundsdal1/2D-ship-cross-section-in-regular-waves
(commit 2465cee, CC0), docs/experimental_setup.md and data/3PPH, 4PPH, 6PPH. The amplitudes are
ours, from their time series: a sine of the wave's frequency, its double and a straight line, fitted
by least squares to the last six periods before waves can come back from the wavemaker (7 m and 14 m
at the group velocity), averaged over repetitions. What such a fit leaves is 1 to 2 mm where heave
is largest: the start has not died away. Waves at the probes are within 4 % of what was asked for up
to ξ = 1.5. Runs whose files we did not have are left out, and ξ = .35, with too few periods."""
