"""Blocks that failed because their workers died: kept in a file, and scored again.

    python -m mjx_revolve.evolution.failed_blocks runs/big/lost/1f0c….npz

A file holds arrays and plain values. It names the function that made the fitness, and may hold its
owner's Python files, so another user's needs trust as a run folder does (`trust.py`).
"""

from __future__ import annotations

import io
import json
import pkgutil
import sys
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjx_revolve.evolution.jobs import LIMITS, Job, function_name, open_job
from mjx_revolve.inputs.commands import Parser, read_path, run_command
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.schema import Text, TupleOf, checked, read, words
from mjx_revolve.inputs.trust import UntrustedError, add_trust_argument, opening
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax

    from mjx_revolve.evolution.blocks import Block, Scored

# Functions that any file may name without trust: they take any configuration.
_OURS = (
    "mjx_revolve.episodes.fitness:make_fitness",
    "mjx_revolve.evolution.body_fitness:make_body_fitness",
)
_BODIES = Annotated[TupleOf[dict[str, Any]], words("morphologies")]


@checked
class _Kept:
    """The plain values of a file: the job, the bodies, and the kind of key."""

    config: Text
    source: Text
    make: Text
    paths: TupleOf[Text]
    key_impl: Text
    bodies: _BODIES | None = None


def save_failed_block(folder: Path, job: Job, block: Block, key: jax.Array) -> Path:
    """Writes a file from which a block can be scored again, and returns its path.

    Args:
        folder: the file's folder.
        job: configuration and fitness.
        block: arrays, and bodies at last where these evolve.
        key: of its episodes.
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
    make = function_name(job.make_fitness)
    kept = _Kept(job.config, job.source, make, paths, impl, bodies)
    arrays: dict[str, Any] = {f"block{k}": np.asarray(array) for k, array in enumerate(block)}
    arrays |= {f"file{k}": np.frombuffer(text, np.uint8) for k, (_, text) in enumerate(job.files)}
    text = json.dumps(asdict(kept))
    buffer = io.BytesIO()
    np.savez(buffer, kept=np.frombuffer(text.encode(), np.uint8), key=data, **arrays)
    path = folder / f"{hash_text(text, *(array.tobytes().hex() for array in arrays.values()))}.npz"
    write_atomic(path, buffer.getvalue())
    return path


def score_failed_block(path: str | Path, trust: bool = False) -> Scored:
    """Scores a block from its file, in this process, so that errors are seen.

    Args:
        path: of the file.
        trust: whether its owner's Python may run; see `trust.opening`.

    Raises:
        InputError: the file holds something else, or Python that is not trusted.
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
    # The files in it are read as those inside of a run folder are.
    with tempfile.TemporaryDirectory() as scratch, opening(path, scratch, trust=trust):
        with reading(path):
            make = pkgutil.resolve_name(kept.make)
            job = Job(kept.config, kept.source, tuple(files), make, LIMITS)
            fitness = open_job(job, scratch)
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
            if not name.isprintable() or Path(name).name == "" or ".." in Path(name).parts:
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
    """The command: scores blocks again and prints their scores; see `run_command`."""
    parser = Parser(
        prog="python -m mjx_revolve.evolution.failed_blocks",
        description="Score blocks of a run again that were given up, to see why.",
    )
    parser.add_argument("paths", nargs="+", type=read_path, metavar="FILE", help="in RUN/lost/")
    add_trust_argument(parser)
    arguments = parser.parse_args(argv)
    for path in arguments.paths:
        print(path, *score_failed_block(path, arguments.trust)[0])
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
