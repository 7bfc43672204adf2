"""Import recorded trajectories, a SUMO net or a measured field as a road.

dptse import trajectories --help
"""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from agents.environments import parse_env
from agents.seeds import KINDS
from dptse_env.importers import Options, Source, Split, import_trajectories, read_source
from dptse_env.importers.fields import FieldRoad, FieldSource, import_field
from dptse_env.importers.folder import ROAD
from dptse_env.importers.report import REPORT, remarks
from dptse_env.importers.sumo_net import (
    PARAMETERS,
    Files,
    ImportedRoad,
    import_road,
    read_configuration,
    segment_path,
)
from dptse_env.traffic import Corridor, is_road_file, ranges, read_road, write_corridor
from dptse_env.utils.files import replacing, require_output
from scripts.cli import Environment

PAPER = "dptse_env:dptse/PaperHighway-v0"
Shares = tuple[float, float, float]
SHARES: Shares = (0.6, 0.2, 0.2)


@dataclass(frozen=True, kw_only=True)
class Trajectories(Environment):
    r"""Import recorded trajectories as records of a road.

    dptse import trajectories --files points.csv --format table \
        --output my-data --columns time=t vehicle=id x=s speed=v \
        --env 'dptse_env:dptse/PaperHighway-v0 {"corridor": "road.toml"}'

    The folder has the road, road.toml, which an environment takes as its corridor, the records and
    a report. The road of --env is where the data was recorded.
    """

    files: tuple[Path, ...]
    """Files of trajectories, in order of time."""
    output: Path
    """Folder to create."""
    format: str | None = None
    """fcd, ngsim, highd, exid, i24, tgsim or table; the mapping's if not given."""
    mapping: Path | None = None
    """TOML file that says what the data means and where the road lies in it."""
    columns: tuple[str, ...] = ()
    """Columns by role, role=column: time, vehicle, x, y, speed, lane, edge, group."""
    units: tuple[str, ...] = ()
    """Units by quantity, as quantity=unit: time, length, speed."""
    where: tuple[str, ...] = ()
    """Values that columns must have, as column=value."""
    shares: Shares = SHARES
    """Shares of the windows for training, validation and test, in this order of time."""
    options: Annotated[Options, arg(name="")] = Options()  # noqa: RUF009 (frozen)

    def run(self) -> None:
        """Import, and print which traffic seeds there are and what to do next."""
        env, keywords = parse_env(self.env)
        road = keywords.get("corridor")
        environment = read_road(road).environment if is_road_file(road) else {}
        imported = import_trajectories(
            self.files,
            self.source(),
            self.corridor(),
            self.output,
            splits(self.shares),
            self.options,
            {key: value for key, value in environment.items() if key != "traffic_seeds"},
        )
        for file in imported.report["files"]:
            for remark in remarks(file):
                print(f"{file['file']}: {remark}")
        for note in imported.report["notes"]:
            print(f"note: {note}")
        print_seeds(imported.seeds)
        print(f"road: {self.output / ROAD}\nreport: {self.output / REPORT}")
        print_next(self.output / ROAD, imported.seeds, imported.corridor, env, keywords)

    def source(self) -> Source:
        """Return what the data means: the mapping, changed by the other arguments."""
        if self.mapping is None and self.format is None:
            raise ValueError("format must be given where no mapping is")
        base = read_source(self.mapping) if self.mapping else Source(str(self.format))
        return dataclasses.replace(
            base,
            format=self.format or base.format,
            columns=base.columns | _pairs("columns", self.columns),
            units=base.units | _pairs("units", self.units),
            where=base.where | _pairs("where", self.where),
        )


@dataclass(frozen=True)
class Field:
    r"""Import a measured field of density and speed, or flow.

    dptse import field --density density.txt --speed speed.txt \
        --cell 0.1 --interval 5 --name my-field --segments 6 --lanes 3 \
        --speed-limit 100 --duration 90 --output my-field

    A field has no vehicles: the release models printed and corrected work on it, those with a
    guarantee need the vehicles and say so.
    """

    source: Annotated[FieldSource, arg(name="")]
    road: Annotated[FieldRoad, arg(name="")]
    output: Path
    """Folder to create."""
    duration: int = 450
    """Seconds of each of the windows that the field is cut into."""
    shares: Shares = SHARES
    """Shares of the windows for training, validation and test, in this order of time."""

    def run(self) -> None:
        """Import, and print which traffic seeds there are and what to do next."""
        corridor, seeds = import_field(
            self.source, self.road, self.output, splits(self.shares), self.duration
        )
        print_seeds(seeds)
        print(
            f"road: {self.output / ROAD}, segments of {corridor.geometry.segment_lengths[0]:g} km"
        )
        print_next(
            self.output / ROAD,
            seeds,
            corridor,
            PAPER,
            {"privacy": "corrected"},
            fit_for=f'{PAPER} {{"privacy": "corrected"}}',
        )


@dataclass(frozen=True)
class Network:
    r"""Make a road of a SUMO net, as a TOML file that an environment takes as its corridor.

    dptse import network --configuration town.sumocfg --path "in ... out" \
        --duration 120 --output my-road.toml
    """

    output: Path = Path("road.toml")
    """The road file to write; the name of the road is that of the file."""
    configuration: Path | None = None
    """SUMO's configuration, a .sumocfg, with net, routes, additional files and options."""
    net: Path | None = None
    """Net file, in place of the configuration's; so below."""
    routes: tuple[Path, ...] = ()
    """Route files."""
    additional: tuple[Path, ...] = ()
    """Additional files."""
    path: str = ""
    """Edges in the direction of travel, as in --path="e1 -e2 e3"; "e1 ... e9" is the shortest path
    between two. The ends become the boundary segments."""
    first_position: float = 0.0
    """Position on the first edge at which the road begins [m]."""
    last_position: float | None = None
    """Position on the last edge at which the road ends [m]; its end if not given."""
    leave_out: str = ""
    """Edges that join or leave the path and are to be no ramps, with blanks between them."""
    segment_length: float = 100.0
    """Wanted length of a segment [m]."""
    begin: int | None = None
    """Second of SUMO's clock at which a record starts; the configuration's after the warm-up."""
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
    force: bool = False
    """Replace the road file if it is there."""

    def run(self) -> None:
        """Import, write the road and print what it is."""
        if self.output.suffix != ".toml":
            raise ValueError(f"output must be a .toml file, got {self.output}")
        edges = self.path.split()
        between = "..." in edges
        if not edges or (between and (len(edges) != 3 or edges[1] != "...")):
            raise ValueError(f"path must be edges, or two with ... between them, got {self.path!r}")
        files = self._files()
        require_output(self.output.parent, [self.output.name], force=self.force)
        ends = self.first_position, self.last_position
        segments = segment_path(
            files,
            edges[::2] if between else edges,
            self.segment_length,
            between,
            self.leave_out.split(),
            ends,
        )
        road = import_road(
            files,
            segments,
            re.sub(r"[^a-z0-9]+", "-", self.output.stem.lower()).strip("-"),
            self.duration,
            begin=self.begin,
            warm_up=self.warm_up,
            speed_limit=self.speed_limit,
        )
        with replacing(self.output) as temporary:
            write_corridor(temporary, road.corridor, comment=describe(road))
        print(describe(road))
        print(f"written: {self.output}")
        keywords = {"parameters": PARAMETERS}
        print_next(self.output, {"test": KINDS["test"][:8]}, road.corridor, PAPER, keywords)

    def _files(self) -> Files:
        if self.configuration is not None:
            files = read_configuration(self.configuration)
        elif self.net is not None:
            files = Files(self.net, ())
        else:
            raise ValueError("net must be given, or a configuration")
        return dataclasses.replace(
            files,
            net=self.net or files.net,
            routes=self.routes or files.routes,
            additional=self.additional or files.additional,
            step_length=self.step_length or files.step_length,
            options=(*files.options, *self.options.split()),
        )


Args = Trajectories | Network | Field


def main(args: Args) -> None:
    """Import."""
    args.run()


def splits(shares: Iterable[float]) -> list[Split]:
    """Return the parts of the windows."""
    return [
        Split(name, share, each) for (name, each), share in zip(KINDS.items(), shares, strict=True)
    ]


def print_seeds(seeds: Mapping[str, tuple[int, ...]]) -> None:
    """Print the traffic seeds of each part."""
    for name, given in seeds.items():
        print(f"{name}: {len(given)} window(s), traffic seeds {ranges(given)}")


def print_next(
    road: Path, seeds: Mapping[str, Sequence[int]], corridor: Corridor, env: str,
    keywords: Mapping[str, Any], fit_for: str = "",
) -> None:  # fmt: skip
    """Print the commands that follow an import, with the traffic seeds that there are.

    Args:
        road: The road file.
        seeds: Traffic seeds by part.
        corridor: The road.
        env: Id of an environment.
        keywords: Its keywords.
        fit_for: Environment to fit the road for, if not the one that a fit has by default.
    """
    missing = [name for name, own in seeds.items() if not own]
    if missing:
        most = corridor.conditions.duration
        print(
            f"note: there is no window for {' and '.join(missing)}, which fitting needs: a "
            f"duration below {most} s, more files or other shares make some"
        )
    if not seeds["test"]:
        return
    given = {
        "bandwidth": min(2, corridor.geometry.n_mainline),
        **keywords,
        "corridor": road.as_posix(),
    }
    first, last = seeds["test"][0], seeds["test"][-1]
    fit = "fit", road.as_posix(), *(("--env", fit_for) if fit_for else ())
    evaluate = "evaluate", "--env", f"{env} {json.dumps(given)}", "--seeds", f"{first}:{last + 1}"
    for words in (evaluate,) if missing else (fit, evaluate):
        print(f"next: {shlex.join(('dptse', *words))}")


def describe(road: ImportedRoad) -> str:
    """Describe a road of a SUMO net in a few lines."""
    corridor, names = road.corridor, road.segments.names
    geometry, files = corridor.geometry, corridor.sumo
    assert files is not None
    n, n_on = geometry.n_mainline, len(geometry.on_ramps)
    lengths, lanes, limits = (
        each[:n]
        for each in (geometry.segment_lengths, geometry.segment_lanes, geometry.speed_limits)
    )
    demand = corridor.conditions.published_demand
    lines = [
        f"{corridor.name}: from {Path(files.net).name}, seconds {files.begin} to "
        f"{files.begin + corridor.conditions.duration}",
        f"{n} segments of {1000 * min(lengths):.0f} to {1000 * max(lengths):.0f} m, "
        f"{min(lanes)} to {max(lanes)} lanes, {min(limits):.0f} to {max(limits):.0f} km/h",
        f"mainline: {_range(demand.mainline)}",
    ]
    on_ramps = zip(geometry.on_ramps, names[:n_on], demand.ramp_profiles, strict=True)
    for face, name, rates in on_ramps:
        lines.append(f"on-ramp at face {face}: {name}, {_range(rates)}")
    off_ramps = zip(geometry.off_ramps, names[n_on:], geometry.exit_shares, strict=True)
    for face, name, share in off_ramps:
        lines.append(f"off-ramp at face {face}: {name}, {100 * share:.1f} % leave")
    lines += [f"note: {remark}" for remark in road.remarks]
    return "\n".join(lines)


def _range(profile: Sequence[tuple[float, float]]) -> str:
    rates = [rate for _, rate in profile]
    return f"{min(rates):.0f} to {max(rates):.0f} veh/h"


def _pairs(path: str, words: Iterable[str]) -> dict[str, str]:
    pairs = {}
    for word in words:
        key, sign, value = word.partition("=")
        if not (key and sign and value):
            raise ValueError(f"{path} must be key=value, got {word!r}")
        pairs[key] = value
    return pairs
