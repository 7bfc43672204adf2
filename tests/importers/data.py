"""Small trajectories, and files of them in each format."""

import json
from pathlib import Path

import numpy as np

from dptse_env.importers import Options, Source, Split, import_trajectories
from dptse_env.importers.placing import Branches
from dptse_env.traffic import Conditions, Corridor, Demand, Geometry, Scales

ROAD = Corridor(
    "test-road",
    Geometry(4, on_ramps=(1,), off_ramps=(3,), exit_shares=(0.1,)),
    Conditions(Demand(((0.0, 0.0),), (0.0,)), duration=20),
    Scales(333.0, 102.0, 8.0),
)
"""Four segments of 100 m: an on-ramp joins at 100 m, an off-ramp leaves at 300 m."""

STRAIGHT = ROAD.replaced(on_ramps=(), off_ramps=(), exit_shares=(), demand=Demand(((0.0, 0.0),)))
"""The same without ramps."""

SPLITS = [
    Split("training", 0.6, range(1000)),
    Split("validation", 0.2, range(1000, 2000)),
    Split("test", 0.2, range(2000, 3000)),
]


def stream(seconds=120.0, period=0.1, headway=4.0, speed=20.0, length=400.0):
    """Return (vehicle, time [s], x [m], speed [m/s]) of vehicles that follow one another.

    They are at no face between segments at a whole second.
    """
    points = []
    for vehicle, start in enumerate(np.arange(0.137 - length / speed, seconds, headway)):
        times = np.arange(round(seconds / period) + 1) * period
        x = speed * (times - start)
        here = (x >= 0.0) & (x < length)
        constant = np.ones(here.sum())
        points.append(np.column_stack([vehicle * constant, times[here], x[here], speed * constant]))
    return np.concatenate(points)


def write_csv(path, columns, delimiter=",", head="", lines=()):
    """Write a table of texts and numbers; extra lines come last."""
    names = list(columns)
    path.parent.mkdir(exist_ok=True)
    rows = zip(*(columns[name] for name in names), strict=True)
    text = [delimiter.join(names), *(delimiter.join(map(str, row)) for row in rows), *lines]
    path.write_text(head + "\n".join(text) + "\n", encoding="utf-8")
    return path


def plain(path, points, **columns):
    """Write points as a table with columns t, id, s, v."""
    vehicle, time, x, speed = np.asarray(points).T
    content = {"t": time.round(4), "id": vehicle.astype(int), "s": x.round(4), "v": speed.round(4)}
    return write_csv(path, content | columns)


PLAIN = Source("table", {"time": "t", "vehicle": "id", "x": "s", "speed": "v"})


def run(path, source=PLAIN, road=STRAIGHT, splits=SPLITS, **options):
    """Import a file, or several, into a folder beside it."""
    paths = path if isinstance(path, list) else [path]
    output = paths[0].parent / "imported"
    return import_trajectories(paths, source, road, output, splits, Options(**options))


def first_file(imported):
    """Return what the report says of the first file, as it was written."""
    path = Path(imported.corridor.recordings.folder) / "report.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content == imported.report
    return content["files"][0]


def driven(record, corridor, period=0.5):
    """Return points as `stream`, and the record column of each, of the vehicles of a record.

    Positions on ramps are those of the face that they join or leave, minus or plus the distance.
    """
    starts = Branches(corridor).column_starts[1]
    points = []
    for vehicle in np.unique(record.vehicle):
        own = record.vehicle == vehicle
        step, column, speed = (each[own] for each in (record.step, record.segment, record.speed))
        if len(step) < 2:
            continue
        way = (speed[1:] + speed[:-1]) / 7.2
        x = 1000.0 * starts[column[0]] + 2.0 + np.concatenate([[0.0], np.cumsum(way)])
        times = np.arange(step[0], step[-1] + 0.5 * period, period)
        at = np.clip(times.astype(int) - step[0], 0, len(step) - 1)
        points.append(np.column_stack([
            np.full(len(times), vehicle), times, np.interp(times, step, x),
            np.interp(times, step, speed) / 3.6, column[at],
        ]))  # fmt: skip
    found = np.concatenate(points)
    return found[:, :4], found[:, 4].astype(int)
