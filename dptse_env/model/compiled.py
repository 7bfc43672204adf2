"""The ARZ model with compiled dynamics: same interface and numbers as `ARZModel`."""

from functools import cached_property

import numpy as np

from dptse_env.model.model import ARZModel, make_road_arrays
from dptse_env.model.network import RoadArrays
from dptse_env.model.step import advance, make_scratch
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel


class CompiledARZModel(ARZModel):
    """`ARZModel` with compiled `step` and `jacobian`."""

    @cached_property
    def road(self) -> RoadArrays:
        """The model as arrays, for the kernels of `dptse_env.model.step`."""
        return make_road_arrays(self)

    def step(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """States `(n, n_x)` one time step later."""
        after = np.empty(states.shape)
        _step_batch(self.road, np.ascontiguousarray(states), np.ascontiguousarray(inputs), after)
        return after

    def jacobian(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Analytic derivative of `step` by the state; see `ARZModel.jacobian`."""
        jacobian = np.zeros((states.shape[0], self.n_states, self.n_states))
        _jacobian_batch(
            self.road, np.ascontiguousarray(states), np.ascontiguousarray(inputs), jacobian
        )
        return jacobian


@kernel
def _step_batch(
    road: RoadArrays, states: FloatArray, inputs: FloatArray, after: FloatArray
) -> None:
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    for i in range(states.shape[0]):
        advance(road, states[i], inputs[i], after[i], blocks, scratch)


@kernel
def _jacobian_batch(
    road: RoadArrays, states: FloatArray, inputs: FloatArray, jacobian: FloatArray
) -> None:
    scratch = make_scratch(road)
    blocks = np.empty((*road.neighbours.shape, 4))
    after = np.empty(states.shape[1])
    for i in range(states.shape[0]):
        advance(road, states[i], inputs[i], after, blocks, scratch)
        for c in range(road.jam.size):
            for slot in range(road.degree[c]):
                b = road.neighbours[c, slot]
                for k in range(4):
                    jacobian[i, 2 * c + k // 2, 2 * b + k % 2] = blocks[c, slot, k]
        for j in range(2 * road.jam.size, after.size):
            e = j - 2 * road.jam.size
            jacobian[i, j, j] = 1.0
            for k in range(2):
                jacobian[i, 2 * road.entries[e] + k, j] = scratch.by_factor[e, k]
