"""Moving horizon estimation, compiled."""

import numpy as np

from dptse_env.estimators.batch import Measurements
from dptse_env.estimators.compiled import mhe_kernels, road_kernels
from dptse_env.estimators.compiled.algebra import padded
from dptse_env.estimators.compiled.kalman import CompiledFilter
from dptse_env.estimators.compiled.road_order import Spaces, make_order
from dptse_env.estimators.compiled.stages import UNSOLVED, Windows
from dptse_env.estimators.horizon import (
    LEAST_DEVIATION,
    Window,
    assemble,
    moving_variance,
    normalised_bounds,
    require_process_noise,
    settings_of_mhe,
    solve,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.model.model import make_road_arrays
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray, IntArray

# Variables of the longest window up to which it is factorised in the order of time: that is faster
# on short roads, and slower on long ones.
MOST_IN_TIME = 1500


class CompiledMHE(CompiledFilter):
    """Moving horizon estimation (paper, eq. 14 to 17), compiled.

    Estimate, deviations and model are those of `dptse_env.estimators.reference.mhe.ReferenceMHE`.
    The program is solved exactly. In windows of up to `MOST_IN_TIME` variables a filter's forward
    pass factorises H, and an active-set method, started from the last step's set, finds the
    components at a bound. In larger ones H is factorised in the order of the road, where it has
    entries near its diagonal only, and a projected Newton method does so, started from the last
    solution; it also takes over where the active set changes for too long. The time of a step then
    is nearly in proportion to the segments, and `covariances`, which a step does not need, are
    computed when they are asked for. Where no method converges the reference's solver is used, and
    where that fails, the prediction.

    Attributes:
        n_passed_on: Number of programs passed on to the reference's solver.
    """

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        require_process_noise(settings)
        super().__init__(model, n_episodes, settings_of_mhe(settings))
        self.n_passed_on = 0
        self._road: RoadArrays = make_road_arrays(model)
        self._windows = _allocate(model, n_episodes, settings, self._road)
        self._in_time = (settings.mhe.horizon + 1) * model.n_states <= MOST_IN_TIME
        order = make_order(model, self._road, settings.mhe.horizon + 1)
        self._spaces = Spaces(order, settings.mhe.horizon + 1)
        self._windows_packed = (*self._packed, tuple(self._windows))
        self._all_packed = (*self._windows_packed, tuple(order))
        self._scales = model.measurement_scale
        self._restart(np.arange(n_episodes))

    @property
    def covariances(self) -> FloatArray:
        """Covariances `(n, n_x, n_x)`, as those of other filters, of the last update."""
        self._write_covariances(np.flatnonzero(self._windows.updated))
        return super().covariances

    def window(self, episode: int) -> Window:
        """Return the linearised problem of an episode at its last update, for `assemble`."""
        windows, length = self._windows, int(self._windows.length[episode])
        n, s, road = self.model.n_states, self.model.n_segments, self._road
        transitions = np.zeros((length - 1, n, n))
        for c in range(s):
            for slot in range(road.degree[c]):
                b = road.neighbours[c, slot]
                block = windows.blocks[episode, : length - 1, c, slot].reshape(-1, 2, 2)
                transitions[:, 2 * c : 2 * c + 2, 2 * b : 2 * b + 2] = block
        each = np.arange(2 * s, n)
        transitions[:, each, each] = 1.0
        for e, factor in enumerate(each):
            for j in range(2):
                by_factor = windows.by_factor[episode, : length - 1, e, j]
                transitions[:, 2 * road.entries[e] + j, factor] = by_factor
        weights = self.model.rows.weights
        rows = np.zeros((length, *weights.shape[:1], 2, n))
        rows[:, :, 0, 0 : 2 * s : 2] = weights
        for j in range(2):
            slopes = windows.slopes[episode, :length, None, :, j]
            rows[:, :, 1, j : 2 * s : 2] = weights * slopes
        targets = windows.values[episode, :length].copy()
        targets[..., 1] -= windows.constants[episode, :length] @ weights.T
        return Window(
            arrival=windows.predicted[episode, 0],
            arrival_variance=windows.arrival_variance[episode],
            transitions=transitions,
            offsets=windows.offsets[episode, : length - 1],
            process_variance=windows.process_variance[episode, : length - 1],
            observed=windows.observed[episode, :length],
            rows=rows,
            targets=targets,
            noise=windows.noise[episode, :length],
        )

    def _predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        if not self._in_time:
            windows = self._windows
            is_full = windows.length[episodes] == windows.solution.shape[1]
            # The stages of the last update are dropped where there was none in this second.
            self._write_covariances(episodes[is_full & (windows.updated[episodes] > 0)])
        mhe_kernels.predict(*self._windows_packed, episodes, inputs)

    def _write_covariances(self, episodes: IntArray) -> None:
        with self._spaces.lend() as space:
            for episode in episodes.tolist():
                road_kernels.write_covariance(*self._all_packed, space, episode)

    def _update(self, measured: Measurements) -> None:
        sigma = np.maximum(measured.sigma, LEAST_DEVIATION * self._scales)
        episodes, observed, values, _, centre = measured
        rounds = self._windows.rounds
        if self._in_time:
            mhe_kernels.update(*self._windows_packed, episodes, observed, values, sigma, centre)
            unsolved = episodes[rounds[episodes] == UNSOLVED]
            if unsolved.size:
                with self._spaces.lend() as space:
                    road_kernels.solve(*self._all_packed, space, unsolved)
        else:
            with self._spaces.lend() as space:
                road_kernels.update(
                    *self._all_packed, space, episodes, observed, values, sigma, centre
                )
        for episode in episodes[rounds[episodes] == UNSOLVED].tolist():
            self._pass_on(episode)

    def _pass_on(self, episode: int) -> None:
        """Pass a program that remains unsolved on to the reference's solver."""
        self.n_passed_on += 1
        windows, n = self._windows, self.model.n_states
        length = int(windows.length[episode])
        lower, upper = np.tile(windows.lower, length), np.tile(windows.upper, length)
        z = solve(*assemble(self.window(episode)), lower, upper, self.settings.mhe.solver)
        self.fallback[episode] = z is None
        windows.side[episode] = 0
        if z is None:
            return
        solution = windows.solution[episode].copy()
        solution[:length, :n] = z.reshape(length, n)
        mhe_kernels.write_sides(windows, episode, solution)
        mhe_kernels.accept(self._road, self._filters, windows, episode, solution)

    def _restart(self, episodes: IntArray) -> None:
        for episode in episodes.tolist():
            mhe_kernels.restart(*self._windows_packed[1:], episode)


def _allocate(
    model: ARZModel, n_episodes: int, settings: EstimatorSettings, road: RoadArrays
) -> Windows:
    """Return empty windows."""
    n, s, n_rows = model.n_states, model.n_segments, model.rows.n_rows
    width, shape = padded(n), (n_episodes, settings.mhe.horizon + 2)
    lower, upper = normalised_bounds(model, settings.mhe.bounds)
    return Windows(
        length=np.ones(n_episodes, dtype=np.int64),
        updated=np.zeros(n_episodes, dtype=np.int64),
        arrival_variance=np.ones((n_episodes, n)),
        predicted=np.zeros((*shape, n)),
        inputs=np.zeros((*shape, model.n_inputs)),
        process_variance=np.ones((*shape, n)),
        blocks=np.zeros((*shape, *road.neighbours.shape, 4)),
        by_factor=np.zeros((*shape, model.n_demand_states, 2)),
        offsets=np.zeros((*shape, n)),
        observed=np.zeros((*shape, n_rows), dtype=np.bool_),
        values=np.zeros((*shape, n_rows, 2)),
        noise=np.ones((*shape, n_rows, 2)),
        centre=np.zeros((*shape, s)),
        slopes=np.zeros((*shape, s, 2)),
        constants=np.zeros((*shape, s)),
        point=np.zeros((n_episodes, width)),
        solution=np.zeros((*shape, width)),
        side=np.zeros((*shape, width), dtype=np.int64),
        rounds=np.zeros(n_episodes, dtype=np.int64),
        moving_variance=moving_variance(model, settings),
        lower=lower,
        upper=upper,
        units=model.state_scale,
        along=settings.mhe.linearisation == "trajectory",
    )
