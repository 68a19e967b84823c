"""A sea of one's own: salt water, a current, waves, and a flat bed."""

import numpy as np

from mjx_revolve import build_robot, load_morphology, make_world, simulate

sea = make_world(  # or a YAML file with the same keys: load_world("sea.yaml")
    density=1025.0,  # kg/m³
    current=(0.05, 0.0, 0.0),  # m/s, world frame
    waves=[{"amplitude": 0.02, "wavelength": 2.0}],  # m
    bed={"kind": "flat", "height": -1.0, "friction": 0.8},
)
robot = build_robot(load_morphology("core"), sea)

pose = np.zeros(robot.mj_model.nq)
pose[2], pose[3] = -0.3, 1.0  # 0.3 m below the surface, upright
trajectory = simulate(robot, duration=8.0, qpos=pose)

for k in range(0, len(trajectory.time), len(trajectory.time) // 4):
    x, _, z = trajectory.xpos[k, 1]
    print(f"{trajectory.time[k]:4.1f} s: drifted {x:.3f} m, {-z:.3f} m deep")
