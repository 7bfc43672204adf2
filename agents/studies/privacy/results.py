"""Results of the study of privacy, and the lengths of trips that they are read with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agents.experiments.cells import Results
from agents.studies.privacy.account import Account
from agents.studies.privacy.plan import PrivacyCell, PrivacyDesign, Protection
from dptse_env.utils.arrays import IntArray


@dataclass(frozen=True)
class PrivacyResults(Results[PrivacyDesign, PrivacyCell]):
    """Scores of the cells of a design, with the guarantee behind their noise.

    Attributes:
        accounts: Guarantees by protection, in the order of the design's epsilons.
        trips: Seconds in which each vehicle of the traffic can be met, shape (n_vehicles,).
        horizon: Length of an episode [s].
    """

    accounts: Mapping[Protection, Sequence[Account]]
    trips: IntArray
    horizon: int

    @property
    def meetings(self) -> tuple[int, int]:
        """Steps in which a vehicle is met: as many as the base cap, and all of an episode."""
        return min(self.design.cap, self.horizon), self.horizon

    @property
    def longest_trip(self) -> int:
        """Most seconds in which a vehicle can be met."""
        return int(np.max(self.trips))
