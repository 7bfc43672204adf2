"""Checks of units and of the direction of travel: what speeds say, and what positions say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dptse_env.traffic.importers.points import TrajectoryError
from dptse_env.traffic.importers.source import LENGTHS, SPEEDS
from dptse_env.traffic.importers.spill import Rows
from dptse_env.utils.arrays import BoolArray, FloatArray

TOLERANCE = 1.25
"""Largest factor between speeds and what positions say of them."""


@dataclass
class Checks:
    """Trajectories by which a file is checked: the longer half of those that are sampled."""

    _ratios: list[FloatArray] = field(default_factory=list)
    _moves: list[FloatArray] = field(default_factory=list)

    def sample(self, rows: Rows, joined: BoolArray) -> None:
        """Take in points in order, and whether each two that follow one another are joined."""
        breaks = np.flatnonzero(np.concatenate([[True], ~joined]))
        last = np.append(breaks[1:], len(rows)) - 1
        move = rows["position"][last] - rows["position"][breaks]
        mean = 0.5 * (rows["speed"][1:] + rows["speed"][:-1])
        steps = np.where(joined, mean * np.diff(rows["time"]) / 3600.0, 0.0)
        total = np.concatenate([[0.0], np.cumsum(steps)])
        far = np.abs(move) >= max(float(np.median(np.abs(move))), 1e-9)
        self._moves.append(move[far])
        self._ratios.append((total[last] - total[breaks])[far] / np.abs(move[far]))

    def require_forward(self, path: Path) -> None:
        """Raise `TrajectoryError` unless vehicles move in the direction of travel."""
        moves = np.concatenate(self._moves)
        share = float((moves < 0.0).mean()) if len(moves) else 0.0
        if share <= 0.1:
            return
        told = "one direction must be chosen by source.where or source.groups"
        if share > 0.9:
            told = "layout.reversed must be turned round"
        raise TrajectoryError(
            f"{path}: {told}, got positions that decrease for {100.0 * share:.0f} % of the vehicles"
        )

    def speed_ratio(self, path: Path, unit: Callable[[str], str]) -> float:
        """Return the median ratio of given speeds to those of positions; NaN without speeds.

        Raises:
            TrajectoryError: It is not near 1; the message names the ratio and units that would be.
        """
        ratios = np.concatenate(self._ratios)
        ratios = ratios[np.isfinite(ratios)]
        if not len(ratios):
            return float("nan")
        ratio = float(np.median(ratios))
        if 1.0 / TOLERANCE <= ratio <= TOLERANCE:
            return ratio
        # Speeds in a larger unit are larger, and so are positions, to which they are held.
        fits = [
            f"{name} in {other}"
            for name, units, power in (("speed", SPEEDS, 1), ("length", LENGTHS, -1))
            for other, factor in units.items()
            if abs(ratio * (factor / units[unit(name)]) ** power - 1.0) < 0.05
        ]
        raise TrajectoryError(
            f"{path}: speeds must agree with positions, got speeds {ratio:.4g} times as large as "
            f"positions say (speed in {unit('speed')}, length in {unit('length')}); what would "
            f"agree: {' or '.join(fits) or 'no known unit'}"
        )
