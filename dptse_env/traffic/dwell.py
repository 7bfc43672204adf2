"""The average time of a vehicle on a segment, measured from records."""

from collections.abc import Iterable

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.field_record import AnyRecord, FieldRecord, with_vehicles
from dptse_env.traffic.record import mean_dwell
from dptse_env.utils.fields import require


def average_dwell(corridor: Corridor, records: Iterable[AnyRecord]) -> float:
    """Return the average time of a vehicle on a mainline segment [s]: T_avg of the paper's eq. (6).

    Of vehicles it is measured (`mean_dwell`); in fields it is the vehicles' time on the segments
    over the number of passages, their flow.

    Raises:
        ValueError: No vehicle was ever on the mainline.
    """
    records, n = list(records), corridor.n_mainline
    fields = [record for record in records if isinstance(record, FieldRecord)]
    if not fields:
        return mean_dwell([with_vehicles(record, "the dwell") for record in records], n)
    lengths = np.array(corridor.segment_lengths[:n])
    tables = [(field.density[:, :n], field.speed[:, :n]) for field in fields]
    present = sum(float((density * lengths).sum()) for density, _ in tables)
    passages = sum(float((density * speed).sum()) for density, speed in tables) / 3600.0
    require(passages > 0.0, "records", "records with a vehicle on the mainline", passages)
    return present / passages
