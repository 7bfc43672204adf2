"""Roads by name, and roads as TOML files.

The corridors that come with the package have an `average_dwell` measured on the training seeds
0..15, by ``dptse record --env ID --train-seeds 0:16``; a test repeats the measurement.

A road file is a corridor, and the keywords of an environment that suit it. It has the fields of a
`Corridor` and of its parts, with tables for ``demand``, ``incident``, ``drivers`` and
``recordings``, whose folder may be relative to the file, and a table ``environment`` of keywords of
``gym.make`` that hold on this road unless the caller gives them. ``docs/guides/your-road.md`` has
the format and an example.
"""

from __future__ import annotations

import os
import re
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

import tomli_w

from dptse_env.geometry import Geometry
from dptse_env.traffic.corridor import Conditions, Corridor, Scales
from dptse_env.traffic.demand import Demand, DemandDistribution, Incident, IncidentDistribution
from dptse_env.utils.files import write_atomically
from dptse_env.utils.registry import Registry, require_registered
from dptse_env.utils.validation import read_toml, require, within

SUFFIX = ".toml"
"""Ending of the name of a road file."""

_ENVIRONMENT = "environment"
PARTS = ("action", "estimator", "observation", "privacy", "reward")
"""Keywords that take names of parts. In a file these are registered names: ``"module:Name"`` would
let a file that somebody sent run code of the current folder."""
_WITH_FOLDER = ("recordings", "sumo")
_FILE_ENDINGS = (".json", ".safetensors")
_WIDTH = 100
_NUMBERS = re.compile(r"^(.*)\[\n((?: +[^\s\"'\[\]]+,\n)+) *\]", re.MULTILINE)
_PAIRS = re.compile(r"^(.*)\[\n((?: +\[[^\n\"'\[\]]*\],\n)+) *\]", re.MULTILINE)


_PAPER = Geometry(15, on_ramps=(3, 9), off_ramps=(6, 12), exit_shares=(0.1, 0.1))
PAPER_HIGHWAY = Corridor(
    name="paper-highway",
    geometry=_PAPER,
    conditions=Conditions(
        demand=Demand(
            mainline=((0.0, 2050.0), (200.0, 6050.0), (400.0, 2050.0)), on_ramps=(320.0, 300.0)
        ),
        incident=Incident(segment=10, phases=((200.0, 400.0, 10.08), (400.0, 500.0, 50.95))),
        duration=700,
    ),
    scales=Scales.of(_PAPER, average_dwell=10.25),
    fixed_sensors=(14, 17, 18),
)
"""The paper's 1.5 km stretch (section IV), its demand and its incident on segment 11.

The paper does not state the three lanes, the exit shares of 10 % and the end after 700 s.
"""

_SHORT = Geometry(6, on_ramps=(2,), off_ramps=(4,), exit_shares=(0.1,), lanes=2)
SHORT_HIGHWAY = Corridor(
    name="short-highway",
    geometry=_SHORT,
    conditions=Conditions(
        demand=Demand(mainline=((0.0, 1800.0), (60.0, 3000.0), (150.0, 1500.0)), on_ramps=(300.0,)),
        incident=Incident(segment=4, phases=((60.0, 140.0, 12.0), (140.0, 170.0, 50.0))),
        duration=240,
    ),
    scales=Scales.of(_SHORT, average_dwell=9.95),
    fixed_sensors=(5, 7),
)
"""A 0.6 km stretch with one ramp of each kind and a jam, for tests and first trials."""

_LONG = Geometry(
    120, on_ramps=(24, 52, 80, 108), off_ramps=(20, 48, 76, 104), exit_shares=(0.1,) * 4
)
LONG_HIGHWAY = Corridor(
    name="long-highway",
    geometry=_LONG,
    conditions=Conditions(
        demand=DemandDistribution(
            Demand(
                mainline=((0.0, 3000.0), (300.0, 5000.0), (750.0, 3000.0)), on_ramps=(400.0,) * 4
            )
        ),
        incident=(
            IncidentDistribution(tuple(range(10, 60)), start=(300.0, 700.0)),
            IncidentDistribution(tuple(range(60, 119)), start=(400.0, 800.0)),
        ),
        duration=1200,
    ),
    scales=Scales.of(_LONG, average_dwell=4.52),
    fixed_sensors=(119, 124, 125, 126, 127),
)
"""A 12 km stretch with four interchanges; demand level and two incidents vary with the seed."""

SHIPPED_CORRIDORS = (PAPER_HIGHWAY, SHORT_HIGHWAY, LONG_HIGHWAY)
"""Corridors whose compiled nets come with the package."""

CORRIDORS = Registry(
    "corridor",
    {corridor.name: corridor for corridor in SHIPPED_CORRIDORS},
    check=lambda part: (
        None if isinstance(part, Corridor) or callable(part) else "be a Corridor, or return one"
    ),
)
"""Corridors by name."""


def randomised(corridor: Corridor) -> Corridor:
    """Return `corridor` with a random demand level and incident for every traffic seed.

    The demand varies by a fifth either way. The incident may block any mainline segment but the
    last, at any time that leaves a third of the record for the jam, with ranges in proportion to
    the record's duration. The demand of `corridor` is the base of the distribution; its incident is
    dropped. Other fields are unchanged, also `average_dwell`, which should be measured again.
    """
    base, total = corridor.conditions.published_demand, corridor.conditions.duration
    incident = IncidentDistribution(
        segments=tuple(range(corridor.geometry.n_mainline - 1)),
        start=(0.1 * total, 0.65 * total),
        duration=(0.1 * total, 0.4 * total),
        recovery_duration=(0.05 * total, 0.2 * total),
    )
    return corridor.replaced(demand=DemandDistribution(base), incident=incident)


@dataclass(frozen=True)
class RoadFile:
    """The content of a road file.

    Attributes:
        corridor: The road.
        environment: Keywords of an environment that suit the road. Names of files in it, strings
            that end in ``.json`` or ``.safetensors``, are absolute.
        assumed: Fields of the corridor that neither the file nor a record of the road gives.
    """

    corridor: Corridor
    environment: Mapping[str, Any] = field(default_factory=dict)
    assumed: tuple[str, ...] = ()


def is_road_file(value: object) -> TypeGuard[str | os.PathLike[str]]:
    """Return whether a value names a road file, by the ending of its name."""
    return isinstance(value, str | os.PathLike) and os.fspath(value).endswith(SUFFIX)


def read_road(path: str | os.PathLike[str]) -> RoadFile:
    """Read a road file.

    Without ``name``, it is that of the file. Scales that are left out follow lanes and speed limit
    (`Scales.of`); an average dwell that is assumed so is named in ``assumed``.

    Raises:
        ValueError: There is no such file, it is no TOML, a field is unknown, missing or out of
            range, or a part is named by an import string; the message starts with the file's path
            and the field.
    """
    path = Path(path)
    content = read_toml(path, "road file")
    with within(f"{path}: "):
        environment = content.pop(_ENVIRONMENT, {})
        require(isinstance(environment, Mapping), _ENVIRONMENT, "a table", environment)
        own = environment.get("corridor")
        require(own is None, f"{_ENVIRONMENT}.corridor", "left out: this file is one", own)
        corridor = _corridor(content, path)
        try:
            for key in PARTS:
                require_registered(environment.get(key), f"{_ENVIRONMENT}.{key}")
            home = path.resolve().parent
            keywords = {key: _absolute(value, home) for key, value in environment.items()}
        except RecursionError as problem:
            raise ValueError(f"{_ENVIRONMENT} must not be nested so deeply") from problem
    assumed = () if "average_dwell" in content else ("average_dwell",)
    return RoadFile(corridor, keywords, assumed)


def read_corridor(path: str | os.PathLike[str]) -> Corridor:
    """Return the corridor of a road file; errors are those of `read_road`."""
    return read_road(path).corridor


def write_corridor(
    path: str | os.PathLike[str],
    corridor: Corridor,
    environment: Mapping[str, Any] | None = None,
    comment: str = "",
) -> None:
    """Write a road file that `read_road` reads as the same corridor, completely or not at all.

    Arrays of numbers stand in few lines.

    Args:
        path: The file; its folder exists.
        corridor: The road.
        environment: Keywords of an environment for the table ``environment``.
        comment: Text for the head of the file.
    """
    content = _plain(corridor.fields())
    for name in _WITH_FOLDER:
        if name in content:
            content[name]["folder"] = from_home(path, content[name]["folder"])
    if environment:
        content[_ENVIRONMENT] = _plain(dict(environment))
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    tables = _PAIRS.sub(_joined, _NUMBERS.sub(_joined, tomli_w.dumps(content)))
    write_atomically(path, head + tables)


def _joined(found: re.Match[str]) -> str:
    """Return an array in one line, or folded."""
    before, body = found.groups()
    entries = [line.strip().removesuffix(",") for line in body.splitlines()]
    if len(line := f"{before}[{', '.join(entries)}]") < _WIDTH:
        return line
    whole = (entry.replace(" ", "\0") for entry in entries)
    folded = textwrap.fill(
        ", ".join(whole), _WIDTH, initial_indent="    ", subsequent_indent="    ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
    return f"{before}[\n{folded},\n]".replace("\0", " ")


def from_home(path: str | os.PathLike[str], file: str | os.PathLike[str]) -> str:
    """Return the path of a file or folder from the folder of a road file on, without links.

    So they can be moved together. On another drive it is absolute.
    """
    target, home = Path(file).resolve(), Path(path).resolve().parent
    same_drive = target.drive == home.drive
    return Path(os.path.relpath(target, home)).as_posix() if same_drive else target.as_posix()


def road_name(text: str) -> str:
    """Return a text as the name of a road."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _corridor(content: Mapping[str, Any], path: Path) -> Corridor:
    """Return the corridor of a file's fields."""
    fields = dict(content)
    for name in _WITH_FOLDER:
        given = fields.get(name)
        if isinstance(given, Mapping) and isinstance(given.get("folder"), str):
            folder = str((path.resolve().parent / given["folder"]).resolve())
            fields[name] = {**given, "folder": folder}
    if "name" not in fields:
        fields["name"] = road_name(path.stem)
    return Corridor.from_fields(fields)


def _absolute(value: Any, folder: Path) -> Any:
    """Return a value in which names of files start at a folder."""
    if isinstance(value, Mapping):
        return {key: _absolute(each, folder) for key, each in value.items()}
    if isinstance(value, list):
        return [_absolute(each, folder) for each in value]
    if isinstance(value, str) and value.endswith(_FILE_ENDINGS):
        return str((folder / value).absolute())
    return value


def _plain(value: Any) -> Any:
    """Return a value as TOML has it: without None, and with lists for tuples."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items() if each is not None}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    return value
