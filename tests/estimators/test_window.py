"""The factor of a window, which is kept as far as its active set stays.

All else of windows is compared in `test_mhe`: with the reference, and with a general solver.
"""

import numpy as np

from dptse_env.estimators import window as parts
from dptse_env.estimators import with_demand
from dptse_env.estimators.linalg import padded
from dptse_env.estimators.window import Window
from tests.helpers import UNEVEN, compiled

from .helpers import RICH, model_of

factorise, make_factor = compiled(parts.factorise), compiled(parts.make_factor)

MODEL = with_demand(model_of("w99-3lane", "rows", UNEVEN), RICH)
ROAD, CHANNELS, N = MODEL.road, MODEL.channels, MODEL.n_states
N_STAGES = 4


def random_window():
    """A window of random transitions and rows."""
    rng = np.random.default_rng(0)
    s, k, n_channels = ROAD.n_segments, ROAD.neighbours.shape[1], CHANNELS.size
    return Window(
        arrival=rng.normal(0.5, 1.0, N),
        arrival_variance=rng.uniform(0.1, 1.0, N),
        blocks=rng.normal(0.0, 0.5, (N_STAGES, s, k, 4)),
        by_factor=rng.normal(0.0, 0.5, (N_STAGES, N - 2 * s, 3)),
        offsets=rng.normal(0.2, 0.1, (N_STAGES, N)),
        process_variance=rng.uniform(0.01, 0.1, (N_STAGES, N)),
        slopes=rng.normal(0.0, 0.5, (N_STAGES, s)),
        observed=rng.random((N_STAGES, n_channels)) < 0.3,
        weights=rng.normal(0.0, 1.0, (N_STAGES, n_channels, 2, 6)),
        targets=rng.normal(0.5, 1.0, (N_STAGES, n_channels, 2)),
        noise=0.01 * rng.uniform(0.5, 1.5, (N_STAGES, n_channels, 2)),
        lower=np.zeros(N),
        upper=np.ones(N),
    )


def test_a_factor_is_renewed_from_the_first_stage_whose_set_differs():
    window, rng = random_window(), np.random.default_rng(1)
    one, other = (rng.random((2, N_STAGES, N)) < 0.1).astype(np.int64)
    other[:2] = one[:2]
    used, fresh = (make_factor(N_STAGES, N, CHANNELS.size, 6, padded(N)) for _ in range(2))
    for factor, sets in ((used, (one, other)), (fresh, (other,))):
        for active_set in sets:
            assert factorise(ROAD, CHANNELS, window, active_set, factor)
    np.testing.assert_array_equal(used.covariances, fresh.covariances)
    np.testing.assert_array_equal(used.before, fresh.before)
