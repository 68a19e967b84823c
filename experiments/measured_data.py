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


def plate_drag_at_bilge(number: float) -> float:
    """The same by a second fit, 22.5 / K + 2.4, of bilge keels [-].

    Ikeda, Himeno and Tanaka, in the ITTC's recommended procedure for roll damping.
    """
    return 22.5 / number + 2.4


# ------------------------------------------------------------------------- swimming chains


class Glide(NamedTuple):
    """A chain of modules with frozen joints that glides at the surface.

    Attributes:
        angles: of the joints, positive where the next module is turned to the left [deg].
        heading: from the middle of the first module along it, pool frame [deg].
        velocity: of the mean of 13 marks, on hinges and modules' middles, pool frame [m/s].
        turning: [deg/s].
        time: since then [s].
        way: distance of the marks' mean from where it was [m].
        rotation: since then [deg].
    """

    angles: tuple[float, ...]
    heading: float
    velocity: tuple[float, float]
    turning: float
    time: tuple[float, ...]
    way: tuple[float, ...]
    rotation: tuple[float, ...]


AMPHIBOT_GLIDE = Glide(
    (16.8, -1.6, -16.3, -29.0, -28.9, -26.8), -31.0, (0.1747, -0.1255), -19.9,
    (0.13, 0.47, 1.00, 1.47, 2.00, 2.47, 3.00, 3.47, 4.00, 4.40),
    (0.027, 0.086, 0.165, 0.221, 0.273, 0.312, 0.350, 0.378, 0.409, 0.431),
    (-2.4, -7.4, -13.9, -18.7, -22.3, -24.3, -25.8, -27.1, -28.5, -29.9),
)  # fmt: skip
"""EPFL's AmphiBot after its motors stop, from the marks' tracks in the repository
FluidsSim/lilytorch, lilytorch/farms_examples/amphibot/experimental_data (commit 1bcd9bf), 15
frames/s, from the frame at 989.051 s. Angles and heading are ours: seven links of .097 m, as the
marks have them, fitted by least squares to the marks' mean shape from that frame on; what is left
is 1.4 mm, and the shape itself changes by 1 to 4 mm. Numbers are the marks', so the first module is
the one with the first mark. The pool's own currents were up to 1 cm/s."""


class Gait(NamedTuple):
    """A wave that runs along a chain of joints, a sin(2π (f t - j lag)), j = 0 next to the head.

    Attributes:
        frequency: f [Hz].
        amplitude: a [deg].
        lag: from joint to joint [cycles].
        speed: of the head, over two periods [m/s].
    """

    frequency: float
    amplitude: float
    lag: float
    speed: float


AMPHIBOT_SWIM = Gait(1 / 0.697, 29.5, 0.0805, 0.62)
"""AmphiBot, six joints: asked for 30°, which the joints did up to 29.5°; the same repository,
lilytorch/examples/amphibot/experimental_data (commit 707aee5)."""
LAMPREY = tuple(
    Gait(1.0, amplitude, lag / 5, speed)
    for amplitude, lag, speed in (
        (40, 0.5, 0.440), (40, 0.75, 0.409), (40, 1.0, 0.307), (40, 1.25, 0.169),
        (35, 0.5, 0.479), (35, 0.8, 0.372), (35, 1.2, 0.150),
        (20, 0.5, 0.400), (20, 0.8, 0.27), (20, 1.2, 0.03),
    )
)  # fmt: skip
"""EPFL's lamprey robot, five joints, in the course "Robotics practicals": the first four in the
repository Nayeuls/TP_8_Robotics_Practicals (commit dabaa2e), the others in
grilloandrea6/robotics-practicals, practical8 (commit 57211be), of which the last two are .26 to .28
and about .03. Speeds are ours, from the head's track: medians over windows of two periods after 2.5
s and away from the walls. Groups of other years differ by up to 20 % for like gaits."""
CHAIN_MODULE = 0.095
"""From hinge to hinge [m]. This module and its mass are EPFL's Webots model's, in the repository
cyberbotics/webots, projects/robots/epfl/biorob/protos/Salamander.proto."""

MAMBA = {"lateral": 0.1288, "eel-like": 0.0894}
"""Speeds [m/s] of Mamba, nine links, at 40°, 120°/s and 40° from joint to joint, with amplitudes
g(i) = 1 and (n - i) / (n + 1), i = 1 at the tail: Kelasidi et al., IEEE Robotics & Automation
Magazine, March 2016, p. 54. Links as in PMC4679098, quoted in markaren/threepp,
python/examples/snake/snake_model.py. Only the ratio is compared."""


# ------------------------------------------------------------------------- a flapping foil


class Flapping(NamedTuple):
    """A foil that heaves and pitches a quarter of a period apart.

    Attributes:
        who: measured it.
        strouhal: 2 f h / U [-].
        angle: of attack at most, atan(ḣ / U) - θ [deg].
        thrust: mean coefficient, on ½ ρ U² c s [-].
        efficiency: thrust times U over the mean power [-].
    """

    who: str
    strouhal: float
    angle: float
    thrust: float
    efficiency: float


FOIL_SPEED, FOIL_HEAVE, FOIL_PIVOT = 0.4, 0.075, 1 / 3  # U [m/s], h [m], pivot behind the nose [c]
FLAPPING = (Flapping("Schouveiler", 0.25, 15.0, 0.32, 0.73), Flapping("Read", 0.6, 35.0, 2.4, 0.43))
"""NACA 0012, chord .1 m, span .6 m. L. Schouveiler, F. S. Hover and M. S. Triantafyllou 2005; D. A.
Read, F. S. Hover and M. S. Triantafyllou 2003, its largest thrust. Second hand: three places agree
on the numbers, the papers themselves could not be read."""


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
