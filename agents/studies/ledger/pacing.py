"""A pacing that does not follow the queries, to be held against one that does."""

from dptse_env.release import PublicStep
from dptse_env.release.pacing import TracerPacing
from dptse_env.utils.arrays import FloatArray


class EqualRates(TracerPacing):
    """`TracerPacing` with equal rates of querying for all mainline segments, whatever is queried.

    A policy that keeps querying the same place is priced as if its queries were spread over the
    road.
    """

    def prices(self, step: PublicStep) -> FloatArray:
        """See `Pacing.prices`."""
        prices = super().prices(step)
        self._rates[step.episodes] = self._first_rates
        return prices
