"""A copy of the metrics as TensorBoard's event files.

Written with tensorboardX, which needs neither TensorFlow nor TensorBoard. Its synchronous writer is
used rather than its SummaryWriter: that one's thread does not report a full disk.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mjx_revolve.episodes.config import Config
from mjx_revolve.inputs.files import naming
from mjx_revolve.inputs.packages import check_package

# The group of a column in TensorBoard; measures of the task have their own.
_GROUPS = {
    "best": "fitness", "mean": "fitness", "std": "fitness", "median": "fitness",
    "lower_quartile": "fitness", "upper_quartile": "fitness", "champion": "fitness",
    "evaluations": "search", "step_size": "search", "failed": "search", "restarts": "search",
    "seconds": "time", "evaluations_per_second": "time",
}  # fmt: skip


def check_tensorboard(config: Config, source: str) -> None:
    """Raises InputError, naming the `source`, if tensorboardX is wanted and missing."""
    if config.evolution.tensorboard:
        check_package(f"{source}: evolution.tensorboard", "tensorboardX")


class TensorBoardLog:
    """An event file; one more for each time that a run is resumed."""

    def __init__(
        self, folder: Path, done: int, history: Iterable[Mapping[str, float]] = ()
    ) -> None:
        """Begins an event file.

        Args:
            folder: where TensorBoard looks.
            done: generations that are done already; later ones in earlier files are
                purged when TensorBoard reads them.
            history: the rows of those generations, written where there is no earlier file.

        Raises:
            OSError: the disk is full or the folder cannot be written; it names the folder.
        """
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import SessionLog

        self._folder = folder
        with naming(self._folder):
            folder.mkdir(parents=True, exist_ok=True)
            resumed = any(folder.glob("events.out.tfevents.*"))
            # The library's name has the second only: two starts within one must not meet.
            self._writer = EventsWriter(str(folder / "events"), f".{os.getpid()}.{done:06d}")
        self._write(step=done + 1, session_log=SessionLog(status=SessionLog.START))
        for row in () if resumed else history:
            self.add(row)

    def _write(self, **event: object) -> None:
        from tensorboardX.proto.event_pb2 import Event

        with naming(self._folder):
            self._writer.write_event(Event(wall_time=time.time(), **event))
            self._writer.flush()

    def add(self, row: Mapping[str, float]) -> None:
        """Adds a generation's figures by column, of which `generation` is the step.

        Raises:
            OSError: the disk is full; it names the folder.
        """
        from tensorboardX.proto.summary_pb2 import Summary

        values: list[Any] = [
            Summary.Value(tag=f"{_GROUPS.get(name, 'measures')}/{name}", simple_value=float(value))
            for name, value in row.items()
            if name != "generation"
        ]
        self._write(step=int(row["generation"]), summary=Summary(value=values))

    def close(self) -> None:
        """Closes the file; `add` has raised already if the disk is full."""
        with contextlib.suppress(OSError):
            self._writer.close()
