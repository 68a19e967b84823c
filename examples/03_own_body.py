"""A body made in memory, edited, and compared with others in one compiled program."""

import jax
import jax.numpy as jnp

from mjx_revolve import (
    add_module,
    free_slots,
    load_morphology,
    make_mixed_fitness,
    make_morphology,
    save_morphology,
)

# Every edit returns a new valid body, or raises InputError with the reason in one line.
tadpole = make_morphology({"type": "Core"}, name="tadpole")
tadpole = add_module(tadpole, 0, 0, "ActiveHinge", orientation=90, name="tail")
tadpole = add_module(tadpole, "tail", 1, "Fin", orientation=90)
print(f"free slots of the tadpole: {free_slots(tadpole)}")
save_morphology(tadpole, "tadpole.yaml")

bodies = [load_morphology("spider"), load_morphology("fish"), tadpole]
fitness = make_mixed_fitness(
    "lake_swim", bodies, **{"task.duration": 4.0, "task.settle": 1.0, "task.horizon": None}
)
robots = [fitness.build(body) for body in bodies]  # no compilation per body
genes = 0.5 * jax.random.normal(jax.random.key(0), (len(bodies), fitness.num_genes))
still = fitness(robots, jnp.zeros_like(genes), jax.random.key(1))
scores = fitness(robots, genes, jax.random.key(1))
for body, a, b in zip(bodies, still, scores, strict=True):
    print(f"{body.name:8} at rest {a:+.3f}, random gait {b:+.3f} body lengths/s")
