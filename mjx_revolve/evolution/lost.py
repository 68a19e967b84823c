"""Blocks that were given up because their workers died: kept in a file, and scored again.

    python -m mjx_revolve.evolution.lost runs/big/lost/1f0c….pickle

Unpickling runs code: open only files of your own.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_revolve.evolution.jobs import Job, open_job
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax

    from mjx_revolve.evolution.blocks import Block, Scored


def save_lost(folder: Path, job: Job, block: Block, key: jax.Array) -> Path:
    """Keeps what it takes to score a block again.

    Args:
        folder: where to.
        job: its configuration and fitness.
        block: the block.
        key: of its episodes.

    Returns:
        The file's path.
    """
    from mjx_revolve.evolution.blocks import key_as_data
    from mjx_revolve.evolution.fingerprints import hash_text

    content = pickle.dumps((job, block, key_as_data(key)))
    path = folder / f"{hash_text(content.hex())}.pickle"
    write_atomic(path, content)
    return path


def score_lost(path: str | Path) -> Scored:
    """Scores a block that was kept, in this process: a worker of its own would hide what happens.

    Args:
        path: of the file.

    Returns:
        Scores and measures.
    """
    runtime.prepare_process()
    from mjx_revolve.evolution.blocks import evaluate_block, key_from_data

    job, block, key = pickle.loads(Path(path).read_bytes())
    return evaluate_block(open_job(job), block, key_from_data(key))


if __name__ == "__main__":
    for path in sys.argv[1:]:
        print(path, *score_lost(path)[0])
