"""pyribs: CMA-MAE's emitters fill an archive of gaits, by how straight and at what cost."""

import jax
import numpy as np
from ribs.archives import GridArchive
from ribs.emitters import EvolutionStrategyEmitter
from ribs.schedulers import Scheduler

from mjx_revolve import make_fitness

fitness = make_fitness(
    "lake_swim",
    **{"task.duration": 4.0, "task.settle": 1.0, "task.horizon": None, "task.trials": 1},
)
archive = GridArchive(
    solution_dim=fitness.num_genes, dims=(10, 10), ranges=[(0, 1), (0, 2)],
    learning_rate=0.01, threshold_min=-1.0,
)  # fmt: skip
start = np.zeros(fitness.num_genes)
emitters = [
    EvolutionStrategyEmitter(
        archive, x0=start, sigma0=0.5, ranker="imp", es="cma_es", batch_size=16, seed=k
    )
    for k in range(4)
]
scheduler = Scheduler(archive, emitters)
for generation in range(10):
    genes = scheduler.ask()  # [64, num_genes]
    scores, measures = fitness.evaluate(genes, jax.random.key(generation))
    points = np.column_stack([measures["straightness"], measures["energy_j"]])
    scheduler.tell(np.asarray(scores), points)
stats = archive.stats
print(f"{stats.num_elites} kinds of gait, the fastest {stats.obj_max:.3f} body lengths/s")
