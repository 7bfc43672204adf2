r"""Import recorded trajectories, a SUMO net, a measured field or a model of stable-baselines3.

dptse import network --net town.net.xml --routes town.rou.xml --path "in ... out" --output town

A road becomes a folder whose road.toml an environment takes as its corridor, a model one with
policy.safetensors. `dptse import KIND --help` shows an example of each kind.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from agents.environments import make_config, parse_env
from agents.models import import_model
from agents.seeds import KINDS
from dptse_env.importers import Options, Source, Split, import_trajectories, read_source
from dptse_env.importers.fields import FieldRoad, FieldSource, import_field
from dptse_env.importers.folder import ROAD, named_after
from dptse_env.importers.report import REPORT, remarks
from dptse_env.importers.sumo_net import (
    PARAMETERS,
    Files,
    import_road,
    read_configuration,
    segment_path,
)
from dptse_env.policies import DETERMINISTIC, SUFFIX
from dptse_env.traffic import (
    Corridor,
    is_road_file,
    ranges,
    read_road,
    write_corridor,
)
from dptse_env.utils.files import require_output
from dptse_env.utils.validation import require
from scripts.cli import Command, Environment, Output, Replacing

PAPER = "dptse_env:dptse/PaperHighway-v0"
POLICY = f"policy{SUFFIX}"


@dataclass(frozen=True, kw_only=True)
class Import(Output, Command):
    """Options of all imports."""

    output: Path = field()
    """Folder to create."""

    def tell(self, found: Mapping[str, Any], said: Iterable[str], *commands: Sequence[str]) -> None:
        """Print what was imported, and the commands that come next."""
        following = [shlex.join(("dptse", *words)) for words in commands]
        self.answer({**found, "next": following}, *said, *(f"next: {line}" for line in following))


@dataclass(frozen=True, kw_only=True)
class RoadImport(Import):
    """Options of the imports of a road."""

    @property
    def road_file(self) -> Path:
        """The road file."""
        return self.output / ROAD

    def tell_road(
        self, found: Mapping[str, Any], said: Iterable[str], seeds: Mapping[str, Sequence[int]],
        corridor: Corridor, env: str, keywords: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Print what was imported, and the commands that come next, with the traffic seeds.

        Args:
            found: What there is beside the road, for a program.
            said: The same in lines.
            seeds: Traffic seeds by kind.
            corridor: The road.
            env: Id of an environment.
            keywords: Its keywords.
        """
        said, commands = [*said], list[tuple[str, ...]]()
        if missing := [kind for kind in KINDS if not seeds[kind]]:
            most = corridor.conditions.duration
            said.append(
                f"note: there is no window for {' and '.join(missing)}, which fitting needs: a "
                f"duration below {most} s, more files or other shares make some"
            )
        else:
            commands.append(("fit", self.road_file.as_posix()))
        if seeds["test"]:
            first, last = seeds["test"][0], seeds["test"][-1]
            few = {"bandwidth": min(2, corridor.geometry.n_mainline)}
            given = json.dumps({**few, **keywords, "corridor": self.road_file.as_posix()})
            test = "--test-seeds", f"{first}:{last + 1}"
            commands.append(("evaluate", "--env", f"{env} {given}", *test))
        self.tell({"road": str(self.road_file), **found}, said, *commands)


@dataclass(frozen=True, kw_only=True)
class WindowImport(RoadImport):
    """Options of the imports of measured traffic, which is cut into windows."""

    shares: tuple[float, float, float] = (0.6, 0.2, 0.2)
    """Shares of the windows for training, validation and test, in this order of time."""

    @property
    def splits(self) -> list[Split]:
        """The parts of the windows."""
        parts = zip(KINDS.items(), self.shares, strict=True)
        return [Split(kind, share, seeds) for (kind, seeds), share in parts]


@dataclass(frozen=True, kw_only=True)
class Trajectories(Environment, WindowImport):
    r"""Import recorded trajectories as records of a road.

    dptse import trajectories --files points.csv --format table \
        --output my-data --columns time=t vehicle=id x=s speed=v \
        --env 'dptse_env:dptse/PaperHighway-v0 {"corridor": "road.toml"}'

    The folder has the road, road.toml, which an environment takes as its corridor, the records and
    a report. The road of --env is where the data was recorded.
    """

    files: tuple[Path, ...]
    """Files of trajectories, in order of time."""
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
    options: Annotated[Options, arg(name="")] = Options()  # noqa: RUF009 (frozen)

    def run(self) -> None:
        """Import, and print the traffic seeds that there are and what to do next."""
        env, keywords = parse_env(self.env)
        road = keywords.get("corridor")
        environment = read_road(road).environment if is_road_file(road) else {}
        imported = import_trajectories(
            self.files,
            self.source(),
            self.corridor(),
            self.output,
            self.splits,
            self.options,
            {key: value for key, value in environment.items() if key != "traffic_seeds"},
        )
        notes = [
            *(
                f"{file['file']}: {each}"
                for file in imported.report["files"]
                for each in remarks(file)
            ),
            *(f"note: {note}" for note in imported.report["notes"]),
        ]
        report = str(self.output / REPORT)
        found = {"report": report, "seeds": imported.seeds, "notes": notes}
        said = *notes, *windows(imported.seeds), f"road: {self.road_file}", f"report: {report}"
        self.tell_road(found, said, imported.seeds, imported.corridor, env, keywords)

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


@dataclass(frozen=True, kw_only=True)
class Field(WindowImport):
    r"""Import a measured field of density and speed, or flow.

    dptse import field --density density.txt --speed speed.txt \
        --cell 0.1 --interval 5 --segments 6 --lanes 3 --speed-limit 100 \
        --duration 90 --output my-field

    A field has no vehicles: the release models printed and corrected work on it, those with a
    guarantee need the vehicles and say so.
    """

    source: Annotated[FieldSource, arg(name="")]
    road: Annotated[FieldRoad, arg(name="")]
    duration: int = 450
    """Seconds of each of the windows that the field is cut into."""

    def run(self) -> None:
        """Import, and print the traffic seeds that there are and what to do next."""
        corridor, seeds = import_field(
            self.source, self.road, self.output, self.splits, self.duration
        )
        length = corridor.geometry.segment_lengths[0]
        found = {"seeds": seeds, "segment_length": length}
        said = *windows(seeds), f"road: {self.road_file}, segments of {length:g} km"
        self.tell_road(found, said, seeds, corridor, PAPER, {"privacy": "corrected"})


@dataclass(frozen=True, kw_only=True)
class Network(RoadImport, Replacing):
    r"""Make a road of a SUMO net.

    dptse import network --configuration town.sumocfg --path "in ... out" \
        --duration 120 --output my-road
    """

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

    def run(self) -> None:
        """Import, write the road and print what it is."""
        edges = self.path.split()
        between = "..." in edges
        if not edges or (between and (len(edges) != 3 or edges[1] != "...")):
            raise ValueError(f"path must be edges, or two with ... between them, got {self.path!r}")
        files = self._files()
        name = named_after(self.output)
        require_output(self.output, [ROAD], force=self.force)
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
            name,
            self.duration,
            begin=self.begin,
            warm_up=self.warm_up,
            speed_limit=self.speed_limit,
        )
        description = road.description
        self.output.mkdir(parents=True, exist_ok=True)
        write_corridor(self.road_file, road.corridor, comment="\n".join(description))
        said = *description, f"road: {self.road_file}"
        seeds, keywords = {**KINDS, "test": KINDS["test"][:8]}, {"parameters": PARAMETERS}
        self.tell_road({"notes": road.remarks}, said, seeds, road.corridor, PAPER, keywords)

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


@dataclass(frozen=True, kw_only=True)
class Policy(Import, Replacing):
    r"""Turn a model of stable-baselines3 or sb3-contrib into a saved policy.

    dptse import policy model.zip --vecnormalize vecnormalize.pkl \
        --env dptse_env:dptse/ShortHighway-v0 --output mine --trust

    Reading a model unpickles it, which can run any code: --trust is your word that you know where
    it is from. The file that it becomes, policy.safetensors, holds numbers alone.
    """

    model: Annotated[Path, Positional, arg(metavar="MODEL")]
    """The model, a .zip file."""
    env: str
    """Environment that it was trained in: an id, or an id and keywords as JSON."""
    vecnormalize: Path | None = None
    """The statistics of VecNormalize, .pkl, if it was trained with any."""
    acts: Literal["deterministic", "drawn"] = "deterministic"
    """Mode of its actions: the likeliest, or drawn ones."""
    trust: bool = False
    """Unpickle the files, which can run any code that is in them."""

    def run(self) -> None:
        """Read the model, check that it fits the environment, and write the policy."""
        require(
            self.trust, "trust", "given, since reading the model can run code in it", self.trust
        )
        for path in (self.model, self.vecnormalize):
            if path is not None and not path.is_file():
                raise FileNotFoundError(f"there is no file {path}")
        env, keywords = parse_env(self.env)
        make_config(env, keywords)
        require_output(self.output, [POLICY], force=self.force)
        path, acts = self.output / POLICY, self.acts == DETERMINISTIC
        read = self.model, self.vecnormalize
        found = import_model(*read, env, keywords, path, deterministic=acts)
        said = f"{path}: {found['class']}, action encoding {found['action']!r}"
        evaluate = "evaluate", "--env", self.env, "--policies", path.as_posix()
        self.tell({"policy": str(path), **found}, [said], evaluate)


Args = Trajectories | Network | Field | Policy


def main(args: Args) -> None:
    """Import."""
    args.run()


def windows(seeds: Mapping[str, Sequence[int]]) -> list[str]:
    """Return lines with the traffic seeds of each part."""
    return [
        f"{name}: {len(given)} window(s), traffic seeds {ranges(given)}"
        for name, given in seeds.items()
    ]


def _pairs(path: str, words: Iterable[str]) -> dict[str, str]:
    pairs = {}
    for word in words:
        key, sign, value = word.partition("=")
        if not (key and sign and value):
            raise ValueError(f"{path} must be key=value, got {word!r}")
        pairs[key] = value
    return pairs
