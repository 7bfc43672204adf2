"""Detailed records: where on the road, in which lane and of which class each vehicle is."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.record import Record
from dptse_env.utils.validation import require


@dataclass(frozen=True, eq=False)
class DetailedRecord(Record):
    """A record with more columns, for what vehicles report of those around them.

    Attributes:
        position: (rows,) float32, position along the mainline [km], from the start of its first
            segment; on a ramp, that of the face that it joins or leaves, minus or plus the distance
            to it.
        lane: (rows,) int16, number of the lane, as the source counts lanes.
        vehicle_class: (rows,) int16, index into `classes`.
        classes: Names of the vehicle classes.

    Raises:
        ValueError: As for `Record`; a position is not finite, or a class has no name.
    """

    FORMAT: ClassVar[str] = "dptse-detailed-record"
    COLUMNS: ClassVar[Mapping[str, np.dtype[Any]]] = {
        **Record.COLUMNS,
        "position": np.dtype("<f4"),
        "lane": np.dtype("<i2"),
        "vehicle_class": np.dtype("<i2"),
    }

    position: NDArray[np.float32]
    lane: NDArray[np.int16]
    vehicle_class: NDArray[np.int16]
    classes: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        super().__post_init__()
        object.__setattr__(self, "classes", tuple(self.classes))
        finite = bool(np.isfinite(self.position).all())
        require(finite, "record.position", "finite", self.position)
        if self.n_rows:
            low, high = int(self.vehicle_class.min()), int(self.vehicle_class.max())
            n = len(self.classes)
            require(low >= 0 and high < n, "record.vehicle_class", f"in 0..{n - 1}", (low, high))

    def _properties(self) -> dict[str, Any]:
        """See `Record`."""
        return {**super()._properties(), "classes": list(self.classes)}

    def class_of_vehicles(self) -> NDArray[np.int16]:
        """Return the class of each vehicle, shape (n_vehicles,), -1 where it has no row."""
        classes = np.full(self.n_vehicles, -1, dtype=np.int16)
        classes[self.vehicle] = self.vehicle_class
        return classes
