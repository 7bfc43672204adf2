"""Constitutive relations of the ARZ model (Aw-Rascle 2000, Zhang 2002): pressure, demand, supply.

Along drivers of one characteristic w the flow is `q_w(rho) = rho (w - p(rho))`. Demand is what a
cell can send, supply what the next cell can receive of drivers w. Arrays broadcast.
"""

from dataclasses import dataclass

import numpy as np

from dptse_env.utils.arrays import FloatArray


@dataclass(frozen=True)
class Relations:
    """The relations of a parameter set; jam densities are arguments.

    Attributes:
        free_flow_speed: v_f [km/h].
        gamma: Exponent of the pressure [-].
    """

    free_flow_speed: float
    gamma: float

    def pressure(self, density: FloatArray, jam: FloatArray) -> FloatArray:
        """Pressure v_f (rho / rho_m)^gamma [km/h], the only one with V_e + p = v_f for eq. (1b)."""
        return self.free_flow_speed * (np.maximum(density, 0.0) / jam) ** self.gamma

    def inverse_pressure(self, pressure: FloatArray, jam: FloatArray) -> FloatArray:
        """The density [veh/km] at which the pressure [km/h] is reached."""
        return jam * (np.maximum(pressure, 0.0) / self.free_flow_speed) ** (1.0 / self.gamma)

    def critical_density(self, w: FloatArray, jam: FloatArray) -> FloatArray:
        """sigma(w) [veh/km], where the flow of drivers w is largest."""
        return self.inverse_pressure(w / (1.0 + self.gamma), jam)

    def capacity(self, w: FloatArray, jam: FloatArray) -> FloatArray:
        """q_max(w) = sigma(w) w gamma / (1 + gamma) [veh/h]."""
        return self.critical_density(w, jam) * w * (self.gamma / (1.0 + self.gamma))

    def demand(self, density: FloatArray, w: FloatArray, jam: FloatArray) -> FloatArray:
        """Largest outflow [veh/h]: q_w(rho) up to the critical density, q_max(w) beyond."""
        pressure = self.pressure(density, jam)
        free = (1.0 + self.gamma) * pressure <= w
        return np.where(free, density * (w - pressure), self.capacity(w, jam))

    def demand_gradient(
        self, density: FloatArray, w: FloatArray, jam: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Partial derivatives of `demand` by density [km/h] and by w [veh/km]."""
        pressure = self.pressure(density, jam)
        free = (1.0 + self.gamma) * pressure <= w
        by_density = np.where(free, w - (1.0 + self.gamma) * pressure, 0.0)
        return by_density, np.where(free, density, self.critical_density(w, jam))

    def supply(self, w: FloatArray, speed: FloatArray, jam: FloatArray) -> FloatArray:
        """Largest inflow of drivers w [veh/h] into a cell of the given speed.

        Entering drivers reach the density `rho_M = p^-1(w - v)` at the cell's speed, and that wave
        runs upstream, unless it exceeds their critical density.
        """
        settled = self.inverse_pressure(w - speed, jam)
        ample = speed >= w * (self.gamma / (1.0 + self.gamma))
        return np.where(ample, self.capacity(w, jam), settled * speed)

    def supply_gradient(
        self, w: FloatArray, speed: FloatArray, jam: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Partial derivatives of `supply` by w and by the speed of the cell [veh/km]."""
        gap = w - speed
        settled = self.inverse_pressure(gap, jam)
        ample = speed >= w * (self.gamma / (1.0 + self.gamma))
        slope = settled / (self.gamma * np.where(ample, 1.0, gap))
        by_w = np.where(ample, self.critical_density(w, jam), speed * slope)
        return by_w, np.where(ample, 0.0, settled - speed * slope)
