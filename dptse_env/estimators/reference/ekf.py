"""Extended Kalman filter by filterpy, a reference for the compiled one."""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from dptse_env.estimators.batch import EpisodeMeasurements
from dptse_env.estimators.reference.kalman import (
    EpisodeFilter,
    ReferenceFilter,
    configure,
    linearise,
    measurement_covariance,
    step_variance,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.utils.arrays import FloatArray


class _Filter(ExtendedKalmanFilter):  # type: ignore[misc]
    """Filter of an episode in normalised units: filterpy's equations with the ARZ model."""

    def __init__(self, model: ARZModel, settings: EstimatorSettings) -> None:
        super().__init__(dim_x=model.n_states, dim_z=2 * model.rows.n_rows)
        configure(self, model, settings)

    @property
    def state(self) -> FloatArray:
        """Mean `(1, n_x)` in physical units."""
        return np.asarray(self.x[None] * self.scale)

    @state.setter
    def state(self, state: FloatArray) -> None:
        self.x = self.model.project(state, self.bounds)[0] / self.scale

    def restart(self) -> None:
        self.state = self.prior[None]
        self.P = self.prior_covariance.copy()

    def predict_x(self, u: FloatArray) -> None:
        """Predict by the ARZ model instead of a matrix."""
        before, inputs, variance = self.state, u[None], step_variance(self)
        jacobian = self.model.jacobian(before, inputs)[0]
        self.F = jacobian * self.scale[None] / self.scale[:, None]
        self.state = self.model.step(before, inputs)
        self.Q = np.diag(variance)

    def advance(self, u: FloatArray) -> None:
        self.predict(u)

    def assimilate(self, measured: EpisodeMeasurements) -> FloatArray:
        """See `EpisodeFilter.assimilate`."""
        observed = measured.observed
        if not observed.any():
            return np.zeros((0, 2))
        predicted = self.model.measure(self.state, measured.centre)[0] / self.measurement_scale
        jacobian = linearise(self.model, self, measured)
        values = (measured.values[observed] / self.measurement_scale).ravel()
        noise = measurement_covariance(self, measured)
        self.update(values, lambda _: jacobian, lambda _: predicted[observed].ravel(), R=noise)
        self.state = self.state
        return np.asarray((self.y / np.sqrt(np.diag(self.S))).reshape(-1, 2))


class ReferenceEKF(ReferenceFilter):
    """Extended Kalman filter on the ARZ model by filterpy, a filter per episode."""

    def _filter(self) -> EpisodeFilter:
        return _Filter(self.model, self.settings)
