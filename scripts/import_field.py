"""Import a measured field of density and speed, or flow, as a road on which tools work.

python scripts/import_field.py --source.density density.txt --source.speed speed.txt
--source.cell 0.02 --source.interval 5 --road.name my-field --road.segments 6 --road.lanes 5
--road.speed-limit 105 --output my-field

The field has no vehicles: the release models `paper` and `corrected` work on it, those with a
guarantee need the vehicles and say so. The folder has the road (road.toml, to be given as the
corridor) and its records.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.importers.fields import FieldRoad, FieldSource, import_field
from dptse_env.importers.folder import ROAD, Split
from dptse_env.traffic import ranges
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Import a measured field."""

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


def main(args: Args) -> None:
    """Import, and print which traffic seeds there are."""
    training, validation, test = args.shares
    splits = [
        Split("training", training, TRAINING_SEEDS),
        Split("validation", validation, VALIDATION_SEEDS),
        Split("test", test, TEST_SEEDS),
    ]
    corridor, seeds = import_field(args.source, args.road, args.output, splits, args.duration)
    for name, given in seeds.items():
        print(f"{name}: {len(given)} window(s), traffic seeds {ranges(given)}")
    print(f"road: {args.output / ROAD}, segments of {corridor.segment_lengths[0]:g} km")


if __name__ == "__main__":
    run(main, Args, __doc__)
