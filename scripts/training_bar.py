"""Progress of a training, as a bar and for TensorBoard."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from agents.training.run_files import Row


class Bar:
    """A progress bar over a column of the learning curve, with the latest errors beside it."""

    def __init__(self, column: str, errors: Sequence[str], total: int, **options: Any) -> None:
        """Show an empty bar.

        Args:
            column: Column of the learning curve that counts the progress.
            errors: Columns that are shown beside the bar.
            total: Value of the column at the end of the training.
            options: Of `tqdm`.
        """
        self.bar = tqdm(total=total, desc="training", **options)
        self._column, self._errors = column, errors
        self._shown: dict[str, str] = {}

    def __call__(self, row: Row) -> None:
        """Advance the bar to a row."""
        self._shown |= {name: f"{row[name]:.4f}" for name in self._errors if name in row}
        self.bar.set_postfix(self._shown, refresh=False)
        self.bar.update(int(row[self._column]) - self.bar.n)

    def show(self, stage: str, fraction: float) -> None:
        """Show the fraction of a stage that is done; the bar stands still meanwhile."""
        self.bar.set_postfix({stage: f"{fraction:.0%}", **self._shown})


@contextlib.contextmanager
def watched(bar: Bar, output: Path) -> Iterator[tuple[Callable[[Row], None], ...]]:
    """Yield the watchers of a training: a bar and, where it is installed, TensorBoard.

    All rows come again when a training goes on, so those that TensorBoard has count no more.
    """
    with bar.bar:
        if importlib.util.find_spec("tensorboard") is None:
            yield (bar,)
            return
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  not always there

        with SummaryWriter(str(output / "tensorboard"), purge_step=0) as writer:

            def write(row: Row) -> None:
                for name, value in row.items():
                    writer.add_scalar(name, value, int(row["steps"]))

            yield bar, write
