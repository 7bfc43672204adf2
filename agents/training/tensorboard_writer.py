"""The learning curve for TensorBoard, where that is installed."""

from __future__ import annotations

import importlib.util
import logging
from pathlib import Path
from typing import Any

from agents.training.run_files import Row

logger = logging.getLogger(__name__)


class TensorBoardWriter:
    """Writes rows of the learning curve for TensorBoard."""

    def __init__(self, folder: Path) -> None:
        """Remember the folder; it is made with the first row."""
        self._folder = folder
        self._writer: Any = None

    def __call__(self, row: Row) -> None:
        """Write a row.

        Raises:
            ImportError: TensorBoard is not installed.
        """
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  not always there

            # Rows that an interrupted training wrote after its last checkpoint do not count.
            step = int(row["steps"])
            self._writer = SummaryWriter(str(self._folder), purge_step=step)
        for name, value in row.items():
            if name not in ("update", "steps"):
                self._writer.add_scalar(name, value, int(row["steps"]))

    def close(self) -> None:
        """Write what is not yet on disk."""
        if self._writer is not None:
            self._writer.close()


def make_tensorboard_writer(folder: Path) -> TensorBoardWriter | None:
    """Return a writer, or log that TensorBoard is missing and return None."""
    if importlib.util.find_spec("tensorboard") is None:
        logger.info("TensorBoard is not installed; the learning curve is in progress.csv only")
        return None
    return TensorBoardWriter(folder)
