"""Sections of random highways that traffic enters from outside.

On a road that SUMO simulates, vehicles enter and leave freely. On a section of a longer one, queues
also come in through the downstream end or arrive from upstream, as on measured roads.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares

from agents.filters.highways import DURATION, WARM_UP, Highway, draw_highway
from agents.filters.highways import Kind as HighwayKind
from agents.fitting.parameters import slowed, start_from, traffic_of
from dptse_env.estimators.tuned import DEFAULT_PARAMETERS
from dptse_env.importers.folder import ROAD
from dptse_env.importers.measured import measure
from dptse_env.model import ARZParameters, load_parameters
from dptse_env.traffic import Conditions, Corridor, Record, RecordLibrary, Scales
from dptse_env.traffic.demand import Demand
from dptse_env.traffic.imported import Kind, save_records
from dptse_env.traffic.roads import write_corridor
from dptse_env.utils.arrays import FloatArray, IntArray

SEGMENTS = (5, 60)
"""Range of the number of segments of a section."""
POINTS = 37
"""Of so many pairs of a density and a speed one is fitted."""
CURVES, GAMMAS, JAMS = 6, (0.4, 3.6), (41.0, 160.0)
"""Curves that are tried, and the ranges of gamma and of a lane's jam density [veh/km]; both, like
the relaxation time, are drawn log-uniformly."""
DEVIATIONS = (-0.03, 0.05, 0.12)
"""Mean, usual and large deviation of the logarithm of speeds: filters err least with low ones."""
RELAXATION = (15.0, 250.0)
"""Range of the relaxation time [s]."""
CANDIDATES, FREE = 24, 0.3
"""Windows among which those of a section are drawn, and the weight of one without queues."""
FILLED = 300
"""Second from which on windows begin where traffic is free [s]: slow vehicles are everywhere."""
SLOW, LASTING = 0.5, 0.15
"""In a queue, speeds are below this share of the limit for at least this share of the time."""


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
        kind: Kind of the highway.
        traffic: Traffic seeds of the highway; windows then begin together, one of each seed, which
            is its own one, too. Where there are none, all windows are of seed 0.
        misjudged: Published demand over the measured one.
        calibrated: Whether its road file has parameters that were fitted to it (`parameters`).
    """

    highway: int
    segments: int
    windows: int
    seconds: int
    averaged: int = 0
    sensors: tuple[int, ...] = ()
    seed: int = 0
    kind: HighwayKind = "queues"
    traffic: tuple[int, ...] = ()
    misjudged: float = 1.0
    calibrated: bool = False

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
        highway = draw_highway(self.highway, self.kind)
        own, seeds = self.traffic, self.traffic or tuple(range(self.windows))
        records = [library.get(highway.corridor, seed) for seed in own or (0,)]
        first, starts = self._place(highway.corridor, records[0])
        if own:
            starts = [FILLED] * len(own)
        bare, columns = _section(highway, first, self)
        cuts = [
            _cut(record, columns, start, self.seconds)
            for record, start in zip(records if own else records * len(starts), starts, strict=True)
        ]
        road = measure(bare, lambda: cuts)
        if self.misjudged != 1.0:
            road = road.replaced(demand=road.conditions.published_demand.scaled(self.misjudged))
        kind: Kind = "fields" if self.averaged else "vehicles"
        if self.averaged:
            cuts = [_averaged(road, each, self.averaged) for each in cuts]
        sources = [
            {"seed": seed, "start": start} for seed, start in zip(seeds, starts, strict=True)
        ]
        kept = save_records(folder, road, cuts, sources, kind)
        environment = {}
        if self.calibrated:
            environment["parameters"] = dataclasses.asdict(self.parameters(library))
        write_corridor(folder / ROAD, road.replaced(recordings=kept), environment)
        return folder / ROAD

    def parameters(self, library: RecordLibrary) -> ARZParameters:
        """Return parameters whose equilibrium speeds are about those of its highway.

        Of some random pairs of gamma and a jam density the one that suits best is taken, as a short
        search does: few densities determine neither. Speeds are off by `DEVIATIONS`, as there. A
        search with a filter takes a thousand times the time.
        """
        corridor = draw_highway(self.highway, self.kind).corridor
        start = start_from(load_parameters(DEFAULT_PARAMETERS), corridor, "fitted")
        density, speed = traffic_of(corridor, [0], library)
        inside = np.s_[WARM_UP:, : corridor.geometry.n_mainline]
        rho, v = density[inside].reshape(-1), speed[inside].reshape(-1)
        rho, v = rho[rho > 0.0][::POINTS], v[rho > 0.0][::POINTS]
        rng = np.random.default_rng([80, self.highway, self.seed])
        fits = [_fit_speed(rho, v, *_draw_curve(rng, float(rho.max()))) for _ in range(CURVES)]
        _, v_f, gamma, jam = min(fits)
        mean, usual, large = DEVIATIONS
        deviation = rng.normal(mean, usual if rng.random() < 0.8 else large)
        fitted = dataclasses.replace(
            start,
            free_flow_speed=v_f * float(np.exp(deviation)),
            gamma=gamma,
            jam_density=jam * start.lanes,
            relaxation_time=float(np.exp(rng.uniform(*np.log(RELAXATION)))),
        )
        return slowed(fitted, corridor)

    def _place(self, highway: Corridor, record: Record) -> tuple[int, list[int]]:
        """Return a first segment and the starts of windows, drawn preferably with queues."""
        rng = np.random.default_rng([78, self.highway, self.segments, self.seed])
        n, filled = highway.geometry.n_mainline, WARM_UP if self.kind == "queues" else FILLED
        lengths, limits = highway.road.lengths, highway.road.limits
        density, speed = np.moveaxis(record.traffic(lengths, limits)[:, :n], -1, 0)
        is_slow, is_empty = speed < SLOW * limits[:n], density.sum(axis=1) == 0.0

        def draw(firsts: IntArray) -> tuple[IntArray, FloatArray]:
            starts = rng.integers(filled, DURATION - self.seconds, size=CANDIDATES)
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


def _draw_curve(rng: np.random.Generator, densest: float) -> tuple[float, float]:
    """Return a gamma and a jam density of a lane [veh/km], no less than the densest traffic."""
    low, high = JAMS
    gamma, jam = rng.uniform(*np.log(GAMMAS)), rng.uniform(*np.log((max(low, densest), high)))
    return float(np.exp(gamma)), float(np.exp(jam))


def _fit_speed(
    rho: FloatArray, v: FloatArray, gamma: float, jam: float
) -> tuple[float, float, float, float]:
    """Return the cost of the free-flow speed that suits a curve best, that speed, and the curve."""
    shape = 1.0 - (rho / jam) ** gamma
    found = least_squares(lambda x: x * shape - v, [v.max()], loss="soft_l1", f_scale=10.0)
    return float(found.cost), float(found.x[0]), gamma, jam


def _section(highway: Highway, first: int, section: Section) -> tuple[Corridor, IntArray]:
    """Return a section as a road, and the columns of its cells in the highway's record."""
    whole, n = highway.corridor.geometry, section.segments
    lanes = whole.segment_lanes[first : first + n]
    mainline = range(first, first + n)

    def inside(faces: tuple[int, ...]) -> list[int]:
        return [k for k, face in enumerate(faces) if first < face < first + n]

    on, off = inside(whole.on_ramps), inside(whole.off_ramps)
    before = whole.n_segments + 2  # then the boundary segments of ramps, on-ramps first
    columns = [
        *mainline,
        *(whole.on_ramp_segments[k][0] for k in on),
        *(whole.off_ramp_segments[k][0] for k in off),
        first - 1,
        first + n,
        *(before + k for k in on),
        *(before + len(whole.on_ramps) + k for k in off),
    ]
    geometry = dataclasses.replace(
        whole,
        n_mainline=n,
        on_ramps=tuple(whole.on_ramps[k] - first for k in on),
        off_ramps=tuple(whole.off_ramps[k] - first for k in off),
        exit_shares=tuple(whole.exit_shares[k] for k in off),
        lanes=lanes,
        speed_limit=highway.limit,
    )
    demand = Demand(mainline=((0.0, 0.0),), on_ramps=(0.0,) * len(on))
    road = Corridor(
        name=f"{highway.corridor.name}-{first}",
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
