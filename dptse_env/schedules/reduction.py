"""A schedule on the reduction of the squared error that each query is expected to bring."""

from typing import ClassVar

import numpy as np

from dptse_env.process import QueryProcess
from dptse_env.schedules.base import ProcessSchedule
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray, Observation

LEAST_DENSITY = 1.0
"""Density [veh/km] by which the noise of a flow is divided at least."""


class ExpectedReduction(ProcessSchedule):
    """The segments whose query is expected to reduce the squared error the most, times the age.

    With the reported variances P of density and speed, and the variances V of what the release
    model expects to release about them, scores are

        (age + 1) (P_rho^2 / (P_rho + V_rho) / a^2 + P_v^2 / (P_v + V_v) / b^2)

    in units a, b of the reward, with the term that the reward has. The variance of a speed that is
    released as a flow is that of the flow's noise over the squared density. Errors of different
    segments, and of density and speed, count as independent: for estimators whose deviations are
    honest, such as `recurrent`. A step sorts the segments once.
    """

    name: ClassVar[str] = "expected-reduction"

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule to a process (``env.unwrapped.process``)."""
        super().__init__(process, seed)
        self._noise = np.square(process.expected_sigma)
        corridor, term = process.config.corridor, process.interface.reward.term
        self._of_density = (term != "speed") / corridor.density_scale**2
        self._of_speed = (term != "density") / corridor.speed_scale**2

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        n, estimate = self.n_mainline, self.process.estimate
        density, density_std, speed_std = (
            table[rows, :n]
            for table in (estimate.density, estimate.density_std, estimate.speed_std)
        )
        flows = self.process.model.reference_speed is not None
        carrier = np.maximum(density, LEAST_DENSITY) if flows else np.ones_like(density)
        value = self._of_density * _reduction(density_std**2, self._noise[0])
        value += self._of_speed * _reduction(speed_std**2, self._noise[1] / carrier**2)
        return self.highest((self.process.age[rows] + 1.0) * value, step)


def _reduction(variance: FloatArray, noise: FloatArray | float) -> FloatArray:
    """Return by how much a measurement with some noise reduces a variance."""
    reduced: FloatArray = variance**2 / np.maximum(variance + noise, 1e-300)
    return reduced
