"""Watched episodes, and an interactive page about an evaluation that needs no network."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents.environments import quietly, unwrap
from agents.figures import COLOURS
from agents.play import Cell
from agents.tables import error_label
from dptse_env.evaluation import Row, evaluate
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
    more = {"traffic_seeds": [seed], "records": records}
    with quietly():
        env = gym.make(cell.env, disable_env_checker=True, **{**cell.all_keywords, **more})
    watched = Watched(name, unwrap(env).process)
    (watched.row,) = evaluate(
        env,
        cell.load_policy(env),
        [seed],
        cell.noise_seed,
        deterministic=cell.deterministic,
        watchers=[lambda process: watched],
    )
    return watched


def write_page(
    path: Path,
    title: str,
    errors: Sequence[tuple[str, dict[str, tuple[float, float]]]],
    episodes: Sequence[Watched],
    seed: int,
) -> None:
    """Write a page with errors of all policies, and episodes over space and time with a slider.

    Args:
        path: The file.
        title: What was evaluated.
        errors: For each policy its name, and mean and half width of the interval by error.
        episodes: Episodes of some policies on one traffic.
        seed: Their traffic seed.

    Raises:
        MissingExtraError: plotly is not installed.
        OSError: The file cannot be written.
    """
    with needed_for("an HTML page"):
        import plotly.graph_objects as go  # noqa: PLC0415
        from plotly.subplots import make_subplots  # noqa: PLC0415

    first, metrics = episodes[0].history, list(errors[0][1])
    n_rows = 3 + len(episodes)
    whole_row = [{"colspan": len(metrics)}, *[None] * (len(metrics) - 1)]
    figure = make_subplots(
        rows=n_rows,
        cols=len(metrics),
        specs=[[{}] * len(metrics), *[whole_row] * (n_rows - 1)],
        subplot_titles=[
            *(error_label(metric).replace(" [", "<br>[") for metric in metrics),
            f"True density on traffic seed {seed}",
            *(f"{each.name}: estimated density, queries dotted" for each in episodes),
            "Density along the road in the second of the slider",
        ],
        row_heights=[0.3 + 0.1 * len(errors), *[1.0] * (1 + len(episodes)), 1.4],
        vertical_spacing=0.36 / n_rows,
    )
    for column, metric in enumerate(metrics, 1):
        figure.add_bar(
            x=[each[metric][0] for _, each in errors],
            y=[name for name, _ in errors],
            error_x={"type": "data", "array": [each[metric][1] for _, each in errors]},
            orientation="h",
            marker_color=COLOURS[0],
            showlegend=False,
            row=1,
            col=column,
        )
        figure.update_yaxes(
            autorange="reversed", showticklabels=column == 1, dtick=1, row=1, col=column
        )
    places = np.cumsum([0.0, *first.lengths])
    largest = max(first.density_scale, float(np.max(first.truth)))
    shades = {"coloraxis": "coloraxis", "x": list(range(len(first.truth))), "y": places.round(3)}
    middles = (places[:-1] + places[1:]) / 2
    maps = [("truth", first.truth), *((each.name, each.history.estimate) for each in episodes)]
    for row, (name, densities) in enumerate(maps, 2):
        columns = np.array(densities).T.round(1)
        figure.add_heatmap(z=columns, name=name, **shades, row=row, col=1)
    for row, each in enumerate(episodes, 3):
        seconds, segments = np.nonzero(np.array(each.history.queried))
        figure.add_scattergl(
            x=seconds,
            y=middles[segments],
            mode="markers",
            marker={"size": 3, "color": "white", "opacity": 0.7},
            hoverinfo="skip",
            showlegend=False,
            row=row,
            col=1,
        )
    figure.update_annotations(font_size=13)
    n_fixed = len(figure.data)
    seconds_shown = range(0, len(first.truth), max(math.ceil(len(first.truth) / FRAMES), 1))
    begun = len(seconds_shown) // 2  # the estimates of second 0 are all the same
    for trace in _profile(go, episodes, middles, seconds_shown[begun]):
        figure.add_trace(trace, row=n_rows, col=1)
    moving = list(range(n_fixed, len(figure.data)))
    figure.frames = [
        go.Frame(data=_profile(go, episodes, middles, second), traces=moving, name=str(second))
        for second in seconds_shown
    ]
    figure.update_layout(
        title="<br>".join(textwrap.wrap(title, 60)),
        margin={"t": 140},
        template="plotly_white",
        height=240 * n_rows,
        coloraxis={
            "colorscale": DENSITY_MAP,
            "cmin": 0,
            "cmax": largest,
            "colorbar": {"title": {"text": "density<br>[veh/km]"}, "len": 0.5, "y": 0.55},
        },
        legend={"orientation": "h", "y": -0.12},
        sliders=[_slider(seconds_shown, begun)],
    )
    for row in range(2, 3 + len(episodes)):
        figure.update_yaxes(title="position [km]", row=row, col=1)
        last = row == 2 + len(episodes)
        ends = [-0.5, len(first.truth) - 0.5]
        figure.update_xaxes(title="time [s]" if last else None, range=ends, row=row, col=1)
    figure.update_xaxes(title="position along the road [km]", row=n_rows, col=1)
    figure.update_yaxes(title="[veh/km]", range=[0, largest], row=n_rows, col=1)
    # Playing at once would draw the moving curves alone.
    write_atomically(path, figure.to_html(include_plotlyjs=True, auto_play=False))


def _profile(go: Any, episodes: Sequence[Watched], middles: FloatArray, second: int) -> list[Any]:
    """Return truth and estimates along the road in one second."""
    truth = episodes[0].history.truth[second].round(1)
    line = {"color": TRUTH, "width": 3}
    traces = [go.Scatter(x=middles, y=truth, name="true density", line=line, mode="lines")]
    for k, each in enumerate(episodes):
        error = {"type": "data", "array": (1.96 * each.density_std[second]).round(1)}
        rmse, epsilon = each.history.rmse[second], each.epsilon[second]
        loss = f", ε {rounded_up(epsilon, '.2f')}" if math.isfinite(epsilon) else ""
        traces.append(
            go.Scatter(
                x=middles,
                y=each.history.estimate[second].round(1),
                error_y=error,
                name=f"{each.name}: RMSE {rmse:.1f} veh/km{loss}",
                mode="lines+markers",
                line={"color": COLOURS[k % len(COLOURS)]},
            )
        )
    return traces


def _slider(seconds: Sequence[int], begun: int) -> dict[str, Any]:
    now = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}
    return {
        "active": begun,
        "currentvalue": {"prefix": "second "},
        "pad": {"t": 40},
        "steps": [
            {"label": str(each), "method": "animate", "args": [[str(each)], now]}
            for each in seconds
        ],
    }
