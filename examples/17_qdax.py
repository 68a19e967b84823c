"""QDax: its MAP-Elites with our fitness as the scoring function."""

from functools import partial

import jax
import jax.numpy as jnp
from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
from qdax.core.emitters.mutation_operators import isoline_variation
from qdax.core.emitters.standard_emitters import MixingEmitter
from qdax.core.map_elites import MAPElites
from qdax.utils.metrics import default_qd_metrics

from mjx_revolve import make_fitness

fitness = make_fitness(
    "lake_swim",
    **{"task.duration": 4.0, "task.settle": 1.0, "task.horizon": None, "task.trials": 1},
)


def score(genes, key):
    """Fitness, descriptors and nothing else of a batch."""
    scores, measures = fitness.evaluate(genes, key)
    return scores, jnp.stack([measures["straightness"], measures["energy_j"]], -1), {}


emitter = MixingEmitter(
    mutation_fn=None,
    variation_fn=partial(isoline_variation, iso_sigma=0.1, line_sigma=0.1),
    variation_percentage=1.0,
    batch_size=64,
)
search = MAPElites(score, emitter, partial(default_qd_metrics, qd_offset=1.0))
key, first, begin = jax.random.split(jax.random.key(0), 3)
genes = 0.5 * jax.random.normal(first, (64, fitness.num_genes))
centroids = compute_euclidean_centroids((10, 10), minval=[0.0, 0.0], maxval=[1.0, 2.0])
repertoire, state, metrics = search.init(genes, centroids, begin)
for _ in range(10):
    key, own = jax.random.split(key)
    repertoire, state, metrics = search.update(repertoire, state, own)
print(f"coverage {metrics['coverage']:.0f} %, best {metrics['max_fitness']:.3f} body lengths/s")
