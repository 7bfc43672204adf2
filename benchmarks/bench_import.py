"""Time the import of trajectories on one core: rows a second and peak memory, by format and size.

python benchmarks/bench_import.py --rows 1000000 4000000

Every file is made here: a stationary stream of vehicles over 1 km at 10 points a second, in the
order of vehicles as NGSIM has it. Each import runs in a process of its own, so that its peak of
memory is its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

from dptse_env.importers import Source, Split, import_trajectories
from dptse_env.traffic import Corridor, Demand

FORMATS = ("csv", "parquet", "text")
ROAD = Corridor(
    name="bench", n_mainline=10, on_ramps=(), off_ramps=(), exit_shares=(), fixed_sensors=(),
    demand=Demand(((0.0, 0.0),)), incident=None, duration=300,
)  # fmt: skip
POINTS = 500
"""Points of a vehicle: 50 s at 20 m/s."""
BATCH = 1000
"""Vehicles that are written together."""


def main() -> None:
    """Make files, import each in a child, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, nargs="+", default=[1_000_000, 4_000_000])
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        import_file(Path(arguments.child))
        return
    print(f"{'format':8} {'rows':>12} {'file [MB]':>10} {'rows/s':>10} {'peak memory [MB]':>17}")
    for kind in arguments.formats:
        for rows in arguments.rows:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"points.{kind.replace('text', 'txt')}"
                write(path, rows // POINTS)
                size = path.stat().st_size / 1e6
                command = [sys.executable, __file__, "--child", str(path)]
                run = subprocess.run(command, check=True, capture_output=True, text=True)
            found = json.loads(run.stdout)
            speed, memory = found["rows"] / found["seconds"], found["memory"] / 1e6
            print(f"{kind:8} {found['rows']:12,} {size:10.1f} {speed:10,.0f} {memory:17.0f}")


def write(path: Path, n_vehicles: int) -> None:
    """Write a file of vehicles that follow one another by a second."""
    for first in range(0, n_vehicles, BATCH):
        vehicle = np.repeat(np.arange(first, min(first + BATCH, n_vehicles)), POINTS)
        since = np.tile(0.1 * np.arange(POINTS), len(vehicle) // POINTS)
        noise = np.random.default_rng(first).normal(0.0, 0.2, len(vehicle))
        columns = {
            "Vehicle_ID": vehicle, "Frame_ID": (10 * (vehicle + since)).astype(int),
            "Total_Frames": np.full(len(vehicle), POINTS),
            "Global_Time": np.round(1118846979700 + 1000.0 * (vehicle + since)).astype(int),
            "Local_X": np.round(18.0 + noise, 3),
            "Local_Y": np.round((20.0 * since + noise) / 0.3048, 3),
            "Global_X": np.full(len(vehicle), 6451137.641),
            "Global_Y": np.full(len(vehicle), 1873344.962),
            "v_Length": np.full(len(vehicle), 14.3), "v_Width": np.full(len(vehicle), 6.4),
            "v_Class": np.full(len(vehicle), 2),
            "v_Vel": np.round((20.0 + noise) / 0.3048, 2), "v_Acc": np.round(noise, 2),
            "Lane_ID": 1 + vehicle % 3, "Preceding": vehicle, "Following": vehicle,
            "Space_Headway": np.full(len(vehicle), 65.6),
            "Time_Headway": np.full(len(vehicle), 1.0),
        }  # fmt: skip
        with path.with_suffix(".csv" if path.suffix == ".parquet" else path.suffix).open(
            "ab"
        ) as file:
            if path.suffix == ".txt":
                np.savetxt(file, np.column_stack(list(columns.values())), fmt="%14.3f")
            else:
                pl.DataFrame(columns).write_csv(file, include_header=first == 0)
    if path.suffix == ".parquet":
        pl.scan_csv(path.with_suffix(".csv")).sink_parquet(path)


def import_file(path: Path) -> None:
    """Import a file, and print rows, seconds and bytes as JSON."""
    splits = [Split("training", 1.0, range(10_000))]
    start = time.perf_counter()
    imported = import_trajectories([path], Source("ngsim"), ROAD, path.parent / "imported", splits)
    seconds = time.perf_counter() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    rows = imported.report["files"][0]["rows"]
    print(json.dumps({"rows": rows, "seconds": seconds, "memory": memory}))


if __name__ == "__main__":
    main()
