"""What stands in a report: its sections, from the runs that were read and the champions' swims."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mjx_revolve.evolution.loop import REPORT_EPISODES
from mjx_revolve.view.plots import COLORS, LABELS, figure_svg, plot_fitness, plot_trajectory
from mjx_revolve.view.report import motion as report_motion
from mjx_revolve.view.report import plots as report_plots
from mjx_revolve.view.report.champion import Replay
from mjx_revolve.view.report.data import RunRecord, number
from mjx_revolve.view.report.groups import (
    Group,
    differences,
    format_interval,
    mean_difference,
    mean_interval,
)
from mjx_revolve.view.report.page import (
    Cell,
    escape,
    figures,
    picture,
    problem_box,
    table,
)

_NONE = "–"


def _tabled(task: str) -> tuple[str, ...]:
    """Measures in tables of several runs."""
    if task == "hold_depth":
        return ("depth_error_m", "cost_of_transport")
    return ("speed_m_s", "cost_of_transport")


def _digits(value: float | None, digits: int = 3) -> str:
    if value is None or not np.isfinite(value):
        return _NONE
    return f"{value:.{digits}g}".replace("-", "−")


def _measure(record: RunRecord, name: str) -> float | None:
    measures = record.champion.get("measures")
    return number(measures.get(name)) if isinstance(measures, Mapping) else None


def _column(name: str) -> str:
    """`speed (m/s)` as a header of two lines."""
    words, _, unit = LABELS.get(name, name.replace("_", " ")).partition(" (")
    return f"{words}\n{unit.rstrip(')')}"


def _swatch(index: int) -> str:
    color = COLORS[index % len(COLORS)]
    return f'<span class="swatch" style="background:{color}"></span>{report_plots.letter(index)}'


def _score(record: RunRecord) -> str:
    score, std = (number(record.champion.get(key)) for key in ("score", "score_std"))
    if score is None or not record.is_finished:
        return _NONE
    return _digits(score) if std is None else f"{_digits(score)} ± {_digits(std, 2)}"


def problems(records: Sequence[RunRecord], lost: Sequence[str]) -> str:
    """The box about what is missing.

    Args:
        records: the runs.
        lost: lines about folders of which nothing could be read.

    Returns:
        HTML.
    """
    named = [(r.label, r.state, [p.text for p in r.problems]) for r in records if r.problems]
    unread = [("Nothing could be read of", "", list(lost))] if lost else []
    kinds = {problem.kind for record in records for problem in record.problems}
    return problem_box([*named, *unread], bool(lost) or bool(kinds & {"damaged", "missing"}))


# --- results --------------------------------------------------------------------------------------


def headline(groups: Sequence[Group]) -> str:
    """The numbers that matter most, of one configuration.

    Args:
        groups: all groups.

    Returns:
        HTML; "" for several configurations, which have a table.
    """
    if len(groups) != 1:
        return ""
    group = groups[0]
    pairs: list[tuple[str, str]] = []
    unit = f" ({group.unit})" if group.unit else ""
    if len(group.records) == 1:
        record = group.records[0]
        if record.is_finished:
            pairs.append((_score(record), f"score{unit}, {REPORT_EPISODES} fresh starts"))
        elif record.metrics and "champion" in record.metrics:
            pairs.append((_digits(float(record.metrics["champion"][-1])), f"best so far{unit}"))
        known = [name for name in ("speed_m_s", "cost_of_transport") if _measure(record, name)]
        pairs += [(_digits(_measure(record, n)), LABELS.get(n, n)) for n in known]
        pairs.append((str(record.generations), "generations"))
    else:
        scores = group.scores()
        if scores:
            text = format_interval(mean_interval(scores))
            pairs.append((text, f"mean score{unit}, 95 % interval"))
            pairs.append((_digits(max(scores)), f"best score{unit}"))
        pairs.append((str(len(group.records)), "seeds"))
    for name in ("evaluations", "seconds"):
        totals = [r.metrics[name][-1] for r in group.shown if name in r.metrics]
        if totals:
            words = "evaluated individuals" if name == "evaluations" else "minutes of evolution"
            total = sum(totals) / (1 if name == "evaluations" else 60)
            pairs.append((f"{total:,.0f}" if total >= 10 else f"{total:.1f}", words))
    return figures(pairs)


def results(groups: Sequence[Group]) -> str:
    """Final scores of all configurations, and in what they differ.

    Args:
        groups: all groups.

    Returns:
        HTML; "" where there is one run only.
    """
    if len(groups) == 1 and len(groups[0].records) == 1:
        return ""
    parts = []
    for task in dict.fromkeys(group.task for group in groups):
        parts.append(_task_table([(k, g) for k, g in enumerate(groups) if g.task == task]))
    if len({group.task for group in groups}) > 1:
        parts.append('<p class="soft">Scores of different tasks cannot be compared.</p>')
    differ = differences(groups)
    if differ and all(group.settings for group in groups):
        header = ["setting", *(report_plots.letter(k) for k in range(len(groups)))]
        rows = [[key, *(_NONE if v is None else v for v in row)] for key, row in differ.items()]
        parts.append("<h3>What differs</h3>" + table(header, rows, left=range(len(header))))
    return "".join(parts)


def _task_table(members: Sequence[tuple[int, Group]]) -> str:
    unit = members[0][1].unit
    reached = min((g.common_generations for _, g in members if g.shown), default=0)
    known = [
        name
        for name in _tabled(members[0][1].task)
        if any(_measure(record, name) is not None for _, g in members for record in g.records)
    ]
    compare = len(members) > 1
    header = ["", "configuration", "n\nseeds", f"score\n{unit}", f"best seed\n{unit}"]
    header += [f"less the first\n{unit}"] if compare else []
    header += [f"after {reached} gen.\nbest so far", *map(_column, known)]
    rows = []
    first = members[0][1].scores()
    for k, (index, group) in enumerate(members):
        scores = group.scores()
        early = [
            record.metrics["champion"][record.metrics["generation"] <= reached][-1]
            for record in group.shown
            if "champion" in record.metrics and (record.metrics["generation"] <= reached).any()
        ]
        row: list[object] = [
            Cell(_swatch(index)), group.name, len(scores),
            format_interval(mean_interval(scores)), _digits(max(scores, default=None)),
        ]  # fmt: skip
        if compare:
            row.append(format_interval(mean_difference(scores, first)) if k else _NONE)
        row.append(format_interval(mean_interval(early)))
        for name in known:
            values = [_measure(r, name) for r in group.records if r.is_finished]
            row.append(format_interval(mean_interval([v for v in values if v is not None])))
        rows.append(row)
    note = (
        f"Score: mean over the seeds' champions, each judged on {REPORT_EPISODES} starts that "
        "evolution never saw, ± half of the 95 % confidence interval (Student's t with n − 1 "
        "degrees of freedom). Runs that are not finished do not count."
    )
    if compare:
        note += " Less the first: difference of the means with its 95 % interval after Welch."
    unequal = [key for key in differences([g for _, g in members]) if key.startswith("task.")]
    if unequal:
        keys = ", ".join(unequal)
        note += f" The tasks differ in {keys}: these scores do not mean quite the same."
    return table(header, rows, left=(0, 1), wrap=(1,)) + f'<p class="soft">{escape(note)}</p>'


def runs_table(groups: Sequence[Group]) -> str:
    """One line for each run.

    Args:
        groups: all groups.

    Returns:
        HTML; "" where there is one run only.
    """
    records = [(k, r) for k, group in enumerate(groups) for r in (*group.records, *group.copies)]
    if len(records) == 1:
        return ""
    wanted = dict.fromkeys(name for _, r in records for name in _tabled(r.task))
    known = [n for n in wanted if any(_measure(r, n) is not None for _, r in records)]
    units = {r.unit for _, r in records}
    unit = units.pop() if len(units) == 1 else ""
    header = ["", "run", "seed", "generations", f"score\n{unit}", *map(_column, known)]
    header += ["minutes", "champion", "state"]
    rows = []
    for k, record in records:
        seconds = record.metrics["seconds"][-1] if "seconds" in record.metrics else None
        planned = record.setting("evolution.generations")
        short = isinstance(planned, int) and planned != record.generations
        rows.append([
            Cell(_swatch(k)), record.label, _NONE if record.seed is None else record.seed,
            f"{record.generations} of {planned}" if short else record.generations, _score(record),
            *(_digits(_measure(record, name)) for name in known),
            _NONE if seconds is None else f"{seconds / 60:.1f}",
            str(record.stand_in or record.champion.get("origin", _NONE))[:60],
            record.state or "whole",
        ])  # fmt: skip
    columns = len(header)
    return table(header, rows, left=(0, 1, columns - 2, columns - 1))


def convergence(groups: Sequence[Group]) -> str:
    """How the fitness grew.

    Args:
        groups: all groups.

    Returns:
        HTML; "" without metrics.
    """
    parts = []
    styles = {group.name: k for k, group in enumerate(groups)}
    shown = [group for group in groups if group.shown]
    for task in dict.fromkeys(group.task for group in shown):
        members = [group for group in groups if group.task == task]
        if len([group for group in members if group.shown]) > 1 or len(members[0].shown) > 1:
            parts.append(picture(
                figure_svg(report_plots.plot_comparison(members, styles)), "svg+xml",
                "Mean best fitness over generations of each configuration, and final scores",
                "Left: the best score so far, mean over the seeds with its 95 % confidence band "
                "(Student's t, from three seeds on), as far as all runs of a configuration reach; "
                "longer runs go on as thin lines. It is the score on a generation's own starts "
                "and so a little lucky. Right: the champions' scores on "
                f"{REPORT_EPISODES} fresh starts, each seed (dots), mean and 95 % interval (from "
                "three seeds on).",
            ))  # fmt: skip
    for group in shown:
        several = len(groups) > 1
        if several:
            parts.append(f"<h3>{_swatch(styles[group.name])}: {escape(group.name)}</h3>")
        if len(group.shown) > 1:
            parts.append(picture(
                figure_svg(report_plots.plot_seeds(group)), "svg+xml",
                f"Best, median and quartiles over the seeds of {group.name}",
                "Best, median and quartiles over the seeds in each generation, and each run as a "
                "thin line.",
            ))  # fmt: skip
        else:
            record = group.shown[0]
            label = f"fitness ({record.unit})" if record.unit else "fitness"
            band = (
                "quartiles of the population"
                if "lower_quartile" in record.metrics
                else "mean and standard deviation of the population"
            )
            parts.append(picture(
                figure_svg(plot_fitness(record.metrics, "", label)), "svg+xml",
                f"Fitness over the generations of {record.label}",
                f"{record.label}: best, median, and {band} in each generation; below, what the "
                "best did, and how far the search spreads.",
            ))  # fmt: skip
    return "".join(parts)


# --- champions ------------------------------------------------------------------------------------


def side_by_side(groups: Sequence[Group], replays: Mapping[Path, Replay]) -> str:
    """All champions in one picture.

    Args:
        groups: all groups.
        replays: episodes by run folder.

    Returns:
        HTML; "" for fewer than two.
    """
    members = [
        (group.name, k, [replays[r.folder] for r in group.records if r.folder in replays])
        for k, group in enumerate(groups)
    ]
    members = [member for member in members if member[2]]
    if sum(len(found) for *_, found in members) < 2:
        return ""
    return picture(
        figure_svg(report_plots.plot_champions(members)), "svg+xml",
        "Ways of all champions from above and from the side, and distance over time",
        "The champion of each run, moved to one start (circle); squares mark where they end. "
        "Right: distance from the start, mean over the seeds with its 95 % confidence band "
        "(Student's t, from three seeds on), and each champion as a thin line.",
    )  # fmt: skip


def champion(record: RunRecord, replay: Replay) -> str:
    """All about one champion.

    Args:
        record: its run.
        replay: its episode.

    Returns:
        HTML.
    """
    robot, trajectory = replay.episode.robot, replay.episode.trajectory
    origin = record.stand_in or record.champion.get("origin")
    seconds = float(np.asarray(trajectory.time)[-1])
    words = f"One episode of {seconds:.3g} s: the first of the starts that evolution never saw"
    words += f". The champion is the {origin}." if isinstance(origin, str) and origin else "."
    parts = [f"<p>{escape(words)}</p>", _measures(record, replay)]
    parts.append(picture(
        _swim_jpeg(replay), "jpeg", f"The robot {robot.morphology.name} along its way",
        "The robot along its way, drawn from its modules' shapes in their colours; below, one "
        "stroke.",
    ))  # fmt: skip
    height = float(robot.world.surface_height)
    parts.append(picture(
        figure_svg(plot_trajectory(trajectory, height)), "svg+xml",
        "Trajectory from above and from the side, depth and speed over time",
        "Way of the core from above and from the side (one scale on both axes), its depth below "
        "the still surface and its speed.",
    ))  # fmt: skip
    if robot.num_hinges:
        parts.append(picture(
            figure_svg(report_motion.plot_joints(replay)), "svg+xml",
            "Angle and target of each joint over time",
            "Angle of each joint and the target that the controller sets; the servo clips targets "
            "at the joint's range, and lags behind, as its speed and effort are limited.",
        ))  # fmt: skip
    if replay.phases is not None:
        parts.append(picture(
            figure_svg(report_motion.plot_phases(replay)), "svg+xml",
            "Phase of each oscillator of the CPG over time, and its mean frequency",
            "Phase of each oscillator, atan2(x, y): 0 when the joint's target passes its middle "
            "upwards, π/2 at its largest. Right: turns per second over the whole episode; an "
            "oscillator with a negative weight turns backwards.",
        ))  # fmt: skip
    if robot.num_thrusters:
        parts.append(picture(
            figure_svg(report_motion.plot_thrusters(replay)), "svg+xml",
            "Command of each thruster over time",
            "Command of each thruster, and what is left of it behind the thruster's lag.",
        ))  # fmt: skip
    parts.append(picture(
        figure_svg(report_motion.plot_energy(replay)), "svg+xml",
        "Power, energy and cost of transport over time",
        "Mechanical power at the servos, summed without sign, with what ideal propellers need; "
        "energy so far; cost of transport: energy over weight in air times net distance, from the "
        f"first row of the track after the settling time ({replay.counted_from:.3g} s, dashed) on.",
    ))  # fmt: skip
    return "".join(parts)


def _measures(record: RunRecord, replay: Replay) -> str:
    rows = []
    unit = f" ({record.unit})" if record.unit else ""
    rows.append([f"score{unit}", _digits(replay.score), _score(record)])
    for name, value in replay.measures.items():
        rows.append([LABELS.get(name, name.replace("_", " ")), _digits(value),
                     _digits(_measure(record, name))])  # fmt: skip
    return table(["", "this episode", f"mean of\n{REPORT_EPISODES} fresh starts"], rows)


def _swim_jpeg(replay: Replay) -> bytes:
    """The swim picture as a JPEG, a quarter of the PNG's size."""
    from PIL import Image

    from mjx_revolve.view.swim_picture import plot_swim

    figure = plot_swim(replay.episode.robot, replay.episode.trajectory)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "JPEG", quality=90, subsampling=0)
    return buffer.getvalue()


def saved_pictures(record: RunRecord) -> str:
    """Pictures that a run left behind, where its champion cannot be replayed.

    Args:
        record: the run.

    Returns:
        HTML; "" without any.
    """
    parts = []
    for name in ("swim.png", "trajectory.png"):
        path = record.folder / name
        data = path.read_bytes() if path.is_file() else b""
        if data.startswith(b"\x89PNG") and data.rstrip().endswith(b"IEND\xaeB`\x82"):
            parts.append(picture(data, "png", name, f"{name}, as the run left it."))
    return "".join(parts)
