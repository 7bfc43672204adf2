"""The ARZ traffic model of a road for estimators: dynamics, measurements and bounds.

State `x = [rho_0, psi_0, rho_1, psi_1, ...]` over the S segments, with density rho [veh/km] and
relative flow psi = rho w [veh/h], where w = v + p(rho) [km/h] is what drivers carry with them.
Inputs `u = [D_in, w_in, rho_out, D_on1, w_on1, ..., rho_off1, ...]`: demands at the entries [veh/h]
with their w [km/h], and densities behind the exits [veh/km]. Arrays have a leading batch axis n.

With demand states the state has a further component for each entry at its end: a factor on the
demand that the inputs give there, which returns to 1: x' = 1 + exp(-T / memory) (x - 1).
"""

import math
from functools import cached_property

import numpy as np

from dptse_env.model.arrays import ARZ, Channels
from dptse_env.model.parameters import (
    LARGEST_FACTOR,
    LARGEST_W,
    LEAST_DENSITY,
    LEAST_FACTOR,
    LEAST_W,
    MEASUREMENT_FLOOR,
    VACUUM,
    ARZParameters,
    Bounds,
)
from dptse_env.model.step import jacobians, next_states, write_inputs
from dptse_env.road import Road
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import non_negative


class ARZModel:
    """Second-order macroscopic traffic flow, Godunov scheme, proportional merge, FIFO diverge.

    Args:
        road: The road.
        parameters: Parameters of the model; each cell's jam density follows its lanes.
        time_step: T [s].
        centre: v_0 [km/h], where sensors release the centred flow rho (v - v_0) [veh/h];
            None where they release the speed. A release may have a centre of its own for each
            segment in its place.
        channels: What is measured, on segments; None for each of them by itself.
        demand_memory: Seconds in which a factor on the demand of an entry returns to 1; None for a
            state without such factors.

    Attributes:
        n_segments: Segments S.
        n_demand_states: Demand factors E in the state: 1 + I or 0.
        n_states: Components n_x of a state, 2 S + E.
        demand_memory: As given.
        n_inputs: Components n_u of the inputs, 3 + 2 I + O.
        n_boundaries: Boundary cells R.
        arz: Numbers of the model for kernels.
        jam_density: Jam density of each segment, shape (S,) [veh/km].
        largest_speed: Largest speed and w of a physical state, 1.1 v_f [km/h].
        density_scale: rho_m of the mainline, the unit of every normalised density [veh/km].
        speed_scale: v_f, the unit of speeds [km/h].
        state_scale: Units of normalised states: rho_m, rho_m v_f, 1 for demand factors, (n_x,).
        measurement_scale: Units of the two numbers of a channel.

    Raises:
        ValueError: A channel leaves the segments, the centre is negative or not finite, or
            a channel covers several segments where mean speeds are released, which have no sum. The
            dynamics, not the constructor, refuse a time step that violates the CFL condition.
    """

    def __init__(
        self,
        road: Road,
        parameters: ARZParameters,
        time_step: float = 1.0,
        centre: float | None = None,
        channels: Channels | None = None,
        demand_memory: float | None = None,
    ) -> None:
        """Derive what the equations need."""
        self.road, self.parameters, self.time_step = road, parameters, time_step
        self.n_segments = road.n_segments
        self.n_demand_states = 0 if demand_memory is None else road.entries.size
        self.demand_memory = demand_memory
        self.n_states = 2 * self.n_segments + self.n_demand_states
        self.n_inputs, self.n_boundaries = road.n_inputs, road.beside.size
        per_lane = parameters.jam_density / parameters.lanes
        self.largest_speed = LARGEST_W * parameters.free_flow_speed
        # The scale of the mainline for all cells, so that equal numbers have an equal meaning.
        self.density_scale = per_lane * float(road.lanes[: road.n_mainline].max())
        self.speed_scale = parameters.free_flow_speed
        pair = [self.density_scale, self.density_scale * self.speed_scale]
        factors = np.ones(self.n_demand_states)
        self.state_scale: FloatArray = np.append(np.tile(pair, self.n_segments), factors)

        self.channels = channels or Channels.of_segments(road)
        first, span = self.channels.first, self.channels.span
        if not ((first >= 0) & (span >= 1) & (first + span <= self.n_segments)).all():
            raise ValueError(f"model.channels must cover segments in 0..{self.n_segments - 1}")
        self._are_segments = bool((span == 1).all())
        if centre is None and not self._are_segments:
            raise ValueError("model.channels must be segments where mean speeds are released")
        self.centre: float | None = None
        second = self.speed_scale
        if centre is not None:
            self.centre = non_negative("model.centre", centre)
            second = self.density_scale * self.speed_scale
        self.measurement_scale: FloatArray = np.array([self.density_scale, second])
        step_ratio = time_step / HOUR / road.lengths[: self.n_segments]
        self.arz = ARZ(
            free_flow_speed=float(parameters.free_flow_speed),
            gamma=float(parameters.gamma),
            step_ratio=step_ratio,
            relaxation=float(time_step / parameters.relaxation_time),
            kept=1.0 if demand_memory is None else math.exp(-time_step / demand_memory),
            jam=per_lane * road.lanes,
            term_weight=step_ratio[road.terms[:, 0]] * road.term_share,
            second_scale=float(second),
        )
        self.jam_density = self.arz.jam[: self.n_segments]

    @cached_property
    def dynamics(self) -> tuple[Road, ARZ, Channels]:
        """Road, numbers of the model and channels, for kernels that step the model.

        Raises:
            ValueError: The time step violates the CFL condition.
        """
        self.require_time_step()
        return self.road, self.arz, self.channels

    @property
    def releases_flow(self) -> bool:
        """True where flows are measured, False where mean speeds are."""
        return self.centre is not None

    def averages(self, values: FloatArray) -> FloatArray:
        """Averages `(n, M, 2)` over the segments of each channel of values `(n, S, 2)`."""
        if self._are_segments:
            return values[:, self.channels.first]
        averages: FloatArray = np.einsum("ms,nsk->nmk", self.averaging, values)
        return averages

    @cached_property
    def averaging(self) -> FloatArray:
        """Weights of the segments in each channel, shape (M, S): 1 / span of those it covers."""
        return self.channels.averaging(self.n_segments)

    def require_time_step(self) -> None:
        """Raise ``ValueError`` where the time step violates the CFL condition on a segment."""
        lengths, n = self.road.lengths[: self.n_segments], self.road.n_mainline
        field = "segment_length" if lengths.min() == lengths[:n].min() else "ramp_length"
        self.parameters.require_time_step(self.time_step, float(lengths.min()), field)

    # States -------------------------------------------------------------------------------------

    def pressure(self, density: FloatArray, jam: FloatArray | None = None) -> FloatArray:
        """Pressure v_f (rho / rho_m)^gamma [km/h], the only one with V_e + p = v_f for eq. (1b).

        Jam densities [veh/km] are by default those of the segments.
        """
        jam = self.jam_density if jam is None else jam
        v_f, gamma = self.parameters.free_flow_speed, self.parameters.gamma
        pressure: FloatArray = v_f * (np.maximum(density, 0.0) / jam) ** gamma
        return pressure

    def states(self, density: FloatArray, speed: FloatArray) -> FloatArray:
        """State `(n, n_x)` of densities [veh/km] and speeds [km/h] `(n, S)`; psi = rho (v + p).

        Demand factors are 1.
        """
        return self.compose(density, density * (speed + self.pressure(density)))

    def components(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Views of rho [veh/km] and psi [veh/h] `(n, S)` of states."""
        end = 2 * self.n_segments
        return states[..., 0:end:2], states[..., 1:end:2]

    def demand_factors(self, states: FloatArray) -> FloatArray:
        """View of the factors on the demands `(n, E)`, E = 0 without demand states."""
        return states[..., 2 * self.n_segments :]

    def compose(
        self, density: FloatArray, psi: FloatArray, factors: FloatArray | None = None
    ) -> FloatArray:
        """State `(n, n_x)` of rho and psi `(n, S)` and demand factors `(n, E)`, 1 by default."""
        pairs = np.stack([density, psi], axis=-1).reshape(*density.shape[:-1], -1)
        if self.n_demand_states == 0:
            return pairs
        if factors is None:
            factors = np.ones((*density.shape[:-1], self.n_demand_states))
        return np.concatenate([pairs, factors], axis=-1)

    def density(self, states: FloatArray) -> FloatArray:
        """Density `(n, S)` [veh/km]."""
        return self.components(states)[0].copy()

    def speed(self, states: FloatArray) -> FloatArray:
        """Speed `(n, S)` [km/h], `max(w - p(rho), 0)`; the free speed v_f in a vacuum."""
        rho, psi = (np.maximum(part, 0.0) for part in self.components(states))
        empty = rho <= VACUUM * self.jam_density
        w = np.where(empty, self.parameters.free_flow_speed, psi / np.where(empty, 1.0, rho))
        return np.maximum(w - self.pressure(rho), 0.0)

    def project(self, states: FloatArray, bounds: Bounds = "cone") -> FloatArray:
        """Nearest component-wise states within bounds.

        `cone`: rho in [1 veh/km, rho_m], v >= 0 and w in [0.4 v_f, 1.1 v_f].
        `box`: rho in [0, rho_m], psi in [0, rho_m v_f], the paper's, which leaves w unbounded.
        Demand factors lie in [0.1, 3] in both.
        """
        v_f, jam = self.parameters.free_flow_speed, self.jam_density
        density, psi = self.components(states)
        if bounds == "cone":
            rho = np.clip(density, LEAST_DENSITY, jam)
            least_w = np.maximum(self.pressure(rho), LEAST_W * v_f)
            low, high = least_w * rho, self.largest_speed * rho
        elif bounds == "box":
            rho = np.clip(density, 0.0, jam)
            low, high = np.zeros_like(rho), np.broadcast_to(jam * v_f, rho.shape)
        else:
            raise ValueError(f"bounds must be 'cone' or 'box', got {bounds!r}")
        factors = np.clip(self.demand_factors(states), LEAST_FACTOR, LARGEST_FACTOR)
        return self.compose(rho, np.clip(psi, low, high), factors)

    # Dynamics -----------------------------------------------------------------------------------

    def step(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """States `(n, n_x)` one time step later under inputs `(n, n_u)` (paper, eq. 1a and 1b)."""
        after = np.empty(states.shape)
        road, arz, _ = self.dynamics
        next_states(road, arz, np.ascontiguousarray(states), np.ascontiguousarray(inputs), after)
        return after

    def jacobian(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Analytic derivative of `step` by the state, `(n, n_x, n_x)`."""
        derivatives = np.zeros((*states.shape, self.n_states))
        states, inputs = np.ascontiguousarray(states), np.ascontiguousarray(inputs)
        road, arz, _ = self.dynamics
        jacobians(road, arz, states, inputs, derivatives)
        return derivatives

    def boundary_inputs(self, density: FloatArray, speed: FloatArray) -> FloatArray:
        """Inputs `(n, n_u)` of the boundary cells' densities and speeds `(n, R)`.

        Boundary cells: upstream, downstream, before each on-ramp, after each off-ramp. The demand
        of an empty cell is zero for any speed, NaN included. w is clipped to [0, 1.1 v_f], so that
        no input violates the CFL condition.
        """
        inputs = np.empty((density.shape[0], self.n_inputs))
        density, speed = np.ascontiguousarray(density), np.ascontiguousarray(speed)
        write_inputs(self.road, self.arz, density, speed, inputs)
        return inputs

    # Measurements -------------------------------------------------------------------------------

    def measure(self, states: FloatArray, centre: FloatArray | None = None) -> FloatArray:
        """Density and speed of each channel `(n, M, 2)` (paper, eq. 3), density floored in v.

        Where flows are released, density and centred flow psi - rho (p(rho) + v_0), averaged over
        the segments of a channel.

        Args:
            states: `(n, n_x)`.
            centre: v_0 of each segment `(S,)` or `(n, S)` [km/h]; None for the model's own.
        """
        if self.centre is None:
            return self.traffic(states)[:, self.channels.first]
        rho, psi = self.components(states)
        v_0 = self.centre if centre is None else centre
        flow = psi - rho * (self.pressure(rho) + v_0)
        return self.averages(np.stack([rho, flow], axis=-1))

    def measurement_matrix(
        self, states: FloatArray, centre: FloatArray | None = None
    ) -> FloatArray:
        """Derivative of `measure` by the state, `(n, M, 2, n_x)`."""
        if self.centre is None:
            blocks = self.traffic_jacobian(states)
        else:
            rho, _ = self.components(states)
            v_0 = self.centre if centre is None else centre
            by_rho = -(1.0 + self.parameters.gamma) * self.pressure(rho) - v_0
            blocks = _blocks(by_rho, np.ones_like(rho))
        n, S = blocks.shape[:2]
        matrix = np.zeros((n, self.channels.size, 2, self.n_states))
        by_segment = np.einsum("ms,nsij->nmisj", self.averaging, blocks)
        matrix[..., : 2 * S] = by_segment.reshape(n, -1, 2, 2 * S)
        return matrix

    def traffic(self, states: FloatArray) -> FloatArray:
        """Density and speed of each segment `(n, S, 2)`, the density floored in the speed."""
        rho, psi = self.components(states)
        floored = np.maximum(rho, MEASUREMENT_FLOOR * self.jam_density)
        return np.stack([rho, psi / floored - self.pressure(floored)], axis=-1)

    def traffic_jacobian(self, states: FloatArray) -> FloatArray:
        """Derivative of `traffic`, `(n, S, 2, 2)`, by the segment's (rho, psi)."""
        rho, psi = self.components(states)
        floor = MEASUREMENT_FLOOR * self.jam_density
        floored = np.maximum(rho, floor)
        slope = -(psi / floored + self.parameters.gamma * self.pressure(floored)) / floored
        return _blocks(np.where(rho > floor, slope, 0.0), 1.0 / floored)


def _blocks(by_rho: FloatArray, by_psi: FloatArray) -> FloatArray:
    """Return the derivatives (n, S, 2, 2) of a density and a second number by (rho, psi)."""
    blocks = np.zeros((*by_rho.shape, 2, 2))
    blocks[..., 0, 0], blocks[..., 1, 0], blocks[..., 1, 1] = 1.0, by_rho, by_psi
    return blocks
