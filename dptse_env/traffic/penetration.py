"""Penetration: which of the vehicles of a record are connected, and what they report."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.detailed_record import DetailedRecord
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import BoolArray, FloatArray
from dptse_env.utils.fields import Interval, checked_fields

ConnectedShare = Annotated[float, Interval(0, 1, open_low=True)]
"""A share of connected vehicles."""


@dataclass(frozen=True)
class ClassShare:
    """The share of connected vehicles in a vehicle class.

    Attributes:
        name: Name of the class.
        share: Share of its vehicles that are connected.

    Raises:
        ValueError: The share is out of range.
    """

    name: str
    share: ConnectedShare

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "penetration.by_class")


@dataclass(frozen=True)
class Penetration:
    """The share of connected vehicles, and which ones these are.

    A vehicle is connected if its uniform number lies below the share. The number depends on the
    penetration seed, the traffic seed and the vehicle's index alone: vehicles that are connected at
    a share are also connected at every larger one, and every policy meets the same.

    Attributes:
        share: Share p of connected vehicles; a pair (low, high) for a share that is drawn for each
            traffic seed, uniformly between the two. With ``by_class`` it is left out, or is the
            share of all vehicles where the traffic does not say how many are of which class.
        by_class: Shares by vehicle class, in place of one share; other classes are not connected.
        seed: Penetration seed.
        misreporting: Share of the connected vehicles that report a wrong speed.
        misreport_factor: Factor on the speed that these report.

    Raises:
        ValueError: A value is out of range, or a class is named twice.
    """

    share: ConnectedShare | tuple[ConnectedShare, ConnectedShare] = 1.0
    seed: Annotated[int, Interval(0, 2**31 - 1)] = 0
    misreporting: Annotated[float, Interval(0, 1)] = 0.0
    misreport_factor: Annotated[float, Interval(0, 10)] = 1.0
    by_class: tuple[ClassShare, ...] = ()

    def __post_init__(self) -> None:
        """Check values."""
        checked_fields(self, "penetration")
        names = [each.name for each in self.by_class]
        if len(set(names)) < len(names):
            raise ValueError(f"penetration.by_class must name each class once, got {names}")
        if self.by_class and isinstance(self.share, tuple):
            raise ValueError(
                f"penetration.share must be one number beside penetration.by_class, got "
                f"{self.share}"
            )
        if isinstance(self.share, tuple):
            low, high = self.share
            if low > high:
                raise ValueError(f"penetration.share must be (low, high), got {self.share}")
            if low == high:
                object.__setattr__(self, "share", low)

    @property
    def is_complete(self) -> bool:
        """True if every vehicle is connected, and reports its own speed."""
        return self.share == 1.0 and not self.by_class and not self.misreports

    @property
    def misreports(self) -> bool:
        """True if some vehicles report a wrong speed."""
        return self.misreporting > 0.0 and self.misreport_factor != 1.0

    @property
    def needs_details(self) -> bool:
        """True if records must hold positions, lanes and classes."""
        return bool(self.by_class)

    @property
    def _class_shares(self) -> dict[str, float]:
        return {each.name: each.share for each in self.by_class}

    def published_share(self, corridor: Corridor) -> float:
        """Return the public share of all vehicles: p, the middle of its range, or from classes."""
        if self.by_class and corridor.vehicle_classes:
            shares = self._class_shares
            return sum(each.share * shares.get(each.name, 0.0) for each in corridor.vehicle_classes)
        return sum(self.share) / 2.0 if isinstance(self.share, tuple) else self.share

    def check_classes(self, corridor: Corridor) -> None:
        """Check that a corridor has the classes of ``by_class``.

        Raises:
            ValueError: It has not, or shares do not add up to that of all vehicles.
        """
        if not self.by_class:
            return
        if corridor.network is not None or corridor.recordings is not None:
            if self.share == 1.0:
                raise ValueError(
                    "penetration.share must be the share of all vehicles that are connected, below "
                    "1, where classes come with the traffic, got 1"
                )
            return  # the classes are those of the records, which are looked up when these are read
        self._require_classes(corridor.class_names)
        total = self.published_share(corridor)
        assert isinstance(self.share, float)
        if self.share != 1.0 and not math.isclose(self.share, total, abs_tol=1e-9):
            raise ValueError(
                f"penetration.share must be left out, or be what penetration.by_class adds up to, "
                f"{total:g}, got {self.share:g}"
            )

    def _require_classes(self, known: tuple[str, ...]) -> None:
        for i, each in enumerate(self.by_class):
            if each.name not in known:
                raise ValueError(
                    f"penetration.by_class[{i}].name must be a class of the traffic, "
                    f"{', '.join(known)}, got {each.name!r}"
                )

    def share_of(self, traffic_seed: int) -> float:
        """Return the share of connected vehicles in the traffic of a seed, without classes."""
        if not isinstance(self.share, tuple):
            return self.share
        low, high = self.share
        return low + (high - low) * float(self._uniform(traffic_seed, 1, 1)[0])

    def connected(self, traffic_seed: int, record: Record) -> BoolArray:
        """Return flags of the connected vehicles of a seed's record, shape (n_vehicles,)."""
        share: FloatArray | float = self.share_of(traffic_seed)
        if self.by_class:
            details = _with_details(record)
            self._require_classes(details.classes)
            shares = self._class_shares
            of_class = np.array([shares.get(name, 0.0) for name in details.classes])
            share = of_class[details.class_of_vehicles()]
        connected: BoolArray = self._uniform(traffic_seed, 0, record.n_vehicles) < share
        return connected

    def reports(self, traffic_seed: int, record: Record) -> Record:
        """Return what the connected vehicles of a record report: their rows, with their speeds.

        Vehicles keep their indices.

        Raises:
            ValueError: The record has no positions, lanes and classes, and they are needed; or it
                has not the classes that are named.
        """
        reported = record.where(self.connected(traffic_seed, record)[record.vehicle])
        if not self.misreports:
            return reported
        wrong = self._uniform(traffic_seed, 2, record.n_vehicles) < self.misreporting
        factor = np.where(wrong, self.misreport_factor, 1.0)[reported.vehicle]
        return replace(reported, speed=(reported.speed * factor).astype(np.float32))

    def _uniform(self, traffic_seed: int, stream: int, n: int) -> FloatArray:
        """Return the uniform numbers of n vehicles in one of several streams, shape (n,).

        Philox is a generator by counter: the number of a vehicle does not depend on n.
        """
        key = np.array([self.seed, traffic_seed], dtype=np.uint64)
        generator = np.random.Generator(np.random.Philox(key=key).jumped(stream))
        return generator.random(n)


def _with_details(record: Record) -> DetailedRecord:
    """Return a record that has positions, lanes and classes.

    Raises:
        ValueError: It has none.
    """
    if not isinstance(record, DetailedRecord):
        raise ValueError(
            "penetration.by_class needs records with positions, lanes and classes, which this "
            "traffic was imported without: import it again with --detailed"
        )
    return record
