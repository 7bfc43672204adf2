"""Draw an episode as a moving picture, and one second of it: docs/images/episode.webp and .png.

A rule queries two of fifteen segments a second, under ``paced``. An incident stops the traffic on
one of them. Below are the errors of the rule and of the paper's schedule, with the same estimator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from PIL import Image

from agents.environments import make_config
from agents.figures import COLOURS, INK, add_frame, turn_grey
from agents.page import watch
from agents.play import Cell
from dptse_env.rendering import History
from dptse_env.traffic.scenario import draw_scenario
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.files import replacing

CELL = Cell(
    "dptse_env:dptse/PrivateHighway-v1",
    "expected-reduction",
    {"bandwidth": 2, "estimator": "recurrent"},
)
BASELINE = "shift-ahead"
SEED, STILL = 2009, 284
SECONDS = range(120, 500, 4)
FRAME = 110  # milliseconds
SHADES = "YlOrRd"  # pale is empty, dark red a jam
NOW, EARLIER, IDLE = COLOURS[0], (COLOURS[0], 0.4), (INK, 0.2)  # when a segment was queried
TRUTH, QUERIES, ESTIMATE = 2.2, 1.25, 0.0  # heights of the strips
STRIPS = {
    TRUTH: ("traffic", "as it is"),
    QUERIES: ("queries", "two a second"),
    ESTIMATE: ("estimate", "noisy sums"),
}
LINES = {"paper's schedule": (COLOURS[1], 1.5), "this rule": (COLOURS[0], 2.0)}
LARGEST = 200.0  # density at the end of the colours [veh/km]
MEMORY = 20  # seconds over which errors are averaged
LEFT, RIGHT = 0.19, 0.865  # of the road and the curve, as shares of the width


@dataclass(frozen=True)
class Scene:
    """An episode and its incident.

    Attributes:
        history: The episode.
        baseline: Density errors of the paper's schedule in it [veh/km].
        segment: Where the incident is.
        start: When it blocks the road [s].
        end: When it stops to [s].
    """

    history: History
    baseline: FloatArray
    segment: int
    start: float
    end: float


def play() -> Scene:
    """Play the episode."""
    corridor = make_config(CELL.env, dict(CELL.keywords)).corridor
    (incident,) = draw_scenario(corridor, SEED).incidents
    start, end, _ = incident.phases[0]
    other = watch("", replace(CELL, policy=BASELINE), SEED).history.rmse
    return Scene(watch("", CELL, SEED).history, np.asarray(other), incident.segment, start, end)


def smooth(errors: FloatArray) -> FloatArray:
    """Return the roots of mean squared errors over the last seconds."""
    squares = np.cumsum(np.square(errors))
    return np.sqrt((squares[MEMORY:] - squares[:-MEMORY]) / MEMORY)


def add_strip(axes: Axes, bottom: float, height: float, n: int) -> PatchCollection:
    """Draw a road of n cells."""
    cells = [
        FancyBboxPatch((i + 0.06, bottom), 0.88, height, boxstyle="round,pad=0,rounding_size=0.1")
        for i in range(n)
    ]
    strip = PatchCollection(cells, edgecolors="none")
    axes.add_collection(strip)
    return strip


class Film:
    """The figure, laid out once, and its frames."""

    def __init__(self, scene: Scene) -> None:
        """Lay out the strips and the curve."""
        self.scene = scene
        n = len(scene.history.lengths)
        self.figure = Figure(figsize=(5.2, 4.1), dpi=140)
        self.canvas = FigureCanvasAgg(self.figure)
        road = self.figure.add_axes((LEFT, 0.38, RIGHT - LEFT, 0.61), xlim=(0, n), ylim=(-0.1, 3.9))
        road.axis("off")
        self.strips = {}
        style = {"color": INK, "va": "center"}
        for bottom, (name, more) in STRIPS.items():
            height = 0.55 if bottom == QUERIES else 0.8
            self.strips[bottom] = add_strip(road, bottom, height, n)
            middle = bottom + height / 2
            road.text(-0.2, middle + 0.17, name, ha="right", weight="bold", size=10, **style)
            road.text(-0.2, middle - 0.2, more, ha="right", size=8, color=COLOURS[-1], va="center")
        road.text(0.06, 3.7, "driving direction  →", size=9, **style)
        self.clock = road.text(n - 0.06, 3.7, "", ha="right", size=10, **style)
        self.incident = road.text(
            scene.segment + 0.5, 3.4, "incident\n▼", ha="center", va="center",
            size=9, weight="bold", color=COLOURS[1],
        )  # fmt: skip
        self._add_bar()
        curve = self.figure.add_axes((LEFT, 0.115, RIGHT - LEFT, 0.19))
        self.curves = [
            curve.plot([], [], color=colour, lw=width)[0] for colour, width in LINES.values()
        ]
        self.errors = [
            curve.text(at, 1.08, "", size=8, weight="bold", color=colour, transform=curve.transAxes)
            for at, (colour, _) in zip((0, 0.61), LINES.values(), strict=True)
        ]
        curve.set(xlim=(SECONDS[0], SECONDS[-1]), ylim=(0, 30), yticks=(0, 10, 20, 30))
        curve.set_xlabel("time [s]", size=9)
        curve.set_ylabel("density error\n[veh/km]", size=9)
        add_frame(curve, "y")
        turn_grey(self.figure)
        self.figure.patch.set_visible(False)
        curve.patch.set_visible(False)

    def _add_bar(self) -> None:
        shades = ScalarMappable(Normalize(0, LARGEST), SHADES)
        place = self.figure.add_axes((RIGHT + 0.015, 0.39, 0.02, 0.42))
        bar = self.figure.colorbar(shades, place, extend="max", ticks=range(0, 201, 50))
        bar.set_label("density [veh/km]", size=9)
        bar.ax.tick_params(labelsize=8)

    def draw(self, second: int) -> Image.Image:
        """Return the picture of a second."""
        history, scene = self.scene.history, self.scene
        for bottom, series in ((TRUTH, history.truth), (ESTIMATE, history.estimate)):
            self.strips[bottom].set_facecolor(colormaps[SHADES](series[second] / LARGEST))
        now = history.queried[second]
        before = np.any(history.queried[second - SECONDS.step + 1 : second], axis=0)
        self.strips[QUERIES].set_facecolor(
            [NOW if a else EARLIER if b else IDLE for a, b in zip(now, before, strict=True)]
        )
        self.incident.set_visible(scene.start <= second < scene.end)
        self.clock.set_text(f"second {second}")
        both = (scene.baseline, np.asarray(history.rmse))
        for errors, curve, text, name in zip(both, self.curves, self.errors, LINES, strict=True):
            curve.set_data(
                range(SECONDS[0], second + 1),
                smooth(errors[SECONDS[0] - MEMORY : second + 1]),
            )
            mean = np.sqrt(np.mean(np.square(errors[SECONDS[0] : second + 1])))
            text.set_text(f"{name}: {mean:.1f} veh/km")
        self.canvas.draw()
        return Image.fromarray(np.array(self.canvas.buffer_rgba()))


def save_moving(frames: list[Image.Image], path: Path) -> None:
    """Save frames as a WebP, whose pixels may be half transparent; few colours keep it small."""
    few = (frame.quantize(128, Image.Quantize.FASTOCTREE) for frame in frames)
    first, *others = (frame.convert("RGBA") for frame in few)
    with replacing(path) as temporary:
        first.save(
            temporary, format="WEBP", save_all=True, append_images=others, duration=FRAME, loop=0,
            lossless=True, quality=50, method=2,
        )  # fmt: skip


def main() -> None:
    """Write the moving picture and the still."""
    folder = Path(__file__).parents[1] / "images"
    film = Film(play())
    save_moving([film.draw(second) for second in SECONDS], folder / "episode.webp")
    with replacing(folder / "episode.png") as temporary:
        film.draw(STILL).save(temporary, format="PNG", optimize=True)


if __name__ == "__main__":
    main()
