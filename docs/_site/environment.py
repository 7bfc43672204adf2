"""Draw the pictures of the pages about the environment: docs/images.

python docs/_site/environment.py
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from agents.figures import (
    COLOURS,
    ERROR_TICKS,
    SHADES,
    WIDTH,
    Look,
    add_frame,
    draw_curve,
    draw_dot,
    draw_level,
    finish_figure,
    make_figure,
    save_figure,
    set_log,
)
from agents.page import watch
from agents.play import Cell
from agents.statistics import Interval, mean_interval
from agents.studies.guarantees import CURVE, paid
from agents.studies.roads import OWN, on_road
from agents.study import read_rows
from agents.tables import ERROR, METRICS, error_label, mean, values
from dptse_env.env import SensorQueryEnv
from dptse_env.schedules import make_schedule
from dptse_env.utils.arrays import Observation

ROOT = Path(__file__).parents[2]
ENV = "dptse_env:dptse/PrivateHighway-v1"
KEYWORDS = {"estimator": "ekf", "bandwidth": 5}
TRAFFIC = 2001  # its incident falls into the seconds that are shown
BLUE, ORANGE = COLOURS[:2]
SCHEDULES = (
    "round-robin", "shift-ahead", "oldest-first", "stale-variance", "speed-front", "oracle-error",
)  # fmt: skip
SHOWN = slice(270, 410)  # seconds
SECOND = 300

ESTIMATORS = (
    "recurrent", "blend", "ukf", "enkf", "ekf", "mhe", "asm", "random_walk",
)  # fmt: skip


def rows_of(study: str) -> pl.DataFrame:
    """Return the rows of a study."""
    return read_rows(study, ROOT / "results" / study)


def draw_estimators() -> Figure:
    """Draw the error of every estimator on a road of the package, on others and on a measured one.

    Over roads it is the mean, with the interval over the traffic seeds that they share.
    """
    found = {
        "PrivateHighway-v1 (simulated)": on_private_highway(rows_of("estimators")),
        "fourteen other roads (simulated)": on_other_roads(rows_of("roads")),
        "US-101 (measured)": on_measured_road(),
    }
    names = {where: [each for each in ESTIMATORS if each in own] for where, own in found.items()}
    counts = [len(each) for each in names.values()]
    figure = make_figure(WIDTH, 5.6)
    axes = figure.subplots(len(found), 1, sharex=True, gridspec_kw={"height_ratios": counts})
    for axis, (title, errors) in zip(axes, found.items(), strict=True):
        for place, name in enumerate(names[title]):
            colour = ORANGE if name == "recurrent" else BLUE
            draw_dot(axis, errors[name], -place, colour, name)
        axis.set_yticks([-place for place in range(len(names[title]))], names[title])
        axis.margins(y=0.1)
        axis.set_title(title, fontsize=9, loc="left")
        axis.set_xlim(0.0, 118.0)
        add_frame(axis, "x")
    axes[-1].set_xlabel("error x 1000", fontsize=9)
    return figure


def on_private_highway(rows: pl.DataFrame) -> dict[str, Interval]:
    """Return errors on PrivateHighway-v1; weights are those that ship."""
    own = rows.filter(pl.col("network").fill_null(0) == 0)
    labels = {"part": "estimators", "world": "PrivateHighway-v1", "policy": "round-robin"}
    names = own.filter(*(pl.col(key) == label for key, label in labels.items()))["estimator"]
    return {name: mean(own, {**labels, "estimator": name}, ERROR) for name in names.unique()}


def on_other_roads(rows: pl.DataFrame) -> dict[str, Interval]:
    """Return errors on the own roads, which nobody trained on, under `paced`."""
    played = rows.filter(pl.col("road").is_in(list(OWN)))
    roads = [road for road in OWN if road in played["road"]]
    return {
        name: mean_interval(
            np.mean([values(played, on_road(road, "paced", name), ERROR) for road in roads], axis=0)
        )
        for name in played["estimator"].unique()
    }


def on_measured_road() -> dict[str, Interval]:
    """Return errors on a measured road, whose field is not ours to ship, from the page on it."""
    page = (ROOT / "results" / "roads" / "README.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `(\w+)`[^|]*\| \**([\d.]+) ± ([\d.]+)", page, re.MULTILINE)
    errors = ((name, float(error), float(half)) for name, error, half in found)
    return {name: Interval(error, error - half, error + half, 5) for name, error, half in errors}


def draw_epsilon() -> Figure:
    """Draw errors against epsilon under both guaranteed release models, and without noise."""
    rows, looks = rows_of("guarantees"), {"capped": Look(ORANGE, "s"), "paced": Look(BLUE, "o")}
    figure = make_figure(WIDTH, 2.8)
    for axis, metric in zip(figure.subplots(1, 2), METRICS, strict=True):
        for release, look in looks.items():
            cells = [paid(release=release, epsilon=each).labels for each in CURVE]
            draw_curve(axis, CURVE, [mean(rows, each, metric) for each in cells], look, release)
        draw_level(axis, mean(rows, paid(release="exact").labels, metric), "no noise")
        set_log(axis, CURVE, ERROR_TICKS)
        axis.set_xlabel("ε at δ = 0.05", fontsize=9)
        axis.set_ylabel(error_label(metric), fontsize=9)
    return finish_figure(figure)


def draw_queries() -> Figure:
    """Draw where schedules look, on the true density of the same traffic."""
    figure = make_figure(WIDTH, 5.2)
    axes = figure.subplots(3, 2, sharex=True, sharey=True)
    for axis, name in zip(axes.flat, SCHEDULES, strict=True):
        watched = watch(name, Cell(ENV, name, KEYWORDS), TRAFFIC)
        truth = np.array(watched.history.truth)[SHOWN].T
        n, seconds = truth.shape
        image = axis.imshow(
            truth, origin="lower", aspect="auto", cmap=SHADES, interpolation="nearest",
            vmin=0.0, vmax=watched.history.density_scale,
            extent=(SHOWN.start - 0.5, SHOWN.start + seconds - 0.5, -0.5, n - 0.5),
        )  # fmt: skip
        segment, second = np.nonzero(np.array(watched.history.queried)[SHOWN].T)
        axis.plot(second + SHOWN.start, segment, "s", color=ORANGE, ms=1.8, mew=0.0)
        error = -1000.0 * watched.row["reward"]
        axis.set_title(f"{name}: {error:.1f}", fontsize=9, loc="left")
        axis.tick_params(labelsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("segment", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=9)
    bar = figure.colorbar(image, ax=axes.ravel().tolist(), fraction=0.03, pad=0.01)
    bar.set_label("true density [veh/km]", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def played(seconds: int) -> Iterator[tuple[SensorQueryEnv, Observation, float, dict[str, float]]]:
    """Yield the environment, observation, reward and info of every second of a round robin."""
    env = SensorQueryEnv("private-highway", traffic_seeds=[TRAFFIC], **KEYWORDS)
    schedule, state = make_schedule("round-robin", env), None
    observation, _ = env.reset(seed=0)
    for _ in range(seconds):
        action, state = schedule.predict(observation, state)
        observation, reward, _, _, info = env.step(action)
        yield env, observation, reward, info


def draw_rewards() -> Figure:
    """Draw an episode's errors of density and speed in units of their scales, and the reward."""
    *_, (env, *_) = episode = list(played(700))
    road, infos = env.config.corridor, [info for *_, info in episode]
    figure = make_figure(WIDTH, 2.8)
    axis = figure.subplots()
    lines = {
        "a: density error over its scale": (
            [info["rmse_density"] / road.scales.density_scale for info in infos], BLUE, "-",
        ),
        "b: speed error over its scale": (
            [info["rmse_speed"] / road.scales.speed_scale for info in infos], ORANGE, "-",
        ),
        "minus the reward": ([-reward for _, _, reward, _ in episode], "black", ":"),
    }  # fmt: skip
    for label, (line, colour, style) in lines.items():
        axis.plot(np.arange(1, 701), line, color=colour, ls=style, lw=1.2, label=label)
    axis.set_xlabel("time [s]", fontsize=9)
    axis.set_ylabel("error", fontsize=9)
    axis.set_ylim(bottom=0.0)
    return finish_figure(figure)


def draw_observation() -> Figure:
    """Draw the blocks of an observation, each in colours from its least to its largest value."""
    *_, (env, observation, _, _) = played(SECOND)
    slices = env.interface.observations.slices
    figure = make_figure(WIDTH, 4.2)
    axis = figure.subplots()
    table = np.full((len(slices), max(part.stop - part.start for part in slices.values())), np.nan)
    for row, part in zip(table, slices.values(), strict=True):
        own = observation[part]
        row[: own.size] = (own - own.min()) / max(np.ptp(own), 1e-9)
    image = axis.pcolormesh(table, cmap="cividis", vmin=0.0, vmax=1.0, edgecolors="none")
    axis.invert_yaxis()
    names = [f"{name}  [{part.start}:{part.stop}]" for name, part in slices.items()]
    axis.set_yticks(np.arange(len(slices)) + 0.5, names, fontsize=7.5)
    places = range(0, table.shape[1], 3)
    axis.set_xticks([place + 0.5 for place in places], map(str, places), fontsize=8)
    axis.set_xlabel("place in the block", fontsize=9)
    axis.spines[:].set_visible(False)
    axis.tick_params(length=0)
    bar = figure.colorbar(image, ax=axis, fraction=0.03, pad=0.01, ticks=[0, 1])
    bar.ax.set_yticklabels(["least", "largest"], fontsize=8)
    return figure


PICTURES = {
    "observation.png": draw_observation,
    "rewards.png": draw_rewards,
    "queries.png": draw_queries,
    "estimators.png": draw_estimators,
    "epsilon.png": draw_epsilon,
}


def main() -> None:
    """Draw all pictures."""
    for name, draw in PICTURES.items():
        save_figure(draw(), ROOT / "docs" / "images" / name, "")


if __name__ == "__main__":
    main()
