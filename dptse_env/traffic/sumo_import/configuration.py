"""SUMO's configuration files (``.sumocfg``): which files and options a simulation has."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from dptse_env.traffic.sumo_files import READ_BY
from dptse_env.traffic.sumo_import.net import open_xml, root_of
from dptse_env.traffic.sumo_scenario import FORCED, WRITES

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
            ValueError: There is none, one cannot be read or is empty, or it includes others.
        """
        if not self.routes and not self.additional:
            raise ValueError("routes: must have at least one file, got none")
        for where, paths in (("routes", self.routes), ("additional", self.additional)):
            for path in paths:
                root = root_of(path, where)
                if root.tag in ("net", "configuration", "sumoConfiguration"):
                    raise ValueError(f"{where}: {path} must hold {where}, got <{root.tag}>")
        for path in self.routes:
            if _is_empty(path):
                raise ValueError(f"routes: {path} must have vehicles, got an empty file")
        for where, paths in (("routes", self.routes), ("additional", self.additional)):
            for path in paths:
                _check_references(path, where)

    @property
    def internal_links(self) -> bool:
        """True if vehicles drive on the internal edges of junctions."""
        return not any(
            option in ("--no-internal-links", "--no-internal-links=true", "--no-internal-links=1")
            for option in self.options
        )


def read_configuration(path: Path) -> Files:
    """Return what a configuration file names; names of files are relative to its folder.

    Raises:
        ValueError: It cannot be read, is no configuration, or names no network.
    """
    root = root_of(path, "configuration")
    if "onfiguration" not in root.tag:
        raise ValueError(
            f"configuration: {path} must be a <configuration> of SUMO, got <{root.tag}>"
        )
    with open_xml(path) as file:
        try:
            tree = ElementTree.parse(file)
        except ElementTree.ParseError as error:
            raise ValueError(f"configuration: {path} must be XML: {error}") from error
    values: dict[str, str] = {}
    for element in tree.iter():
        value = element.get("value", element.get("v"))
        if value is not None:
            values[SHORT.get(element.tag, element.tag)] = value

    def paths(name: str) -> tuple[Path, ...]:
        names = re.split(r"[,;]\s*|\s+(?=\S)", values.pop(name, "").strip())
        return tuple(path.parent / each for each in names if each)

    def number(name: str, default: float) -> float:
        text = values.pop(name, None)
        return default if text is None else seconds(text, f"configuration: {path}: {name}")

    net, routes, additional = (
        paths(name) for name in ("net-file", "route-files", "additional-files")
    )
    if len(net) != 1:
        raise ValueError(f"configuration: {path} must name one net-file, got {len(net)}")
    for name, meaning in REFUSED.items():
        if values.get(name, "false") not in ("false", "0", ""):
            raise ValueError(f"configuration: {path}: {name} must be left out: it is {meaning}")
    return Files(
        net=net[0],
        routes=routes,
        additional=additional,
        begin=number("begin", 0.0),
        step_length=number("step-length", 1.0),
        options=_options(values),
    )


def seconds(text: str, where: str) -> float:
    """Return a time of SUMO in seconds: a number, or ``[days:]hours:minutes:seconds``.

    Raises:
        ValueError: It is neither.
    """
    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError as error:
        raise ValueError(f"{where} must be seconds or hh:mm:ss, got {text!r}") from error
    if len(parts) not in (1, 3, 4):
        raise ValueError(f"{where} must be seconds or hh:mm:ss, got {text!r}")
    weights = (1.0,) if len(parts) == 1 else (86400.0, 3600.0, 60.0, 1.0)[-len(parts) :]
    return sum(weight * part for weight, part in zip(weights, parts, strict=True))


def _options(values: dict[str, str]) -> tuple[str, ...]:
    kept = {
        name: value
        for name, value in values.items()
        if name not in FORCED | REFUSED.keys()
        and not WRITES.search(name)
        and not SHOWN.search(name)
    }
    return tuple(f"--{name}={value}" for name, value in kept.items())


def _elements(path: Path, act: Callable[[ElementTree.Element], bool]) -> None:
    """Hand the elements of a file to a function, until it returns True."""
    with open_xml(path) as file:
        try:
            for _, element in ElementTree.iterparse(file, events=("start",)):
                if act(element):
                    return
                element.clear()
        except ElementTree.ParseError as error:
            raise ValueError(f"{path}: must be XML: {error}") from error


def _is_empty(path: Path) -> bool:
    seen = 0

    def count(_: ElementTree.Element) -> bool:
        nonlocal seen
        seen += 1
        return seen > 1

    _elements(path, count)
    return seen <= 1


def _check_references(path: Path, where: str) -> None:
    """Check that a file reads no other file, which no digest would cover."""

    def check(element: ElementTree.Element) -> bool:
        if element.tag in READ_BY and ("file" in element.attrib or "href" in element.attrib):
            raise ValueError(
                f"{where}: {path}: <{element.tag}> must not read another file, got "
                f"{element.get('file', element.get('href'))!r}: put its content in its place"
            )
        return False

    _elements(path, check)
