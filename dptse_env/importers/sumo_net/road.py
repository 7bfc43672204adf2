"""Corridor of a segmentation, with the demand and the exit shares of one simulated run."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dptse_env.importers.measured import with_measured
from dptse_env.importers.sumo_net.configuration import Files
from dptse_env.importers.sumo_net.segmentation import Segmentation
from dptse_env.traffic.corridor import Conditions, Corridor, Scales
from dptse_env.traffic.demand import Demand, Profile
from dptse_env.traffic.own_sumo import SumoScenario
from dptse_env.traffic.record import Record
from dptse_env.traffic.recording import simulate_in_worker
from dptse_env.traffic.sumo import RecordingError
from dptse_env.utils.arrays import BoolArray, IntArray
from dptse_env.utils.files import file_digest
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import require

NEVER = np.iinfo(np.int64).max
"""First step of a vehicle on a column where it never is."""


@dataclass(frozen=True)
class ImportedRoad:
    """A road of a SUMO net.

    Attributes:
        corridor: the road, with demand, exit shares and average dwell counted in `record`.
        segments: its segments in the net.
        record: the run that was counted.
        remarks: sentences for people on what is unusual.
    """

    corridor: Corridor
    segments: Segmentation
    record: Record
    remarks: tuple[str, ...]

    @property
    def description(self) -> list[str]:
        """The road, what enters and leaves it, and the remarks, in lines."""
        corridor, names = self.corridor, self.segments.names
        geometry, files = corridor.geometry, corridor.sumo
        assert files is not None
        n, n_on = geometry.n_mainline, len(geometry.on_ramps)
        lengths, lanes, limits = (
            each[:n]
            for each in (geometry.segment_lengths, geometry.segment_lanes, geometry.speed_limits)
        )
        demand = corridor.conditions.published_demand
        on_ramps = zip(geometry.on_ramps, names[:n_on], demand.ramp_profiles, strict=True)
        off_ramps = zip(geometry.off_ramps, names[n_on:], geometry.exit_shares, strict=True)
        return [
            f"{corridor.name}: from {Path(files.net).name}, seconds {files.begin} to "
            f"{files.begin + corridor.conditions.duration}",
            f"{n} segments of {1000 * min(lengths):.0f} to {1000 * max(lengths):.0f} m, "
            f"{min(lanes)} to {max(lanes)} lanes, {min(limits):.0f} to {max(limits):.0f} km/h",
            f"mainline: {_range(demand.mainline)}",
            *(f"on-ramp at face {face}: {name}, {_range(rates)}" for face, name, rates in on_ramps),
            *(
                f"off-ramp at face {face}: {name}, {100 * share:.1f} % leave"
                for face, name, share in off_ramps
            ),
            *(f"note: {remark}" for remark in self.remarks),
        ]


def _range(profile: Profile) -> str:
    rates = [rate for _, rate in profile]
    return f"{min(rates):.0f} to {max(rates):.0f} veh/h"


def import_road(
    files: Files,
    segments: Segmentation,
    name: str,
    duration: int,
    begin: int | None = None,
    warm_up: int = 0,
    speed_limit: float | None = None,
    seed: int = 0,
) -> ImportedRoad:
    """Make a corridor of a segmentation, and count its demand in one simulated run.

    Args:
        files: what the simulation reads.
        segments: the segments.
        name: name of the corridor.
        duration: length of a record [s].
        begin: second of SUMO's clock at which a record starts; that of `files` after the warm-up
            if None.
        warm_up: seconds simulated before, at most `begin`.
        speed_limit: limit of all segments [km/h]; that of the edges if None.
        seed: traffic seed of the run that is counted.

    Raises:
        ValueError: Files or fields are malformed, SUMO refuses the files, or no vehicle uses the
            path.
    """
    if begin is None:
        require(float(files.begin).is_integer(), "begin", "whole seconds", files.begin)
        begin = int(files.begin) + warm_up
    remarks = [*segments.remarks, *files.check(begin - warm_up)]
    try:
        draft = _draft(files, segments, name, duration, begin, warm_up, speed_limit)
    except ValueError as problem:
        raise ValueError(f"net: {files.net}: {problem}") from problem
    try:
        record = simulate_in_worker(draft, seed, remarks.append)
    except RecordingError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"net: {files.net}: SUMO refuses these files: {reason:.500}") from error
    if not (record.segment < draft.geometry.n_mainline).any():
        seen = f"{record.n_vehicles} on its ramps or ends" if record.n_rows else "none"
        routes = ", ".join(path.name for path in files.routes)
        raise ValueError(
            f"routes: {routes} must have vehicles that use the path from {begin} s to "
            f"{begin + duration} s, got {seen}"
        )
    # First step of each vehicle on each column.
    first = np.full((record.n_vehicles, record.n_columns), NEVER)
    np.minimum.at(first, (record.vehicle, record.segment), record.step.astype(np.int64))
    corridor = with_measured(draft, [record], _demand(draft, first), _exit_shares(draft, first))
    inside = (first.argmin(axis=1) < draft.geometry.n_mainline) & (first.min(axis=1) > 0)
    if inside.any():
        share = f"{inside.sum()} of {record.n_vehicles} vehicles"
        remarks.append(f"{share} appear on the mainline, past every entrance")
    if not record.counts[0, : draft.geometry.n_mainline].any():
        remarks.append("the record begins on an empty mainline; a warm-up fills it")
    remarks += [f"no vehicle {text}" for text in _unused(draft, segments.names, first)]
    remarks.append(
        "fixed sensors are assumed on the last mainline segment and on off-ramps: "
        f"fixed_sensors = {list(draft.fixed_sensors)}"
    )
    return ImportedRoad(corridor, segments, record, tuple(remarks))


def _unused(corridor: Corridor, names: Sequence[str], first: IntArray) -> Iterator[str]:
    """Yield the entrances and exits that no vehicle takes, for people."""
    road = corridor.geometry
    N, S, n_on = road.n_mainline, road.n_segments, len(road.on_ramps)
    ends = ["enters at the upstream end", "leaves at the downstream end"]
    ramps = [f"{'enters by' if i < n_on else 'leaves by'} {name}" for i, name in enumerate(names)]
    for i, text in enumerate([*ends, *ramps]):
        columns = [S + i] if i < 2 else [S + i, N + i - 2]
        if (first[:, columns] == NEVER).all():
            yield text


def _draft(
    files: Files,
    segments: Segmentation,
    name: str,
    duration: int,
    begin: int,
    warm_up: int,
    speed_limit: float | None,
) -> Corridor:
    """Return the corridor without what is counted."""
    folder = files.net.parent.resolve()
    paths = (files.net, *files.routes, *files.additional)
    # With slashes everywhere, so that a road file can be read on another system.
    names = tuple(Path(os.path.relpath(path.resolve(), folder)).as_posix() for path in paths)
    n_routes = len(files.routes)
    sumo = SumoScenario(
        net=names[0],
        routes=names[1 : 1 + n_routes],
        additional=names[1 + n_routes :],
        sha256=tuple(file_digest(path) for path in paths),
        columns=segments.columns,
        folder=str(folder),
        begin=begin,
        warm_up=warm_up,
        step_length=files.step_length,
        options=files.options,
    )
    road = segments.geometry
    if speed_limit is not None:
        road = dataclasses.replace(road, speed_limit=speed_limit, ramp_speed_limit=None)
    N, n_on, n_off = road.n_mainline, len(road.on_ramps), len(road.off_ramps)
    return Corridor(
        name=name,
        geometry=road,
        conditions=Conditions(Demand(((0.0, 0.0),), (0.0,) * n_on), duration),
        scales=Scales.of(road),
        sumo=sumo,
        fixed_sensors=(N - 1, *(N + n_on + i for i in range(n_off))),
    )


def _demand(corridor: Corridor, first: IntArray) -> Demand:
    """Count who comes over the upstream boundary segment, and who over the on-ramps.

    Vehicles that are there at second 0 have entered before. Rates hold for a quarter of a record,
    one minute at least and five at most.
    """
    duration = corridor.conditions.duration
    period = max(60, min(300, duration // 4))
    times = np.append(np.arange(0, duration, period), duration)
    if len(times) > 2 and times[-1] - times[-2] < period:
        times = np.delete(times, -2)  # a last step that is shorter joins the one before

    def rates(steps: IntArray) -> Profile:
        counts, _ = np.histogram(steps[(steps > 0) & (steps < NEVER)], times)
        hourly = HOUR * counts / np.diff(times)
        pairs = zip(times[:-1], hourly, strict=True)
        return tuple((float(time), round(float(rate), 1)) for time, rate in pairs)

    road = corridor.geometry
    N, S, n_on = road.n_mainline, road.n_segments, len(road.on_ramps)
    ramps = [np.minimum(first[:, N + i], first[:, S + 2 + i]) for i in range(n_on)]
    return Demand(mainline=rates(first[:, S]), on_ramps=tuple(map(rates, ramps)))


def _exit_shares(corridor: Corridor, first: IntArray) -> Iterator[float]:
    """Yield the share of vehicles that leave, of those that pass each off-ramp."""

    def reached(*columns: int) -> BoolArray:
        found: BoolArray = np.any(first[:, columns] < NEVER, axis=1)
        return found

    road = corridor.geometry
    N, S, n_on = road.n_mainline, road.n_segments, len(road.on_ramps)
    for i, face in enumerate(road.off_ramps):
        left = reached(N + n_on + i, S + 2 + n_on + i)
        passed = reached(S, *range(face)) & reached(*range(face, N), S + 1) & ~left
        yield left.sum() / max((left | passed).sum(), 1)
