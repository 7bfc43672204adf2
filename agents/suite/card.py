"""Cards: the results of one policy in a suite, as a JSON file."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.files import write_json
from agents.suite.cells import Suite
from dptse_env.utils.digests import json_digest

DONE, FAILED = "done", "failed"


@dataclass(frozen=True)
class CellResult:
    """Result of a policy in a cell; a failed one has a reason and no numbers.

    Attributes:
        cell: Name of the cell.
        digest: Digest of what its errors depend on.
        status: `DONE` or `FAILED`.
        error: Minus the reward x 1000 after the warm-up, mean of an episode, for each traffic seed.
        density: RMSE of density [veh/km], likewise.
        speed: RMSE of speed [km/h], likewise.
        chi2_density: Mean square of density errors over reported deviations.
        chi2_speed: The same for speeds.
        epsilon: Epsilon of all releases of an episode together at `delta`; None if infinite.
        is_guaranteed: Whether the guarantee holds; otherwise epsilon is a claim.
        percent_refused: Share of vehicles' contributions that their budget did not pay for; None
            where none is kept.
        queries_a_second: Queries that were served.
        policy_ms: Time of a decision for one episode [ms].
        step_ms: Time of a step of one episode, decision included [ms].
    """

    cell: str
    digest: str
    status: str
    reason: str = ""
    traffic_seeds: tuple[int, ...] = ()
    error: tuple[float, ...] = ()
    density: tuple[float, ...] = ()
    speed: tuple[float, ...] = ()
    chi2_density: float | None = None
    chi2_speed: float | None = None
    epsilon: float | None = None
    delta: float | None = None
    is_guaranteed: bool = False
    percent_refused: float | None = None
    queries_a_second: float | None = None
    policy_ms: float | None = None
    step_ms: float | None = None

    @classmethod
    def from_json(cls, content: Any) -> CellResult:
        """Return the result of plain JSON.

        Raises:
            ValueError: A field is missing or unknown, of another type, or not finite.
        """
        names = {each.name for each in dataclasses.fields(cls)}
        if not isinstance(content, Mapping) or set(content) != names:
            raise ValueError(f"a result must have the fields {', '.join(sorted(names))}")
        values: dict[str, Any] = {
            key: tuple(each) if isinstance(each, list) else each for key, each in content.items()
        }
        result: CellResult = cls(**values)
        result.check()
        return result

    def check(self) -> None:
        """Check types and lengths.

        Raises:
            ValueError: A field is of another type, not finite, or not as long as the others.
        """
        hints = typing.get_type_hints(type(self))
        for each in dataclasses.fields(self):
            value, kind = getattr(self, each.name), hints[each.name]
            members = value if isinstance(value, tuple) else (value,)
            if isinstance(value, tuple) != (typing.get_origin(kind) is tuple) or any(
                isinstance(member, float) and not math.isfinite(member) for member in members
            ):
                raise ValueError(f"{each.name} of cell {self.cell!r} must be {kind}, got {value!r}")
            numeric = each.name not in ("cell", "digest", "status", "reason")
            if any(isinstance(member, str) is numeric for member in members if member is not None):
                raise ValueError(f"{each.name} of cell {self.cell!r} must be {kind}, got {value!r}")
        n = len(self.traffic_seeds)
        if self.status not in (DONE, FAILED) or (self.status == DONE) != bool(n):
            raise ValueError(f"status of cell {self.cell!r} does not agree with its numbers")
        if any(len(getattr(self, name)) != n for name in ("error", "density", "speed")):
            raise ValueError(f"cell {self.cell!r} must have {n} errors of each kind")


@dataclass(frozen=True)
class Card:
    """The results of a policy in a suite.

    Attributes:
        suite: Name of the suite.
        name: Name of the policy in tables.
        source: How the policy was given.
        identity: What tells it apart, whatever its file is called.
        made_with: Versions of packages, and the digest of the code of dptse_env.
        results: Results by cell.
    """

    suite: str
    name: str
    source: str
    identity: str
    made_with: dict[str, Any] = field(default_factory=dict)
    results: dict[str, CellResult] = field(default_factory=dict)

    @property
    def content(self) -> dict[str, Any]:
        """The card as plain JSON, without its digest."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    @property
    def digest(self) -> str:
        """Digest of the content."""
        return json_digest(self.content)[:16]

    def write(self, path: Path) -> None:
        """Write the card in one piece."""
        write_json(path, {**self.content, "digest": self.digest})

    @classmethod
    def read(cls, path: Path) -> Card:
        """Read a card.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is not as this class writes it, or was changed afterwards.
        """
        try:
            content = json.loads(path.read_bytes())
            if not isinstance(content, dict):
                raise ValueError("it must be a JSON object")
            digest = content.pop("digest")
            results = {
                name: CellResult.from_json(each) for name, each in content["results"].items()
            }
            card = cls(**{**content, "results": results})
            strings = (card.suite, card.name, card.source, card.identity)
            if not all(isinstance(each, str) for each in strings):
                raise ValueError("suite, name, source and identity must be strings")
        except (ValueError, KeyError, TypeError, AttributeError) as problem:
            raise ValueError(f"{path} is no card of a suite: {problem}") from problem
        if card.digest != digest:
            raise ValueError(f"{path} was changed after it was written: its digest does not agree")
        return card

    def check(self, suite: Suite, path: Path | str) -> None:
        """Refuse a card that is not of a suite as it is now.

        Raises:
            ValueError: It is of another suite, or a cell is unknown, changed, or has other seeds.
        """
        if self.suite != suite.name:
            raise ValueError(f"{path} is a card of {self.suite!r}, not of {suite.name!r}")
        for name, result in self.results.items():
            cell = suite.cell(name)
            if result.cell != name or result.digest != cell.digest:
                raise ValueError(
                    f"{path}: cell {name!r} has digest {result.digest}, here it has {cell.digest}: "
                    "the card was made with another version of the cell, its settings or networks"
                )
            if result.status == DONE and result.traffic_seeds != cell.traffic_seeds:
                raise ValueError(f"{path}: cell {name!r} was run on other seeds than {cell.seeds}")
