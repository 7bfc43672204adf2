r"""Import recorded traffic as a road on which all tools work: trajectories, or a measured field.

$ dptse import trajectories --files fcd.xml --env dptse_env:dptse/ShortHighway-v0 \
    --format fcd --output my-data

The folder has the road (road.toml, to be given as the corridor) and its records; that of
trajectories has a report, too. A field has no vehicles: the release models `paper` and `corrected`
work on it, those with a guarantee need the vehicles and say so.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from agents.environments import parse_env
from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.importers import Options, Source, Split, import_trajectories, read_source
from dptse_env.importers.fields import FieldRoad, FieldSource, import_field
from dptse_env.importers.folder import ROAD
from dptse_env.importers.report import REPORT
from dptse_env.traffic import is_road_file, ranges, read_road
from scripts.cli import Environment, run


@dataclass(frozen=True, kw_only=True)
class Trajectories(Environment):
    """Import recorded trajectories as records of a road."""

    files: tuple[Path, ...]
    """Files of trajectories, in order of time."""
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

    def run(self) -> None:
        """Import, and print which traffic seeds there are."""
        road = parse_env(self.env)[1].get("corridor")
        environment = read_road(road).environment if is_road_file(road) else {}
        imported = import_trajectories(
            self.files,
            self.source(),
            self.corridor(),
            self.output,
            splits(self.shares),
            Options(self.longest_gap, self.skip_start, self.skip_end, self.pause),
            {key: value for key, value in environment.items() if key != "traffic_seeds"},
        )
        print_seeds(imported.seeds)
        print(f"road: {self.output / ROAD}\nreport: {self.output / REPORT}")

    def source(self) -> Source:
        """Return what the data means: the mapping, changed by the other arguments."""
        if self.mapping is None and self.format is None:
            raise ValueError("format must be given where no mapping is")
        base = read_source(self.mapping) if self.mapping else Source(str(self.format))
        return replace(
            base,
            format=self.format or base.format,
            columns=base.columns | _pairs("columns", self.columns),
            units=base.units | _pairs("units", self.units),
            where=base.where | _pairs("where", self.where),
        )


@dataclass(frozen=True)
class Field:
    """Import a measured field of density and speed, or flow."""

    source: FieldSource
    """Files and their units."""
    road: FieldRoad
    """The road."""
    output: Path
    """Folder to create."""
    duration: int = 450
    """Seconds of each of the windows that the field is cut into."""
    shares: tuple[float, float, float] = (0.6, 0.2, 0.2)
    """Shares of the windows for training, validation and test, in this order of time."""

    def run(self) -> None:
        """Import, and print which traffic seeds there are."""
        corridor, seeds = import_field(
            self.source, self.road, self.output, splits(self.shares), self.duration
        )
        print_seeds(seeds)
        print(f"road: {self.output / ROAD}, segments of {corridor.segment_lengths[0]:g} km")


Args = Trajectories | Field


def main(args: Args) -> None:
    """Import; an interruption leaves nothing."""
    try:
        args.run()
    except KeyboardInterrupt:
        print("interrupted: nothing was written", file=sys.stderr)
        raise SystemExit(130) from None


def splits(shares: Iterable[float]) -> list[Split]:
    """Return the parts of the windows."""
    seeds = {"training": TRAINING_SEEDS, "validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
    return [
        Split(name, share, each) for (name, each), share in zip(seeds.items(), shares, strict=True)
    ]


def print_seeds(seeds: Mapping[str, tuple[int, ...]]) -> None:
    """Print the traffic seeds of each part."""
    for name, given in seeds.items():
        print(f"{name}: {len(given)} window(s), traffic seeds {ranges(given)}")


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
