"""The paper's five results, and a verdict on each of its claims.

S. C. Vishnoi, A. F. Taha, S. A. Nugroho and C. G. Claudel, "On Differential Privacy and Traffic
State Estimation Problem for Connected Vehicles": errors against the number of CV segments, a map of
density over space and time, density error against epsilon and against delta, and the time of a
step. Each is played under the noise as printed (``paper``) and as the paper's theorem needs it
(``corrected``), with the paper's ARZ parameters and with calibrated ones (``w99-3lane``).

A claim has parts. A part is one number for each traffic seed, in most cases a difference of two
errors on the same traffic and the same noise. It holds if the 95 % interval of its mean lies inside
the claim's range, does not hold if the interval lies outside, and is undecided otherwise. A claim
holds if all its parts hold, and does not hold if one of them does not.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import polars as pl
from matplotlib.ticker import NullFormatter

import dptse_env
from agents.environments import quietly, unwrap
from agents.figures import (
    ERROR_TICKS,
    ESTIMATOR_LOOKS,
    LABELS,
    add_frame,
    add_legend,
    draw_curve,
    draw_level,
    error_label,
    make_figure,
    save_figure,
    set_log_ticks,
    shifted,
    spread,
)
from agents.play import Cell, corridor_of, record
from agents.statistics import (
    Interval,
    geometric_mean_interval,
    mean_interval,
    paired_difference,
)
from agents.study import Place, Study, read_table
from agents.tables import (
    DENSITY,
    METRICS,
    SPEED,
    Labels,
    UnmeasuredError,
    cell,
    format_interval,
    markdown,
    pick,
)
from dptse_env.evaluation import Row, evaluate
from dptse_env.process import QueryProcess
from dptse_env.rendering import DENSITY_MAP, History
from dptse_env.utils.arrays import FloatArray

ENV = "dptse_env:dptse/PaperHighway-v0"
SCHEDULE = "paper"
SEEDS = tuple(range(2000, 2020))
PAPER_ESTIMATORS = ("ekf", "ukf", "enkf", "mhe")
"""The paper's estimators, in its order."""
BASELINES = ("random_walk", "open_loop")
"""Played beside them in every result: without a traffic model, and without measurements."""
ESTIMATORS = (*PAPER_ESTIMATORS, *BASELINES)
BASE = {"epsilon": 1.0, "delta": 0.05, "bandwidth": 5}
"""The paper's privacy, and its fewest CV segments, wherever they are not swept."""
SWEEPS: dict[str, tuple[float, ...]] = {
    "bandwidth": (5, 6, 7, 8, 9, 10, 11),
    "epsilon": (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0, 10.0),
    "delta": (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.2),
}
"""Values of results 1, 3 and 4, by the keyword that varies."""
PRIVACY = ("epsilon", "delta")
AXES = {"bandwidth": "CV segments", "epsilon": "ε", "delta": "δ"}
PAPER_SECONDS = {"ekf": 0.06, "ukf": 0.026, "enkf": 0.040, "mhe": 0.045}
"""The paper's seconds a step: MATLAB R2019b, a 3.6 GHz i7-7700."""
CLOSE, SMALL, SIMILAR = 5.0, 10.0, 0.9
"""Where the paper gives no number, fixed before the full run after a look at three traffic seeds:
errors are close within this [%], a variation is small below this [%], and curves are similar if
their correlation along the grid exceeds this."""
SECONDS = "seconds"
N_TIMED = 10
"""Traffic seeds behind each time of a step."""
PICTURE_SEGMENTS = 7
"""CV segments of result 2."""
RUN_TIME, SPACE_TIME = "run_time.parquet", "space_time.parquet"
MAPS = ("truth", "estimate")
EVERY = 5
"""Seconds between two columns of the map of space and time [s]."""
LOST = ("n_diverged", "n_fallback", "n_dropped")
DPI = 90
SHADES = ("#0072b2", "#56b4e9", "#d55e00", "#e69f00")
"""Colours of the settings."""


class Setting(NamedTuple):
    """A choice that the paper leaves open; each result is shown under all of them."""

    privacy: str
    parameters: str

    def __str__(self) -> str:
        """Return both names."""
        return f"{self.privacy} noise, {self.parameters} parameters"


SETTINGS = tuple(Setting(*each) for each in (
    ("paper", "paper"), ("paper", "w99-3lane"), ("corrected", "paper"), ("corrected", "w99-3lane"),
))  # fmt: skip


def labels_of(estimator: str, setting: Setting, **swept: float) -> dict[str, Any]:
    """Return the labels of a cell, which are its keywords.

    The open loop uses no release, so one cell stands for all privacy and all queries.
    """
    privacy, parameters = setting
    if estimator == "open_loop":
        privacy, swept = "paper", {"bandwidth": 1}
    names = {"estimator": estimator, "parameters": parameters, "privacy": privacy}
    return {**names, **BASE, **swept}


def curve_of(field: str | None, estimator: str, setting: Setting) -> list[dict[str, Any]]:
    """Return the labels of the cells along a sweep, or of the one at the base point."""
    swept = [{field: value} for value in SWEEPS[field]] if field is not None else [{}]
    return [labels_of(estimator, setting, **each) for each in swept]


def cells_of(estimator: str, setting: Setting) -> list[dict[str, Any]]:
    """Return the labels of the cells of all sweeps."""
    return once(each for field in SWEEPS for each in curve_of(field, estimator, setting))


def once(many: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return labels without those that come again."""
    return list({tuple(labels.values()): labels for labels in many}.values())


PAIRS = [(name, setting) for setting in SETTINGS for name in ESTIMATORS]
CELLS = tuple(
    Cell(ENV, SCHEDULE, keywords=labels, labels=labels)
    for labels in once(each for pair in PAIRS for each in cells_of(*pair))
)


class Stopwatch:
    """Adds up the time spent in some methods of an object."""

    def __init__(self, timed: Any, names: Sequence[str]) -> None:
        """Replace the methods of this object by timed methods."""
        self.seconds = 0.0
        for name in names:
            setattr(timed, name, self._timed(getattr(timed, name)))

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(*args, **keywords)
            finally:
                self.seconds += time.perf_counter() - start

        return call


def _make_env(labels: Labels, place: Place) -> gym.Env[Any, Any]:
    with quietly():
        return gym.make(ENV, **labels, traffic_seeds=list(SEEDS), records=place.records)


def measure_run_time(place: Place) -> pl.DataFrame:
    """Return the mean time of a step [s] of each estimator in each of some episodes.

    They are played one at a time in this process, estimators in turns, so that a drift of the
    machine hits them all alike. The estimate at the reset is counted with the steps.
    """
    record(corridor_of(CELLS[0]), SEEDS[:N_TIMED], place.records)
    timed = []
    for labels in once(labels_of(*pair) for pair in PAIRS):
        env = _make_env(labels, place)
        evaluate(env, SCHEDULE, SEEDS[:1])  # kernels load before anything counts
        process = unwrap(env).process
        watch = Stopwatch(process.estimator, ("predict", "update", "estimate"))
        timed.append((labels, env, process, watch))
    version, rows = {"version": dptse_env.__version__}, []
    for seed in SEEDS[:N_TIMED]:
        for labels, env, process, watch in timed:
            watch.seconds = 0.0
            evaluate(env, SCHEDULE, [seed])
            seconds = watch.seconds / float(process.elapsed[0])
            rows.append({**version, **labels, "traffic_seed": seed, SECONDS: seconds})
    return pl.DataFrame(rows)


class _Watch:
    """Keeps the densities of an episode."""

    def __init__(self, process: QueryProcess) -> None:
        self._process, self._history = process, History.empty(process)

    def __call__(self) -> None:
        self._history.append(self._process)

    def rows(self) -> list[Row]:
        return [{name: getattr(self._history, name) for name in MAPS}]


def measure_space_time(place: Place) -> pl.DataFrame:
    """Return true and estimated densities of an episode of each estimator, to 1 veh/km."""
    record(corridor_of(CELLS[0]), SEEDS[:1], place.records)
    rows = []
    for labels in once(labels_of(*pair, bandwidth=PICTURE_SEGMENTS) for pair in PAIRS):
        (row,) = evaluate(_make_env(labels, place), SCHEDULE, SEEDS[:1], watchers=[_Watch])
        maps = {name: np.rint(row[name][::EVERY]).astype(int).tolist() for name in MAPS}
        rows.append({"version": dptse_env.__version__, **labels, **row, **maps})
    return pl.DataFrame(rows).select("version", *CELLS[0].labels, "traffic_seed", DENSITY, *MAPS)


class Curve(NamedTuple):
    """A column of the rows of an estimator, along a sweep or at the base point."""

    estimator: str
    metric: str = DENSITY
    field: str | None = None


class Found:
    """Rows and run times by cell.

    Args:
        rows: The rows of the study.
        times: The run times; None if they were not measured.
    """

    def __init__(self, rows: pl.DataFrame, times: pl.DataFrame | None = None) -> None:
        """Sort both by cell."""
        self._rows, self._times = _by_cell(rows), {} if times is None else _by_cell(times)

    def cell(self, labels: Labels, metric: str) -> tuple[str, dict[int, float]]:
        """Return the version that played a cell, and a column of its rows by traffic seed.

        Raises:
            UnmeasuredError: It was not played.
        """
        columns = (self._times if metric == SECONDS else self._rows).get(tuple(labels.values()))
        if columns is None:
            raise UnmeasuredError(labels, metric)
        values = zip(columns["traffic_seed"], columns[metric], strict=True)
        return columns["version"][0], dict(values)

    def curves(self, setting: Setting, *curves: Curve) -> list[FloatArray]:
        """Return curves (n_points, n_seeds), paired on the seeds that all their cells have.

        Raises:
            UnmeasuredError: A cell was not played, or not by the version of the others.
        """
        found: list[list[dict[int, float]]] = []
        versions = set()
        for estimator, metric, field in curves:
            found.append([])
            for labels in curve_of(field, estimator, setting):
                version, values = self.cell(labels, metric)
                versions.add(version)
                found[-1].append(values)
        seeds = sorted(set.intersection(*(set(point) for curve in found for point in curve)))
        if len(versions) > 1 or len(seeds) < 2:
            raise UnmeasuredError(curves, versions)
        return [np.array([[point[seed] for seed in seeds] for point in curve]) for curve in found]


def _by_cell(table: pl.DataFrame) -> dict[tuple[Any, ...], dict[str, list[Any]]]:
    found = {}
    for each in CELLS:
        with contextlib.suppress(UnmeasuredError):
            rows = pick(table, each.labels)
            found[tuple(each.labels.values())] = rows.to_dict(as_series=False)
    return found


# Statistics of curves (n_points, n_seeds), each as an interval over seeds.


def slope(curve: FloatArray) -> Interval:
    """Return the least-squares slope over the number of CV segments."""
    return mean_interval(np.polyfit(SWEEPS["bandwidth"], curve, 1)[0])


def level(curve: FloatArray) -> Interval:
    """Return the mean over points."""
    return mean_interval(curve.mean(axis=0))


def gap(a: FloatArray, b: FloatArray) -> Interval:
    """Return the mean of a curve minus that of another."""
    return paired_difference(a.mean(axis=0), b.mean(axis=0))


def excess(a: FloatArray, b: FloatArray) -> Interval:
    """Return by how much the mean of a curve exceeds that of another [%]."""
    return mean_interval(100.0 * (a.mean(axis=0) / b.mean(axis=0) - 1.0))


def growth(curve: FloatArray, low: int = 0, high: int = -1) -> Interval:
    """Return by how much one point of a curve exceeds another [%]."""
    return mean_interval(100.0 * (curve[low] / curve[high] - 1.0))


def roughness_gap(a: FloatArray, b: FloatArray) -> Interval:
    """Return the mean size of second differences along a curve minus that along another."""
    return paired_difference(*(np.abs(np.diff(y, n=2, axis=0)).mean(axis=0) for y in (a, b)))


def fall_gap(a: FloatArray, b: FloatArray) -> Interval:
    """Return the fall of a curve from end to end minus that of another."""
    return paired_difference(a[0] - a[-1], b[0] - b[-1])


def correlation(a: FloatArray, b: FloatArray) -> Interval:
    """Return Pearson's correlation of two curves, by Fisher's transformation."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    each = (a * b).sum(axis=0) / np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    # A perfect correlation would go to infinity.
    z = mean_interval(np.arctanh(np.clip(each, -1.0 + 1e-9, 1.0 - 1e-9)))
    return Interval(math.tanh(z.mean), math.tanh(z.low), math.tanh(z.high), z.n)


def ratio(a: FloatArray, b: FloatArray) -> Interval:
    """Return the geometric mean of the ratio of two single points."""
    return geometric_mean_interval(a[0] / b[0])


class Part(NamedTuple):
    """One measured number of a claim: a statistic of some curves."""

    name: str
    statistic: Callable[..., Interval]
    curves: tuple[Curve, ...]


def of_each(
    statistic: Callable[..., Interval], *kinds: tuple[str, str], over: str = ""
) -> list[Part]:
    """Return a part for each of the paper's estimators, of its curves (metric, field)."""
    return [
        Part(LABELS[name] + over, statistic, tuple(Curve(name, *kind) for kind in kinds))
        for name in PAPER_ESTIMATORS
    ]


def of_pairs(
    statistic: Callable[..., Interval],
    pairs: Iterable[tuple[str, str]],
    metric: str = DENSITY,
    field: str | None = "bandwidth",
    over: str = "",
) -> list[Part]:
    """Return a part for each pair of estimators, of the same curve of both."""
    return [
        Part(
            f"{LABELS[a]}, {LABELS[b]}{over}",
            statistic,
            (Curve(a, metric, field), Curve(b, metric, field)),
        )
        for a, b in pairs
    ]


def against(name: str) -> list[tuple[str, str]]:
    """Return the pairs of an estimator with each other one of the paper."""
    return [(name, other) for other in PAPER_ESTIMATORS if other != name]


class Claim(NamedTuple):
    """A statement of the paper, what is measured, and the range that it must lie in."""

    statement: str
    quantity: str
    low: float
    high: float
    parts: list[Part]


SLOPE = "slope of the RMSE over the number of CV segments"
GAP = "first minus second, mean RMSE over the numbers of CV segments"
APART = "first above second, mean RMSE over the numbers of CV segments [%]"
PRIVACY_GAP = "first minus second, mean density RMSE over the values of ε or δ [veh/km]"
INF = math.inf
ONE = SWEEPS["epsilon"].index(BASE["epsilon"])
CLAIMS = (
    Claim("P1. The density error of every technique falls with more CV segments.",
          f"{SLOPE} [veh/km]", -INF, 0.0, of_each(slope, (DENSITY, "bandwidth"))),
    Claim("P2. The speed error of every technique falls with more CV segments.",
          f"{SLOPE} [km/h]", -INF, 0.0, of_each(slope, (SPEED, "bandwidth"))),
    Claim("P3. UKF performs best in density.",
          f"{GAP} [veh/km]", -INF, 0.0, of_pairs(gap, against("ukf"))),
    Claim("P4. UKF performs best in speed.",
          f"{GAP} [km/h]", -INF, 0.0, of_pairs(gap, against("ukf"), SPEED)),
    Claim("P5. EnKF performs worst in density.",
          f"{GAP} [veh/km]", 0.0, INF, of_pairs(gap, against("enkf"))),
    Claim("P6. EnKF performs worst in speed.",
          f"{GAP} [km/h]", 0.0, INF, of_pairs(gap, against("enkf"), SPEED)),
    Claim("P7. In density, MHE and EKF follow UKF closely.",
          APART, -CLOSE, CLOSE, of_pairs(excess, (("mhe", "ukf"), ("ekf", "ukf")))),
    Claim("P8. In speed, EKF follows UKF closely.",
          APART, -CLOSE, CLOSE, of_pairs(excess, [("ekf", "ukf")], SPEED)),
    Claim("P9. MHE falls behind EKF in speed.",
          f"{GAP} [km/h]", 0.0, INF, of_pairs(gap, [("mhe", "ekf")], SPEED)),
    Claim("P10. EKF and MHE perform comparably.", APART, -CLOSE, CLOSE, [
              part for metric, (name, _) in METRICS.items()
              for part in of_pairs(excess, [("mhe", "ekf")], metric, over=f", {name}")
          ]),
    Claim("P11. EnKF's error varies more from one number of CV segments to the next.",
          "first minus second, mean size of second differences of the density RMSE [veh/km]",
          0.0, INF, of_pairs(roughness_gap, against("enkf"))),
    *(
        Claim(f"{key}. {LABELS[name]} performs {rank} in density under other ε and δ, too.",
              PRIVACY_GAP, *ends, [
                  part for field in PRIVACY
                  for part in of_pairs(gap, against(name), DENSITY, field, f", over {AXES[field]}")
              ])
        for key, name, rank, ends in (
            ("P12", "ukf", "best", (-INF, 0.0)), ("P13", "enkf", "worst", (0.0, INF)),
        )
    ),
    Claim("P14. All techniques vary similarly with privacy.",
          "correlation of the density RMSE of both along ε", SIMILAR, INF,
          of_pairs(correlation, combinations(PAPER_ESTIMATORS, 2), DENSITY, "epsilon")),
    Claim("P15. The speed error varies with ε and δ as the density error does.",
          "correlation of density and speed RMSE along ε or δ", SIMILAR, INF, [
              part for field in PRIVACY
              for part in of_each(correlation, (DENSITY, field), (SPEED, field),
                                  over=f", over {AXES[field]}")
          ]),
    Claim("P16. ε has more influence than δ.",
          "fall of the density RMSE from end to end, along ε minus along δ [veh/km]",
          0.0, INF, of_each(fall_gap, (DENSITY, "epsilon"), (DENSITY, "delta"))),
    Claim("P17. The variation is small over the full range of δ.",
          "excess of the density RMSE at the lowest δ over that at the highest [%]",
          -SMALL, SMALL, of_each(growth, (DENSITY, "delta"))),
    Claim("P18. The variation is small for ε above 1.",
          "excess of the density RMSE at ε = 1 over that at the highest ε [%]",
          -SMALL, SMALL, of_each(partial(growth, low=ONE), (DENSITY, "epsilon"))),
    Claim("P19. The error worsens quickly as ε goes from 1 towards 0.",
          "excess of the density RMSE at the lowest ε over that at ε = 1 [%]",
          SMALL, INF, of_each(partial(growth, high=ONE), (DENSITY, "epsilon"))),
    Claim("P20. A step takes UKF the least time, then EnKF, MHE and EKF.",
          "time of a step of the first over that of the second", -INF, 1.0,
          of_pairs(ratio, pairwise(("ukf", "enkf", "mhe", "ekf")), SECONDS, None)),
)  # fmt: skip
"""Claims of the paper's section on results, in its order."""

HOLDS, FAILS, OPEN = "holds", "does not hold", "undecided"
SIGNS = {HOLDS: "✓", FAILS: "✗", OPEN: "?"}


def judge(interval: Interval, low: float, high: float) -> str:
    """Return whether an interval lies inside a range, outside of it, or across one of its ends."""
    if low < interval.low and interval.high < high:
        return HOLDS
    return FAILS if interval.high < low or interval.low > high else OPEN


def measure(found: Found, claim: Claim, setting: Setting, part: Part) -> tuple[Interval, str]:
    """Return the interval of a part of a claim, and its verdict.

    Raises:
        UnmeasuredError: It needs a cell that was not played.
    """
    interval = part.statistic(*found.curves(setting, *part.curves))
    return interval, judge(interval, claim.low, claim.high)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the figures."""
    times = folder / RUN_TIME
    found = Found(rows, read_table(times, (*CELLS[0].labels, SECONDS)) if times.exists() else None)
    draw_sweeps(found, folder / "fig1_cv_segments.png", "bandwidth", METRICS, columns=4)
    draw_sweeps(found, folder / "fig3_epsilon.png", "epsilon", [DENSITY], columns=2)
    draw_sweeps(found, folder / "fig4_delta.png", "delta", [DENSITY], columns=2)
    draw_times(found, folder / "fig5_run_time.png")
    if (folder / SPACE_TIME).exists():
        draw_space_time(read_table(folder / SPACE_TIME, MAPS), folder / "fig2_space_time.png")
    return tables_of(found)


def tables_of(found: Found) -> str:
    """Return the verdicts, the errors and times at the base point, and each claim in numbers."""

    def verdict(claim: Claim, setting: Setting) -> str:
        verdicts = [measure(found, claim, setting, part)[1] for part in claim.parts]
        worst = next((each for each in (FAILS, OPEN) if each in verdicts), HOLDS)
        return f"{worst} ({verdicts.count(HOLDS)} of {len(verdicts)})"

    def error(metric: str, name: str, setting: Setting) -> str:
        curve, walk = Curve(name, metric), Curve("random_walk", metric)
        text = format_interval(level(*found.curves(setting, curve)))
        if curve == walk:
            return text
        above = excess(*found.curves(setting, curve, walk))
        return f"{text}; {above.mean:+.1f} ± {above.half_width:.1f} %"

    def milliseconds(name: str, setting: Setting) -> str:
        own, ekf = found.curves(setting, Curve(name, SECONDS), Curve("ekf", SECONDS))
        text = format_interval(geometric_mean_interval(1e3 * own[0]))
        return f"{text}; {ratio(own, ekf).mean:.2f}"

    def timed(name: str) -> str:
        if name not in PAPER_SECONDS:
            return LABELS[name]
        seconds, ekf = PAPER_SECONDS[name], PAPER_SECONDS["ekf"]
        return f"{LABELS[name]} (the paper: {1e3 * seconds:g}; {seconds / ekf:.2f})"

    def lost(name: str, setting: Setting) -> str:
        cells, counts = cells_of(name, setting), []
        for column in LOST:
            episodes = [each for labels in cells for each in found.cell(labels, column)[1].values()]
            counts.append(f"{sum(episodes):.0f}")
        return f"{' / '.join(counts)} in {len(episodes)}"

    def measured(claim: Claim, part: Part, setting: Setting) -> str:
        interval, verdict = measure(found, claim, setting, part)
        return f"{format_interval(interval)} {SIGNS[verdict]}"

    text = [
        "# The paper's results",
        "## Claims of the paper, and how many of their parts hold",
        by_setting("claim", CLAIMS, verdict, lambda claim: claim.statement),
    ]
    for metric, (name, unit) in METRICS.items():
        text += [
            f"## RMSE of {name} [{unit}], and by how much it exceeds the random walk's",
            by_setting("estimator", ESTIMATORS, partial(error, metric), LABELS.__getitem__),
        ]
    text += [
        "## Time of a step [ms], and over the EKF's",
        by_setting("estimator", ESTIMATORS, milliseconds, timed),
        "## Seconds started anew / seconds without an update / requests dropped, in episodes",
        by_setting("estimator", ESTIMATORS, lost, LABELS.__getitem__),
        "## Each claim in numbers: ✓ holds, ✗ does not hold, ? undecided",
    ]
    for claim in CLAIMS:
        text += [
            f"### {claim.statement}",
            f"{claim.quantity}, in ({claim.low:g}, {claim.high:g})",
            by_setting("part", claim.parts, partial(measured, claim), lambda part: part.name),
        ]
    return "\n\n".join(text)


def by_setting(
    corner: str,
    rows: Iterable[Any],
    entry: Callable[[Any, Setting], str],
    name: Callable[[Any], str],
) -> str:
    """Return a table of what ``entry`` gives for each row and setting."""
    return markdown(
        [corner, *map(str, SETTINGS)],
        [[name(row), *(cell(entry, row, setting) for setting in SETTINGS)] for row in rows],
    )


def draw_sweeps(found: Found, path: Path, field: str, metrics: Iterable[str], columns: int) -> None:
    """Draw errors along a sweep, a panel for each metric and setting, with 95 % intervals."""
    panels = [(metric, setting) for metric in metrics for setting in SETTINGS]
    figure = make_figure(2.0 * columns + 4.4, 2.6 * len(panels) / columns + 0.8, DPI)
    axes = figure.subplots(len(panels) // columns, columns, squeeze=False)
    for axis, (metric, setting) in zip(axes.flat, panels, strict=True):
        for k, name in enumerate(ESTIMATORS[:-1]):
            with contextlib.suppress(UnmeasuredError):
                (curve,) = found.curves(setting, Curve(name, metric, field))
                places = shifted(SWEEPS[field], 0.01 * (k - 2), field in PRIVACY)
                intervals = [mean_interval(values) for values in curve]
                draw_curve(axis, places, intervals, ESTIMATOR_LOOKS[name], LABELS[name])
        axis.set_title(str(setting), fontsize=9, loc="left")
        axis.set_xticks(SWEEPS[field])
        if field in PRIVACY:
            axis.set_xscale("log")
            set_log_ticks(axis.xaxis, SWEEPS[field])
        if field == "epsilon":
            axis.set_yscale("log")
            set_log_ticks(axis.yaxis, ERROR_TICKS)
        with contextlib.suppress(UnmeasuredError):
            alone = level(*found.curves(setting, Curve("open_loop", metric)))
            if field == "epsilon":
                draw_level(axis, alone, label=LABELS["open_loop"])
            else:
                axis.annotate(
                    f"open loop {alone.mean:.1f}, off the scale", (0.98, 0.98), fontsize=7.5,
                    xycoords="axes fraction", ha="right", va="top",
                )  # fmt: skip
                axis.margins(y=0.12)
        add_frame(axis)
    for axis, (metric, _) in zip(axes[:, 0], panels[::columns], strict=True):
        axis.set_ylabel(error_label(metric))
    for axis in axes[-1]:
        axis.set_xlabel(AXES[field])
    add_legend(figure, axes.flat, columns=6)
    fixed = ", ".join(f"{AXES[name]} = {value:g}" for name, value in BASE.items() if name != field)
    save_figure(figure, path, f"Error against {AXES[field]}; {fixed}")


def draw_space_time(table: pl.DataFrame, path: Path) -> None:
    """Draw maps of density: truth on top, then each estimator; a column for each setting."""
    corridor = corridor_of(CELLS[0])
    figure = make_figure(2.4 * len(SETTINGS) + 0.8, 6.4, DPI)
    panels = figure.subplots(1 + len(ESTIMATORS), len(SETTINGS), sharex=True, sharey=True)
    for k, setting in enumerate(SETTINGS):
        for axis, name in zip(panels[:, k], ("truth", *ESTIMATORS), strict=True):
            estimator = ESTIMATORS[0] if name == "truth" else name
            labels = labels_of(estimator, setting, bandwidth=PICTURE_SEGMENTS)
            (row,) = pick(table, labels).iter_rows(named=True)
            title = str(setting) if name == "truth" else f"{LABELS[name]}, {row[DENSITY]:.1f}"
            axis.set_title(title, loc="left", fontsize=8, pad=2)
            axis.tick_params(labelsize=7)
            image = axis.imshow(
                np.transpose(row["truth" if name == "truth" else "estimate"]),
                origin="lower", aspect="auto", interpolation="nearest", cmap=DENSITY_MAP,
                extent=(0.0, corridor.duration, 0.0, corridor.n_mainline * corridor.segment_length),
                vmin=0.0, vmax=corridor.density_scale,
            )  # fmt: skip
        axis.set_xlabel("time [s]", fontsize=8)
    for axis in panels[:, 0]:
        axis.set_ylabel("road [km]", fontsize=7)
    bar = figure.colorbar(image, ax=panels.ravel().tolist(), fraction=0.02, pad=0.01, extend="max")
    bar.set_label("density [veh/km]", fontsize=8)
    title = "True density, and estimates below it with their RMSE [veh/km]"
    more = f"traffic seed {SEEDS[0]}, {PICTURE_SEGMENTS} CV segments, dptse-env {row['version']}"
    save_figure(figure, path, f"{title}; {more}")


def draw_times(found: Found, path: Path) -> None:
    """Draw the time of a step beside the paper's."""
    figure = make_figure(6.4, 3.9, DPI)
    axis = figure.subplots()
    places = np.arange(len(ESTIMATORS))[::-1]
    for k, setting in enumerate(SETTINGS):
        for place, name in zip(places + 0.24 - 0.16 * k, ESTIMATORS, strict=True):
            with contextlib.suppress(UnmeasuredError):
                (seconds,) = found.curves(setting, Curve(name, SECONDS))
                mean = geometric_mean_interval(1e3 * seconds[0])
                axis.errorbar(
                    [mean.mean], [place], xerr=spread([mean]), fmt="o", markersize=4, capsize=2,
                    color=SHADES[k], label=f"here, {setting}",
                )  # fmt: skip
    axis.plot(
        [1e3 * seconds for seconds in PAPER_SECONDS.values()], places[: len(PAPER_SECONDS)],
        linestyle="none", marker="x", color="#000000", label="the paper",
    )  # fmt: skip
    axis.set_yticks(places, [LABELS[name] for name in ESTIMATORS])
    axis.set_xscale("log")
    axis.set_xlabel("time of a step [ms]")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    add_frame(axis, "x")
    add_legend(figure, [axis], columns=2)
    save_figure(figure, path, "Time of predict, update and estimate, one episode at a time")


STUDY = Study(
    "paper",
    CELLS,
    SEEDS,
    report,
    measures={RUN_TIME: measure_run_time, SPACE_TIME: measure_space_time},
)
