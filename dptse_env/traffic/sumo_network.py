"""Networks of corridors for SUMO: one edge per segment, compiled by netconvert.

The networks of the presets come with the package; any other geometry is compiled on demand, which
needs `eclipse-sumo` (extra ``corridors``).

Every edge declares the nominal segment length, and the recording runs with SUMO's internal links
switched off: every vehicle is then on exactly one segment, and all segments are equally long.
"""

import importlib.util
import itertools
import math
import os
import re
import subprocess
import tempfile
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.presets import SHIPPED_CORRIDORS

LANE_WIDTH_M = 3.2
RAMP_ANGLE = math.radians(45.0)  # a flat ramp would stretch the junction over half a segment
NETCONVERT_OPTIONS = (
    "--no-turnarounds",
    "--offset.disable-normalization",
    # Rounded corners would enlarge the junctions, and a limit on turns would slow the ramps down.
    "--default.junctions.radius=0",
    "--junctions.limit-turn-speed=-1",
    "--xml-validation=never",
)


class NetworkError(RuntimeError):
    """A network cannot be compiled: netconvert is missing or refused it."""


class Geometry(NamedTuple):
    """The part of a corridor that its network depends on."""

    n_mainline: int
    on_ramps: tuple[int, ...]
    off_ramps: tuple[int, ...]
    lanes: int
    ramp_lanes: int
    segment_length: float
    speed_limit: float

    @classmethod
    def from_corridor(cls, corridor: Corridor) -> "Geometry":
        """Return the geometry of a corridor."""
        return cls(*(getattr(corridor, field) for field in cls._fields))


def edge_ids(corridor: Corridor) -> tuple[str, ...]:
    """Return the SUMO edge of each record column: the S segments, then the R boundary segments."""
    on_ramps, off_ramps = range(corridor.n_on_ramps), range(corridor.n_off_ramps)
    return (
        *(f"main_{i}" for i in range(corridor.n_mainline)),
        *(f"on_{i}" for i in on_ramps),
        *(f"off_{i}" for i in off_ramps),
        "upstream",
        "downstream",
        *(f"before_on_{i}" for i in on_ramps),
        *(f"after_off_{i}" for i in off_ramps),
    )


def network_xml(corridor: Corridor) -> str:
    """Return the corridor's compiled network: the packaged one, else a fresh compilation.

    Raises:
        NetworkError: The geometry is not that of a preset, and netconvert is missing or fails.
    """
    geometry = Geometry.from_corridor(corridor)
    for preset in SHIPPED_CORRIDORS:
        if Geometry.from_corridor(preset) == geometry:
            return packaged_network(preset.name)
    return compile_network(geometry)


@lru_cache
def packaged_network(name: str) -> str:
    """Read the compiled network of the preset `name` from the package."""
    resource = resources.files("dptse_env.traffic") / "networks" / f"{name}.net.xml"
    return resource.read_text(encoding="utf-8")


@lru_cache
def compile_network(geometry: Geometry) -> str:
    """Compile a network with netconvert.

    Returns:
        The network's XML, without the comment that holds netconvert's time and paths, so that the
        same geometry always gives the same text.

    Raises:
        NetworkError: `eclipse-sumo` is not installed, or netconvert fails.
    """
    command = [str(_netconvert()), *NETCONVERT_OPTIONS]
    with tempfile.TemporaryDirectory(prefix="dptse-network-") as directory:
        folder = Path(directory)
        for option, suffix, text in zip(
            ("-n", "-e", "-x"), ("nod", "edg", "con"), _plain_xml(geometry), strict=True
        ):
            path = folder / f"corridor.{suffix}.xml"
            path.write_text(text, encoding="utf-8")
            command += [option, str(path)]
        output = folder / "corridor.net.xml"
        result = subprocess.run(
            [*command, "-o", str(output)], capture_output=True, text=True, check=False
        )
        if result.returncode != 0:
            raise NetworkError(f"netconvert refused {geometry}:\n{result.stderr.strip()}")
        network = output.read_text(encoding="utf-8")
    return re.sub(r"<!--.*?-->\s*", "", network, flags=re.DOTALL)


def _netconvert() -> Path:
    """Return the path of the netconvert of `eclipse-sumo`; SUMO_HOME is not used."""
    spec = importlib.util.find_spec("sumo")
    if spec is None or spec.origin is None:
        raise NetworkError(
            "a corridor with another geometry is compiled by netconvert, which comes with "
            "eclipse-sumo: pip install 'dptse-env[corridors]'"
        )
    suffix = ".exe" if os.name == "nt" else ""
    return Path(spec.origin).parent / "bin" / f"netconvert{suffix}"


def _plain_xml(geometry: Geometry) -> list[str]:
    """Describe nodes, edges and connections in netconvert's plain XML."""
    nodes, edges, connections = (
        ElementTree.Element(tag) for tag in ("nodes", "edges", "connections")
    )
    length_m = 1000.0 * geometry.segment_length

    def node(name: str, x: float, y: float = 0.0, kind: str = "priority") -> None:
        ElementTree.SubElement(nodes, "node", id=name, x=f"{x:.2f}", y=f"{y:.2f}", type=kind)

    def edge(name: str, start: str, end: str, lanes: int, shape: str | None = None) -> None:
        element = ElementTree.SubElement(
            edges,
            "edge",
            {"id": name, "from": start, "to": end, "numLanes": str(lanes), "spreadType": "center"},
            speed=f"{geometry.speed_limit / 3.6:.4f}",
            length=f"{length_m:.2f}",
        )
        if shape is not None:
            element.set("shape", shape)

    def connect(start: str, end: str, lanes: int) -> None:
        for lane in map(str, range(lanes)):
            attributes = {"from": start, "to": end, "fromLane": lane, "toLane": lane}
            ElementTree.SubElement(connections, "connection", attributes)

    mainline = ["upstream", *(f"main_{i}" for i in range(geometry.n_mainline)), "downstream"]
    for face in range(-1, geometry.n_mainline + 2):
        # Plain priority junctions would starve the ramps; a zipper lets both branches flow.
        kind = "zipper" if face in geometry.on_ramps else "priority"
        node(f"face_{face}", face * length_m, kind=kind)
    for face, name in enumerate(mainline, start=-1):
        edge(name, f"face_{face}", f"face_{face + 1}", geometry.lanes)
    for start, end in itertools.pairwise(mainline):
        connect(start, end, geometry.lanes)

    # Ramps start and end on the axis of the mainline's rightmost lanes, not of its middle.
    axis_y = -0.5 * LANE_WIDTH_M * (geometry.lanes - geometry.ramp_lanes)

    def ramp_point(face: int, n_segments: int) -> tuple[float, float]:
        """Return the point `n_segments` along a ramp: on-ramps count backwards, from the face."""
        along = n_segments * length_m
        return (
            face * length_m + along * math.cos(RAMP_ANGLE),
            axis_y - abs(along) * math.sin(RAMP_ANGLE),
        )

    def shape(face: int, *points: int) -> str:
        return " ".join("{:.2f},{:.2f}".format(*ramp_point(face, point)) for point in points)

    for i, face in enumerate(geometry.on_ramps):
        node(f"on_{i}_entry", *ramp_point(face, -2))
        node(f"on_{i}_start", *ramp_point(face, -1))
        edge(f"before_on_{i}", f"on_{i}_entry", f"on_{i}_start", geometry.ramp_lanes)
        edge(f"on_{i}", f"on_{i}_start", f"face_{face}", geometry.ramp_lanes, shape(face, -1, 0))
        connect(f"before_on_{i}", f"on_{i}", geometry.ramp_lanes)
        connect(f"on_{i}", f"main_{face}", geometry.ramp_lanes)
    for i, face in enumerate(geometry.off_ramps):
        node(f"off_{i}_end", *ramp_point(face, 1))
        node(f"off_{i}_exit", *ramp_point(face, 2))
        edge(f"off_{i}", f"face_{face}", f"off_{i}_end", geometry.ramp_lanes, shape(face, 0, 1))
        edge(f"after_off_{i}", f"off_{i}_end", f"off_{i}_exit", geometry.ramp_lanes)
        connect(f"main_{face - 1}", f"off_{i}", geometry.ramp_lanes)
        connect(f"off_{i}", f"after_off_{i}", geometry.ramp_lanes)
    return [ElementTree.tostring(root, encoding="unicode") for root in (nodes, edges, connections)]
