"""A copy of the metrics as TensorBoard's event files, for those who watch their runs there.

Written with tensorboardX, which needs neither TensorFlow nor TensorBoard. Its synchronous writer is
used rather than its `SummaryWriter`: that one writes from a thread, where a full disk is noticed by
nobody.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mjx_revolve.inputs.errors import InputError

# Where a column of the metrics stands in TensorBoard's tree; measures of the task have their own.
_GROUPS = {
    "best": "fitness", "mean": "fitness", "std": "fitness", "median": "fitness",
    "lower_quartile": "fitness", "upper_quartile": "fitness", "champion": "fitness",
    "evaluations": "search", "step_size": "search", "failed": "search", "restarts": "search",
    "seconds": "time", "evaluations_per_second": "time",
}  # fmt: skip


def check_tensorboard(source: str) -> None:
    """Refuses to begin where the library is missing.

    Args:
        source: what asked for it, for the message.

    Raises:
        InputError: tensorboardX is not installed.
    """
    if importlib.util.find_spec("tensorboardX") is None:
        raise InputError(
            f"{source}: evolution.tensorboard: expected the package tensorboardX (pip install "
            "'mjx_revolve[tensorboard]'); found none"
        )


class TensorBoardLog:
    """An event file; one more for each time that a run is resumed."""

    def __init__(
        self, folder: Path, done: int, history: Iterable[Mapping[str, float]] = ()
    ) -> None:
        """Begins an event file.

        Args:
            folder: where TensorBoard looks.
            done: generations that are done already; whatever earlier files say of later ones is
                purged when TensorBoard reads them.
            history: the rows of those generations, written where there is no earlier file.

        Raises:
            OSError: the disk is full or the folder cannot be written; it names the folder.
        """
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            resumed = any(folder.glob("events.out.tfevents.*"))
            # The library's name has the second only: two starts within one must not meet.
            suffix = f".{os.getpid()}.{done:06d}"
            self._writer = EventsWriter(str(folder / "events"), suffix)
            start = SessionLog(status=SessionLog.START)
            self._writer.write_event(Event(step=done + 1, wall_time=time.time(), session_log=start))
            self._writer.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror or str(error), str(folder)) from None
        for row in () if resumed else history:
            self.add(row)

    def add(self, row: Mapping[str, float]) -> None:
        """Adds a generation.

        Args:
            row: the figures by column; `generation` is the step.

        Raises:
            OSError: the disk is full; it names the folder.
        """
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        values: list[Any] = [
            Summary.Value(tag=f"{_GROUPS.get(name, 'measures')}/{name}", simple_value=float(value))
            for name, value in row.items()
            if name != "generation"
        ]
        step = int(row["generation"])
        try:
            self._writer.write_event(
                Event(step=step, wall_time=time.time(), summary=Summary(value=values))
            )
            self._writer.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror or str(error), str(self._folder)) from None

    def close(self) -> None:
        """Closes the file; what the disk refuses, `add` has told already."""
        with contextlib.suppress(OSError):
            self._writer.close()
