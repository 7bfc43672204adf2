"""Estimators that are given something else than what was released, to see what they live off."""

from __future__ import annotations

from typing import Any

import numpy as np

from dptse_env.process import QueryProcess

FAILING, CONSTANT_DEMAND, OTHER_RELEASES = "failing", "constant-demand", "other-releases"
TAMPERINGS = (FAILING, CONSTANT_DEMAND, OTHER_RELEASES)
FIRST, LAST = 300, 360
"""Seconds between which fixed sensors fail."""


def tamper(process: QueryProcess, tampering: str) -> None:
    """Change what the estimator of a process is given; episodes keep in step.

    - ``failing``: fixed sensors measure nothing for a minute.
    - ``constant-demand``: nominal demands stay what they are in the first second.
    - ``other-releases``: an episode gets the values and centres of the episode before it.

    Raises:
        ValueError: There is no such tampering.
    """
    if tampering not in TAMPERINGS:
        raise ValueError(f"tampering must be one of {', '.join(TAMPERINGS)}, got {tampering!r}")
    process.estimator = _Tampered(process, tampering)  # type: ignore[assignment]


class _Tampered:
    """An estimator whose arguments are changed on their way; everything else is the estimator's."""

    def __init__(self, process: QueryProcess, tampering: str) -> None:
        self._process, self._estimator, self._tampering = process, process.estimator, tampering
        self._sensors = list(process.config.corridor.fixed_sensors)
        self._first_inputs: Any = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def predict(self, episodes: Any, inputs: Any) -> None:
        """Predict, from inputs that may be changed."""
        if self._tampering == CONSTANT_DEMAND:
            if self._first_inputs is None:
                self._first_inputs = np.array(inputs)
            entries = self._process.model.layout.entry_inputs
            inputs = np.array(inputs)
            inputs[:, entries] = self._first_inputs[:, entries]
        self._estimator.predict(episodes, inputs)

    def update(self, episodes: Any, observed: Any, values: Any, sigma: Any, centre: Any) -> None:
        """Update by measurements that may be changed."""
        time = int(self._process.time[0])
        if self._tampering == FAILING and FIRST <= time < LAST:
            observed = np.array(observed)
            rows = self._process.model.rows
            lost = [m for m in range(rows.n_rows) if rows.span[m] == 1]
            observed[:, [m for m in lost if rows.first[m] in self._sensors]] = False
        if self._tampering == OTHER_RELEASES:
            values = np.roll(values, 1, axis=0)
            centre = np.roll(centre, 1, axis=0) if np.ndim(centre) == 2 else centre
        self._estimator.update(episodes, observed, values, sigma, centre)
