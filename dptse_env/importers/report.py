"""Report of an import: as Markdown, as JSON and as a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dptse_env.importers.recording import Recording
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.imported import ranges
from dptse_env.traffic.record import Record

REPORT = "report.md"
_COUNTS = {
    "rows": {
        "rows": "rows of vehicles",
        "no_vehicle": "other rows, dropped: without a vehicle's id",
        "other_group": "dropped: of another group than chosen",
        "off_lanes": "dropped: on other lanes, lateral positions or edges than the road's",
        "off_ends": "dropped: before the road's start or beyond its end",
        "far_away": "dropped: ten minutes or more from all windows; are these times right?",
        "duplicates": "dropped: duplicates of another row",
        "pauses": "times of half a minute or more without a row: the road counts as empty there",
        "steps_back": "steps back of the whole file's time; its parts are put in order of time",
        "out_of_order": "out of order in time, sorted",
        "seconds": "vehicles at whole seconds, from the others",
        "negative_speeds": "of these with a speed below 0, set to 0",
    },
    "trajectories": {
        "vehicles": "vehicles by id",
        "ids_shared": "ids of several vehicles at one time, told apart by their positions; if they "
        "are many, does the file have two recordings, or traffic of two times?",
        "pieces": "trajectories after cuts; each counts as a vehicle",
        "gaps_filled": "gaps filled by interpolation",
        "seconds_filled": "whole seconds in them",
        "gaps_cut": "cuts at longer gaps: missing frames, or an id that is used again",
        "jumps_cut": "cuts where a vehicle jumps to another place",
        "too_short": "trajectories without a whole second, dropped",
    },
}
_ORDINARY = ("rows", "seconds", "vehicles", "pieces", "gaps_filled", "seconds_filled")
_BEGIN = {
    "present_at_start": "are there at the start of the file",
    "entered": "begin at an entry",
    "appeared": "begin amid the road",
}
_END = {
    "present_at_end": "are there at its end",
    "left": "end at an exit",
    "vanished": "end amid the road",
}


def write_report(
    folder: Path, corridor: Corridor, recordings: Sequence[Recording],
    seeds: Mapping[str, tuple[int, ...]], windows: Sequence[Mapping[str, Any]], first: Record,
    notes: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """Write the report into a folder.

    Args:
        folder: The folder.
        corridor: The road as written.
        recordings: The files.
        seeds: Traffic seeds by split.
        windows: Descriptions of the windows.
        first: The record of the first window, for the picture.
        notes: What is unusual of the traffic.

    Returns:
        What the report says, as plain JSON.
    """
    demand: Any = corridor.conditions.demand
    content = {
        "road": corridor.name,
        "duration": corridor.conditions.duration,
        "seeds": {name: list(each) for name, each in seeds.items()},
        "demand": {"mainline": demand.mainline[0][1], "on_ramps": list(demand.on_ramps)},
        "exit_shares": list(corridor.geometry.exit_shares),
        "average_dwell": corridor.scales.average_dwell,
        "notes": list(notes),
        "files": [_file(recording) for recording in recordings],
        "windows": list(windows),
    }
    (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / REPORT).write_text(_markdown(content), encoding="utf-8")
    _draw(folder / "report.png", corridor, recordings[0], first)
    return content


def remarks(file: Mapping[str, Any]) -> list[str]:
    """Return what a user should know of a file of a report, in a line each."""
    told = {key: words for table in _COUNTS.values() for key, words in table.items()}
    rare = [key for key in told if key not in _ORDINARY and file[key]]
    return [f"{file[key]} {told[key]}" for key in rare]


def _file(recording: Recording) -> dict[str, Any]:
    names = (*_COUNTS["rows"], *_COUNTS["trajectories"], *_BEGIN, *_END)
    ratio = recording.speed_ratio
    return {
        "file": recording.path.name,
        "bytes": recording.path.stat().st_size,
        "windows": len(recording.windows),
        "speed_ratio": None if ratio is None else round(ratio, 4),
        "off_the_road": recording.off_names,
        **{name: int(recording.counts[name]) for name in names},
    }


def _markdown(content: Mapping[str, Any]) -> str:
    parts = [f"# Import of trajectories to {content['road']}\n"]
    parts += [
        f"- {name}: {len(each)} window(s) of {content['duration']} s, traffic seeds {ranges(each)}"
        for name, each in content["seeds"].items()
    ]
    rates = ", ".join(f"{rate:g}" for rate in content["demand"]["on_ramps"])
    on_ramps = f"{rates} veh/h on the on-ramps" if rates else "no on-ramps"
    shares = ", ".join(f"{share:g}" for share in content["exit_shares"])
    exits = f"exit shares {shares}" if shares else "no exits"
    parts.append(
        "\nMeasured in the windows of the first split: "
        f"{content['demand']['mainline']:g} veh/h on the mainline, {on_ramps}, "
        f"{exits}, average dwell {content['average_dwell']:g} s.\n\n"
        "![Points, density and speed](report.png)\n"
    )
    parts += [f"- note: {note}" for note in content["notes"]]
    for file in content["files"]:
        parts.append(f"\n## {file['file']}")
        for title, told in _COUNTS.items():
            parts.append(f"\n| {title} | |\n| --: | :-- |")
            parts += [f"| {file[key]} | {words} |" for key, words in told.items()]
        begin, end = (
            ", ".join(f"{file[key]} {words}" for key, words in ends.items())
            for ends in (_BEGIN, _END)
        )
        parts.append(
            f"\nOf the {file['pieces']} trajectories {begin}; {end}. Many that begin or end amid "
            "the road are trajectories in pieces, or a ramp that the layout does not have."
        )
        if file["off_the_road"]:
            parts.append(f"Off the road: {', '.join(file['off_the_road'])}.")
        if file["speed_ratio"] is not None:
            ratio = file["speed_ratio"]
            parts.append(f"Its speeds are {ratio:g} times the speeds that its positions give.")
        parts.append("")
    parts.append("## Windows\n\n| seed | file | group | start [s] | vehicles |")
    parts.append("| --: | :-- | :-- | --: | --: |")
    parts += [
        "| {seed} | {file} | {group} | {start:.0f} | {vehicles} |".format(**each)
        for each in content["windows"]
    ]
    return "\n".join(parts) + "\n"


def _draw(path: Path, corridor: Corridor, recording: Recording, record: Record) -> None:
    """Draw points, density and speed of the first window over space and time."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import)

    road, n = corridor.geometry, corridor.geometry.n_mainline
    lengths = corridor.road.lengths[:n]
    faces = np.concatenate([[0.0], np.cumsum(lengths)])
    times = np.arange(record.n_steps + 1) - 0.5
    counts = record.counts[:, :n]
    speed = np.where(counts > 0, record.speed_sums[:, :n] / np.maximum(counts, 1), np.nan)
    figure = Figure(figsize=(9.0, 9.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, sharey=True)
    colours: dict[str, Any] = {
        "cmap": "RdYlGn",
        "vmin": 0.0,
        "vmax": road.largest_speed_limit,
    }
    points = recording.points()
    shown = {} if points["speed"].null_count() else {"c": points["speed"], **colours}
    axes[0].scatter(points["time"], points["position"], s=0.5, rasterized=True, **shown)
    axes[0].set_title("points of the file on the mainline")
    for axis, values, title, look in (
        (axes[1], counts / lengths, "density of the record [veh/km]", {"cmap": "viridis"}),
        (axes[2], speed, "speed of the record [km/h]", colours),
    ):
        mesh = axis.pcolormesh(times, faces, values.T, rasterized=True, **look)
        figure.colorbar(mesh, ax=axis)
        axis.set_title(title)
    for axis in axes:
        axis.set_ylabel("position [km]")
        axis.set_ylim(faces[0], faces[-1])
    axes[2].set_xlabel("time in the first window [s]")
    figure.savefig(path, dpi=110)
