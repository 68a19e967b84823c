"""Blocks that were given up because their workers died: kept in a file, and scored again.

    python -m mjx_revolve.evolution.lost runs/big/lost/1f0c….npz

A file holds arrays and plain values. It names what made the fitness, and may hold Python files of
its owner's, so a stranger's is asked about as a run folder is (`trust.py`).
"""

from __future__ import annotations

import io
import json
import sys
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjx_revolve.evolution.jobs import MAKE_BODY_FITNESS, MAKE_FITNESS, Job, Limits, open_job
from mjx_revolve.inputs.commands import Parser, read_path, run_command
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.schema import Row, Text, checked, read, words
from mjx_revolve.inputs.trust import UntrustedError, add_trust_argument, opening
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax

    from mjx_revolve.evolution.blocks import Block, Scored

# Those that anybody's file may name: they are made to be given any configuration.
_OURS = (MAKE_FITNESS, MAKE_BODY_FITNESS)
_BODIES = Annotated[Row[dict[str, Any]], words("morphologies")]


@checked
class _Kept:
    """What a file has beside arrays: the job, the bodies, and the kind of key."""

    config: Text
    source: Text
    make: Text
    paths: Row[Text]
    key_impl: Text
    bodies: _BODIES | None = None


def save_lost(folder: Path, job: Job, block: Block, key: jax.Array) -> Path:
    """Keeps what it takes to score a block again.

    Args:
        folder: where to.
        job: its configuration and fitness.
        block: the block: arrays, and bodies at last where these evolve.
        key: of its episodes.

    Returns:
        The file's path.
    """
    import numpy as np

    from mjx_revolve.evolution.blocks import key_as_data
    from mjx_revolve.evolution.fingerprints import hash_text

    data, impl = key_as_data(key)
    bodies: tuple[dict[str, Any], ...] | None = None
    if not isinstance(block[-1], np.ndarray):
        *block, last = block  # type: ignore[assignment]
        bodies = tuple(body.to_mapping() for body in last)
    paths = tuple(path for path, _ in job.files)
    kept = _Kept(job.config, job.source, job.make, paths, impl, bodies)
    arrays: dict[str, Any] = {f"block{k}": np.asarray(array) for k, array in enumerate(block)}
    arrays |= {f"file{k}": np.frombuffer(text, np.uint8) for k, (_, text) in enumerate(job.files)}
    text = json.dumps(asdict(kept))
    buffer = io.BytesIO()
    np.savez(buffer, kept=np.frombuffer(text.encode(), np.uint8), key=data, **arrays)
    path = folder / f"{hash_text(text, *(array.tobytes().hex() for array in arrays.values()))}.npz"
    write_atomic(path, buffer.getvalue())
    return path


def score_lost(path: str | Path, trust: bool = False) -> Scored:
    """Scores a block that was kept, in this process: a worker of its own would hide what happens.

    Args:
        path: of the file.
        trust: whether its owner's Python may run; see `trust.opening`.

    Returns:
        Scores and measures.

    Raises:
        InputError: the file holds something else, or what is not trusted.
    """
    runtime.prepare_process()
    import numpy as np

    from mjx_revolve.evolution.blocks import evaluate_block, key_from_data

    kept, arrays = _read(Path(path))
    if kept.make not in _OURS and not trust:
        raise UntrustedError(
            f"{path}: make: expected {' or '.join(_OURS)}, or --trust; found {show(kept.make)}"
        )
    files = [(name, arrays[f"file{k}"].tobytes()) for k, name in enumerate(kept.paths)]
    # What the file holds itself is read as what lies in a run folder is.
    with tempfile.TemporaryDirectory() as scratch, opening(path, scratch, trust=trust):
        job = Job(kept.config, kept.source, tuple(files), kept.make, Limits())
        with reading(path):
            fitness = open_job(job, Path(scratch))
            block: list[Any] = [arrays["block0"]]
            if block[0].shape[1:] != (fitness.num_genes,) or block[0].dtype != np.float32:
                raise InputError(
                    f"block0: expected float32 [P, {fitness.num_genes}]; found {block[0].dtype} "
                    f"{list(block[0].shape)}"
                )
            if kept.bodies is not None:
                block += [arrays["block1"], _grow(kept)]
        return evaluate_block(fitness, tuple(block), key_from_data((arrays["key"], kept.key_impl)))


def _read(path: Path) -> tuple[_Kept, dict[str, Any]]:
    """The plain values and the arrays of a file."""
    import numpy as np

    with reading(path):
        if not path.is_file():
            raise InputError("expected a file; found none")
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            data = json.loads(arrays.pop("kept").tobytes())
        except OSError:
            raise
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile, AttributeError) as error:
            raise InputError(f"expected a block that was kept; found: {error}") from None
        kept = read(_Kept, data)
        needed = {"key", "block0", *(f"file{k}" for k in range(len(kept.paths)))}
        needed |= set() if kept.bodies is None else {"block1"}
        if missing := sorted(needed - arrays.keys()):
            raise InputError(f"expected an array {missing[0]}; found none")
        for name in kept.paths:  # a copy of each is written
            if not name.isprintable() or Path(name).name in ("", ".."):
                raise InputError(f"paths: expected those of files; found {show(name)}")
    return kept, arrays


def _grow(kept: _Kept) -> list[Any]:
    """The bodies of a block."""
    from mjx_revolve.body.morphology import make_morphology
    from mjx_revolve.episodes.config import make_config
    from mjx_revolve.episodes.fitness import read_modules

    modules = read_modules(make_config(json.loads(kept.config), "/", source=kept.source))
    return [make_morphology(body, modules, allow_overlap=True) for body in kept.bodies or ()]


def main(argv: list[str] | None = None) -> int:
    """Scores blocks again and prints what they score.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: a file is wrong, or not trusted.
    """
    parser = Parser(
        prog="python -m mjx_revolve.evolution.lost",
        description="Score blocks of a run again that were given up, to see why.",
    )
    parser.add_argument("paths", nargs="+", type=read_path, metavar="FILE", help="in RUN/lost/")
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    for path in arguments.paths:
        print(path, *score_lost(path, arguments.trust)[0])
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
