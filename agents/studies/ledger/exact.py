"""The release model `Exact`: the sums of paced ledgers without noise and without a guarantee."""

import math
from typing import ClassVar

import numpy as np

from dptse_env.release import PrivacyReport, PublicStep, ReleaseModel, ReleaseSetup
from dptse_env.release.paced import Paced
from dptse_env.release.pacing import Pacing
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.vector_info import Rows

PRICE = 1e6
"""Price of every query [1/veh^2]; the noise of a count is a thousandth of a vehicle."""


class AnyPrice(Pacing):
    """The same price for every query, which every vehicle can pay."""

    def prices(self, step: PublicStep) -> FloatArray:
        """See `Pacing.prices`."""
        return np.full(step.observed.shape, PRICE)

    def expected_price(self, speed: FloatArray) -> float:
        """See `Pacing.expected_price`."""
        return PRICE


class Exact(Paced):
    """The sums that `Paced` releases, of all vehicles and with negligible noise.

    It protects nobody: a floor for the errors of one filter, against which the cost of a guarantee
    is measured. Centres and clip are those of `Paced`; epsilon and delta have no effect.
    """

    claims_guarantee: ClassVar[bool] = False

    def __init__(self, setup: ReleaseSetup) -> None:
        """Make ledgers without a limit."""
        super().__init__(setup)
        self.ledgers.budget = math.inf
        self.pacing = AnyPrice(self.pacing.setup)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return infinite losses, which is what is known of a release without a guarantee."""
        return ReleaseModel.spent(self, episodes, steps)

    def report(self) -> PrivacyReport:
        """Return the report of a model that states no guarantee."""
        return ReleaseModel.report(self)

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return nothing: no vehicle has a budget."""
        return {}
