"""Moving horizon estimation, compiled."""

import numpy as np

from dptse_env.estimators.batch import Measurements
from dptse_env.estimators.compiled import mhe_kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.compiled.kalman import CompiledFilter
from dptse_env.estimators.compiled.mhe_kernels import Windows
from dptse_env.estimators.horizon import (
    LEAST_DEVIATION,
    Window,
    assemble,
    normalised_bounds,
    process_variance,
    settings_of_mhe,
    solve,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.road_arrays import RoadArrays, make_road_arrays
from dptse_env.utils.arrays import FloatArray, IntArray


class CompiledMHE(CompiledFilter):
    """Moving horizon estimation (paper, eq. 14 to 17), compiled.

    Estimate, deviations and model are those of `dptse_env.estimators.reference.mhe.ReferenceMHE`.
    The program is solved exactly: a filter's forward pass factorises H, and an active-set method,
    started from the last step's set, finds the components at a bound. Where it does not converge
    the reference's solver is used, and where that fails, the prediction.

    Attributes:
        n_passed_on: Number of programs passed on to the reference's solver.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        process_variance(settings)  # check before allocation
        super().__init__(model, n_episodes, settings_of_mhe(settings))
        mhe = settings.mhe
        self.n_passed_on = 0
        n, s, width = model.n_states, model.n_segments, padded(model.n_states)
        self._road: RoadArrays = make_road_arrays(model)
        shape = (n_episodes, mhe.horizon + 1)
        lower, upper = normalised_bounds(model, mhe.bounds)
        self._windows = Windows(
            length=np.ones(n_episodes, dtype=np.int64),
            arrival_variance=np.ones((n_episodes, 2)),
            predicted=np.zeros((*shape, n)),
            inputs=np.zeros((*shape, model.n_inputs)),
            observed=np.zeros((*shape, s), dtype=np.bool_),
            values=np.zeros((*shape, s, 2)),
            noise=np.ones((*shape, 2)),
            blocks=np.zeros((*shape, *self._road.neighbours.shape, 4)),
            offsets=np.zeros((*shape, n)),
            rows=np.zeros((*shape, s, 2)),
            constants=np.zeros((*shape, s)),
            solution=np.zeros((*shape, width)),
            side=np.zeros((*shape, width), dtype=np.int64),
            unsolved=np.zeros(n_episodes, dtype=np.bool_),
            moving_variance=np.square(np.array(mhe.arrival_noise, dtype=np.float64)),
            lower=lower,
            upper=upper,
            along=mhe.linearisation == "trajectory",
        )
        self._windows_packed = (*self._packed, tuple(self._windows))
        self._scales = model.measurement_scale
        self._restart(np.arange(n_episodes))

    def window(self, episode: int) -> Window:
        """Return the linearised problem of an episode, dense, for `assemble`."""
        windows, length = self._windows, int(self._windows.length[episode])
        n, road = self.model.n_states, self._road
        transitions = np.zeros((length - 1, n, n))
        for c in range(self.model.n_segments):
            for slot in range(road.degree[c]):
                b = road.neighbours[c, slot]
                block = windows.blocks[episode, : length - 1, c, slot].reshape(-1, 2, 2)
                transitions[:, 2 * c : 2 * c + 2, 2 * b : 2 * b + 2] = block
        targets = windows.values[episode, :length].copy()
        targets[..., 1] -= windows.constants[episode, :length]
        return Window(
            arrival=windows.predicted[episode, 0],
            arrival_variance=windows.arrival_variance[episode],
            transitions=transitions,
            offsets=windows.offsets[episode, : length - 1],
            process_variance=self._filters.process_variance,
            observed=windows.observed[episode, :length],
            rows=windows.rows[episode, :length],
            targets=targets,
            noise=windows.noise[episode, :length],
        )

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        mhe_kernels.predict(*self._windows_packed, episodes, inputs)

    def _update(self, measured: Measurements) -> None:
        sigma = np.maximum(measured.sigma, LEAST_DEVIATION * self._scales)
        mhe_kernels.update(
            *self._windows_packed, measured.episodes, measured.observed, measured.values, sigma
        )
        unsolved = measured.episodes[self._windows.unsolved[measured.episodes]]
        for episode in unsolved.tolist():
            self._pass_on(episode)

    def _pass_on(self, episode: int) -> None:
        """Pass a program that the active-set method did not solve on to the reference's solver."""
        self.n_passed_on += 1
        windows, n = self._windows, self.model.n_states
        length = int(windows.length[episode])
        lower, upper = np.tile(windows.lower, length), np.tile(windows.upper, length)
        z = solve(*assemble(self.window(episode)), lower, upper, self.settings.mhe.solver)
        self.fallback[episode] = z is None
        windows.side[episode] = 0
        if z is None:
            return
        at_upper, at_lower = (z >= upper).astype(np.int64), (z <= lower).astype(np.int64)
        windows.side[episode, :length, :n] = (at_upper - at_lower).reshape(length, n)
        solution = windows.solution[episode].copy()
        solution[:length, :n] = z.reshape(length, n)
        mhe_kernels.accept(self._road, self._filters, windows, episode, solution)

    def _restart(self, episodes: IntArray) -> None:
        for episode in episodes.tolist():
            mhe_kernels.restart(*self._windows_packed, episode)
