"""The ARZ traffic model for estimators: dynamics, measurements, derivatives and bounds."""

from typing import Literal

import numpy as np

from dptse_env.model.dynamics import ARZDynamics, interleave
from dptse_env.model.jacobian import step_jacobian
from dptse_env.model.layout import RoadNetwork
from dptse_env.model.parameters import ARZParameters
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.validation import non_negative

Bounds = Literal["cone", "box"]

# The cone of physical states: 1 veh/km <= rho <= rho_m, v >= 0 and 0.4 v_f <= w <= 1.1 v_f. The
# lower bound on w excludes standing traffic in nearly empty cells, where the supply depends on the
# state as w / rho, which makes filters diverge.
LEAST_DENSITY = 1.0
LEAST_W = 0.4
# Share of the jam density below which a measurement treats the density as constant: dv/drho grows
# as psi / rho^2, which makes filters diverge.
MEASUREMENT_FLOOR = 0.01


class ARZModel(ARZDynamics):
    """`ARZDynamics` with the measurement of eq. 3, derivatives by the state, and bounds on it.

    Args:
        network: The road.
        parameters: Parameters of the model; each cell's jam density follows its lanes.
        time_step: T [s].
        reference_speed: v_0 [km/h], where sensors release the centred flow rho (v - v_0) [veh/h];
            None where they release the speed.

    Raises:
        ValueError: The network is impossible, the time step violates the CFL condition, or the
            reference speed is negative or not finite.
    """

    def __init__(
        self,
        network: RoadNetwork,
        parameters: ARZParameters,
        time_step: float = 1.0,
        reference_speed: float | None = None,
    ) -> None:
        """Prepare the dynamics and the scale of measurements."""
        super().__init__(network, parameters, time_step)
        self.reference_speed: float | None = None
        second = 1.0
        if reference_speed is not None:
            self.reference_speed = non_negative("model.reference_speed", reference_speed)
            second = self.density_scale
        self.measurement_scale = np.array([self.density_scale, second * self.speed_scale])

    def jacobian(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Analytic derivative of `step` by the state, `(n, 2 S, 2 S)`."""
        return step_jacobian(self, states, inputs)

    def measure(self, states: FloatArray) -> FloatArray:
        """Density and speed of each segment `(n, S, 2)` (paper, eq. 3), density floored in v.

        With a reference speed, density and centred flow psi - rho (p(rho) + v_0).
        """
        if self.reference_speed is None:
            return self.traffic(states)
        rho, psi = states[..., 0::2], states[..., 1::2]
        carried = self.relations.pressure(rho, self.jam_density) + self.reference_speed
        return np.stack([rho, psi - rho * carried], axis=-1)

    def measurement_jacobian(self, states: FloatArray) -> FloatArray:
        """Derivative of `measure`, `(n, S, 2, 2)`, by the segment's (rho, psi)."""
        if self.reference_speed is None:
            return self.traffic_jacobian(states)
        pressure = self.relations.pressure(states[..., 0::2], self.jam_density)
        jacobian = np.zeros((*pressure.shape, 2, 2))
        jacobian[..., 0, 0] = 1.0
        jacobian[..., 1, 0] = -(1.0 + self.parameters.gamma) * pressure - self.reference_speed
        jacobian[..., 1, 1] = 1.0
        return jacobian

    def traffic(self, states: FloatArray) -> FloatArray:
        """Density and speed of each segment `(n, S, 2)`, the density floored in the speed."""
        rho, psi = states[..., 0::2], states[..., 1::2]
        floored = np.maximum(rho, MEASUREMENT_FLOOR * self.jam_density)
        speed = psi / floored - self.relations.pressure(floored, self.jam_density)
        return np.stack([rho, speed], axis=-1)

    def traffic_jacobian(self, states: FloatArray) -> FloatArray:
        """Derivative of `traffic`, `(n, S, 2, 2)`, by the segment's (rho, psi)."""
        rho, psi = states[..., 0::2], states[..., 1::2]
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
        """
        v_f, jam = self.parameters.free_flow_speed, self.jam_density
        if bounds == "cone":
            rho = np.clip(states[..., 0::2], LEAST_DENSITY, jam)
            least_w = np.maximum(self.relations.pressure(rho, jam), LEAST_W * v_f)
            low, high = least_w * rho, self.largest_speed * rho
        elif bounds == "box":
            rho = np.clip(states[..., 0::2], 0.0, jam)
            low, high = np.zeros_like(rho), np.broadcast_to(jam * v_f, rho.shape)
        else:
            raise ValueError(f"bounds must be 'cone' or 'box', got {bounds!r}")
        return interleave(rho, np.clip(states[..., 1::2], low, high))
