"""A corridor made of a SUMO network, a path along it, and one simulated run."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.demand import Demand
from dptse_env.traffic.record import Record, average_dwell
from dptse_env.traffic.road_files import DENSITY_SCALE
from dptse_env.traffic.sumo import RecordingError
from dptse_env.traffic.sumo_import.configuration import Files
from dptse_env.traffic.sumo_import.counts import counted_demand, counted_shares
from dptse_env.traffic.sumo_import.layout import Layout, lay_out
from dptse_env.traffic.sumo_import.net import Net
from dptse_env.traffic.sumo_scenario import SumoScenario
from dptse_env.traffic.worker import simulate_in_child
from dptse_env.utils.digests import file_digest
from dptse_env.utils.fields import require


@dataclass(frozen=True)
class ImportedRoad:
    """A road of a SUMO network.

    Attributes:
        corridor: the road, with demand, exit shares and average dwell counted in `record`.
        layout: where its segments are in the network.
        record: the run that was counted.
        remarks: what was unusual, for people.
    """

    corridor: Corridor
    layout: Layout
    record: Record
    remarks: tuple[str, ...]


def find_layout(
    files: Files,
    path: Sequence[str],
    segment_length: float,
    between: bool = False,
    left_out: Collection[str] = (),
    ends: tuple[float, float | None] = (0.0, None),
) -> Layout:
    """Return the segments of a path in a network.

    Args:
        files: what the simulation reads; of these only the network is read here.
        path: ids of the path's edges, or of its first and last with `between`.
        segment_length: wanted length of a segment [m].
        between: take the shortest path between the two edges of `path`.
        left_out: edges at the path that are no ramps.
        ends: positions [m] on the first and the last edge at which the road begins and ends; None
            for the end of the last.

    Raises:
        ValueError: The network or the path is of no use; the message names the file or the field.
        MissingExtraError: `eclipse-sumo` is not installed.
    """
    require(segment_length >= 40.0, "segment_length", "at least 40 m", segment_length)
    require(len(path) >= 1, "path", "at least one edge", list(path))
    net = Net(files.net, files.internal_links)
    edges = net.path_between(path[0], path[-1]) if between else net.path_along(path)
    return lay_out(net, edges, segment_length, left_out, ends)


def import_road(
    files: Files,
    layout: Layout,
    name: str,
    duration: int,
    begin: int | None = None,
    warm_up: int = 0,
    speed_limit: float | None = None,
    seed: int = 0,
) -> ImportedRoad:
    """Make a corridor of a layout, and count its demand in one simulated run.

    Args:
        files: what the simulation reads.
        layout: the segments.
        name: name of the corridor.
        duration: length of a record [s].
        begin: second of SUMO's clock at which a record starts; that of `files` after the warm-up
            if None.
        warm_up: seconds simulated before, at most `begin`.
        speed_limit: limit of all segments [km/h]; that of the edges if None.
        seed: traffic seed of the run that is counted.

    Raises:
        ValueError: Files or fields are of no use, SUMO refuses the files, or no vehicle uses the
            path.
    """
    files.check()
    allowed = "whole seconds"
    require(begin is not None or files.begin.is_integer(), "begin", allowed, files.begin)
    start = int(files.begin) + warm_up if begin is None else begin
    draft = _draft(files, layout, name, duration, start, warm_up, speed_limit)
    try:
        record = simulate_in_child(draft, seed)
    except RecordingError as error:
        raise ValueError(f"SUMO refuses these files: {' '.join(str(error).split())}") from error
    in_road = record.segment < draft.n_mainline
    if not in_road.any():
        seen = f"{record.n_vehicles} on its ramps or ends" if record.n_rows else "none"
        routes = ", ".join(path.name for path in files.routes)
        raise ValueError(
            f"routes: {routes} must have vehicles that use the path from {start} s to "
            f"{start + duration} s, got {seen}"
        )
    corridor = dataclasses.replace(
        draft,
        demand=counted_demand(draft, record, max(60, min(300, duration // 4))),
        exit_shares=counted_shares(draft, record),
        average_dwell=round(average_dwell(draft, [record]), 2),
    )
    remarks = (*layout.remarks, *_appearing(corridor, record))
    return ImportedRoad(corridor, layout, record, remarks)


def _draft(
    files: Files,
    layout: Layout,
    name: str,
    duration: int,
    begin: int,
    warm_up: int,
    speed_limit: float | None,
) -> Corridor:
    """Return the corridor without what is counted."""
    folder = files.net.parent.resolve()
    paths = (files.net, *files.routes, *files.additional)
    names = tuple(os.path.relpath(path.resolve(), folder) for path in paths)
    n_routes = len(files.routes)
    network = SumoScenario(
        net=names[0],
        routes=names[1 : 1 + n_routes],
        additional=names[1 + n_routes :],
        sha256=tuple(file_digest(path) for path in paths),
        columns=layout.columns,
        folder=str(folder),
        begin=begin,
        warm_up=warm_up,
        step_length=files.step_length,
        options=files.options,
    )
    N, n_on, n_off = len(layout.lengths), len(layout.on_ramps), len(layout.off_ramps)
    limits, ramp_limits = layout.limits, layout.ramp_limits
    if speed_limit is not None:
        limits, ramp_limits = (speed_limit,) * N, (speed_limit,) * (n_on + n_off)
    limits, ramp_limits = (
        tuple(round(limit, 1) for limit in each) for each in (limits, ramp_limits)
    )
    return Corridor(
        name=name,
        n_mainline=N,
        on_ramps=layout.on_ramps,
        off_ramps=layout.off_ramps,
        exit_shares=(0.5,) * n_off,
        demand=Demand(mainline=((0.0, 0.0),), on_ramps=(0.0,) * n_on),
        incident=None,
        fixed_sensors=(N - 1, *(N + n_on + i for i in range(n_off))),
        duration=duration,
        lanes=layout.lanes,
        ramp_lanes=layout.ramp_lanes or 1,
        segment_length=_kilometres(layout.lengths),
        speed_limit=limits,
        ramp_length=_kilometres(layout.ramp_lengths) or None,
        ramp_speed_limit=ramp_limits or None,
        density_scale=DENSITY_SCALE * max(layout.lanes),
        speed_scale=max(limits),
        network=network,
    )


def _kilometres(lengths: Sequence[float]) -> tuple[float, ...]:
    return tuple(round(length / 1000.0, 4) for length in lengths)


def _appearing(corridor: Corridor, record: Record) -> tuple[str, ...]:
    """Say how many vehicles appear between the entrances of a road."""
    order = np.lexsort((record.step, record.vehicle))
    vehicles, first = np.unique(record.vehicle[order], return_index=True)
    step, column = record.step[order][first], record.segment[order][first]
    inside = (column < corridor.n_mainline) & (step > 0)
    n_inside = int(inside.sum())
    if not n_inside:
        return ()
    return (f"{n_inside} of {len(vehicles)} vehicles appear on the mainline, past every entrance",)
