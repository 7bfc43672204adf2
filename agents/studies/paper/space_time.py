"""The figure of result 2: true and estimated density over space and time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from agents.evaluation.episodes import WARM_UP, watch_episode
from agents.evaluation.figures import save
from agents.experiments.runner import make_env
from agents.studies.paper.measures import LABELS
from agents.studies.paper.plan import SCHEDULE, SETTINGS, Design, Setting
from dptse_env.rendering import DENSITY_MAP, History
from dptse_env.schedules import make_schedule


def watch(design: Design, records: str | None) -> dict[tuple[str, Setting], History]:
    """Run the episodes that are shown: the first traffic seed, every estimator and setting."""
    seed = design.seeds[0]
    shown: dict[Any, History] = {}
    for setting in SETTINGS:
        for name in design.all_estimators:
            cell = design.picture(name, setting)
            if cell not in shown:
                env = make_env(design.env, cell, design.seeds, records)
                schedule = make_schedule(SCHEDULE, env)
                _, shown[cell] = watch_episode(env, schedule, traffic_seed=seed, seed=seed)
    return {
        (name, setting): shown[design.picture(name, setting)]
        for setting in SETTINGS
        for name in design.all_estimators
    }


def save_space_time(
    path: Path, design: Design, histories: Mapping[tuple[str, Setting], History], title: str
) -> None:
    """Save maps of density: truth on top, then each estimator; a column for each setting."""
    names = design.all_estimators
    figure = Figure(figsize=(14.0, 1.35 * (len(names) + 1) + 1.0), dpi=130)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(len(names) + 1, len(SETTINGS), sharex=True, sharey=True)
    for column, setting in enumerate(SETTINGS):
        first = histories[names[0], setting]
        image = _map(axes[0, column], first, first.truth)
        axes[0, column].set_title(f"{setting}\ntruth", loc="left", fontsize=9)
        for row, name in enumerate(names, start=1):
            own = histories[name, setting]
            rmse = float(np.sqrt(np.mean(np.square(own.rmse[WARM_UP + 1 :]))))
            _map(axes[row, column], own, own.estimate)
            label = f"{LABELS[name]}, RMSE {rmse:.1f} veh/km"
            axes[row, column].set_title(label, loc="left", fontsize=9)
    for axis in axes[:, 0]:
        axis.set_ylabel("road [km]", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=8)
    bar = figure.colorbar(image, ax=axes, fraction=0.02, pad=0.01, extend="max")
    bar.set_label("density [veh/km]")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    save(figure, path)


def _map(axis: Any, history: History, values: Any) -> Any:
    array = np.array(values).T
    axis.tick_params(labelsize=8)
    return axis.imshow(
        array,
        origin="lower",
        aspect="auto",
        extent=(-0.5, array.shape[1] - 0.5, 0.0, len(array) * history.segment_length),
        cmap=DENSITY_MAP,
        vmin=0.0,
        vmax=history.density_scale,
    )
