"""An episode as a picture: truth and estimate along the road now, and over space and time."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dptse_env.release import RELEASE_MODELS
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.registry import needed_for

if TYPE_CHECKING:
    from dptse_env.process import QueryProcess

DENSITY_MAP = "viridis"
TRUTH_COLOUR = "#000000"
ESTIMATE_COLOUR = "#0072b2"
QUERY_COLOUR = "#d55e00"
NO_QUERY_COLOUR = "#f2f4f7"
LOOP_COLOUR = "#009e73"
RAMP_COLOUR = "#666666"
LIMIT_STEP = 10.0
"""Step in which the axis of errors grows [veh/km]."""
SMOOTH_FROM = 500
"""Horizon [s] from which on the query panel has fewer pixels than seconds."""


@dataclass
class History:
    """Truth, estimate and queries of an episode of a process, second by second.

    Attributes:
        episode: Number of the episode in the process.
        horizon: Length of a full episode [s].
        lengths: Lengths of the mainline segments [km].
        density_scale: Density at the end of the colour scale [veh/km].
        truth: True mainline densities [veh/km], an array (n_mainline,) per second.
        estimate: Estimated mainline densities [veh/km], an array (n_mainline,) per second.
        queried: Segments that a query covered, flags (n_mainline,) per second.
        rmse: Density error over the mainline [veh/km], a number per second.
        title: Id or road, estimator, release model and bandwidth in words.
        loops: Places of stations of loops along the mainline [km].
        ramps: Place of each ramp along the mainline [km], with its kind in words.
    """

    episode: int
    horizon: int
    lengths: tuple[float, ...]
    density_scale: float
    truth: list[FloatArray] = field(default_factory=list)
    estimate: list[FloatArray] = field(default_factory=list)
    queried: list[BoolArray] = field(default_factory=list)
    rmse: list[float] = field(default_factory=list)
    title: str = ""
    loops: tuple[float, ...] = ()
    ramps: tuple[tuple[float, str], ...] = ()

    @classmethod
    def empty(cls, process: QueryProcess, episode: int = 0, name: str = "") -> History:
        """Return the history of an episode of ``process`` that is to begin.

        Args:
            process: The process.
            episode: Number of the episode.
            name: Id of the environment, for the title; that of the road stands in its place.
        """
        config, corridor = process.config, process.config.corridor
        lengths = corridor.geometry.segment_lengths[: corridor.geometry.n_mainline]
        known = config.estimator
        estimator = known if isinstance(known, str) else getattr(known, "__name__", "your own")
        is_sums = config.bandwidth_unit == "sums"
        every = config.query_every
        often = "a second" if every == 1 else f"in {every} s"
        unit = "sums" if is_sums else f"of {len(lengths)} segments"
        place = name.rpartition("/")[2] or corridor.name
        losses = f"ε {config.privacy.epsilon:g}, δ {config.privacy.delta:g}"
        release = f"{RELEASE_MODELS.name_of(config.privacy.preset)} ({losses})"
        queries = f"queries {config.bandwidth} {unit} {often}"
        title = f"{place}, estimator {estimator}, release {release},\n{queries}"
        scale = corridor.scales.density_scale
        loops = tuple(corridor.stations.positions.tolist())
        kinds = {"on-ramp": corridor.geometry.on_ramps, "off-ramp": corridor.geometry.off_ramps}
        ramps = tuple((sum(lengths[:face]), kind) for kind in kinds for face in kinds[kind])
        return cls(
            episode, config.horizon_steps, lengths, scale, title=title, loops=loops, ramps=ramps
        )

    @property
    def road_length(self) -> float:
        """Length of the mainline [km]."""
        return sum(self.lengths)

    @cached_property
    def rows(self) -> IntArray:
        """Segment of each row of a picture, whose rows have one height: the shortest segment's."""
        n_rows = round(self.road_length / min(self.lengths))
        middles = (np.arange(n_rows) + 0.5) * self.road_length / n_rows
        return np.searchsorted(np.cumsum(self.lengths), middles).astype(np.int64)

    def append(self, process: QueryProcess) -> None:
        """Add the present second, or replace it where a decision took several actions."""
        n, e = process.interface.queries.n_mainline, self.episode
        second, rows = int(process.elapsed[e]), np.array([e])
        self.truth[second:] = [process.truth(rows)[0, :n, 0]]
        self.estimate[second:] = [process.estimate.density[e, :n].copy()]
        self.queried[second:] = [process.interface.queries.covered(process.queried[rows])[0]]
        self.rmse[second:] = [float(process.error.density[e])]


class Picture:
    """Five panels, laid out once and filled as an episode goes on.

    The first shows the present second along the road, the others have one time axis.
    """

    def __init__(self, history: History) -> None:
        """Lay out the panels for episodes of the road and length of ``history``."""
        # No pyplot: it keeps global state and may open a window.
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
        from matplotlib.colors import ListedColormap  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415

        figure = Figure(figsize=(5.0, 6.4), dpi=144, layout="constrained")
        self._canvas: Any = FigureCanvasAgg(figure)
        axes = figure.subplots(5, 1, gridspec_kw={"height_ratios": [2.6, 3, 3, 2.6, 1.6]})
        figure.suptitle(history.title, x=0.01, ha="left", fontsize=10)
        self._draw_profile(axes[0], history)
        self._shape = (len(history.rows), history.horizon + 1)
        extent = (-0.5, history.horizon + 0.5, 0.0, history.road_length)
        shades = {"cmap": DENSITY_MAP, "vmin": 0.0, "vmax": history.density_scale}
        flags = {"cmap": ListedColormap([NO_QUERY_COLOUR, QUERY_COLOUR]), "vmin": 0, "vmax": 1}
        # More seconds than pixels would leave an arbitrary choice of the queries; smooth those.
        smooth = "nearest" if history.horizon < SMOOTH_FROM else "antialiased"
        blank, place = np.full(self._shape, np.nan), {"origin": "lower", "aspect": "auto"}
        self._maps = [
            axis.imshow(blank, extent=extent, interpolation=interpolation, **place, **colours)
            for axis, colours, interpolation in zip(
                axes[1:4], (shades, shades, flags), ("nearest", "nearest", smooth), strict=True
            )
        ]
        (self._error,) = axes[4].plot([], [], color=ESTIMATE_COLOUR, linewidth=1.2)
        axes[4].set_xlim(extent[:2])
        axes[4].set_ylabel("[veh/km]", fontsize=8)
        axes[4].set_xlabel("time [s]", fontsize=8)
        titles = ("", "True density", "Estimated density", "Queried segments", "")
        for axis, title in zip(axes, titles, strict=True):
            axis.set_title(title, loc="left", fontsize=9, pad=3)
            axis.tick_params(labelsize=8)
        for axis in axes[1:4]:
            axis.set_ylabel("position [km]", fontsize=8)
            axis.tick_params(labelbottom=False)
        # Titles that change from second to second.
        self._now = axes[0].set_title(" ", loc="left", fontsize=9, pad=17)  # above the legend
        self._rmse = axes[4].set_title(" ", loc="left", fontsize=9, pad=3)
        bar = figure.colorbar(
            self._maps[0], ax=axes.tolist(), fraction=0.03, pad=0.02, extend="max",
            shrink=0.44, anchor=(0.0, 0.62),
        )  # fmt: skip
        bar.set_label("density [veh/km]", fontsize=8)
        bar.ax.tick_params(labelsize=8)
        # The layout stays as it is: working it out takes most of the time of a drawing.
        figure.canvas.draw()
        figure.set_layout_engine("none")
        self._moving = (
            self._marks, self._true, self._estimated, *self._maps, self._error, self._now,
            self._rmse,
        )  # fmt: skip
        for artist in self._moving:
            artist.set_animated(True)  # left out of the background
        self._limit, self._background = 0.0, None

    def _draw_profile(self, axis: Any, history: History) -> None:
        """Lay out the panel along the road, and name its curves."""
        edges = np.concatenate(([0.0], np.cumsum(history.lengths)))
        zeros, top = np.zeros(len(history.lengths)), history.density_scale
        look = {"edges": edges, "linewidth": 1.6, "baseline": None}
        self._marks = axis.stairs(
            zeros, edges, fill=True, color=QUERY_COLOUR, alpha=0.35, label="queried now"
        )
        self._true = axis.stairs(zeros, color=TRUTH_COLOUR, label="true density", **look)
        self._estimated = axis.stairs(zeros, color=ESTIMATE_COLOUR, label="estimate", **look)
        if history.loops:
            mark = {"marker": "^", "markersize": 6, "linestyle": "", "color": LOOP_COLOUR}
            axis.plot(
                history.loops,
                np.zeros(len(history.loops)),
                label="loops",
                **mark,
                clip_on=False,
                zorder=3,
            )
        for place, kind in history.ramps:
            axis.axvline(place, color=RAMP_COLOUR, linewidth=0.8, linestyle=":")
            axis.text(place, 0.98 * top, kind, color=RAMP_COLOUR, fontsize=7, va="top")
        axis.set(xlim=(0.0, edges[-1]), ylim=(0.0, top))
        axis.set_xlabel("position along the road [km]", fontsize=8)
        axis.set_ylabel("[veh/km]", fontsize=8)
        axis.legend(
            ncols=4, frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 0.97),
            borderaxespad=0.0, columnspacing=1.0, handlelength=1.2,
        )  # fmt: skip

    def draw(self, history: History) -> NDArray[np.uint8]:
        """Return the picture of ``history`` as RGB, shape (height, width, 3)."""
        panels: tuple[list[Any], ...] = (history.truth, history.estimate, history.queried)
        for image, series in zip(self._maps, panels, strict=True):
            values = np.full(self._shape, np.nan)
            values[:, : len(series)] = np.transpose(series)[history.rows]
            image.set_data(values)
        self._marks.set_data(history.queried[-1] * history.density_scale)
        self._true.set_data(history.truth[-1])
        self._estimated.set_data(history.estimate[-1])
        self._error.set_data(range(len(history.rmse)), history.rmse)
        self._now.set_text(f"Density in second {len(history.truth) - 1} of {history.horizon}")
        self._rmse.set_text(
            f"Error of the estimate (RMSE along the road), now {history.rmse[-1]:.1f} veh/km"
        )
        self._draw_background(LIMIT_STEP * np.ceil(max(history.rmse) / LIMIT_STEP + 0.05))
        self._canvas.restore_region(self._background)
        for artist in self._moving:
            artist.axes.draw_artist(artist)
        for axis in {artist.axes: None for artist in self._moving}:
            for spine in axis.spines.values():
                axis.draw_artist(spine)
        return np.array(self._canvas.buffer_rgba())[..., :3]

    def _draw_background(self, limit: float) -> None:
        """Draw what stays from second to second, anew where the axis of errors must grow."""
        if limit == self._limit:
            return
        self._limit = limit
        self._error.axes.set_ylim(0.0, limit)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._canvas.figure.bbox)


class Drawing:
    """The picture of an episode that goes on, and a window that shows it.

    Attributes:
        history: The episode so far; None before the first one begins.
    """

    def __init__(self, episode: int = 0, every: int = 1, screen: Screen | None = None) -> None:
        """Draw an episode of a process.

        Args:
            episode: Its number.
            every: Seconds between two drawings; in between, `draw` returns the last one.
            screen: Shows every second; None for none.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        with needed_for("a render_mode"):
            import matplotlib  # noqa: F401, PLC0415  (slow to import)
        self.episode, self.every, self.screen = episode, every, screen
        self.history: History | None = None
        self._picture: Picture | None = None
        self._frame: tuple[int, NDArray[np.uint8]] | None = None

    def begin(self, process: QueryProcess, name: str) -> None:
        """Take up an episode that was just reset, of an environment with some id, or none."""
        self.history, self._frame = History.empty(process, self.episode, name), None
        self.history.append(process)
        if self.screen is not None:
            self.screen.reopen()
            self.screen.show(self.draw())

    def follow(self, process: QueryProcess, episodes: IntArray) -> None:
        """Add the second that the episode stands at, if it is one of those that moved."""
        if self.episode not in episodes:
            return
        assert self.history is not None
        self.history.append(process)
        if self.screen is not None:
            self.screen.show(self.draw())

    def draw(self) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3), drawn anew if it is due.

        Raises:
            gymnasium.error.ResetNeeded: No episode has begun.
        """
        history = self.history
        if history is None:
            raise gym.error.ResetNeeded("nothing to render: call reset() first")
        second = len(history.truth) - 1
        drawn = self._frame[0] if self._frame is not None else -self.every
        if second - drawn >= self.every or drawn < second == history.horizon:
            if self._picture is None:
                self._picture = Picture(history)
            self._frame = second, self._picture.draw(history)
        assert self._frame is not None
        return self._frame[1].copy()


class Screen:
    """A window for pictures of one size, by pygame.

    Closing it by hand ends the showing and nothing else: the episode goes on.
    """

    def __init__(self, title: str, frames_per_second: int) -> None:
        """Load pygame; the window opens with the first picture.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        with needed_for("render_mode='human'"):
            import pygame  # noqa: PLC0415
        self._pygame: Any = pygame
        self._title, self._rate = title, frames_per_second
        self._surface: Any = None
        self._clock = pygame.time.Clock()
        self._was_closed = False

    def reopen(self) -> None:
        """Let the next picture open a window, if the last one was closed by hand."""
        self._was_closed = False

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture of shape (height, width, 3), no sooner than its time has come.

        Raises:
            gymnasium.error.Error: There is no display.
        """
        pygame = self._pygame
        if self._was_closed:
            return
        if self._surface is None:
            self._surface = self._opened(picture.shape[1], picture.shape[0])
        pixels = pygame.surfarray.make_surface(np.swapaxes(picture, 0, 1))
        self._surface.blit(pixels, (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            self._was_closed = True
        self._clock.tick(self._rate)

    def _opened(self, width: int, height: int) -> Any:
        pygame = self._pygame
        try:
            pygame.display.init()
            # Where SDL finds no display it draws into memory, which nobody sees.
            unseen = pygame.display.get_driver() == "offscreen"
            if unseen and os.environ.get("SDL_VIDEODRIVER") != "offscreen":
                raise pygame.error("no display found")
            surface = pygame.display.set_mode((width, height))
        except pygame.error as problem:
            pygame.display.quit()
            raise gym.error.Error(
                f"render_mode='human' needs a display, and none can be opened ({problem}): use "
                "render_mode='rgb_array', or gymnasium.wrappers.RecordVideo for a video"
            ) from problem
        pygame.display.set_caption(self._title.replace("\n", " "))
        return surface

    def close(self) -> None:
        """Close the window; a closed one stays closed."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
