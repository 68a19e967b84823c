"""A fish in a lake: joints driven by sine waves, simulated for ten seconds."""

import numpy as np

from mjx_revolve import (
    bind_genes,
    build_robot,
    load_morphology,
    load_world,
    make_sine,
    simulate,
    trim_neutral,
)

water = load_world("lake")
# Ballast or floats in the core so that the robot neither sinks nor rises.
body = trim_neutral(load_morphology("fish"), water.density)
robot = build_robot(body, water)

# Genes are unbounded; zero genes hold every joint still.
controller = make_sine(robot)
genes = np.random.default_rng(0).normal(0, 0.7, controller.num_genes)

trajectory = simulate(robot, bind_genes(controller, genes), duration=10.0)
start, end = trajectory.xpos[0, 1], trajectory.xpos[-1, 1]  # the core, world frame [m]
print(f"{body.name}: {body.num_hinges} hinges, {body.mass:.3f} kg, {controller.num_genes} genes")
print(f"moved {np.linalg.norm(end - start):.3f} m in {trajectory.time[-1]:.1f} s")
