"""A worker: scores blocks of individuals for the process that leads a run, one after the other.

    python -m mjx_revolve.evolution.worker    # started by `pool`, not by hand

What to do comes as one line of JSON on standard input; scores go back over a connection (see
`wire`). Standard input stays open as long as the process that started this one lives: when it
ends, even by kill -9, the worker ends at once. It ends too when its connection does.

Interrupts are the leader's affair: a worker ignores Ctrl-C and SIGTERM, so that the generation
under way can be finished when all processes of a job get the signal.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import socket
import sys
import threading
import time
import traceback
from typing import Any, NoReturn

from mjx_revolve.evolution.wire import PROTOCOL, Channel, SecretError, format_address
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

# How long a handshake's message may take: the leader may still be building its own robot [s].
_HANDSHAKE = 300.0
# Between attempts to reach a leader that is not there yet [s].
_RETRY = 0.2


def main() -> int:
    """Runs the command.

    Returns:
        The exit code: 0 when the leader said to stop, 2 when it refused this worker or the input is
        wrong, 1 otherwise. The last line on standard error says why.
    """
    for name in ("SIGINT", "SIGTERM"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    line = _read_line()
    if not line:
        print("error: expected to be started by mjx_revolve.evolve", file=sys.stderr)
        return 2
    job = json.loads(line)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.path[:] = job["path"]
    runtime.prepare_worker(job["core"], job["cache"])
    try:
        return _work(job)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (EOFError, OSError) as error:
        reason = "" if isinstance(error, EOFError) else f" ({error})"
        address = format_address(job["address"])
        print(f"error: the leader at {address} is gone{reason}", file=sys.stderr)
        return 1


def _read_line() -> bytes:
    """Byte by byte, so that nothing but the line is read."""
    line = bytearray()
    while (byte := os.read(0, 1)) not in (b"", b"\n"):
        line += byte
    return bytes(line)


def _end_with_parent() -> NoReturn:
    while os.read(0, 1):
        pass
    os._exit(1)


def load_function(name: str) -> Any:
    """The function that `MODULE:NAME` names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _work(job: dict[str, Any]) -> int:
    from mjx_revolve.episodes.config import make_config
    from mjx_revolve.evolution.fingerprints import model_hash, settings_hash

    config = make_config(job["config"], "/", source=job["source"])
    fitness = load_function(job["make"])(config)
    hello = {
        "type": "hello",
        "protocol": PROTOCOL,
        "versions": program_versions(),
        "settings_hash": settings_hash(config),
        "model_hash": model_hash(fitness),
        "host": job["host"],
        "hosts": job["hosts"],
        "worker": job["worker"],
        "workers": job["workers"],
        "node": socket.gethostname(),
        "cpu": runtime.cpu_model(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "process": os.getpid(),
        "cached": bool(job["cache"]),
    }
    channel = _connect(tuple(job["address"]), job["patience"])
    try:
        channel.introduce(job["secret"].encode())
    except SecretError:
        raise InputError(
            f"MJX_REVOLVE_SECRET: expected the secret of the leader at "
            f"{format_address(job['address'])}; found another"
        ) from None
    channel.send(hello)
    answer, _ = channel.receive()
    if answer["type"] == "refused":
        raise InputError(answer["reason"])
    channel.set_patience(None)  # between generations it may take any time
    warm = False
    while True:
        order, population = channel.receive()
        if order["type"] == "stop":
            break
        try:
            scores, names = evaluate_block(fitness, population, order["key"], order["kind"])
        except Exception as error:
            traceback.print_exc()
            lines = str(error).splitlines() or [""]
            channel.send({"type": "failed", "reason": f"{type(error).__name__}: {lines[0]}"})
            return 1
        if not warm and job["core"] is not None:
            runtime.pin_process([job["core"]])
        warm = True
        channel.send({"type": "scores", "block": order["block"], "measures": names}, scores)
    channel.close()
    if order["reason"]:
        print(f"error: the leader ended the run: {order['reason']}", file=sys.stderr)
    return 1 if order["reason"] else 0


def program_versions() -> dict[str, str]:
    """What must be the same in all processes of a run."""
    import importlib.metadata as metadata

    names = ("jax", "jaxlib", "mujoco", "mujoco-mjx")
    versions = {name: metadata.version(name) for name in names}
    return {"mjx_revolve": runtime.source_hash(), **versions}


def evaluate_block(fitness: Any, population: Any, key: list[int], kind: str) -> Any:
    """Scores one block.

    Args:
        fitness: the fitness.
        population: `[rows, genes]` float32.
        key: the data of the key.
        kind: its implementation's name.

    Returns:
        `[1 + measures, rows]` float32 scores and measures, and the measures' names.
    """
    import jax
    import numpy as np

    made = jax.random.wrap_key_data(jax.numpy.asarray(key, np.uint32), impl=kind)
    scores, measures = fitness.evaluate(jax.numpy.asarray(population), made)
    rows = [np.asarray(values, np.float32) for values in (scores, *measures.values())]
    return np.stack(rows), list(measures)


def _connect(address: tuple[str, int], patience: float) -> Channel:
    """Reaches the leader, who may start later."""
    deadline = time.monotonic() + patience
    while True:
        try:
            return Channel(socket.create_connection(address, timeout=5.0), _HANDSHAKE)
        except OSError as error:
            if time.monotonic() > deadline:
                raise InputError(
                    f"--coordinator {format_address(address)}: expected the run's leader to "
                    f"listen there within {patience:.0f} s; found: {error.strerror or error}"
                ) from None
        time.sleep(_RETRY)


if __name__ == "__main__":
    code = main()
    # JAX's own farewell takes a tenth of a second, and there is nothing to bid farewell to.
    sys.stderr.flush()
    os._exit(code)
