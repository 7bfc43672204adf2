"""Random highways of some three kilometres, and sections of them that queues enter from outside.

On a road that SUMO simulates, vehicles enter and leave freely. On a section of a longer one, queues
also come in through the downstream end or arrive from upstream, as on measured roads.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from dptse_env.importers.folder import ROAD
from dptse_env.importers.measured import measure
from dptse_env.traffic import Conditions, Corridor, Geometry, Record, RecordLibrary, Scales
from dptse_env.traffic.demand import Demand, Drivers, Incident, VehicleClass
from dptse_env.traffic.imported import Kind, save_records
from dptse_env.traffic.roads import write_corridor
from dptse_env.utils.arrays import FloatArray, IntArray

DURATION, WARM_UP = 1150, 100
"""Length of a highway's record, and of its beginning in which the road fills [s]."""
LANES, LENGTHS, LIMITS = (1, 6), (0.05, 0.25), (60.0, 130.0)
"""Ranges of lanes, lengths of segments [km] and speed limits [km/h]."""
SEGMENTS = (5, 60)
"""Range of the number of segments of a section."""
KILOMETRES = (2.5, 4.0)
"""Range of the length of a highway [km]."""
CAPACITY = 1950.0
"""Flow of a lane [veh/h] that demands are drawn as shares of."""
HEADWAYS = {"W99": (0.7, 1.6), "IDM": (0.9, 1.9), "Krauss": (0.8, 1.6)}
"""Desired time headways of drivers by their model [s]."""
CANDIDATES, FREE = 24, 0.3
"""Windows among which those of a section are drawn, and the weight of one without queues."""
SLOW, LASTING = 0.5, 0.15
"""In a queue, speeds are below this share of the limit for at least this share of the time."""


def draw_highway(number: int) -> Corridor:
    """Return the highway of a number, always the same one.

    Bottlenecks are temporary limits, most of them at the downstream end; more than half of them
    alternate every 20 to 90 s and send waves upstream. In one of seven there is little traffic.
    """
    rng = np.random.default_rng([77, number])
    length = round(float(np.exp(rng.uniform(*np.log(LENGTHS)))), 3)
    n = max(round(float(rng.uniform(*KILOMETRES)) / length), 13)
    most = int(rng.choice(np.arange(1, 7), p=[0.05, 0.15, 0.25, 0.25, 0.2, 0.1]))
    lanes: Any = most
    if most > 1 and rng.random() < 0.2:
        drop = int(rng.integers(n // 3, n))
        lanes = (most,) * drop + (most - 1,) * (n - drop)
    limit = float(rng.choice([60, 70, 80, 90, 100, 102, 105, 110, 120, 130]))
    model = str(rng.choice(["W99", "IDM", "Krauss"], p=[0.4, 0.35, 0.25]))
    classes: tuple[VehicleClass, ...] = ()
    if rng.random() < 0.4:
        trucks = round(float(rng.uniform(0.03, 0.2)), 3)
        slow = VehicleClass("truck", trucks, length=12.0, largest_speed=90.0)
        classes = (VehicleClass("car", 1.0 - trucks), slow)
    faces = _draw_ramps(rng, n)
    on = tuple(face for face, is_entry in faces if is_entry)
    off = tuple(face for face, is_entry in faces if not is_entry)
    demand = _draw_demand(rng, CAPACITY * most, len(on))
    geometry = Geometry(
        n_mainline=n,
        on_ramps=on,
        off_ramps=off,
        exit_shares=tuple(round(float(rng.uniform(0.03, 0.2)), 3) for _ in off),
        lanes=lanes,
        segment_length=length,
        speed_limit=limit,
    )
    conditions = Conditions(
        demand=demand,
        incident=_draw_bottlenecks(rng, n),
        duration=DURATION,
        drivers=Drivers(
            model=model,  # type: ignore[arg-type]
            headway=round(float(rng.uniform(*HEADWAYS[model])), 2),
            speed_deviation=round(float(rng.uniform(0.04, 0.18)), 3),
        ),
        vehicle_classes=classes,
    )
    scales = Scales.of(geometry, average_dwell=8.0)
    return Corridor(f"highway-{number}", geometry, conditions, scales)


def _draw_ramps(rng: np.random.Generator, n: int) -> list[tuple[int, bool]]:
    """Return faces of ramps with whether it is an on-ramp; none on half of the highways."""
    if rng.random() < 0.5:
        return []
    count = int(rng.integers(1, min(7, n // 3)))
    faces = sorted(rng.choice(np.arange(2, n - 1), size=count, replace=False).tolist())
    return [(face, bool(rng.random() < 0.5)) for face in faces]


def _draw_demand(rng: np.random.Generator, capacity: float, n_on_ramps: int) -> Demand:
    kind = rng.choice(["heavy", "medium", "night"], p=[0.65, 0.2, 0.15])
    low, high = {"heavy": (0.6, 1.0), "medium": (0.15, 0.75), "night": (0.0, 0.0)}[str(kind)]
    changes = rng.choice(np.arange(100, DURATION - 100, 50), int(rng.integers(1, 4)), replace=False)
    rates = [
        float(np.exp(rng.uniform(np.log(100.0), np.log(1200.0))))
        if kind == "night"
        else float(capacity * rng.uniform(low, high))
        for _ in range(len(changes) + 1)
    ]
    ramps = (20.0, 100.0) if kind == "night" else (150.0, 900.0)
    return Demand(
        mainline=tuple(
            zip([0.0, *np.sort(changes).tolist()], np.round(rates).tolist(), strict=True)
        ),
        on_ramps=tuple(round(float(rng.uniform(*ramps)), 0) for _ in range(n_on_ramps)),
    )


def _draw_bottlenecks(rng: np.random.Generator, n: int) -> tuple[Incident, ...]:
    found = []
    for k in range(int(rng.choice([0, 1, 2, 3], p=[0.07, 0.4, 0.35, 0.18]))):
        anywhere = int(rng.integers(n // 4, n))
        segment = anywhere if k else int(rng.choice([anywhere, n - 1, n - 2]))
        time = float(rng.uniform(0, 500)) if rng.random() < 0.6 else 5.0
        alternates, low = rng.random() < 0.6, float(rng.uniform(4, 40))
        end, phases = min(time + rng.uniform(150, 1100), DURATION - 30), []
        while time < end:
            until = time + float(rng.uniform(20, 90) if alternates else rng.uniform(60, 300))
            limit = float(np.clip(low * rng.uniform(0.3, 1.8), 3, 60))
            phases.append((round(time, 1), round(until, 1), round(limit, 1)))
            time = until + (float(rng.uniform(20, 120)) if rng.random() < 0.15 else 0.0)
        found.append(Incident(segment, tuple(phases)))
    return tuple(found)


@dataclass(frozen=True)
class Section:
    """A section of a highway, with several windows of time.

    Attributes:
        highway: Number of the highway (`draw_highway`).
        segments: Number of its segments, at least two fewer than the highway has.
        windows: Number of windows; each is the record of a traffic seed, from 0 on.
        seconds: Length of a window [s].
        averaged: Seconds over which densities and speeds are averaged, as detectors do. The record
            is then a field without vehicles; 0 for the vehicles of every second.
        sensors: Segments of the mainline that are measured every second.
        seed: Seed of place and times.
    """

    highway: int
    segments: int
    windows: int
    seconds: int
    averaged: int = 0
    sensors: tuple[int, ...] = ()
    seed: int = 0

    def write(self, folder: Path, library: RecordLibrary) -> Path:
        """Write its road file and records to a folder, and return the path of the file.

        Demand, exit shares and dwell are those of the windows.

        Args:
            folder: An empty folder.
            library: Has the record of the highway, or makes it.

        Raises:
            OSError: The folder cannot be written.
            RecordingError: The highway cannot be recorded.
        """
        highway = draw_highway(self.highway)
        record = library.get(highway, 0)
        first, starts = self._place(highway, record)
        bare, columns = _section(highway, first, self)
        cuts = [_cut(record, columns, start, self.seconds) for start in starts]
        road = measure(bare, lambda: cuts)
        kind: Kind = "fields" if self.averaged else "vehicles"
        if self.averaged:
            cuts = [_averaged(road, each, self.averaged) for each in cuts]
        sources = [{"seed": seed, "start": start} for seed, start in enumerate(starts)]
        kept = save_records(folder, road, cuts, sources, kind)
        write_corridor(folder / ROAD, road.replaced(recordings=kept))
        return folder / ROAD

    def _place(self, highway: Corridor, record: Record) -> tuple[int, list[int]]:
        """Return a first segment and the starts of windows, drawn preferably with queues."""
        rng = np.random.default_rng([78, self.highway, self.segments, self.seed])
        n = highway.geometry.n_mainline
        lengths, limits = highway.road.lengths, highway.road.limits
        density, speed = np.moveaxis(record.traffic(lengths, limits)[:, :n], -1, 0)
        is_slow, is_empty = speed < SLOW * limits[:n], density.sum(axis=1) == 0.0

        def draw(firsts: IntArray) -> tuple[IntArray, FloatArray]:
            starts = rng.integers(WARM_UP, DURATION - self.seconds, size=CANDIDATES)
            chances = np.empty(CANDIDATES)
            for k, (first, start) in enumerate(zip(firsts, starts, strict=True)):
                time = slice(start, start + self.seconds)
                queues = is_slow[time, first : first + self.segments].mean(axis=0) > LASTING
                chances[k] = 1.0 if queues.any() else FREE
                if is_empty[time].all():
                    chances[k] = 1e-9
            return starts, chances / chances.sum()

        firsts = rng.integers(1, n - self.segments, size=CANDIDATES)
        first = int(rng.choice(firsts, p=draw(firsts)[1]))
        starts, chances = draw(np.full(CANDIDATES, first))
        return first, rng.choice(starts, self.windows, replace=False, p=chances).tolist()


def _section(highway: Corridor, first: int, section: Section) -> tuple[Corridor, IntArray]:
    """Return a section as a road, and the columns of its cells in the highway's record."""
    n, lanes = section.segments, highway.geometry.segment_lanes[first : first + section.segments]
    mainline = range(first, first + n)

    def inside(faces: tuple[int, ...]) -> list[int]:
        return [k for k, face in enumerate(faces) if first < face < first + n]

    on, off = inside(highway.geometry.on_ramps), inside(highway.geometry.off_ramps)
    before = highway.geometry.n_segments + 2  # then the boundary segments of ramps, on-ramps first
    columns = [
        *mainline,
        *(highway.geometry.on_ramp_segments[k][0] for k in on),
        *(highway.geometry.off_ramp_segments[k][0] for k in off),
        first - 1,
        first + n,
        *(before + k for k in on),
        *(before + len(highway.geometry.on_ramps) + k for k in off),
    ]
    geometry = dataclasses.replace(
        highway.geometry,
        n_mainline=n,
        on_ramps=tuple(highway.geometry.on_ramps[k] - first for k in on),
        off_ramps=tuple(highway.geometry.off_ramps[k] - first for k in off),
        exit_shares=tuple(highway.geometry.exit_shares[k] for k in off),
        lanes=lanes,
    )
    demand = Demand(mainline=((0.0, 0.0),), on_ramps=(0.0,) * len(on))
    road = Corridor(
        name=f"{highway.name}-{first}",
        geometry=geometry,
        conditions=Conditions(demand, section.seconds),
        scales=Scales.of(geometry, average_dwell=8.0),
        fixed_sensors=section.sensors,
    )
    return road, np.array(columns)


def _cut(record: Record, columns: IntArray, start: int, seconds: int) -> Record:
    """Return the record of some columns, from a second on."""
    own = np.full(record.n_columns, -1)
    own[columns] = np.arange(len(columns))
    rows = slice(record.offsets[start], record.offsets[start + seconds + 1])
    segment = own[record.segment[rows]]
    keep = segment >= 0
    step = record.step[rows][keep]
    order = np.lexsort((segment[keep], step))
    vehicle = np.unique(record.vehicle[rows][keep], return_inverse=True)[1]
    return Record(
        n_steps=seconds + 1,
        n_columns=len(columns),
        step=(step - start)[order],
        vehicle=vehicle[order].astype(np.int32),
        segment=segment[keep][order],
        speed=record.speed[rows][keep][order],
    )


def _averaged(road: Corridor, record: Record, seconds: int) -> Record:
    """Return running means of densities and speeds over some seconds, as a field."""
    counts, speeds = (
        uniform_filter1d(each.astype(float), seconds, axis=0, mode="nearest")
        for each in (record.counts, record.speed_sums)
    )
    # Sums of a running window leave rests of some 1e-13 where it is empty again.
    least = 0.5 / seconds
    lengths = road.road.lengths
    density = np.where(counts < least, 0.0, counts) / lengths
    speed = np.maximum(speeds, 0.0) / np.maximum(counts, least)
    return Record(
        n_steps=record.n_steps,
        n_columns=record.n_columns,
        field=np.stack([density, speed], axis=-1),
    )
