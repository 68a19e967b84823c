"""A module type of one's own, a foam float, and a robot that carries it."""

from pathlib import Path

from mjx_revolve import (
    MODULES,
    add_module,
    build_robot,
    load_modules,
    load_morphology,
    load_world,
    simulate,
)

Path("floats.yaml").write_text(
    """
modules:
  Float:
    mount: -x                 # the face by which it is attached
    parts:
      - {name: foam, size: [0.04, 0.04, 0.04], mass: 0.01}   # [m], [kg]; displaces its box
"""
)
modules = MODULES | load_modules("floats.yaml")
plain = load_morphology("core")
lifted = plain
for slot in (2, 3):
    lifted = add_module(lifted, 0, slot, "Float", modules=modules)

water = load_world("lake")
for body in (plain, lifted):
    weight = body.mass - body.volume * water.density  # in water [kg]
    end = simulate(build_robot(body, water), duration=3.0).xpos[-1, 1, 2]
    print(f"{len(body.modules)} modules: {1000 * weight:+.1f} g in water, at z = {end:+.3f} m")
