"""SUMO files of one's own: what a road is recorded from in place of a generated network."""

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Annotated

from dptse_env.utils.fields import Interval, checked_fields, require
from dptse_env.utils.files import file_digest

Position = Annotated[float, Interval(0, 1e6)]
"""Place on an edge, from its start [m]."""
Stretch = tuple[str, Position, Position]
"""Part of an edge: its id, and the positions at which the part begins and ends [m]."""
StepLength = Annotated[float, Interval(0.01, 1.0)]
"""Time step of SUMO [s]."""
Clock = Annotated[int, Interval(0, 10_000_000)]
"""Whole seconds of SUMO's clock."""

FORCED = frozenset([
    "n", "r", "a", "c", "b", "e", "S", "net-file", "route-files", "additional-files",
    "configuration-file", "begin", "end", "seed", "random", "scale", "step-length", "no-step-log",
    "duration-log.disable", "no-warnings", "xml-validation", "xml-validation.net",
    "xml-validation.routes",
])  # fmt: skip
"""Options of SUMO that a recording sets itself."""

WRITES = re.compile(
    r"output|statistic|(^|[.-])log([.-]|$)|^save-state|^(summary|tripinfo|vehroutes?|netstate|ndump)$"
)
"""Options of SUMO that write files, which a recording does not."""

TOLERANCE = 0.01
"""Precision of lengths in network files [m]."""


class ChangedFilesError(ValueError):
    """A file that a road is recorded from is missing, or is not the one that was imported."""


@dataclass(frozen=True)
class SumoScenario:
    """SUMO's files for a road, and the places on their edges that a record counts.

    Attributes:
        net: network file.
        routes: route files, in SUMO's order.
        columns: for each record column (the S segments, then the R boundary segments) the stretches
            of edges that belong to it. A vehicle counts where its front bumper is.
        sha256: SHA-256 (hex) of each file: the network, the route files, the additional files.
        folder: folder of the files; in a road file it may be relative to that file. Their names are
            relative to it.
        additional: additional files, in SUMO's order. What they would write is not written.
        begin: second of SUMO's clock at which a record starts.
        warm_up: seconds simulated before that, which are not recorded.
        step_length: SUMO's time step [s]; it divides a second.
        options: further options of SUMO, ``--name=value`` each.

    Raises:
        ValueError: Stretches are empty or overlap, or an option is one that a recording sets.
    """

    net: str
    routes: tuple[str, ...]
    columns: tuple[tuple[Stretch, ...], ...]
    sha256: tuple[str, ...]
    folder: str
    additional: tuple[str, ...] = ()
    begin: Clock = 0
    warm_up: Clock = 0
    step_length: StepLength = 1.0
    options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        checked_fields(self, "network")
        n_files, n_sums = len(self.files), len(self.sha256)
        require(n_sums == n_files, "network.sha256", f"one for each of {n_files} files", n_sums)
        allowed = f"at most begin = {self.begin} s"
        require(self.warm_up <= self.begin, "network.warm_up", allowed, self.warm_up)
        steps = 1.0 / self.step_length
        allowed = "a whole part of a second"
        require(abs(steps - round(steps)) < 1e-9, "network.step_length", allowed, self.step_length)
        self._check_options()
        self._check_columns()

    def _check_options(self) -> None:
        for option in self.options:
            match = re.fullmatch(r"--([a-z][\w.-]*)(=.*)?", option)
            require(match is not None, "network.options", "--name=value each", option)
            assert match is not None
            free = match[1] not in FORCED and not WRITES.search(match[1])
            require(free, "network.options", "free of outputs and of what a recording sets", option)

    def _check_columns(self) -> None:
        taken: dict[str, list[tuple[float, float]]] = {}
        for i, stretches in enumerate(self.columns):
            path = f"network.columns[{i}]"
            require(bool(stretches), path, "at least one stretch of an edge", stretches)
            for edge, start, end in stretches:
                require(start < end, path, "stretches that end after they start", (start, end))
                taken.setdefault(edge, []).append((start, end))
        for edge, parts in taken.items():
            parts.sort()
            for (_, end), (start, _) in pairwise(parts):
                apart = end <= start + TOLERANCE
                require(apart, "network.columns", f"without overlap on edge {edge!r}", (start, end))

    @property
    def files(self) -> tuple[str, ...]:
        """Names of all files: the network, the route files, the additional files."""
        return (self.net, *self.routes, *self.additional)

    @property
    def substeps(self) -> int:
        """Number of SUMO's steps in a second."""
        return round(1.0 / self.step_length)

    @property
    def traffic(self) -> dict[str, object]:
        """Description of what determines the traffic: contents of files, not their names."""
        n_routes = len(self.routes)
        return {
            "net": self.sha256[0],
            "routes": self.sha256[1 : 1 + n_routes],
            "additional": self.sha256[1 + n_routes :],
            "begin": self.begin,
            "warm_up": self.warm_up,
            "step_length": self.step_length,
            "options": self.options,
            "columns": self.columns,
        }

    def path(self, name: str) -> Path:
        """Return the path of a file."""
        return Path(self.folder) / name

    def check_files(self) -> None:
        """Compare the files with those that were imported.

        Raises:
            ChangedFilesError: A file cannot be read, or its content is another.
        """
        for name, expected in zip(self.files, self.sha256, strict=True):
            path = self.path(name)
            try:
                found = file_digest(path)
            except OSError as error:
                raise ChangedFilesError(f"{path}: cannot be read: {error.strerror}") from error
            if found != expected:
                raise ChangedFilesError(
                    f"{path}: is not the file that the road was made from (its SHA-256 is {found}, "
                    f"not {expected}); import the road again"
                )


class Places:
    """Places of the record columns on the edges of a network.

    Args:
        columns: as in `SumoScenario`.
    """

    def __init__(self, columns: tuple[tuple[Stretch, ...], ...]) -> None:
        """Sort the stretches by edge."""
        parts: dict[str, list[tuple[float, float, int]]] = {}
        for column, stretches in enumerate(columns):
            for edge, start, end in stretches:
                parts.setdefault(edge, []).append((start, end, column))
        self._parts = {edge: sorted(of_edge) for edge, of_edge in parts.items()}

    def __iter__(self) -> Iterator[str]:
        """Iterate over the edges, by the first column that each is a part of."""
        return iter(self._parts)

    def find(self, edge: str, position: float) -> int | None:
        """Return the column of a position [m] on an edge; None where nothing is recorded."""
        parts = self._parts[edge]
        index = bisect_right(parts, position + TOLERANCE, key=itemgetter(0)) - 1
        if index < 0 or position > parts[index][1] + TOLERANCE:
            return None
        return parts[index][2]
