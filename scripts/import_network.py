"""Make a road of a SUMO network: a TOML file that every tool takes as a corridor.

python scripts/import_network.py --configuration town.sumocfg --first e12 --last e40 --begin 25200 \
    --duration 900 --output a8.toml
python scripts/import_network.py --net a8.net.xml --routes a8.rou.xml --path "e1 e2 e3"
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agents.files import refuse_to_replace
from dptse_env.importers.network import (
    Files,
    ImportedRoad,
    find_layout,
    import_road,
    read_configuration,
)
from dptse_env.traffic import write_corridor
from dptse_env.utils.files import replacing
from scripts.cli import run


@dataclass(frozen=True)
class Args:
    """Import a road."""

    output: Path = Path("road.toml")
    """The road file to write; the name of the road is that of the file."""
    configuration: Path | None = None
    """SUMO's configuration, a .sumocfg, with network, routes, additional files and options."""
    net: Path | None = None
    """Network file; that of the configuration if not given."""
    routes: tuple[Path, ...] = ()
    """Route files; those of the configuration if not given."""
    additional: tuple[Path, ...] = ()
    """Additional files; those of the configuration if not given."""
    path: str = ""
    """Edges of the road in the direction of travel, with blanks between them, as in
    --path="e1 -e2"; its ends become the boundary segments."""
    first: str | None = None
    """First edge, instead of a path; --first=-e1 where its name begins with a hyphen."""
    last: str | None = None
    """Last edge: the road is the shortest path between the two."""
    first_position: float = 0.0
    """Position on the first edge at which the road begins [m]."""
    last_position: float | None = None
    """Position on the last edge at which the road ends [m]; its end if not given."""
    leave_out: str = ""
    """Edges that join or leave the path and are to be no ramps, with blanks between them."""
    segment_length: float = 100.0
    """Wanted length of a segment [m]."""
    begin: int | None = None
    """Second of SUMO's clock at which a record starts; that of the configuration after the warm-up
    if not given."""
    duration: int = 600
    """Length of a record [s]."""
    warm_up: int = 0
    """Seconds that are simulated before a record starts."""
    speed_limit: float | None = None
    """Speed limit of all segments [km/h]; that of the edges if not given."""
    step_length: float | None = None
    """SUMO's time step [s]; that of the configuration, or else 1, if not given."""
    options: str = ""
    """Further options of SUMO, as in --options="--time-to-teleport=-1 --eager-insert=true"."""
    seed: int = 0
    """Traffic seed of the run that demand and exit shares are counted in."""
    force: bool = False
    """Replace the road file if it is there."""


def main(args: Args) -> None:
    """Import, write the road and print what it is."""
    if args.output.suffix != ".toml":
        raise ValueError(f"output must be a .toml file, got {args.output}")
    refuse_to_replace([args.output], args.force)
    files = _files(args)
    path, between = _path(args)
    ends = (args.first_position, args.last_position)
    layout = find_layout(files, path, args.segment_length, between, args.leave_out.split(), ends)
    road = import_road(
        files,
        layout,
        re.sub(r"[^a-z0-9]+", "-", args.output.stem.lower()).strip("-"),
        args.duration,
        begin=args.begin,
        warm_up=args.warm_up,
        speed_limit=args.speed_limit,
        seed=args.seed,
    )
    with replacing(args.output) as temporary:
        write_corridor(temporary, road.corridor, comment=_comment(road))
    print(_comment(road))
    print(f"written: {args.output}")


def _files(args: Args) -> Files:
    if args.configuration is None and args.net is None:
        raise ValueError("net must be given, or a configuration")
    if args.configuration is not None:
        files = read_configuration(args.configuration)
    else:
        assert args.net is not None
        files = Files(args.net, ())
    return dataclasses.replace(
        files,
        net=args.net or files.net,
        routes=args.routes or files.routes,
        additional=args.additional or files.additional,
        step_length=args.step_length or files.step_length,
        options=(*files.options, *args.options.split()),
    )


def _path(args: Args) -> tuple[tuple[str, ...], bool]:
    """Return the path's edges, and whether these are its ends alone."""
    if args.path:
        if args.first or args.last:
            raise ValueError("path must be given alone, or first and last without it")
        return tuple(args.path.split()), False
    if args.first is None or args.last is None:
        raise ValueError("path must be given, or first and last")
    return (args.first, args.last), True


def _comment(road: ImportedRoad) -> str:
    """Describe a road in a few lines."""
    corridor, layout, network = road.corridor, road.layout, road.corridor.network
    assert network is not None
    on, off = layout.names[: corridor.n_on_ramps], layout.names[corridor.n_on_ramps :]
    lengths = layout.lengths
    lines = [
        f"{corridor.name}: from {Path(network.net).name}, seconds {network.begin} to "
        f"{network.begin + corridor.duration}",
        f"{corridor.n_mainline} segments of {min(lengths):.0f} to {max(lengths):.0f} m, "
        f"{min(layout.lanes)} to {max(layout.lanes)} lanes, "
        f"{min(layout.limits):.0f} to {max(layout.limits):.0f} km/h",
    ]
    demand = corridor.published_demand
    lines.append(f"mainline: {_range(demand.mainline)}")
    for face, name, rates in zip(corridor.on_ramps, on, demand.ramp_profiles, strict=True):
        lines.append(f"on-ramp at face {face}: {name}, {_range(rates)}")
    for face, name, share in zip(corridor.off_ramps, off, corridor.exit_shares, strict=True):
        lines.append(f"off-ramp at face {face}: {name}, {100 * share:.1f} % leave")
    lines += [f"note: {remark}" for remark in road.remarks]
    return "\n".join(lines)


def _range(profile: Sequence[tuple[float, float]]) -> str:
    rates = [rate for _, rate in profile]
    return f"{min(rates):.0f} to {max(rates):.0f} veh/h"


if __name__ == "__main__":
    run(main, Args, __doc__)
