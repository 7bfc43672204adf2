"""Flicker: the deviation of what is counted on a segment from the densities of a continuum.

A segment of length l [km] and density rho has n = rho l vehicles on average, and in any second some
number around it. Freely moving vehicles come nearly as a Poisson process; the denser they are, the
more regular their distances:

    var N = 1/12 + n (1 - rho / rho_m)^6,

with the rounding to whole vehicles. For vehicles of speed v whose own speeds deviate by s, a flow
centred on c then has the variance ``(var N (v - c)^2 + n s^2) / l^2``, and their mean speed
``s^2 / n``. The same vehicles are on the segment for l / v: values that are d seconds apart count
as one where d is less, so that each has ``max(1, l / (v d))`` times the variance of one alone.

The exponent and s were fitted to records of the package's roads on training seeds, counts against
their means over 41 s: the ratio of variance to mean is .8 to .95 below 30 veh/km on three lanes, .2
at 65 and .1 at 100; s is 9 to 15 km/h. The autocorrelation over a lag of d is near 1 - d v / l.
"""

import numpy as np

from dptse_env.model import ARZModel
from dptse_env.model.parameters import VACUUM
from dptse_env.model.step import pressure
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import Bundle, kernel
from dptse_env.utils.units import HOUR

SPREAD = 12.0
"""Standard deviation s of the vehicles' speeds on a segment [km/h]."""
REGULARITY = 6
"""Exponent of the share of the road that is free in the variance of a count over its mean."""
ROUNDING = 1.0 / 12.0
"""Variance of the rounding to whole vehicles."""
LEAST_SPEED = 5.0
"""Speed from which on the time on a segment does not grow any more [km/h]."""
NEVER = 1e9
"""Seconds since what was never observed."""


class Flicker:
    """Adds flicker to the deviations of measurements that a filter on the model reads.

    Attributes:
        since: Seconds since each channel was observed, of n episodes, shape (n, M).
    """

    def __init__(self, model: ARZModel, n_episodes: int) -> None:
        """Prepare for the channels of a model."""
        self.since = np.full((n_episodes, model.channels.size), NEVER)
        self._time_step = model.time_step
        self._bundle = Bundle(model.arz, model.channels)

    def reset(self, episodes: IntArray) -> None:
        """Forget what was observed of episodes (k,)."""
        self.since[episodes] = NEVER

    def deviations(
        self,
        episodes: IntArray,
        states: FloatArray,
        observed: BoolArray,
        centre: FloatArray,
        sigma: FloatArray,
    ) -> FloatArray:
        """Return the deviations of a measurement of episodes (k,) with those of flicker.

        Args:
            episodes: Distinct indices.
            states: Predicted means, (k, n_x) [veh/km, veh/h].
            observed: See `dptse_env.estimators.Measurement`.
            centre: See there.
            sigma: See there.
        """
        since, sigma = self.since[episodes] + self._time_step, sigma.copy()
        add(self._bundle, states, observed, centre, since, sigma)
        self.since[episodes] = since
        return sigma


@kernel
def add(
    bundle: Bundle,
    states: FloatArray,
    observed: BoolArray,
    centre: FloatArray,
    since: FloatArray,
    sigma: FloatArray,
) -> None:
    """Add flicker to deviations `(k, M, 2)`; `since` `(k, M)` becomes 0 where it was observed."""
    arz, channels = bundle.parts
    for k in range(observed.shape[0]):
        for m in range(channels.first.size):
            if not observed[k, m]:
                continue
            first, span, length = channels.first[m], channels.span[m], channels.length[m]
            density = flow = slip = 0.0
            for s in range(first, first + span):
                rho, jam = states[k, 2 * s], arz.jam[s]
                if rho > VACUUM * jam:
                    speed = states[k, 2 * s + 1] / rho
                    speed -= pressure(rho, jam, arz.free_flow_speed, arz.gamma)
                    flow += rho * max(speed, 0.0)
                density += rho
                slip += centre[k, s] / span
            speed = flow / density if density > 0.0 else arz.free_flow_speed
            density /= span
            number, slip = density * length, speed - slip
            dwell = HOUR * length / max(speed, LEAST_SPEED)
            alike = max(dwell / since[k, m], 1.0)
            since[k, m] = 0.0
            free = max(1.0 - density / arz.jam[first], 0.0)
            count = alike * (ROUNDING + number * free**REGULARITY)  # var N
            variance = count / length**2
            sigma[k, m, 0] = np.sqrt(sigma[k, m, 0] ** 2 + variance)
            if np.isnan(slip):
                variance = alike * SPREAD**2 / max(number, 1.0)
            else:
                variance = variance * slip**2 + alike * number * (SPREAD / length) ** 2
            sigma[k, m, 1] = np.sqrt(sigma[k, m, 1] ** 2 + variance)
