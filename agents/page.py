"""Watched episodes, and an interactive page about an evaluation that needs no network."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.figures import COLOURS
from agents.play import Cell, play
from dptse_env.evaluation import Row
from dptse_env.privacy import rounded_up
from dptse_env.process import QueryProcess
from dptse_env.rendering import DENSITY_MAP, History
from dptse_env.traffic import Records
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.files import write_atomically
from dptse_env.utils.registry import needed_for

FRAMES = 140
"""Most positions of the slider: more would make the page large and slow."""

TRUTH = "#000000"


class Watched:
    """An episode of one policy, second by second, from the state at the reset on.

    Attributes:
        name: The policy.
        history: Truth, estimates, queries and errors.
        density_std: Deviations that the estimator reports of the mainline densities [veh/km], an
            array (n_mainline,) for each second.
        epsilon: Privacy loss so far, a number for each second; infinite where none is bounded.
        row: The row of the episode.
    """

    row: Row

    def __init__(self, name: str, process: QueryProcess) -> None:
        """Begin with nothing."""
        self.name, self._process = name, process
        self.history = History.empty(process)
        self.density_std: list[FloatArray] = []
        self.epsilon: list[float] = []

    def __call__(self) -> None:
        """Add the present second."""
        process, n = self._process, self._process.interface.queries.n_mainline
        self.history.append(process)
        self.density_std.append(process.estimate.density_std[0, :n].copy())
        self.epsilon.append(float(process.info(0)["spent_epsilon"]))

    def rows(self) -> list[Row]:
        """See `dptse_env.evaluation.Watcher.rows`: no further columns."""
        return [{}]


def watch(name: str, cell: Cell, seed: int, records: Records = None) -> Watched:
    """Play a cell on one traffic seed, and keep what happens."""
    watched: list[Watched] = []

    def begin(process: QueryProcess) -> Watched:
        watched.append(Watched(name, process))
        return watched[0]

    (watched[0].row,) = play(cell, [seed], records, watchers=[begin])
    return watched[0]


def write_page(
    path: Path,
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    episodes: Sequence[Watched],
    seed: int,
) -> None:
    """Write a page with a table, and with episodes over space and time with a slider.

    Args:
        path: The file.
        title: What was evaluated.
        header: Header of the table of errors.
        rows: Rows of that table.
        episodes: Episodes of some policies on one traffic.
        seed: Their traffic seed.

    Raises:
        MissingExtraError: plotly is not installed.
        OSError: The file cannot be written.
    """
    with needed_for("an HTML page"):
        from plotly.subplots import make_subplots  # noqa: PLC0415

    first, n_rows = episodes[0].history, 3 + len(episodes)
    figure = make_subplots(
        rows=n_rows,
        cols=1,
        specs=[[{"type": "table"}], *[[{}]] * (n_rows - 1)],
        subplot_titles=[
            "",
            f"True density on traffic seed {seed}",
            *(f"{each.name}: estimated density, queries dotted" for each in episodes),
            "Density along the road in the second of the slider",
        ],
        row_heights=[0.3 + 0.12 * len(rows), *[1.0] * (1 + len(episodes)), 1.4],
        vertical_spacing=0.36 / n_rows,
    )
    titles = [each.replace("\n", "<br>") for each in header]
    columns = list(zip(*rows, strict=True))
    figure.add_table(header={"values": titles}, cells={"values": columns}, row=1, col=1)
    places = np.cumsum([0.0, *first.lengths])
    middles, n_seconds = (places[:-1] + places[1:]) / 2, len(first.truth)
    panels: list[tuple[str, Any, Any]] = [("truth", first.truth, [])]
    panels += [(each.name, each.history.estimate, each.history.queried) for each in episodes]
    for row, (name, densities, queried) in enumerate(panels, 2):
        figure.add_heatmap(
            z=np.array(densities).T.round(1), x=list(range(n_seconds)), y=places.round(3),
            coloraxis="coloraxis", name=name, row=row, col=1,
        )  # fmt: skip
        if queried:
            seconds, segments = np.nonzero(np.array(queried))
            figure.add_scattergl(
                x=seconds, y=middles[segments], mode="markers", hoverinfo="skip", row=row, col=1,
                marker={"size": 3, "color": "white", "opacity": 0.7}, showlegend=False,
            )  # fmt: skip
    shown = range(0, n_seconds, math.ceil(n_seconds / FRAMES))
    begun = len(shown) // 2  # the estimates of second 0 are all the same
    for trace in _profile(episodes, middles, shown[begun]):
        figure.add_trace(trace, row=n_rows, col=1)
    moving = list(range(len(figure.data)))[-1 - len(episodes) :]
    figure.frames = [
        {"data": _profile(episodes, middles, each), "traces": moving, "name": str(each)}
        for each in shown
    ]
    now = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}
    steps = [
        {"label": str(each), "method": "animate", "args": [[str(each)], now]} for each in shown
    ]
    slider = {"currentvalue": {"prefix": "second "}, "pad": {"t": 40}}
    largest = max(first.density_scale, float(np.max(first.truth)))
    bar = {"title": {"text": "density<br>[veh/km]"}, "len": 0.5, "y": 0.55}
    figure.update_layout(
        title="<br>".join(textwrap.wrap(title, 60)),
        margin={"t": 140},
        template="plotly_white",
        height=240 * n_rows,
        coloraxis={"colorscale": DENSITY_MAP, "cmin": 0, "cmax": largest, "colorbar": bar},
        legend={"orientation": "h", "y": -0.12},
        sliders=[slider | {"active": begun, "steps": steps}],
    )
    figure.update_xaxes(title="time [s]", range=[-0.5, n_seconds - 0.5])
    figure.update_yaxes(title="position [km]")
    last = {"row": n_rows, "col": 1}
    figure.update_xaxes(title="position along the road [km]", range=[0, places[-1]], **last)
    figure.update_yaxes(title="[veh/km]", range=[0, largest], **last)
    # Playing at once would draw the moving curves alone.
    write_atomically(path, figure.to_html(include_plotlyjs=True, auto_play=False))


def _profile(episodes: Sequence[Watched], middles: FloatArray, second: int) -> list[dict[str, Any]]:
    """Return truth and estimates along the road in one second."""
    truth = episodes[0].history.truth[second].round(1)
    line = {"color": TRUTH, "width": 3}
    traces = [{"x": middles, "y": truth, "name": "true density", "line": line, "mode": "lines"}]
    for k, each in enumerate(episodes):
        rmse, epsilon = each.history.rmse[second], each.epsilon[second]
        loss = f", ε {rounded_up(epsilon, '.2f')}" if math.isfinite(epsilon) else ""
        traces.append(
            {
                "x": middles,
                "y": each.history.estimate[second].round(1),
                "error_y": {"type": "data", "array": (1.96 * each.density_std[second]).round(1)},
                "name": f"{each.name}: RMSE {rmse:.1f} veh/km{loss}",
                "mode": "lines+markers",
                "line": {"color": COLOURS[k % len(COLOURS)]},
            }
        )
    return traces
