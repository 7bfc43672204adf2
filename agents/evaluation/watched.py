"""An episode as a page shows it: truth, estimate, queries and privacy, second by second."""

from __future__ import annotations

from dataclasses import dataclass, field

from dptse_env.process import QueryProcess
from dptse_env.rendering import History
from dptse_env.traffic import Corridor, Incident, draw_scenario
from dptse_env.utils.arrays import FloatArray


@dataclass
class Watched:
    """An episode of a policy, and what its pictures leave out.

    Attributes:
        name: The policy.
        corridor: The road.
        traffic_seed: The traffic.
        history: Truth, estimates, queries and errors.
        density_std: Standard deviations that the estimator reports of the mainline densities
            [veh/km], an array (n_mainline,) for each second.
        epsilon: Privacy loss so far, a number for each second; infinite where none is bounded.
    """

    name: str
    corridor: Corridor
    traffic_seed: int
    history: History
    density_std: list[FloatArray] = field(default_factory=list)
    epsilon: list[float] = field(default_factory=list)

    def append(self, process: QueryProcess) -> None:
        """Add the present second of the first episode."""
        self.history.append(process)
        n = process.interface.n_mainline
        self.density_std.append(process.estimate.density_std[0, :n].copy())
        self.epsilon.append(float(process.info(0)["epsilon"]))

    @property
    def incidents(self) -> tuple[Incident, ...]:
        """The incidents of the traffic; none where it was recorded from elsewhere."""
        if self.corridor.recordings is not None or self.corridor.network is not None:
            return ()
        return draw_scenario(self.corridor, self.traffic_seed).incidents
