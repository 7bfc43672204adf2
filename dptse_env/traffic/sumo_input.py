"""SUMO's input for a corridor: a net with one edge for each segment, and vehicles with routes.

The nets of the package's corridors come with it. netconvert compiles any other geometry on demand,
which needs `eclipse-sumo` (extra ``corridors``). ``nets/NAME.net.xml`` is
``compile_net(CORRIDORS[NAME].geometry)``.

Every edge declares the nominal length of its segment, and the recording runs with SUMO's internal
links switched off: every vehicle is then on exactly one segment.
"""

import importlib.util
import itertools
import math
import os
import re
import subprocess
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path

from dptse_env.geometry import Geometry
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.roads import SHIPPED_CORRIDORS
from dptse_env.traffic.scenario import MAINLINE, Scenario
from dptse_env.utils.registry import missing_extra
from dptse_env.utils.units import KMH
from dptse_env.versions import installed, sumo_version

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

LONGEST_OUTPUT = 2000
"""Characters of SUMO's messages that an error has at most."""

Point = tuple[float, float]
"""Coordinates [m]."""


class NetconvertError(RuntimeError):
    """netconvert cannot compile the net of a road; the message says why."""


def edge_ids(geometry: Geometry) -> tuple[str, ...]:
    """Return the SUMO edge of each record column: the S segments, then the R boundary segments."""
    on_ramps, off_ramps = geometry.on_ramp_segments, geometry.off_ramp_segments
    return (
        *(f"main_{i}" for i in range(geometry.n_mainline)),
        *(edge for i, ramp in enumerate(on_ramps) for edge in ramp_edges(f"on_{i}", ramp)),
        *(edge for i, ramp in enumerate(off_ramps) for edge in ramp_edges(f"off_{i}", ramp)),
        "upstream",
        "downstream",
        *(f"before_on_{i}" for i in range(len(on_ramps))),
        *(f"after_off_{i}" for i in range(len(off_ramps))),
    )


def ramp_edges(name: str, segments: Sequence[int]) -> tuple[str, ...]:
    """Return the SUMO edges of a ramp's segments, in the direction of travel."""
    several = len(segments) > 1
    return tuple(f"{name}_{k}" for k in range(len(segments))) if several else (name,)


def net_xml(geometry: Geometry) -> str:
    """Return the compiled net of a road: the packaged one, else a fresh compilation.

    Raises:
        MissingExtraError: The geometry is not that of a preset, and netconvert is missing.
        NetconvertError: netconvert fails.
    """
    described = _plain_xml(geometry)
    for preset in SHIPPED_CORRIDORS:
        if _plain_xml(preset.geometry) == described:
            return packaged_net(preset.name)
    return compile_net(geometry)


@lru_cache
def packaged_net(name: str) -> str:
    """Read the compiled net of the preset `name` from the package."""
    resource = resources.files("dptse_env.traffic") / "nets" / f"{name}.net.xml"
    return resource.read_text(encoding="utf-8")


@lru_cache
def compile_net(geometry: Geometry) -> str:
    """Compile a net with netconvert.

    Returns:
        The XML of the net, without the comment that holds netconvert's time and paths, so that the
        same geometry always gives the same text.

    Raises:
        MissingExtraError: `eclipse-sumo` is not installed.
        NetconvertError: It is of another version than libsumo, or netconvert fails.
        SumoVersionError: libsumo is missing or too old.
    """
    command = [str(_netconvert()), *NETCONVERT_OPTIONS]
    with tempfile.TemporaryDirectory(prefix="dptse-net-") as directory:
        folder = Path(directory)
        for option, suffix, text in zip(
            ("-n", "-e", "-x"), ("nod", "edg", "con"), _plain_xml(geometry), strict=True
        ):
            path = folder / f"corridor.{suffix}.xml"
            path.write_text(text, encoding="utf-8")
            command += [option, path.name]
        output = folder / "corridor.net.xml"
        result = subprocess.run(
            [*command, "-o", output.name], cwd=folder, capture_output=True, text=True, check=False
        )
        if result.returncode != 0:
            said = result.stderr.strip()[:LONGEST_OUTPUT]
            raise NetconvertError(f"netconvert refused {str(geometry)[:LONGEST_OUTPUT]}:\n{said}")
        net = output.read_text(encoding="utf-8")
    return re.sub(r"<!--.*?-->\s*", "", net, flags=re.DOTALL)


def _netconvert() -> Path:
    """Return the path of the netconvert of `eclipse-sumo`; SUMO_HOME is not used.

    A record is known by the version of libsumo alone, so netconvert has to be of the same.
    """
    spec = importlib.util.find_spec("sumo")
    if spec is None or spec.origin is None:
        raise missing_extra("sumo", "a road of your own, which netconvert compiles,")
    found, wanted = installed("eclipse-sumo"), sumo_version()
    if found != wanted:
        raise NetconvertError(
            f"eclipse-sumo must be of the version of libsumo, {wanted}, found {found}: "
            f"pip install 'eclipse-sumo=={wanted}'"
        )
    suffix = ".exe" if os.name == "nt" else ""
    return Path(spec.origin).parent / "bin" / f"netconvert{suffix}"


def _plain_xml(geometry: Geometry) -> list[str]:
    """Describe nodes, edges and connections in netconvert's plain XML."""
    xml, n = _PlainXML(geometry), geometry.n_mainline
    lanes, lengths = geometry.segment_lanes, xml.lengths_m
    cells = [0, *range(n), n - 1]
    names = ["upstream", *(f"main_{i}" for i in range(n)), "downstream"]
    x = [-lengths[0], *itertools.accumulate((lengths[cell] for cell in cells[1:]), initial=0.0)]
    xml.edges(names, cells, [f"face_{face}" for face in range(-1, n + 2)], [(at, 0.0) for at in x])
    xml.connect(names, [min(lanes[a], lanes[b]) for a, b in itertools.pairwise(cells)])
    # Ramps are laid out from their face, on-ramps backwards.
    on_ramps = zip(geometry.on_ramps, geometry.on_ramp_segments, strict=True)
    for i, (face, ramp) in enumerate(on_ramps):
        own, cells = ramp_edges(f"on_{i}", ramp), [ramp[0], *ramp]
        names, node = [f"before_on_{i}", *own], f"face_{face}"
        nodes = [f"on_{i}_entry", *(f"{edge}_start" for edge in own), node]
        along = [-sum(lengths[cell] for cell in cells[k:]) for k in range(len(nodes))]
        points = [xml.ramp_point(face, x[face + 1], ramp[0], distance) for distance in along]
        xml.edges(names, cells, nodes, points, node)
        xml.connect([*names, f"main_{face}"], [lanes[ramp[0]]] * len(names))
    off_ramps = zip(geometry.off_ramps, geometry.off_ramp_segments, strict=True)
    for i, (face, ramp) in enumerate(off_ramps):
        own, cells = ramp_edges(f"off_{i}", ramp), [*ramp, ramp[-1]]
        names, node = [*own, f"after_off_{i}"], f"face_{face}"
        nodes = [node, *(f"{edge}_end" for edge in own), f"off_{i}_exit"]
        along = [sum(lengths[cell] for cell in cells[:k]) for k in range(len(nodes))]
        points = [xml.ramp_point(face - 1, x[face + 1], ramp[0], distance) for distance in along]
        xml.edges(names, cells, nodes, points, node)
        xml.connect([f"main_{face - 1}", *names], [lanes[ramp[0]]] * len(names))
    return xml.texts()


class _PlainXML:
    """Nodes, edges and connections of a net, as netconvert reads them."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self.lengths_m = [1000.0 * length for length in geometry.segment_lengths]
        self._content: dict[str, list[str]] = {"nodes": [], "edges": [], "connections": []}

    def edges(
        self,
        names: Sequence[str],
        cells: Sequence[int],
        nodes: Sequence[str],
        points: Sequence[Point],
        face: str = "",
    ) -> None:
        """Add edges in a row, with length, lanes and limit of segments, and their nodes.

        Args:
            names: Names of the edges.
            cells: Their segments.
            nodes: Names of the nodes, one more.
            points: Where these are [m].
            face: A node of the mainline, which is there; the edge at it is drawn to its own point.
        """
        geometry = self.geometry
        # Plain priority junctions would starve the ramps; a zipper lets both branches flow.
        zippers = {f"face_{face}" for face in geometry.on_ramps}
        for name, (x, y) in zip(nodes, points, strict=True):
            kind = "zipper" if name in zippers else "priority"
            if name != face:
                node = f'<node id="{name}" x="{x:.2f}" y="{y:.2f}" type="{kind}"/>'
                self._content["nodes"].append(node)
        for k, (name, cell) in enumerate(zip(names, cells, strict=True)):
            shape = " ".join("{:.2f},{:.2f}".format(*point) for point in points[k : k + 2])
            self._content["edges"].append(
                f'<edge id="{name}" from="{nodes[k]}" to="{nodes[k + 1]}" spreadType="center" '
                f'numLanes="{geometry.segment_lanes[cell]}" length="{self.lengths_m[cell]:.2f}" '
                f'speed="{geometry.speed_limits[cell] / KMH:.4f}"'
                + (f' shape="{shape}"/>' if face in nodes[k : k + 2] else "/>")
            )

    def connect(self, edges: Sequence[str], counts: Sequence[int]) -> None:
        """Connect the rightmost lanes of each edge, so many of them, with those of the next."""
        for (start, end), count in zip(itertools.pairwise(edges), counts, strict=True):
            self._content["connections"] += (
                f'<connection from="{start}" to="{end}" fromLane="{lane}" toLane="{lane}"/>'
                for lane in range(count)
            )

    def ramp_point(self, beside: int, x: float, ramp: int, along: float) -> Point:
        """Return the point at a distance along a ramp [m] from the face at x [m].

        Ramps start and end on the axis of the mainline's rightmost lanes, not of its middle;
        `beside` is the mainline segment that the ramp joins or leaves.
        """
        lanes = self.geometry.segment_lanes
        axis_y = -0.5 * LANE_WIDTH_M * (lanes[beside] - lanes[ramp])
        return x + along * math.cos(RAMP_ANGLE), axis_y - abs(along) * math.sin(RAMP_ANGLE)

    def texts(self) -> list[str]:
        """Return the three files."""
        return [f"<{tag}>{''.join(lines)}</{tag}>" for tag, lines in self._content.items()]


def routes_xml(corridor: Corridor, scenario: Scenario) -> str:
    """Return SUMO's route file of a scenario, on the net that is made for its corridor."""
    road, drivers = corridor.geometry, corridor.conditions.drivers
    classes = {
        each.name: each.attributes(drivers) for each in corridor.conditions.vehicle_classes
    } or {"car": drivers.attributes()}
    lines = []
    for name, attributes in classes.items():
        values = " ".join(f'{key}="{value}"' for key, value in attributes.items())
        lines.append(f'<vType id="{name}" {values}/>')
    for origin in range(MAINLINE, len(road.on_ramps)):
        for end in range(MAINLINE, len(road.off_ramps)):
            first = 0 if origin == MAINLINE else road.on_ramps[origin]
            last = road.n_mainline if end == MAINLINE else road.off_ramps[end]
            if first >= last:
                continue
            entry, leave = _entry_edges(road, origin), _exit_edges(road, end)
            edges = " ".join([*entry, *(f"main_{i}" for i in range(first, last)), *leave])
            lines.append(f'<route id="{origin}:{end}" edges="{edges}"/>')
    # As fast as is safe, on the lane that suits the route, and by default at the start of the
    # boundary segment, so that it is measured there. About 4,700 veh/h can then enter the paper's
    # mainline; others queue outside. With `departPos="last"` 9 % more can enter, but vehicles start
    # at the far end of an empty boundary segment.
    how, names = 'departSpeed="max" departLane="best"', list(classes)
    columns = scenario.departures, scenario.origins, scenario.exits, scenario.classes
    for vehicle, (departure, origin, end, kind) in enumerate(zip(*columns, strict=True)):
        lines.append(
            f'<vehicle id="{vehicle}" type="{names[kind]}" route="{origin}:{end}" '
            f'depart="{departure:.3f}" {how}/>'
        )
    return f"<routes>{''.join(lines)}</routes>"


def _entry_edges(geometry: Geometry, origin: int) -> list[str]:
    if origin == MAINLINE:
        return ["upstream"]
    name = f"on_{origin}"
    return [f"before_{name}", *ramp_edges(name, geometry.on_ramp_segments[origin])]


def _exit_edges(geometry: Geometry, end: int) -> list[str]:
    if end == MAINLINE:
        return ["downstream"]
    name = f"off_{end}"
    return [*ramp_edges(name, geometry.off_ramp_segments[end]), f"after_{name}"]
