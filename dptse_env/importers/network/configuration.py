"""SUMO's configuration files (``.sumocfg``): which files and options a simulation has."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from dptse_env.importers.network.net import UNREADABLE, open_xml, root_of
from dptse_env.traffic.own_sumo import FORCED, READ_BY, WRITES
from dptse_env.utils.fields import shown

SHORT = {
    "n": "net-file", "net": "net-file",
    "r": "route-files", "routes": "route-files",
    "a": "additional-files", "additional": "additional-files",
    "b": "begin", "e": "end",
}  # fmt: skip
"""Other names of options."""

REFUSED = {
    "mesosim": "the mesoscopic model, which gives vehicles no positions",
    "load-state": "a saved state, which a digest does not cover",
    "weight-files": "travel times of edges, which a digest does not cover",
}
"""Options that cannot be kept, and what they stand for."""

SHOWN = re.compile(
    r"^(verbose|v|p|help|version|print-options|aggregate-warnings|step-log\..*|xml-validation.*"
    r"|gui.*|window.*|delay|start|quit-on-end|breakpoints|game.*|registry.*"
    r"|remote-port|num-clients|threads)$"
)
"""Options about what is shown, which are left out."""


@dataclass(frozen=True)
class Files:
    """Files and options of a simulation.

    Attributes:
        net: network file.
        routes: route files.
        additional: additional files.
        begin: second of SUMO's clock at which it begins.
        step_length: SUMO's time step [s].
        options: other options, ``--name=value`` each.
    """

    net: Path
    routes: tuple[Path, ...]
    additional: tuple[Path, ...] = ()
    begin: float = 0.0
    step_length: float = 1.0
    options: tuple[str, ...] = ()

    def check(self) -> None:
        """Check that route files and additional files are XML of their kinds.

        Raises:
            ValueError: There is none, one cannot be read or is empty, or it reads another file,
                which no digest would cover.
        """
        if not self.routes and not self.additional:
            raise ValueError(f"routes: must have at least one file for {self.net}, got none")
        for path in self.routes:
            if _n_elements(path, "routes") <= 1:
                raise ValueError(f"routes: {path} must have vehicles, got an empty file")
        for path in self.additional:
            _n_elements(path, "additional")

    @property
    def internal_links(self) -> bool:
        """True if vehicles drive on the internal edges of junctions."""
        off = {f"--no-internal-links{value}" for value in ("", "=true", "=1")}
        return off.isdisjoint(self.options)


def read_configuration(path: Path) -> Files:
    """Return what a configuration file names; names of files are relative to its folder.

    Raises:
        ValueError: It cannot be read, is no configuration, or names no network.
    """
    where = f"configuration: {path}"
    root = root_of(path, "configuration")
    if "onfiguration" not in root.tag:
        raise ValueError(f"{where} must be a <configuration> of SUMO, got <{root.tag:.60}>")
    values: dict[str, str] = {}
    for element in _elements(path, "configuration"):
        value = element.get("value", element.get("v"))
        if value is not None:
            values[SHORT.get(element.tag, element.tag)] = value
    for name, meaning in REFUSED.items():
        if values.pop(name, "") not in ("false", "0", ""):
            raise ValueError(f"{where}: {name} must be left out: it is {meaning}")

    def paths(name: str) -> tuple[Path, ...]:
        names = re.split(r"[,;]\s*|\s+(?=\S)", values.pop(name, "").strip())
        return tuple(path.parent / each for each in names if each)

    files = {name: paths(name) for name in ("net-file", "route-files", "additional-files")}
    if len(files["net-file"]) != 1:
        raise ValueError(f"{where} must name one net-file, got {len(files['net-file'])}")
    return Files(
        net=files["net-file"][0],
        routes=files["route-files"],
        additional=files["additional-files"],
        begin=_seconds(values.pop("begin", "0"), f"{where}: begin"),
        step_length=_seconds(values.pop("step-length", "1"), f"{where}: step-length"),
        options=tuple(f"--{name}={value}" for name, value in values.items() if _is_kept(name)),
    )


def _seconds(text: str, where: str) -> float:
    """Return a time of SUMO in seconds: a number, or ``[days:]hours:minutes:seconds``."""
    try:
        *clock, rest = (float(part) for part in text.split(":"))
        weights = {0: (), 2: (3600.0, 60.0), 3: (86400.0, 3600.0, 60.0)}[len(clock)]
    except (ValueError, KeyError) as error:
        raise ValueError(f"{where} must be seconds or hh:mm:ss, got {shown(text)}") from error
    return sum(weight * part for weight, part in zip(weights, clock, strict=True)) + rest


def _is_kept(option: str) -> bool:
    """Return whether an option is about the traffic, and no recording sets it."""
    return not (option in FORCED or WRITES.search(option) or SHOWN.search(option))


def _n_elements(path: Path, where: str) -> int:
    """Count the elements of a file of routes or additional elements; check what they are."""
    root = root_of(path, where)
    if root.tag in ("net", "configuration", "sumoConfiguration"):
        raise ValueError(f"{where}: {path} must hold {where}, got <{root.tag}>")
    count = 0
    for element in _elements(path, where):
        count += 1
        read = element.get("file", element.get("href"))
        if element.tag in READ_BY and read is not None:
            raise ValueError(
                f"{where}: {path}: <{element.tag}> must not read another file, got "
                f"{shown(read)}: put its content in its place"
            )
        element.clear()  # route files may be large
    return count


def _elements(path: Path, where: str) -> Iterator[ElementTree.Element]:
    """Yield the elements of a file, each as it begins."""
    try:
        with open_xml(path) as file:
            for _, element in ElementTree.iterparse(file, events=("start",)):
                yield element
    except UNREADABLE as error:
        raise ValueError(f"{where}: {path} must be XML: {error!s:.200}") from error
