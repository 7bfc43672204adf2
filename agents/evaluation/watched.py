"""An episode as a page shows it: truth, estimate, queries and privacy, second by second."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dptse_env.process import QueryProcess
from dptse_env.traffic import Corridor, Incident, draw_scenario
from dptse_env.utils.arrays import BoolArray, FloatArray


@dataclass
class Watched:
    """What happened in an episode on the mainline, an array (n_mainline,) for each second.

    Attributes:
        name: The policy.
        corridor: The road.
        traffic_seed: The traffic.
        truth: True densities [veh/km].
        truth_speed: True speeds [km/h]; 0 where there is no vehicle.
        density: Estimated densities [veh/km].
        density_std: Standard deviations that the estimator reports of them [veh/km].
        speed: Estimated speeds [km/h].
        queried: Segments that a query covered.
        error: Density error over the mainline [veh/km], a number for each second.
        epsilon: Privacy loss so far, a number for each second; NaN where none is accounted for.
    """

    name: str
    corridor: Corridor
    traffic_seed: int
    truth: list[FloatArray] = field(default_factory=list)
    truth_speed: list[FloatArray] = field(default_factory=list)
    density: list[FloatArray] = field(default_factory=list)
    density_std: list[FloatArray] = field(default_factory=list)
    speed: list[FloatArray] = field(default_factory=list)
    queried: list[BoolArray] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    epsilon: list[float] = field(default_factory=list)

    def append(self, process: QueryProcess) -> None:
        """Add the present second of the first episode."""
        n, first = process.interface.n_mainline, np.zeros(1, dtype=np.int64)
        truth, estimate = process.truth(first)[0, :n], process.estimate
        self.truth.append(truth[:, 0].copy())
        self.truth_speed.append(truth[:, 1].copy())
        self.density.append(estimate.density[0, :n].copy())
        self.density_std.append(estimate.density_std[0, :n].copy())
        self.speed.append(estimate.speed[0, :n].copy())
        self.queried.append(process.interface.queries.covered(process.queried[:1])[0].copy())
        info = process.info(0)
        self.error.append(float(info["rmse_density"]))
        self.epsilon.append(float(info["epsilon"]))

    @property
    def incidents(self) -> tuple[Incident, ...]:
        """The incidents of the traffic; none where it was recorded from elsewhere."""
        if self.corridor.recordings is not None or self.corridor.network is not None:
            return ()
        return draw_scenario(self.corridor, self.traffic_seed).incidents
