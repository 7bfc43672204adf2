"""Draw the pictures of the guides: docs/images/road.png, network.png and frame.png.

python docs/_site/guides.py

Both roads come from the files that the guides show; the network needs the extra corridors.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import sumolib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.patches import Rectangle

from agents.figures import COLOURS, INK, WIDTH, add_frame, make_figure, save_figure
from dptse_env.importers.sumo_net import Files, Segmentation, segment_path
from dptse_env.schedules import make_schedule
from dptse_env.traffic import Corridor, read_corridor
from dptse_env.utils.arrays import FloatArray

DOCS = Path(__file__).parents[1]
FILE = re.compile(r'^```\w+ title="([\w.-]+)"\n(.*?)^```', re.DOTALL | re.MULTILINE)
PATH = "west", "east"  # as in the guide
SEGMENT_LENGTH = 150.0  # [m]; as in the guide
MAINLINE, RAMP, BOUNDARY = (COLOURS[0], COLOURS[5]), COLOURS[1], COLOURS[6]


def write_files(guide: str, folder: Path) -> None:
    """Write the files that a guide shows to a folder."""
    for name, text in FILE.findall((DOCS / "guides" / guide).read_text(encoding="utf-8")):
        (folder / name).write_text(text, encoding="utf-8")


def draw_network(net: Path, segments: Segmentation) -> Figure:
    """Draw the lanes of a network in grey, and over them its segments with their numbers."""
    network = sumolib.net.readNet(str(net), withInternal=True)
    figure = make_figure(WIDTH, 2.2)
    axis = figure.subplots()
    for edge in network.getEdges(withInternal=True):
        for lane in edge.getLanes():
            axis.plot(
                *np.array(lane.getShape()).T, color=INK, alpha=0.25, lw=2.5, solid_capstyle="butt"
            )
    n, n_ramps = segments.geometry.n_mainline, segments.geometry.n_ramps
    colours = [MAINLINE[number % 2] for number in range(n)] + [RAMP] * n_ramps
    colours += [BOUNDARY] * (2 + n_ramps)
    for number, (stretches, colour) in enumerate(zip(segments.columns, colours, strict=True)):
        lines = [points_of(network.getEdge(edge), low, high) for edge, low, high in stretches]
        for line in lines:
            axis.plot(*line.T, color=colour, lw=4.0, solid_capstyle="butt")
        if number < n + n_ramps:
            add_number(axis, np.concatenate(lines), str(number), above=number < n)
    handles = [
        axis.plot([], [], color=colour, lw=4.0, label=label)[0]
        for colour, label in (
            (MAINLINE[0], "segments of the mainline"), (RAMP, "segments of ramps"),
            (BOUNDARY, "boundary segments"),
        )
    ]  # fmt: skip
    axis.legend(handles=handles, loc="upper left", frameon=False, fontsize=8)
    axis.annotate(
        "", (0.95, 0.22), (0.8, 0.16), xycoords="axes fraction", textcoords="axes fraction",
        arrowprops={"arrowstyle": "->", "color": INK},
    )  # fmt: skip
    axis.annotate("traffic", (0.87, 0.08), xycoords="axes fraction", ha="center", fontsize=9)
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]", fontsize=9)
    axis.set_ylabel("y [m]", fontsize=9)
    axis.tick_params(labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def points_of(edge: sumolib.net.edge.Edge, start: float, end: float) -> FloatArray:
    """Return the points of an edge between two positions [m] on its longest lane, shape (n, 2)."""
    shape = np.array(edge.getShape(), dtype=np.float64)[:, :2]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(shape, axis=0).T))])
    length = max(lane.getLength() for lane in edge.getLanes())
    low, high = (min(place / length, 1.0) * way[-1] for place in (start, end))
    places = np.concatenate([[low], way[(way > low) & (way < high)], [high]])
    return np.column_stack([np.interp(places, way, axis) for axis in shape.T])


def add_number(axis: Axes, line: FloatArray, number: str, above: bool) -> None:
    """Write the number of a segment above its middle, or below."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    x, y = (float(np.interp(way[-1] / 2.0, way, part)) for part in line.T)
    axis.annotate(
        number, (x, y), xytext=(0, 9 if above else -10), textcoords="offset points",
        ha="center", va="center", fontsize=9,
    )  # fmt: skip


def draw_road(corridor: Corridor) -> Figure:
    """Draw segments to scale along the road, lanes across it, ramps beside it, and sensors."""
    n, lengths = corridor.geometry.n_mainline, np.array(corridor.geometry.segment_lengths)
    starts = np.concatenate([[0.0], np.cumsum(lengths[:n])])
    figure = make_figure(WIDTH, 2.4)
    axis = figure.subplots()
    most = corridor.geometry.most_lanes

    def box(segment: int, left: float, bottom: float, colour: str) -> None:
        width, lanes = float(lengths[segment]), corridor.geometry.segment_lanes[segment]
        axis.add_patch(Rectangle((left, bottom), width, lanes, fc=(colour, 0.3), ec=INK))
        middle = (left + width / 2, bottom + lanes / 2)
        axis.annotate(f"{segment}", middle, ha="center", va="center", fontsize=7)
        if segment in corridor.fixed_sensors:
            axis.plot(left + width / 2, bottom + lanes - 0.25, "v", color=COLOURS[1], markersize=5)

    for segment in range(n):
        box(segment, float(starts[segment]), 0.0, COLOURS[0])
    groups = [(*corridor.geometry.on_ramps, *corridor.geometry.off_ramps)]
    ramps = (*corridor.geometry.on_ramp_segments, *corridor.geometry.off_ramp_segments)
    for face, segments in zip(*groups, ramps, strict=True):
        joins = segments[0] in {s for each in corridor.geometry.on_ramp_segments for s in each}
        left = float(starts[face])
        if joins:
            left -= float(lengths[list(segments)].sum())
        for segment in segments:
            box(segment, left, -1.6 - corridor.geometry.segment_lanes[segment], COLOURS[1])
            left += float(lengths[segment])
        place = float(starts[face])
        ends = ((place, -0.05), (place, -1.5)) if joins else ((place, -1.5), (place, -0.05))
        axis.annotate("", *ends, arrowprops={"arrowstyle": "->", "color": INK})
    limits = corridor.geometry.speed_limits[:n]
    for segment in range(n):
        if segment == 0 or limits[segment] != limits[segment - 1]:
            at = (float(starts[segment]), most + 0.3)
            axis.annotate(f"{limits[segment]:g} km/h", at, fontsize=7)
    axis.set_xlim(-0.02 * starts[-1], 1.02 * starts[-1])
    axis.set_ylim(-4.2 if corridor.geometry.n_ramps else -0.6, most + 1.2)
    axis.set_yticks([])
    axis.set_xlabel("road [km]; traffic goes right, triangles are fixed sensors", fontsize=8)
    add_frame(axis, "x")
    axis.spines["left"].set_visible(False)
    return figure


def draw_frame(path: Path, seconds: int = 420) -> None:
    """Save what an environment renders when some seconds of an episode are over."""
    keywords = {"estimator": "ekf", "bandwidth": 5, "render_mode": "rgb_array"}
    env = gym.make("dptse_env:dptse/PrivateHighway-v1", **keywords)
    schedule, state = make_schedule("speed-front", env), None
    observation, _ = env.reset(seed=0, options={"traffic_seed": 0})
    for _ in range(seconds):
        action, state = schedule.predict(observation, state)
        observation, *_ = env.step(action)
    imsave(path, np.asarray(env.render()))


def draw_guides() -> None:
    """Draw all of them."""
    images = DOCS / "images"
    draw_frame(images / "frame.png")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files("your-road.md", folder)
        road = draw_road(read_corridor(folder / "my-road.toml"))
        save_figure(road, images / "road.png", "")
        write_files("your-network.md", folder)
        words = "--node-files town.nod.xml --edge-files town.edg.xml --output-file town.net.xml"
        command = [str(Path(sys.executable).with_name("netconvert")), *words.split()]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        files = Files(folder / "town.net.xml", (folder / "town.rou.xml",))
        segments = segment_path(files, PATH, SEGMENT_LENGTH, between=True)
        save_figure(draw_network(files.net, segments), images / "network.png", "")


if __name__ == "__main__":
    draw_guides()
