"""The report of an import: Markdown to read, JSON to process, a picture to look at."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.imported import ranges
from dptse_env.traffic.importers.recording import Recording
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import AnyArray

REPORT, NUMBERS, PICTURE = "report.md", "report.json", "report.png"

_ROWS = {
    "rows": "rows of vehicles",
    "other_group": "dropped: of another group than chosen",
    "off_lanes": "dropped: on other lanes, lateral positions or edges than the road's",
    "off_ends": "dropped: before the road's start or beyond its end",
    "duplicates": "dropped: duplicates of another row",
    "out_of_order": "out of order in time, sorted",
    "seconds": "vehicles at whole seconds, from the others",
    "negative_speeds": "of these with a speed below 0, set to 0",
}
_TRAJECTORIES = {
    "vehicles": "vehicles by id",
    "pieces": "trajectories after cuts; each counts as a vehicle",
    "gaps_filled": "gaps filled by interpolation",
    "seconds_filled": "whole seconds in them",
    "gaps_cut": "cuts at longer gaps: missing frames, or an id that is used again",
    "jumps_cut": "cuts where a vehicle jumps to another place",
    "too_short": "trajectories without a whole second, dropped",
}
_ENDS = (
    ("present_at_start", "are there at the start of the file"),
    ("entered", "begin at an entry"),
    ("appeared", "begin amid the road"),
    ("present_at_end", "are there at its end"),
    ("left", "end at an exit"),
    ("vanished", "end amid the road"),
)


def write_report(
    folder: Path,
    corridor: Corridor,
    recordings: Sequence[Recording],
    seeds: Mapping[str, tuple[int, ...]],
    windows: Sequence[Mapping[str, Any]],
    first: Record,
) -> dict[str, Any]:
    """Write the report into a folder.

    Args:
        folder: The folder.
        corridor: The road as written.
        recordings: The files.
        seeds: Traffic seeds by split.
        windows: Descriptions of the windows.
        first: The record of the first window, for the picture.

    Returns:
        What the report says, as plain JSON.
    """
    demand: Any = corridor.demand
    content = {
        "road": corridor.name,
        "duration": corridor.duration,
        "seeds": {name: list(each) for name, each in seeds.items()},
        "demand": {"mainline": demand.mainline[0][1], "on_ramps": list(demand.on_ramps)},
        "exit_shares": list(corridor.exit_shares),
        "average_dwell": corridor.average_dwell,
        "files": [_file(recording) for recording in recordings],
        "windows": list(windows),
    }
    (folder / NUMBERS).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    (folder / REPORT).write_text(_markdown(content), encoding="utf-8")
    _draw(folder / PICTURE, corridor, recordings[0], first)
    return content


def _file(recording: Recording) -> dict[str, Any]:
    ratio = recording.speed_ratio
    return {
        "file": recording.path.name,
        "bytes": recording.path.stat().st_size,
        "windows": len(recording.windows),
        "speed_ratio": None if np.isnan(ratio) else round(ratio, 4),
        "off_the_road": recording.off_names,
        **vars(recording.counts),
    }


def _markdown(content: Mapping[str, Any]) -> str:
    parts = [f"# Import of trajectories to {content['road']}\n"]
    parts += [
        f"- {name}: {len(each)} window(s) of {content['duration']} s, traffic seeds {ranges(each)}"
        for name, each in content["seeds"].items()
    ]
    on_ramps = ", ".join(f"{rate:g}" for rate in content["demand"]["on_ramps"]) or "none"
    shares = ", ".join(f"{share:g}" for share in content["exit_shares"]) or "none"
    parts.append(
        "\nMeasured in the windows of the first split: "
        f"{content['demand']['mainline']:g} veh/h on the mainline, on-ramps {on_ramps} veh/h, "
        f"exit shares {shares}, average dwell {content['average_dwell']:g} s.\n\n"
        f"![Points, density and speed]({PICTURE})\n"
    )
    for file in content["files"]:
        parts.append(f"## {file['file']}\n\n| rows | |\n| --: | :-- |")
        parts += [f"| {file[key]} | {words} |" for key, words in _ROWS.items()]
        parts.append("\n| trajectories | |\n| --: | :-- |")
        parts += [f"| {file[key]} | {words} |" for key, words in _TRAJECTORIES.items()]
        begin, end = (
            ", ".join(f"{file[key]} {words}" for key, words in ends)
            for ends in (_ENDS[:3], _ENDS[3:])
        )
        parts.append(
            f"\nOf the {file['pieces']} trajectories {begin}; {end}. Many that begin or end amid "
            "the road are trajectories in pieces, or a ramp that the layout does not have."
        )
        if file["off_the_road"]:
            parts.append(f"Off the road: {', '.join(file['off_the_road'])}.")
        if file["speed_ratio"] is not None:
            parts.append(f"Speeds are {file['speed_ratio']:g} times what positions say.")
        parts.append("")
    parts.append("## Windows\n\n| seed | file | group | start [s] | vehicles |")
    parts.append("| --: | :-- | :-- | --: | --: |")
    parts += [
        f"| {each['seed']} | {each['file']} | {each['group']} | {each['start']:.0f} | "
        f"{each['vehicles']} |"
        for each in content["windows"]
    ]
    return "\n".join(parts) + "\n"


def _draw(path: Path, corridor: Corridor, recording: Recording, record: Record) -> None:
    """Draw points, density and speed of the first window over space and time."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import)

    n = corridor.n_mainline
    lengths = np.array(corridor.segment_lengths[:n])
    faces = np.concatenate([[0.0], np.cumsum(lengths)])
    times = np.arange(record.n_steps + 1) - 0.5
    counts = record.counts[:, :n]
    density = counts / lengths
    speed = np.where(counts > 0, record.speed_sums[:, :n] / np.maximum(counts, 1), np.nan)
    figure = Figure(figsize=(9.0, 9.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, sharey=True)
    start = recording.windows[0].start - (recording.base or 0.0)
    points = recording.points
    colours: dict[str, Any] = {"cmap": "RdYlGn", "vmin": 0.0, "vmax": corridor.largest_speed_limit}
    if np.isnan(points["speed"]).any():
        axes[0].plot(points["time"] - start, points["position"], ".", markersize=0.5, color="0.3")
    else:
        shown = points["time"] - start, points["position"]
        axes[0].scatter(*shown, s=0.5, c=points["speed"], rasterized=True, **colours)
    axes[0].set_title("points of the file on the mainline")

    def field(axis: Any, values: AnyArray, title: str, **look: Any) -> None:
        mesh = axis.pcolormesh(times, faces, values.T, rasterized=True, **look)
        figure.colorbar(mesh, ax=axis)
        axis.set_title(title)

    field(axes[1], density, "density of the record [veh/km]", cmap="viridis")
    field(axes[2], speed, "speed of the record [km/h]", **colours)
    for axis in axes:
        axis.set_ylabel("position [km]")
        axis.set_ylim(faces[0], faces[-1])
    axes[2].set_xlabel("time in the first window [s]")
    figure.savefig(path, dpi=110)
