"""A road that is fitted: its file, the environment that it is fitted for, and its traffic seeds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.environments import parse_env, preset_of, quietly
from agents.play import Cell
from agents.seeds import KINDS, require_seeds
from dptse_env.config import (
    PRESETS,
    EnvConfig,
    parse_seeds,
    resolve,
)
from dptse_env.evaluation import WARM_UP
from dptse_env.model import available_parameters
from dptse_env.model.parameters import LARGEST_W
from dptse_env.traffic import (
    Corridor,
    RecordLibrary,
    average_dwell,
    is_road_file,
    ranges,
    read_road,
    write_corridor,
)
from dptse_env.traffic.imported import has_vehicles, recorded_seeds
from dptse_env.traffic.sumo_input import net_xml
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import require
from dptse_env.versions import code_version

CHOSEN = ("parameters", "estimator", "estimator_settings")
"""Keywords of an environment that a fit decides."""

PLAYED = "road.toml"
"""File of the road that the episodes of a fit are played on."""


@dataclass(frozen=True)
class Road:
    """A road and the environment that it is fitted for.

    Attributes:
        path: The road file.
        corridor: The road of the file; that of `config` has the demand and incident of `keywords`.
        env: Id of the environment.
        config: The environment, as the file and the keywords make it before the fit.
        keywords: Keywords of every episode that is played, without `CHOSEN`.
        present: Keywords among `CHOSEN` that the file has, if they are neither shipped sets nor
            those of an earlier fit.
        assumed: Fields of the corridor that the file does not give.
        seeds: Traffic seeds by kind, as `agents.seeds.KINDS`.
        decided: Keywords among these that neither the file nor the caller gives.
        remarks: What was decided for want of a word in the file, a sentence each.
    """

    path: Path
    corridor: Corridor
    env: str
    config: EnvConfig
    keywords: Mapping[str, Any]
    present: Mapping[str, Any]
    assumed: tuple[str, ...]
    seeds: Mapping[str, tuple[int, ...]]
    decided: tuple[str, ...]
    remarks: tuple[str, ...]

    @property
    def is_of_records(self) -> bool:
        """True where files have its vehicles; those that are drawn are nobody's."""
        return self.corridor.recordings is not None or self.corridor.sumo is not None

    @property
    def inherited(self) -> str:
        """Name of the ARZ parameters that the environment has where nobody gives any."""
        return PRESETS[preset_of(self.env)].parameters.name

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """Traffic seeds of all kinds."""
        return tuple(seed for kind in KINDS for seed in self.seeds[kind])

    def cell(self, policy: str) -> Cell:
        """Return a query policy on the road, to be checked."""
        keywords = {**self.keywords, "corridor": str(self.path)}
        return Cell(self.env, policy, keywords, transferred=True)

    def plan(self, trials: int) -> dict[str, Any]:
        """Return what two fits must share for one to go on with what the other has found."""
        road = self.corridor.fields()
        del road["average_dwell"], road["measured"]  # the fit itself puts them into the file
        content = {
            "road": road,
            "env": self.env,
            "keywords": self.keywords,
            "seeds": self.seeds,
            "trials": trials,
            "dptse-env": code_version(),
        }
        found: dict[str, Any] = json.loads(json.dumps(content))
        return found

    def write_played(self, stages: Path, dwell: float) -> None:
        """Write the road that is played, with the dwell that it has."""
        stages.mkdir(parents=True, exist_ok=True)
        # The file that a fit leaves has more under `measured`, and is the same road.
        played = dataclasses.replace(self.corridor, measured=())
        if "average_dwell" in self.assumed:
            played = played.replaced(average_dwell=dwell)
        write_corridor(stages / PLAYED, played)

    def measure_dwell(self, library: RecordLibrary) -> float:
        """Return the average dwell in training traffic [s].

        Raises:
            ValueError: No vehicle was ever on the mainline; the message has the file's path.
        """
        corridor = self.config.corridor
        records = (library.get(corridor, seed) for seed in self.seeds["training"])
        try:
            return round(average_dwell(corridor, records), 2)
        except ValueError as problem:
            raise ValueError(
                f"{self.path}: no vehicle is on the mainline in training traffic: give the road "
                "demand, or recordings with vehicles"
            ) from problem


def require_road(path: Path) -> None:
    """Refuse the path of another file than a road.

    Raises:
        ValueError: Its name has another ending.
    """
    require(is_road_file(path), "road", "a road file, whose name ends in .toml", str(path))


def find_road(path: Path, env: str, folder: Path, seeds: Mapping[str, str | None]) -> Road:
    """Read a road file and check everything that needs no traffic.

    Args:
        path: The road file.
        env: Id of the environment, or id and keywords as JSON (`agents.environments.parse_env`).
        folder: Where the fit goes; what the file has from there is no present choice.
        seeds: Traffic seeds by kind, as `agents.seeds.KINDS`, ``"first:stop"``; None for the usual
            number, or all that were recorded.

    Raises:
        ValueError: The file, a keyword or a seed is out of range, or the road cannot be fitted; the
            message starts with a path and says what to change.
        MissingExtraError: netconvert is missing.
        NetconvertError: netconvert refuses the road.
    """
    require_road(path)
    road = read_road(path)
    corridor, (env, given) = road.corridor, parse_env(env)
    for key in (*CHOSEN, "corridor", "traffic_seeds", "records"):
        require(key not in given, f"env.{key}", "left out", given.get(key))
    _check_road(path, corridor)
    present = {key: value for key, value in road.environment.items() if key in CHOSEN}
    arz = present.get("parameters")
    is_own = arz is None or arz in available_parameters() or _lies_in(arz, folder)
    if is_own and "estimator_settings" not in present:
        present = {}
    keywords = {k: v for k, v in road.environment.items() if k not in (*CHOSEN, "traffic_seeds")}
    keywords |= given
    base, decided, remarks = PRESETS[preset_of(env)], list[str](), list[str]()
    third = max(corridor.geometry.n_mainline // 3, 1)
    if "bandwidth" not in keywords and third < base.bandwidth:
        keywords["bandwidth"] = third
        decided.append("bandwidth")
        remarks.append(f"bandwidth {third}, a third of the segments")
    is_field = not has_vehicles(corridor.recordings)
    needs_vehicles = base.release_model.needs_vehicles
    if is_field and needs_vehicles and "privacy" not in keywords:
        keywords["privacy"] = "corrected"
        decided.append("privacy")
        remarks.append("release model 'corrected', since a measured field has no vehicles")
    found = {kind: seeds_of(kind, seeds[kind], corridor, str(path)) for kind in KINDS}
    with quietly():
        more = {"corridor": str(path), "traffic_seeds": list(found["test"])}
        config = resolve(preset_of(env), {**keywords, **more})
    longer = f"more than the {WARM_UP} s that do not count"
    require(config.horizon_steps > WARM_UP, f"{path}: duration", longer, config.horizon_steps)
    return Road(
        path, corridor, env, config, keywords, present, road.assumed, found, tuple(decided),
        tuple(remarks),
    )  # fmt: skip


def _lies_in(value: Any, folder: Path) -> bool:
    """Return whether a value names a file in a folder."""
    return isinstance(value, str) and Path(value).resolve().is_relative_to(folder.resolve())


def _check_road(path: Path, corridor: Corridor) -> None:
    """Refuse a road without traffic or SUMO files, and segments that suit no set of parameters."""
    if corridor.recordings is None and corridor.sumo is None:
        rates = [rate for _, rate in corridor.conditions.published_demand.mainline]
        require(max(rates) > 0.0, f"{path}: demand.mainline", "above 0 veh/h at some time", rates)
        net_xml(corridor.geometry)  # so that netconvert refuses the road, or is missing, at once
    pairs = zip(corridor.geometry.segment_lengths, corridor.geometry.speed_limits, strict=True)
    for segment, (length, limit) in enumerate(pairs):
        least = LARGEST_W * limit / HOUR
        if length < 1.02 * least:
            raise ValueError(
                f"{path}: segment {segment} of {length:g} km must be longer than "
                f"{1.02 * least:.3f} km at {limit:g} km/h, so that no vehicle crosses it within "
                "the time step of 1 s; or choose the estimator asm, which steps no model"
            )


USUAL = {"training": 8, "validation": 16, "test": 16}
"""Traffic seeds of each kind on a road that is simulated."""


def seeds_of(kind: str, given: str | None, corridor: Corridor, origin: str) -> tuple[int, ...]:
    """Return traffic seeds of a kind: those given, all that were recorded, or the usual number.

    Args:
        kind: One of `agents.seeds.KINDS`.
        given: ``"first:stop"``, or None.
        corridor: The road of the file; that of `config` has the demand and incident of `keywords`.
        origin: File or environment that the road comes from, for messages.

    Raises:
        ValueError: They are out of range, or no traffic of this kind was recorded.
    """
    option, allowed = f"{kind.removesuffix('ing')}_seeds", KINDS[kind]
    if given is not None:
        found = parse_seeds(given, option)
    elif corridor.recordings is None:
        found = tuple(allowed[: USUAL[kind]])
    else:
        recorded = recorded_seeds(corridor.recordings)
        found = tuple(seed for seed in recorded if seed in allowed)
        if not found:
            raise ValueError(
                f"{origin}: recordings must have a window of {kind} traffic, got seeds "
                f"{ranges(recorded)}: import them again with a shorter duration, or other --shares"
            )
    require_seeds(option, found, allowed)
    return found
