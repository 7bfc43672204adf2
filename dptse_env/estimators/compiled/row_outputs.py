"""Compiled outputs of many states: averages over neighbouring segments, as rows measure them."""

from dptse_env.model.columns import released_by_states
from dptse_env.model.network import RoadArrays
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part


@kernel_part(fastmath={"contract"})
def average_outputs(
    road: RoadArrays,
    states: FloatArray,
    first: int,
    span: int,
    centre: FloatArray,
    density: FloatArray,
    second: FloatArray,
    work: FloatArray,
) -> None:
    """Write the average densities and centred flows of neighbouring segments, for each state.

    Args:
        road: The road.
        states: `(n_x, width)`, a state per column.
        first: The first segment.
        span: The number of segments.
        centre: `(S,)` speeds that the flows are centred on [km/h].
        density: `(width,)` output [veh/km].
        second: `(width,)` output [veh/h].
        work: `(width,)` scratch.
    """
    density[:], second[:] = 0.0, 0.0
    part = 1.0 / span
    for s in range(first, first + span):
        rho, psi = states[2 * s], states[2 * s + 1]
        released_by_states(road, s, rho, psi, centre[s], work)
        for j in range(rho.size):
            density[j] += part * rho[j]
            second[j] += part * work[j]
