"""What a run has come to, in words and pictures, when it ends."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.fitness import read_modules
from mjx_revolve.episodes.scoring import REPORT_EPISODES
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.evolution.loop import Champion
from mjx_revolve.evolution.start import Start
from mjx_revolve.formats.mjcf import make_mjcf
from mjx_revolve.view import plots
from mjx_revolve.view.colony_curves import plot_colony, plot_population
from mjx_revolve.view.colony_history import read_history
from mjx_revolve.view.colony_pictures import plot_arena, plot_families, plot_lives
from mjx_revolve.view.motion import counted_time
from mjx_revolve.view.surroundings import target_at_last
from mjx_revolve.view.swim_picture import plot_swim
from mjx_revolve.view.thumbnails import plot_best


def describe_score(champion: Champion, config: Config) -> str:
    """The result of a run in words: `0.158 ± 0.0025 body lengths/s over 16 fresh starts`."""
    unit = score_unit(config.task.type)
    score = f"{champion.score:.3g} ± {champion.std:.2g} {unit}".rstrip()
    return f"{score} over {REPORT_EPISODES} fresh starts"


def save_pictures(start: Start, champion: Champion) -> None:
    """Writes a run's pictures, and the champion as MJCF with water, as far as there is a robot.

    Args:
        start: the run, its generations done.
        champion: the champion, judged.

    Raises:
        OSError: the disk is full.
    """
    run, fitness, config = start.run, start.fitness, start.config
    unit = score_unit(config.task.type)
    if config.bodies is not None:
        fitness = fitness.single(champion.body)
    title = f"{run.folder.name}: {describe_score(champion, config)}"
    label = f"fitness ({unit})" if unit else "fitness"
    if config.colony is None:
        figures = {"fitness.png": plots.plot_fitness(run.load_metrics(), title, label)}
    else:
        title = f"{run.folder.name}: the champion swims {describe_score(champion, config)}"
        figures = _draw_colony(start, champion)
    if config.bodies is not None:
        figures["bodies.png"] = plot_best(run.folder, read_modules(config), title)
    if hasattr(fitness, "replay"):
        trajectory = fitness.replay(champion.genes, champion.key)
        robot = getattr(fitness, "robot", None)
        height = float(getattr(getattr(robot, "world", None), "surface_height", 0.0))
        figures["trajectory.png"] = plots.plot_trajectory(trajectory, height, title)
        if robot is not None:
            # In the first of the poses from which it was judged.
            run.write(
                "champion/robot.xml", make_mjcf(robot, np.asarray(trajectory.qpos[0])).encode()
            )
            counted = counted_time(config.task, robot.world.timestep)
            water = fitness.water(champion.key) if hasattr(fitness, "water") else None
            target = target_at_last(config.task, trajectory)
            figures["swim.png"] = plot_swim(robot, trajectory, counted, water, target)
    for name, figure in figures.items():
        run.write(name, plots.figure_png(figure))


def _draw_colony(start: Start, champion: Champion) -> dict[str, Figure]:
    """Pictures of a colony by the names of their files."""
    run, config = start.run, start.config
    assert config.colony is not None
    metrics = run.load_metrics()
    history, _ = read_history(run.folder, float(metrics["time"][-1]))
    title = f"{run.folder.name}: {len(history.spans)} robots lived"
    return {
        "fitness.png": plot_colony(metrics, title),
        "population.png": plot_population(history, config.evolution.population_size, title),
        "lives.png": plot_lives(history, title),
        "families.png": plot_families(history, champion.individual, title),
        "arena.png": plot_arena(history, config.colony, title),
    }
