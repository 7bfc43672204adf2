"""The episode as a picture over space and time: true density, its estimate, and the queries."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dptse_env.utils.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    from dptse_env.process import QueryProcess

DENSITY_MAP = "viridis"
ERROR_COLOUR = "#c1272d"
QUERY_COLOUR = "#1b2a41"
SMOOTH_FROM = 500
"""Seconds from which on the query panel has no pixel for each."""


@dataclass
class History:
    """What a picture needs of the first episode of a process.

    Attributes:
        horizon: Seconds of the whole episode.
        segment_length: [km].
        density_scale: Density that counts as full [veh/km].
        truth: True mainline densities [veh/km], one array (n_mainline,) per second.
        estimate: Estimated ones.
        queried: Queried segments.
        rmse: Density error over the mainline [veh/km].
    """

    horizon: int
    segment_length: float
    density_scale: float
    truth: list[FloatArray] = field(default_factory=list)
    estimate: list[FloatArray] = field(default_factory=list)
    queried: list[BoolArray] = field(default_factory=list)
    rmse: list[float] = field(default_factory=list)

    @classmethod
    def begin(cls, process: QueryProcess) -> History:
        """Start a history at the present state of ``process``."""
        corridor = process.config.corridor
        history = cls(process.config.horizon_steps, corridor.segment_length, corridor.density_scale)
        history.append(process)
        return history

    def append(self, process: QueryProcess) -> None:
        """Add the present second; a second that is there already is replaced."""
        n = process.interface.n_mainline
        second = int(process.elapsed[0])
        self.truth[second:] = [process.truth(np.zeros(1, dtype=np.int64))[0, :n, 0]]
        self.estimate[second:] = [process.estimate.density[0, :n].copy()]
        self.queried[second:] = [process.queried[0].copy()]
        self.rmse[second:] = [float(process.error.density[0])]


def draw(figure: Any, history: History) -> None:
    """Draw ``history`` into an empty matplotlib figure: four panels over one time axis."""
    axes = figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": [3, 3, 3, 1.3]})
    truth, estimate, queried = (
        np.array(series).T for series in (history.truth, history.estimate, history.queried)
    )
    road = len(truth) * history.segment_length
    extent = (-0.5, truth.shape[1] - 0.5, 0.0, road)
    place: dict[str, Any] = {"origin": "lower", "aspect": "auto", "extent": extent}
    crisp = {"interpolation": "nearest"}
    shades = {"cmap": DENSITY_MAP, "vmin": 0.0, "vmax": history.density_scale}
    image = axes[0].imshow(truth, **place, **crisp, **shades)
    axes[1].imshow(estimate, **place, **crisp, **shades)
    # More seconds than pixels would leave an arbitrary choice of the queries; smooth those.
    flags = crisp if queried.shape[1] < SMOOTH_FROM else {"interpolation": "antialiased"}
    axes[2].imshow(queried, **place, **flags, cmap=_two_colours(), vmin=0, vmax=1)
    axes[3].plot(history.rmse, color=ERROR_COLOUR, linewidth=1.0)
    for axis, name in zip(axes, ("true density", "estimate", "queried", "error"), strict=True):
        axis.set_title(name, loc="left", fontsize=9, pad=3)
        axis.tick_params(labelsize=8)
    for axis in axes[:3]:
        axis.set_ylabel("road [km]", fontsize=8)
    axes[3].set_ylabel("RMSE\n[veh/km]", fontsize=8)
    axes[3].set_ylim(bottom=0.0)
    axes[3].set_xlim(-0.5, history.horizon + 0.5)
    axes[3].set_xlabel("time [s]", fontsize=8)
    bar = figure.colorbar(image, ax=axes.tolist(), fraction=0.03, pad=0.02, extend="max")
    bar.set_label("density [veh/km]", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def render_rgb(history: History) -> NDArray[np.uint8]:
    """Return the picture of ``history``, shape (h, w, 3)."""
    # No pyplot: it keeps global state and may pick a window system.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(7.2, 6.4), dpi=100, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    draw(figure, history)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()


def _two_colours() -> Any:
    from matplotlib.colors import ListedColormap  # noqa: PLC0415

    return ListedColormap(["#eef1f5", QUERY_COLOUR])
