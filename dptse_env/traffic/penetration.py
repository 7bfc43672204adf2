"""Penetration: which of the vehicles of a record are connected, and what they report."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.validation import Interval, checked_fields

ConnectedShare = Annotated[float, Interval(1e-9, 1)]
"""A share of connected vehicles, the smallest of which is as good as none."""


@dataclass(frozen=True)
class Penetration:
    """The share of connected vehicles, and which ones these are.

    A vehicle is connected if its uniform number lies below the share. The number depends on the
    penetration seed, the traffic seed and the vehicle's index alone: vehicles that are connected at
    a share are also connected at every larger one, and every policy meets the same.

    Attributes:
        share: Share p of connected vehicles; a pair (low, high) for a share that is drawn for each
            traffic seed, uniformly between the two.
        seed: Penetration seed.
        misreporting: Share of the connected vehicles that report a wrong speed.
        misreport_factor: Factor on the speed that these report.

    Raises:
        ValueError: A value is out of range.
    """

    share: ConnectedShare | tuple[ConnectedShare, ConnectedShare] = 1.0
    seed: Annotated[int, Interval(0, 2**31 - 1)] = 0
    misreporting: Annotated[float, Interval(0, 1)] = 0.0
    misreport_factor: Annotated[float, Interval(0, 10)] = 1.0

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "penetration")
        if isinstance(self.share, tuple):
            low, high = self.share
            if low > high:
                raise ValueError(f"penetration.share must be (low, high), got {self.share}")
            if low == high:
                object.__setattr__(self, "share", low)

    @property
    def is_complete(self) -> bool:
        """True if every vehicle is connected, and reports its own speed."""
        return self.share == 1.0 and not self.misreports

    @property
    def misreports(self) -> bool:
        """True if some vehicles report a wrong speed."""
        return self.misreporting > 0.0 and self.misreport_factor != 1.0

    @property
    def published_share(self) -> float:
        """The public share of connected vehicles: p, or the middle of its range."""
        return sum(self.share) / 2.0 if isinstance(self.share, tuple) else self.share

    def share_of(self, traffic_seed: int) -> float:
        """Return the share of connected vehicles in the traffic of a seed."""
        if not isinstance(self.share, tuple):
            return self.share
        low, high = self.share
        return low + (high - low) * float(self._uniform(traffic_seed, 1, 1)[0])

    def connected(self, traffic_seed: int, record: Record) -> BoolArray:
        """Return flags of the connected vehicles of a seed's record, shape (n_vehicles,)."""
        uniform = self._uniform(traffic_seed, 0, record.n_vehicles)
        connected: BoolArray = uniform < self.share_of(traffic_seed)
        return connected

    def speeds(self, traffic_seed: int, record: Record) -> NDArray[np.float32]:
        """Return the speed that each row's vehicle reports [km/h], -1 if it is not connected."""
        speeds = record.speed
        if self.misreports:
            wrong = self._uniform(traffic_seed, 2, record.n_vehicles) < self.misreporting
            factor = np.where(wrong, self.misreport_factor, 1.0)[record.vehicle]
            speeds = (speeds * factor).astype(np.float32)
        reports = self.connected(traffic_seed, record)[record.vehicle]
        return np.where(reports, speeds, np.float32(-1.0))

    def _uniform(self, traffic_seed: int, stream: int, n: int) -> FloatArray:
        """Return the uniform numbers of n vehicles in one of several streams, shape (n,).

        Philox is a generator by counter: the number of a vehicle does not depend on n.
        """
        key = np.array([self.seed, traffic_seed], dtype=np.uint64)
        generator = np.random.Generator(np.random.Philox(key=key).jumped(stream))
        return generator.random(n)
