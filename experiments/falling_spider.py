"""The thesis's falling spider: dropped 0.25 m above the water, with and without buoyancy.

``python -m experiments.falling_spider [--out DIR] [--data DIR]``

The thesis recorded the height of Revolve's spider in Gazebo every 0.2 s and read the acceleration
off the speeds. Its drag was in effect off, so our runs beside it have drag and added mass off, too;
two more show what partial submersion, and drag by faces with added mass, change. Everything is
computed in float64: over a fall of 100 m, rounding in float32 costs 1e-4 m/s².
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.common import ROOT, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path
from mjx_revolve.view.plots import figure_png

DROP = 0.25  # height of the release above the surface [m]
ROW = 0.2  # time between two rows of the thesis's data, by its own account [s]
GRAVITY = 9.81
# Gazebo's and SDFormat's default (SDFormat specification, world/gravity).
GAZEBO_GRAVITY = 9.8
# Step of the clock that stamps the thesis's rows [s]; see `row_ticks`.
TICK = 0.002
# Rows before the spider reaches the floor at z = -100 m.
FALLING = {"air": 19, "water": 71}

# The runs: what differs from the default water, and for how long [s]. All end above the floor.
RUNS: dict[str, tuple[dict[str, object], float]] = {
    "air": ({"buoyancy": "off", "drag": "off", "added_mass": False}, 4.4),
    "mask": ({"buoyancy": "mask", "drag": "off", "added_mass": False}, 14.8),
    "partial": ({"buoyancy": "partial", "drag": "off", "added_mass": False}, 14.8),
    "faces": ({"drag": "faces"}, 14.8),
}


@dataclass(frozen=True)
class Fall:
    """A recorded fall.

    Attributes:
        time: `[T]` since the release [s].
        height: `[T]` of the core, world frame [m].
        speed: `[T]` of the core, upwards [m/s].
    """

    time: np.ndarray
    height: np.ndarray
    speed: np.ndarray


@dataclass(frozen=True)
class ClosedForm:
    """What a point mass does that is released above water in which only buoyancy acts.

    Attributes:
        gravity: [m/s²].
        wet: acceleration below the surface, downwards [m/s²].
    """

    gravity: float
    wet: float

    @property
    def entry_speed(self) -> float:
        """Downward speed at the surface [m/s]."""
        return float(np.sqrt(2 * self.gravity * DROP))

    def height(self, time: np.ndarray) -> np.ndarray:
        """Height at times since the release [m]."""
        entry = self.entry_speed / self.gravity
        below = np.maximum(time - entry, 0)
        dry = DROP - 0.5 * self.gravity * np.minimum(time, entry) ** 2
        return dry - self.entry_speed * below - 0.5 * self.wet * below**2

    def time(self, height: np.ndarray) -> np.ndarray:
        """Time since the release at which it passes heights below the surface [s]."""
        v = self.entry_speed
        return v / self.gravity + (np.sqrt(v * v - 2 * self.wet * height) - v) / self.wet


def closed_form(kind: str, gravity: float, share: float) -> ClosedForm:
    """The closed form of a run.

    Args:
        kind: "air" or "water".
        gravity: [m/s²].
        share: ρ V / m, the buoyancy's share of the weight [-].

    Returns:
        The closed form.
    """
    return ClosedForm(gravity, gravity if kind == "air" else gravity * (1 - share))


def fall(changes: dict[str, object], duration: float) -> Fall:
    """Drops the spider 0.25 m above the water, at rest, joints at 0.

    Args:
        changes: what differs from the default water.
        duration: [s].

    Returns:
        The fall, in float64.
    """
    import jax

    from mjx_revolve import build_robot, load_morphology, load_world, simulate

    world = load_world("empty_underwater", gravity=GRAVITY, **changes)
    robot = build_robot(load_morphology(ROOT / "morphologies" / "spider.yaml"), world)
    qpos = robot.start_qpos(depth=-DROP)
    with jax.enable_x64(True):
        trajectory = simulate(robot, None, duration, qpos=qpos)
        return Fall(
            np.asarray(trajectory.time),
            np.asarray(trajectory.qpos[:, 2]),
            np.asarray(trajectory.qvel[:, 2]),
        )


def acceleration(run: Fall) -> float:
    """Downward acceleration below 1 m of depth, from the speeds [m/s²].

    From there on all modules are under water, and the legs have stopped to swing from the entry.
    """
    deep = run.height < -1.0
    return -float(np.polyfit(run.time[deep], run.speed[deep], 1)[0])


# ------------------------------------------------------------------ the thesis's data


def load_thesis(folder: Path) -> dict[str, np.ndarray] | None:
    """Reads the thesis's heights as far as the spider falls.

    Args:
        folder: holds `air_heights.txt` and `water_heights.txt`, a height [m] in each row.

    Returns:
        Heights of "air" and "water" [m]; None where the files are absent.

    Raises:
        InputError: a file is not what it should be.
    """
    data = {}
    for kind, rows in FALLING.items():
        path = folder / f"{kind}_heights.txt"
        if not path.is_file():
            return None
        try:
            heights = np.loadtxt(path, ndmin=1)
        except ValueError as error:
            raise InputError(path, "one number in each row", error) from None
        if heights.ndim != 1 or len(heights) < rows:
            raise InputError(path, f"at least {rows} rows", heights.shape)
        data[kind] = heights[:rows]
    return data


def mean_acceleration(heights: np.ndarray, intervals: int) -> float:
    """The thesis's estimate: last speed minus first speed, over a number of intervals [m/s²].

    n heights have n-1 speeds between them, and n-2 intervals between the speeds.

    Args:
        heights: `[n]`, one each 0.2 s [m].
        intervals: what to divide by.
    """
    speeds = np.diff(heights) / ROW
    return float((speeds[0] - speeds[-1]) / (intervals * ROW))


def fit(time: np.ndarray, heights: np.ndarray) -> tuple[float, float, float]:
    """Fits a parabola.

    Args:
        time: `[n]` [s].
        heights: `[n]` [m].

    Returns:
        Downward acceleration [m/s²], the speed squared with which the parabola passes height 0
        [m²/s²], and the residuals' root mean square [m].
    """
    square, slope, offset = np.polyfit(time, heights, 2)
    residual = heights - np.polyval((square, slope, offset), time)
    return -2 * square, slope**2 - 4 * square * offset, float(np.sqrt(np.mean(residual**2)))


def row_ticks(heights: np.ndarray, form: ClosedForm) -> tuple[np.ndarray, float]:
    """How many ticks of the simulator's clock lie between the rows.

    In simulated time the rows are not 0.2 s apart: a program that sleeps 0.2 s of wall clock wakes
    up a little late, and the simulator runs at its own rate. Asked when the closed form passes the
    recorded heights, the rows of the run in air lie whole multiples of 2 ms apart.

    Args:
        heights: `[n]` [m].
        form: the closed form.

    Returns:
        `[n-1]` ticks, and the root mean square distance from whole numbers [ticks]; of any times,
        it would be 0.29.
    """
    spacing = np.diff(form.time(heights)) / TICK
    ticks = np.round(spacing)
    return ticks, float(np.sqrt(np.mean((spacing - ticks) ** 2)))


@dataclass(frozen=True)
class Reading:
    """What the thesis's rows of one run say.

    Attributes:
        printed: what the thesis's sum gives with its divisor, and prints rounded [m/s²].
        mended: the same with the right divisor [m/s²].
        fitted: by a parabola through rows 0.2 s apart [m/s²].
        timed: by a parabola through rows on the simulator's clock [m/s²].
        row: mean time between rows on that clock [s].
        misfit: of the rows and that clock [ticks].
        drop: height from which it would have to fall to enter the water as fast as the parabola on
            that clock, at Gazebo's gravity [m].
        drop_short: the same if every row were a tick shorter, and `timed_short` its acceleration.
        timed_short: see `drop_short` [m/s²].
        wobble: what the parabola on that clock leaves, root mean square [m].
        time: `[n]` on that clock, since the release [s].
    """

    printed: float
    mended: float
    fitted: float
    timed: float
    row: float
    misfit: float
    drop: float
    drop_short: float
    timed_short: float
    wobble: float
    time: np.ndarray


def read_run(heights: np.ndarray, form: ClosedForm) -> Reading:
    """Reads one run of the thesis's.

    Args:
        heights: `[n]` [m].
        form: the closed form at Gazebo's gravity.

    Returns:
        The reading.
    """
    n = len(heights)
    ticks, misfit = row_ticks(heights, form)
    clock = TICK * np.concatenate([[0.0], np.cumsum(ticks)])
    timed, square, wobble = fit(clock, heights)
    short = clock - TICK * np.arange(n)
    timed_short, square_short, _ = fit(short, heights)
    return Reading(
        printed=mean_acceleration(heights, n - 1),
        mended=mean_acceleration(heights, n - 2),
        fitted=fit(ROW * np.arange(n), heights)[0],
        timed=timed,
        row=float(TICK * ticks.mean()),
        misfit=misfit,
        drop=square / (2 * form.gravity),
        drop_short=square_short / (2 * form.gravity),
        timed_short=timed_short,
        wobble=wobble,
        time=clock + np.mean(form.time(heights) - clock),
    )


# ------------------------------------------------------------------ the closed forms


@dataclass(frozen=True)
class Still:
    """What follows from the spider's tables when it lies level, legs straight.

    Attributes:
        share: ρ V / m, the buoyancy's share of the weight [-].
        start: downward acceleration from rest under water, with the carried water [m/s²].
        terminal: downward speed at which the drag balances the net weight [m/s].
    """

    share: float
    start: float
    terminal: float


def read_tables() -> Still:
    """Closed forms, drag by faces, from the spider's fluid table."""
    import mujoco

    from mjx_revolve import build_robot, load_morphology, load_world
    from mjx_revolve.water.face_drag import FACES

    world = load_world("empty_underwater", gravity=GRAVITY, drag="faces")
    robot = build_robot(load_morphology(ROOT / "morphologies" / "spider.yaml"), world)
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_kinematics(robot.mj_model, data)
    table = robot.fluid
    vertical = data.xmat[table.body].reshape(-1, 3, 3)[:, 2]  # world z in the body's frame
    n = np.abs(np.einsum("pi,pij->pj", vertical, table.rotation))
    mass, water = float(table.mass.sum()), world.density
    net = GRAVITY * (mass - water * float(table.volume.sum()))
    return Still(
        share=water * float(table.volume.sum()) / mass,
        start=net / (mass + water * float(np.sum(table.added_mass * n**2))),
        terminal=float(np.sqrt(net / (np.sum(FACES.numbers(table, robot.world).linear * n**3)))),
    )


# ------------------------------------------------------------------ what is written


def table(
    falls: dict[str, Fall], still: Still, readings: dict[str, Reading] | None
) -> list[tuple[str, ...]]:
    """The comparison as rows of text, headings first."""
    rows: list[tuple[str, ...]] = [
        ("quantity", "thesis", "its sum,", "its rows,", "its rows,", "ours", "closed", "unit"),
        ("", "prints", "mended", "0.2 s apart", "2 ms clock", "", "form", ""),
    ]
    form = {kind: closed_form(kind, GRAVITY, still.share) for kind in FALLING}

    def add(name: str, printed: str, kind: str, ours: float, closed: float, unit: str) -> None:
        reading = readings[kind] if readings and kind else None
        numbers = ["-"] * 3
        if reading is not None:
            numbers = [f"{x:.4f}" for x in (reading.mended, reading.fitted, reading.timed)]
        rows.append((name, printed, *numbers, f"{ours:.5f}", f"{closed:.5f}", unit))

    dry, wet = form["air"].wet, form["water"].wet
    add("no buoyancy (air): acceleration", "9.28", "air", acceleration(falls["air"]), dry, "m/s2")
    add("thesis's buoyancy, no drag: acceleration", "0.60", "water",
        acceleration(falls["mask"]), wet, "m/s2")  # fmt: skip
    add("partial submersion, no drag: acceleration", "-", "",
        acceleration(falls["partial"]), wet, "m/s2")  # fmt: skip
    speed = -float(falls["faces"].speed[-1])
    add("drag by faces: speed at the end", "-", "", speed, still.terminal, "m/s")
    return rows


def remarks(still: Still, readings: dict[str, Reading] | None) -> list[str]:
    """A sentence or two on each difference, numbers filled in."""
    form = closed_form("water", GRAVITY, still.share)
    lines = []
    if readings:
        air, water = readings["air"], readings["water"]
        wet = closed_form("water", GAZEBO_GRAVITY, still.share).wet
        lines += [
            f"9.28 and 0.60: n rows have n-2 intervals between their speeds, {FALLING['air'] - 2} "
            f"and {FALLING['water'] - 2}; divided by one more the gains in speed give "
            f"{air.printed:.2f} and {water.printed:.3f} (0.60 if cut off), rightly "
            f"{air.mended:.2f} and {water.mended:.3f}.",
            f"{air.fitted:.2f} and {water.fitted:.3f} from rows 0.2 s apart: in simulated time "
            "they are further apart. In air the rows lie whole ticks of 2 ms apart, "
            f"{air.row:.4f} s in the mean ({air.misfit:.3f} ticks rms off; chance would give "
            f"0.29), in water {water.row:.4f} s ({water.misfit:.2f} ticks off).",
            f"{air.timed:.3f} on that clock, not {GRAVITY:g}: that is Gazebo's default gravity, "
            f"{GAZEBO_GRAVITY:g} m/s2.",
            f"{water.timed:.4f} on that clock: the closed form at that gravity is {wet:.4f}. A "
            f"tick less between all rows would read {water.timed_short:.4f}, but the speed at the "
            f"surface would be that of a drop from {water.drop_short:.4f} m; on the clock it is "
            f"that of {water.drop:.4f} m, and the release was at {DROP:g} m.",
            f"What then remains of the water run is a slow wobble of {1e3 * water.wobble:.1f} mm "
            "rms, unexplained; ours has none.",
        ]
    lines += [
        "Partial submersion falls like the mask: it does the same work on the way through the "
        "surface. The mask can only switch between two steps, which at the speed of entry are "
        f"{1e3 * form.entry_speed * 0.005:.0f} mm apart.",
        f"Drag by faces ends the fall at {still.terminal:.4f} m/s, and with the carried "
        f"water to move it would start from rest at {still.start:.3f} m/s2, not {form.wet:.3f}.",
    ]
    return lines


_BLUE, _DEEP, _ORANGE, _GREY = "#1f77b4", "#0b3c5d", "#e07b00", "#6b7680"
_WATER = "#eaf3f9"
_STYLES: dict[str, dict[str, Any]] = {
    "air": {"color": _ORANGE, "linewidth": 1.8, "label": "no buoyancy"},
    "mask": {"color": _BLUE, "linewidth": 1.8, "label": "thesis's buoyancy, no drag"},
    "partial": {
        "color": _DEEP, "linewidth": 1.6, "linestyle": (0, (4, 3)),
        "label": "partial submersion, no drag",
    },
    "faces": {"color": "#2a9d6f", "linewidth": 1.8, "label": "drag by faces"},
}  # fmt: skip


def draw(
    falls: dict[str, Fall],
    data: dict[str, np.ndarray] | None,
    readings: dict[str, Reading] | None,
    share: float,
) -> Figure:
    """Heights over time, the entry magnified, and the thesis's data less the closed form.

    Args:
        falls: the runs.
        data: the thesis's heights, or None.
        readings: what they say.
        share: ρ V / m [-].

    Returns:
        The figure.
    """
    canvas = Figure(figsize=(10.0, 5.8), dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(canvas)
    grid = canvas.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    whole = canvas.add_subplot(grid[:, 0])
    entry = canvas.add_subplot(grid[0, 1] if data else grid[:, 1])
    for axes in (whole, entry):
        for name, run in falls.items():
            axes.plot(run.time, run.height, **_STYLES[name])
    if data and readings:
        for kind, heights in data.items():
            # The rows carry no time: the first is put where the closed form passes its height.
            first = closed_form(kind, GAZEBO_GRAVITY, share).time(heights[:1])[0]
            time = first + ROW * np.arange(len(heights))
            for axes in (whole, entry):
                axes.plot(
                    time, heights, "o", color="white", markeredgecolor="#333333",
                    markeredgewidth=0.9, markersize=4.2, zorder=4,
                    label="thesis's data, a row each 0.2 s" if kind == "air" else None,
                )  # fmt: skip
    whole.set(xlim=(-0.3, 15.2), ylim=(-103, 4))
    whole.set_ylabel("height of the core (m)")
    whole.set_title("the whole fall", loc="left", fontsize=10, color=_GREY)
    entry.set(xlim=(0, 2.6), ylim=(-3.4, 0.4))
    entry.set_title("the entry", loc="left", fontsize=10, color=_GREY)
    entry.set_ylabel("height (m)")
    whole.legend(loc="upper right", bbox_to_anchor=(1.0, 0.93), fontsize=8.5, frameon=False)
    panels = [whole, entry]
    if data and readings:
        rest = canvas.add_subplot(grid[1, 1])
        panels.append(rest)
        for kind, color in (("air", _ORANGE), ("water", _BLUE)):
            heights, reading = data[kind], readings[kind]
            plain = closed_form(kind, GRAVITY, share)
            time = plain.time(heights[:1])[0] + ROW * np.arange(len(heights))
            rest.plot(
                time, heights - plain.height(time), "o-", color=color, markersize=2.6,
                linewidth=0.8, label=f"{kind}, rows 0.2 s apart, g = {GRAVITY:g}",
            )  # fmt: skip
            timed = closed_form(kind, GAZEBO_GRAVITY, share)
            rest.plot(
                reading.time, heights - timed.height(reading.time), "-", color=color, linewidth=2.2,
                alpha=0.45, label=f"{kind}, 2 ms clock, g = {GAZEBO_GRAVITY:g}",
            )  # fmt: skip
        rest.set_ylabel("thesis's data less\nclosed form (m)")
        rest.set_xlim(-0.3, 15.2)
        rest.legend(loc="lower left", fontsize=8, frameon=True, framealpha=0.9, edgecolor="none")
    for axes in (whole, entry):
        low, high = axes.get_ylim()
        axes.axhspan(low, 0, color=_WATER, zorder=0, linewidth=0)
        axes.axhline(0, color="#4aa3df", linewidth=1.2, zorder=1)
        axes.set_ylim(low, high)
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(_GREY)
        axes.tick_params(colors="#333333", labelsize=9)
        axes.grid(True, color="#d9dfe3", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.set_xlabel("time since the release (s)")
    return canvas


def write_csv(path: Path, falls: dict[str, Fall]) -> None:
    """Writes the heights [m], a row for each step; cells are empty where a run has ended."""
    longest = max(falls.values(), key=lambda run: len(run.time))
    lines = ["time_s," + ",".join(f"{name}_m" for name in falls)]
    for k, time in enumerate(longest.time):
        cells = [f"{run.height[k]:.6f}" if k < len(run.time) else "" for run in falls.values()]
        lines.append(",".join([f"{time:.3f}", *cells]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(argv: list[str] | None = None) -> int:
    """Runs the experiment, prints the table, writes `falls.png` and `falls.csv`."""
    parser = make_parser("falling_spider", "The thesis's falling spider, beside its data.")
    parser.add_argument(
        "--data", metavar="DIR", help="the thesis's heights (default: ../shared/thesis, if present)"
    )
    options = parser.parse_args(argv)
    source = Path(options.data) if options.data is not None else ROOT.parent / "shared" / "thesis"
    data = load_thesis(source)
    if data is None and options.data is not None:
        raise InputError(f"--data: expected air_heights.txt and water_heights.txt in {source}")
    folder = make_folder(options.out, "falling_spider")

    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    still = read_tables()
    falls = {name: fall(changes, duration) for name, (changes, duration) in RUNS.items()}
    readings = None
    if data is not None:
        readings = {
            kind: read_run(heights, closed_form(kind, GAZEBO_GRAVITY, still.share))
            for kind, heights in data.items()
        }
    print(f"The spider, dropped {DROP} m above the water\n")
    print("\n".join(align(table(falls, still, readings))))
    print()
    if data is None:
        print("The thesis's data are not here: its columns stay empty, and it is not in the plot.")
    for line in remarks(still, readings):
        print("\n".join(textwrap.wrap(line, 98, initial_indent="- ", subsequent_indent="  ")))
    (folder / "falls.png").write_bytes(figure_png(draw(falls, data, readings, still.share)))
    write_csv(folder / "falls.csv", falls)
    if options.results:
        dry = {name: acceleration(falls[name]) for name in ("air", "mask", "partial")}
        last = {"speed_m_s": -float(falls["faces"].speed[-1]), "terminal_m_s": still.terminal}
        write_results("falling_spider", {"accelerations": dry, "faces": last}, ())
    print(f"\nwritten: falls.png and falls.csv in {short_path(folder)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
