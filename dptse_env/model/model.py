"""The ARZ traffic model for estimators: dynamics, measurements, derivatives and bounds."""

import numpy as np

from dptse_env.model.dynamics import ARZDynamics
from dptse_env.model.jacobian import step_jacobian
from dptse_env.model.network import (
    DIVERGE,
    EXIT,
    LINK,
    MERGE,
    MeasurementRows,
    RoadArrays,
    RoadNetwork,
)
from dptse_env.model.parameters import (
    LARGEST_FACTOR,
    LEAST_DENSITY,
    LEAST_FACTOR,
    LEAST_W,
    MEASUREMENT_FLOOR,
    ARZParameters,
    Bounds,
)
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.validation import non_negative


class ARZModel(ARZDynamics):
    """`ARZDynamics` with the measurement of eq. 3, derivatives by the state, and bounds on it.

    Args:
        network: The road.
        parameters: Parameters of the model; each cell's jam density follows its lanes.
        time_step: T [s].
        reference_speed: v_0 [km/h], where sensors release the centred flow rho (v - v_0) [veh/h];
            None where they release the speed. A release may have a centre of its own for each
            segment in its place.
        rows: What a measurement may cover; None for single segments.
        demand_states: Whether the state has a factor on the demand of each entry.

    Raises:
        ValueError: The network is impossible, the time step violates the CFL condition, the
            reference speed is negative or not finite, or rows cover several segments where mean
            speeds are released, which have no sum.
    """

    def __init__(
        self,
        network: RoadNetwork,
        parameters: ARZParameters,
        time_step: float = 1.0,
        reference_speed: float | None = None,
        rows: MeasurementRows | None = None,
        demand_states: bool = False,
    ) -> None:
        """Prepare the dynamics and the scale of measurements."""
        super().__init__(network, parameters, time_step, demand_states)
        self.rows = rows or MeasurementRows.single(self.n_segments)
        if reference_speed is None and not (self.rows.span == 1).all():
            raise ValueError("model.rows must be single segments where mean speeds are released")
        self.reference_speed: float | None = None
        second = 1.0
        if reference_speed is not None:
            self.reference_speed = non_negative("model.reference_speed", reference_speed)
            second = self.density_scale
        self.measurement_scale = np.array([self.density_scale, second * self.speed_scale])

    def jacobian(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Analytic derivative of `step` by the state, `(n, n_x, n_x)`."""
        return step_jacobian(self, states, inputs)

    def measure(self, states: FloatArray, centre: FloatArray | None = None) -> FloatArray:
        """Density and speed of each row `(n, M, 2)` (paper, eq. 3), density floored in v.

        Where flows are released, density and centred flow psi - rho (p(rho) + v_0), averaged over
        the segments of a row.

        Args:
            states: `(n, n_x)`.
            centre: v_0 of each segment `(S,)` or `(n, S)` [km/h]; None for the reference speed.
        """
        if self.reference_speed is None:
            return self.traffic(states)[:, self.rows.first]
        rho, psi = self.components(states)
        v_0 = self.reference_speed if centre is None else centre
        carried = self.relations.pressure(rho, self.jam_density) + v_0
        return self.rows.averages(np.stack([rho, psi - rho * carried], axis=-1))

    def measurement_jacobian(
        self, states: FloatArray, centre: FloatArray | None = None
    ) -> FloatArray:
        """Derivative, `(n, S, 2, 2)`, of a row of a single segment by the segment's (rho, psi)."""
        if self.reference_speed is None:
            return self.traffic_jacobian(states)
        pressure = self.relations.pressure(self.components(states)[0], self.jam_density)
        v_0 = self.reference_speed if centre is None else centre
        jacobian = np.zeros((*pressure.shape, 2, 2))
        jacobian[..., 0, 0] = 1.0
        jacobian[..., 1, 0] = -(1.0 + self.parameters.gamma) * pressure - v_0
        jacobian[..., 1, 1] = 1.0
        return jacobian

    def measurement_matrix(
        self, states: FloatArray, centre: FloatArray | None = None
    ) -> FloatArray:
        """Derivative of `measure` by the state, `(n, M, 2, n_x)`."""
        blocks = self.measurement_jacobian(states, centre)
        n, S = blocks.shape[:2]
        matrix = np.zeros((n, self.rows.n_rows, 2, self.n_states))
        by_segment = np.einsum("ms,nsij->nmisj", self.rows.weights, blocks)
        matrix[..., : 2 * S] = by_segment.reshape(n, -1, 2, 2 * S)
        return matrix

    def traffic(self, states: FloatArray) -> FloatArray:
        """Density and speed of each segment `(n, S, 2)`, the density floored in the speed."""
        rho, psi = self.components(states)
        floored = np.maximum(rho, MEASUREMENT_FLOOR * self.jam_density)
        speed = psi / floored - self.relations.pressure(floored, self.jam_density)
        return np.stack([rho, speed], axis=-1)

    def traffic_jacobian(self, states: FloatArray) -> FloatArray:
        """Derivative of `traffic`, `(n, S, 2, 2)`, by the segment's (rho, psi)."""
        rho, psi = self.components(states)
        floor = MEASUREMENT_FLOOR * self.jam_density
        floored = np.maximum(rho, floor)
        pressure = self.relations.pressure(floored, self.jam_density)
        slope = -(psi / floored + self.parameters.gamma * pressure) / floored
        jacobian = np.zeros((*rho.shape, 2, 2))
        jacobian[..., 0, 0] = 1.0
        jacobian[..., 1, 0] = np.where(rho > floor, slope, 0.0)
        jacobian[..., 1, 1] = 1.0 / floored
        return jacobian

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
            least_w = np.maximum(self.relations.pressure(rho, jam), LEAST_W * v_f)
            low, high = least_w * rho, self.largest_speed * rho
        elif bounds == "box":
            rho = np.clip(density, 0.0, jam)
            low, high = np.zeros_like(rho), np.broadcast_to(jam * v_f, rho.shape)
        else:
            raise ValueError(f"bounds must be 'cone' or 'box', got {bounds!r}")
        factors = np.clip(self.demand_factors(states), LEAST_FACTOR, LARGEST_FACTOR)
        return self.compose(rho, np.clip(psi, low, high), factors)


def make_road_arrays(model: ARZModel) -> RoadArrays:
    """Return a model as arrays and numbers."""
    layout, n = model.layout, model.n_segments
    kind = np.full(n, EXIT, dtype=np.int64)
    parties = np.full((n, 3), -1, dtype=np.int64)
    parties[:, 0] = np.arange(n)
    share = np.zeros(n)
    for up, down in layout.links.T:
        kind[up], parties[up, 1] = LINK, down
    for main, ramp, down in layout.merges.T:
        kind[[main, ramp]] = MERGE
        parties[main, 1:] = down, ramp
        parties[ramp, 1:] = down, main
    for (up, main, off), exit_share in zip(layout.diverges.T, layout.exit_shares, strict=True):
        kind[up], share[up] = DIVERGE, exit_share
        parties[up, 1:] = main, off

    entry, leave = np.full((2, n), -1, dtype=np.int64)
    entry[layout.entries] = layout.entry_inputs
    leave[layout.exits] = layout.exit_inputs
    outside_jam = np.zeros(n)
    outside_jam[layout.exits] = model.exit_jam_density

    edges, edge_share = layout.edges, layout.edge_shares
    neighbours, degree = _neighbours(model)
    terms, weights = _terms(parties, edges, edge_share, neighbours)
    return RoadArrays(
        free_flow_speed=float(model.parameters.free_flow_speed),
        gamma=float(model.parameters.gamma),
        step_ratio=model.step_ratio,
        relaxation=float(model.relaxation),
        jam=model.jam_density,
        outside_jam=outside_jam,
        kind=kind,
        parties=parties,
        share=share,
        entry=entry,
        entries=layout.entries,
        exit=leave,
        edges=edges,
        edge_share=edge_share,
        neighbours=neighbours,
        degree=degree,
        terms=terms,
        term_weight=model.step_ratio[terms[:, 0]] * weights,
        second_scale=float(model.measurement_scale[1]),
        row_first=model.rows.first,
        row_span=model.rows.span,
    )


def _neighbours(model: ARZModel) -> tuple[IntArray, IntArray]:
    sparsity = model.layout.sparsity()
    degree = sparsity.sum(axis=1).astype(np.int64)
    neighbours = np.full((model.n_segments, int(degree.max())), -1, dtype=np.int64)
    for cell, row in enumerate(sparsity):
        cells = np.flatnonzero(row)
        neighbours[cell, : degree[cell]] = [cell, *cells[cells != cell]]
    return neighbours, degree


def _terms(
    parties: IntArray, edges: IntArray, edge_share: FloatArray, neighbours: IntArray
) -> tuple[IntArray, FloatArray]:
    """List the rows of the Jacobian that each outflow's gradient enters, with its weights."""
    flows = [(cell, cell, -1.0) for cell in range(len(parties))]
    flows += [(start, end, part) for (start, end), part in zip(edges, edge_share, strict=True)]
    terms, weights = [], []
    for start, row, weight in flows:
        for party, cell in enumerate(parties[start]):
            if cell >= 0:
                slot = int(np.flatnonzero(neighbours[row] == cell)[0])
                terms.append((row, slot, start, party))
                weights.append(weight)
    return np.array(terms, dtype=np.int64), np.array(weights)
