"""Episodes with rows over several segments, which the tests of estimators share."""

from dataclasses import dataclass

import numpy as np

from dptse_env.estimators import DemandSettings, EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.network import MeasurementRows
from dptse_env.utils.arrays import FloatArray

from .episodes import SIGMAS, Episodes, simulate, tell

N_STEPS = 60
PLAIN = EstimatorSettings()
RICH = EstimatorSettings(density_growth=0.03, count_noise=0.5, demand=DemandSettings())


@dataclass(frozen=True)
class RowEpisodes(Episodes):
    """Episodes whose rows have deviations `sigma` `(K, n, M, 2)` of their own at every step."""

    centre: FloatArray  # (K, n, S) speeds that the flows are centred on [km/h]


def every_row(n_segments: int, n_mainline: int) -> MeasurementRows:
    """All segments singly, then all pairs and triples of the mainline, which overlap."""
    pairs = [(first, 1) for first in range(n_segments)]
    pairs += [(first, span) for span in (2, 3) for first in range(n_mainline + 1 - span)]
    first, span = np.array(pairs, dtype=np.int64).T
    return MeasurementRows(first.copy(), span.copy(), n_segments)


def with_rows(model: ARZModel, rows: MeasurementRows) -> ARZModel:
    return ARZModel(
        model.network, model.parameters, reference_speed=model.reference_speed, rows=rows
    )


def averaged(n_steps: int = N_STEPS) -> RowEpisodes:
    """Traffic of which random rows are released; all of them at every tenth step."""
    plain, rng = simulate(n_steps=n_steps, release="flow"), np.random.default_rng(1)
    model = plain.model
    model = with_rows(model, every_row(model.n_segments, model.network.n_mainline))
    shape = n_steps, 1, model.rows.n_rows
    sigma = SIGMAS["flow"] * rng.uniform(0.2, 2.0, (*shape, 2))
    centre = rng.uniform(20.0, 90.0, (n_steps, 1, model.n_segments))
    exact = [model.measure(x, v_0) for x, v_0 in zip(plain.truth, centre, strict=True)]
    values = np.stack(exact) + sigma * rng.normal(size=sigma.shape)
    observed = rng.random(shape) < 0.3
    observed[::10] = True
    kept = plain.start, plain.inputs, observed, values, plain.truth, sigma
    return RowEpisodes(model, *kept, centre)


def update(estimator, episodes, k, observed=None):
    seen = episodes.observed[k] if observed is None else observed
    given = episodes.values[k], episodes.sigma[k], episodes.centre[k]
    tell(estimator, episodes.everyone, seen, *given)
