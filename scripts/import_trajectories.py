"""Import recorded trajectories as records of a road, on which all tools work.

python scripts/import_trajectories.py --files fcd.xml --corridor short-highway --format fcd \
--output my-data
python scripts/import_trajectories.py --files 0750.txt 0805.txt --corridor us-101.toml \
--mapping us-101-data.toml --output us-101
python scripts/import_trajectories.py --files points.csv --corridor road.toml --format table \
--columns time=t vehicle=id x=s speed=v lane=lane --units length=ft speed=mi/h --output my-data

The folder has the road (road.toml, to be given as the corridor), its records, and a report.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from agents.environments import given_keywords
from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.importers import (
    Options,
    Source,
    Split,
    import_trajectories,
    read_source,
)
from dptse_env.importers.folder import ROAD
from dptse_env.importers.report import REPORT
from dptse_env.traffic import is_road_file, ranges, read_road
from scripts.cli import make_corridor, run


@dataclass(frozen=True)
class Args:
    """Import recorded trajectories."""

    files: tuple[Path, ...]
    """Files of trajectories, in order of time."""
    corridor: str
    """The road: a road file that ends in .toml, the name of a shipped corridor, or a JSON object of
    fields that replace those of the paper's."""
    output: Path
    """Folder to create."""
    format: str | None = None
    """fcd, ngsim, highd, exid, i24, tgsim or table; the mapping's if not given."""
    mapping: Path | None = None
    """TOML file that says what the data means and where the road lies in it."""
    columns: tuple[str, ...] = ()
    """Columns of the file by role, as role=column (time, vehicle, x, y, speed, lane, edge,
    group)."""
    units: tuple[str, ...] = ()
    """Units by quantity, as quantity=unit: time, length, speed."""
    where: tuple[str, ...] = ()
    """Values that columns must have, as column=value."""
    shares: tuple[float, float, float] = (0.6, 0.2, 0.2)
    """Shares of the windows for training, validation and test, in this order of time."""
    longest_gap: float = Options.longest_gap
    """Longest time without points of a vehicle that is filled by interpolation [s]."""
    skip_start: float = Options.skip_start
    """Seconds left out at the start of each file."""
    skip_end: float = Options.skip_end
    """Seconds left out at the end of each file."""
    pause: int = Options.pause
    """Seconds left out between two windows."""


def main(args: Args) -> None:
    """Import, and print which traffic seeds there are."""
    environment = read_road(args.corridor).environment if is_road_file(args.corridor) else {}
    corridor = make_corridor("dptse_env:dptse/PaperHighway-v0", given_keywords("{}", args.corridor))
    parts = zip(
        ("training", "validation", "test"),
        args.shares,
        (TRAINING_SEEDS, VALIDATION_SEEDS, TEST_SEEDS),
        strict=True,
    )
    try:
        imported = import_trajectories(
            args.files,
            source(args),
            corridor,
            args.output,
            [Split(*part) for part in parts],
            Options(args.longest_gap, args.skip_start, args.skip_end, args.pause),
            {key: value for key, value in environment.items() if key != "traffic_seeds"},
        )
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        raise SystemExit(130) from None
    for name, seeds in imported.seeds.items():
        print(f"{name}: {len(seeds)} window(s), traffic seeds {ranges(seeds)}")
    print(f"road: {args.output / ROAD}\nreport: {args.output / REPORT}")


def source(args: Args) -> Source:
    """Return what the data means: the mapping, changed by the other arguments."""
    if args.mapping is None and args.format is None:
        raise ValueError("format must be given where no mapping is")
    base = read_source(args.mapping) if args.mapping else Source(str(args.format))
    return replace(
        base,
        format=args.format or base.format,
        columns=base.columns | _pairs("columns", args.columns),
        units=base.units | _pairs("units", args.units),
        where=base.where | _pairs("where", args.where),
    )


def _pairs(path: str, words: Iterable[str]) -> dict[str, str]:
    pairs = {}
    for word in words:
        key, sign, value = word.partition("=")
        if not (key and sign and value):
            raise ValueError(f"{path} must be key=value, got {word!r}")
        pairs[key] = value
    return pairs


if __name__ == "__main__":
    run(main, Args, __doc__)
