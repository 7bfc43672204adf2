"""SUMO's configuration files (``.sumocfg``): the files and options of a simulation."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from dptse_env.importers.sumo_net.net import root_of
from dptse_env.traffic.own_sumo import TRAFFIC, UNREADABLE, clock, copy_input
from dptse_env.utils.files import open_unzipped
from dptse_env.utils.validation import shown, within

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
    "device.fcd-replay.files": "positions of vehicles, which a digest does not cover",
}
"""Options that cannot be kept, and their meaning."""


@dataclass(frozen=True)
class Files:
    """Files and options of a simulation.

    Attributes:
        net: net file.
        routes: route files.
        additional: additional files.
        begin: second of SUMO's clock at which it begins.
        step_length: SUMO's time step [s].
        options: other options that change the traffic, ``--name=value`` each.
        left_out: names of the options that a configuration has and a recording does not take.
    """

    net: Path
    routes: tuple[Path, ...]
    additional: tuple[Path, ...] = ()
    begin: float = 0.0
    step_length: float = 1.0
    options: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def check(self, begin: float) -> tuple[str, ...]:
        """Check that route files and additional files are XML of their kinds.

        Args:
            begin: second of SUMO's clock at which it begins.

        Returns:
            Sentences for people on what a recording leaves out or changes.

        Raises:
            ValueError: There is none, one cannot be read or is empty, or it reads another file,
                which no digest would cover.
        """
        if not self.routes and not self.additional:
            raise ValueError(f"routes: must have at least one file for {self.net}, got none")
        remarks = [f"options that are not taken: {', '.join(self.left_out)}"] * bool(self.left_out)
        kinds = {"net": (self.net,), "routes": self.routes, "additional": self.additional}
        for where, path in ((where, path) for where, paths in kinds.items() for path in paths):
            root = root_of(path, where)
            if where != "net" and root.tag in ("net", "configuration", "sumoConfiguration"):
                raise ValueError(f"{where}: {path} must hold {where}, got <{root.tag}>")
            with (
                within(f"{where}: "),
                tempfile.TemporaryDirectory(prefix="dptse-import-") as folder,
            ):
                copied = copy_input(path, Path(folder) / "copy.xml", begin)
            if where == "routes" and not copied.n_elements:
                raise ValueError(f"routes: {path} must have vehicles, got an empty file")
            if not copied.is_sorted:
                remarks.append(
                    f"{path.name}: out of order of departure, where SUMO alone starts vehicles "
                    "late or not at all; they are sorted"
                )
            if copied.outputs:
                said = ", ".join(f"{n} of {name}" for name, n in copied.outputs.items())
                remarks.append(f"{path.name}: outputs that are not written: {said}")
        return tuple(remarks)

    @property
    def internal_links(self) -> bool:
        """True if vehicles drive on the internal edges of junctions."""
        off = {f"--no-internal-links{value}" for value in ("", "=true", "=1")}
        return off.isdisjoint(self.options)


def read_configuration(path: Path) -> Files:
    """Return what a configuration file names; names of files are relative to its folder.

    Raises:
        ValueError: It cannot be read, is no configuration, or names no net.
    """
    where = f"configuration: {path}"
    root = root_of(path, "configuration")
    if "onfiguration" not in root.tag:
        raise ValueError(f"{where} must be a <configuration> of SUMO, got <{root.tag:.60}>")
    try:
        with open_unzipped(path) as file:
            elements = list(ElementTree.parse(file).iter())
    except UNREADABLE as error:
        raise ValueError(f"{where} must be XML: {error!s:.200}") from error
    values: dict[str, str] = {}
    for element in elements:
        value = element.get("value", element.get("v"))
        if value is not None:
            values[SHORT.get(element.tag, element.tag)] = value
    for name, meaning in REFUSED.items():
        if values.pop(name, "") not in ("false", "0", ""):
            raise ValueError(f"{where}: {name} must be left out: it is {meaning}")

    def paths(name: str) -> tuple[Path, ...]:
        names = map(str.strip, values.pop(name, "").split(","))  # as SUMO does
        return tuple(path.parent / each for each in names if each)

    files = {name: paths(name) for name in ("net-file", "route-files", "additional-files")}
    if len(files["net-file"]) != 1:
        raise ValueError(f"{where} must name one net-file, got {len(files['net-file'])}")
    begin, step_length = (
        _seconds(values.pop(name, default), f"{where}: {name}")
        for name, default in (("begin", "0"), ("step-length", "1"))
    )
    kept = {name: value for name, value in values.items() if TRAFFIC.fullmatch(name)}
    return Files(
        net=files["net-file"][0],
        routes=files["route-files"],
        additional=files["additional-files"],
        begin=begin,
        step_length=step_length,
        options=tuple(f"--{name}={value}" for name, value in kept.items()),
        left_out=tuple(name for name in values if name not in kept),
    )


def _seconds(text: str, where: str) -> float:
    try:
        return clock(text)
    except ValueError as error:
        raise ValueError(f"{where} must be seconds or hh:mm:ss, got {shown(text)}") from error
