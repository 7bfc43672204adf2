"""The paper's five results, and a verdict on each of its claims.

S. C. Vishnoi, A. F. Taha, S. A. Nugroho and C. G. Claudel, "On Differential Privacy and Traffic
State Estimation Problem for Connected Vehicles": errors against the number of CV segments, a map of
density over space and time, density error against epsilon and against delta, and the time of a
step. Each is played under the noise as printed (``printed``) and as the paper's theorem needs it
(``corrected``), with the paper's ARZ parameters and with calibrated ones (``w99-3lane``).

A claim has parts. A part is one number for each traffic seed, in most cases a difference of two
errors on the same traffic and the same noise. It holds if the 95 % interval of its mean lies inside
the claim's range, does not hold if the interval lies outside, and is undecided otherwise. A claim
holds if all its parts hold, and does not hold if one of them does not.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import polars as pl
from matplotlib.figure import Figure

from agents.environments import PAPER, quietly
from agents.figures import (
    COLOURS,
    ERROR_TICKS,
    ESTIMATOR_LOOKS,
    LABELS,
    WIDTH,
    Look,
    RoadMap,
    draw_curve,
    draw_maps,
    finish_figure,
    make_figure,
    save_measured,
    set_log,
    shifted,
)
from agents.page import watch
from agents.play import Cell, record
from agents.statistics import Interval, mean_interval
from agents.study import Place, Study, read_table
from agents.tables import (
    DENSITY,
    METRICS,
    SPEED,
    error_label,
    format_interval,
    format_range,
    paired,
    pick,
    table,
)
from dptse_env.evaluation import evaluate
from dptse_env.rendering import History
from dptse_env.utils.arrays import FloatArray
from dptse_env.versions import code_version

SCHEDULE = "shift-ahead"
SEEDS = tuple(range(2000, 2020))
PAPER_ESTIMATORS = ("ekf", "ukf", "enkf", "mhe")
"""The paper's estimators, in its order."""
ESTIMATORS = (*PAPER_ESTIMATORS, "random_walk", "open_loop")
"""Two more in every result: without a traffic model, and without measurements."""
AS_PUBLISHED = {f"{name}-published": name for name in PAPER_ESTIMATORS}
"""The paper's estimators with its own settings, at the base point, by their labels; others are
tuned as ours."""
BASE = {"epsilon": 1.0, "delta": 0.05, "bandwidth": 5}
"""The paper's privacy, and its fewest CV segments, wherever they are not swept."""
SWEEPS: dict[str, tuple[float, ...]] = {
    "bandwidth": (5, 6, 7, 8, 9, 10, 11),
    "epsilon": (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0, 10.0),
    "delta": (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.2),
}
"""Values of results 1, 3 and 4, by the keyword that varies."""
AXES = {"bandwidth": "CV segments", "epsilon": "ε", "delta": "δ"}
PAPER_SECONDS = {"ekf": 0.06, "ukf": 0.026, "enkf": 0.040, "mhe": 0.045}
"""The paper's seconds a step: MATLAB R2019b, a 3.6 GHz i7-7700."""
CLOSE, SMALL, SIMILAR = 5.0, 10.0, 0.9
"""Bounds that the paper leaves open, fixed before the full run after a look at three traffic seeds:
errors are close within this [%], a variation is small below this [%], and curves are similar if
their correlation along the grid exceeds this."""
SECONDS = "seconds"
N_TIMED = 10
"""Traffic seeds behind each time of a step."""
MAP_SEGMENTS, MAP_STEP = 7, 5
"""CV segments of result 2, and seconds between two columns of its maps."""
RUN_TIME, SPACE_TIME = "run_time.parquet", "space_time.parquet"
SETTINGS = {
    f"{privacy} noise, {parameters} parameters": {"parameters": parameters, "privacy": privacy}
    for privacy, parameters in itertools.product(
        ("printed", "corrected"), ("published", "w99-3lane")
    )
}
"""Choices that the paper leaves open, by name; each result is shown under all of them."""


def labels_of(estimator: str, setting: str, **swept: float) -> dict[str, Any]:
    """Return the labels of a cell.

    The open loop uses no release, so one cell stands for all privacy and all queries.
    """
    labels = {"estimator": estimator, **SETTINGS[setting], **BASE, **swept}
    if estimator == "open_loop":
        labels |= {"privacy": "printed", **BASE, "bandwidth": 1}
    return labels


def labels_along(field: str | None, estimator: str, setting: str) -> list[dict[str, Any]]:
    """Return the labels of the cells along a sweep, or of the one at the base point."""
    swept = [{field: value} for value in SWEEPS[field]] if field is not None else [{}]
    return [labels_of(estimator, setting, **each) for each in swept]


def once(many: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return labels without those that come again."""
    return list({tuple(labels.values()): labels for labels in many}.values())


def keywords_of(labels: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of a cell: its labels, and which settings its estimator has."""
    name = labels["estimator"]
    settings = "published" if name in AS_PUBLISHED else None
    return {
        **labels, "estimator": AS_PUBLISHED.get(name, name), "estimator_settings": settings,
    }  # fmt: skip


PAIRS = [(name, setting) for setting in SETTINGS for name in ESTIMATORS]
CELLS = tuple(
    Cell(PAPER, SCHEDULE, keywords=keywords_of(labels), labels=labels)
    for labels in once(
        [
            *(each for pair in PAIRS for field in SWEEPS for each in labels_along(field, *pair)),
            *(labels_of(name, setting) for setting in SETTINGS for name in AS_PUBLISHED),
        ]
    )
)


def time_methods(timed: Any, names: Sequence[str]) -> list[float]:
    """Replace methods of an object by ones that append their time [s] to the list returned."""
    seconds: list[float] = []

    def call(method: Callable[..., Any], *args: Any, **keywords: Any) -> Any:
        start = time.perf_counter()
        found = method(*args, **keywords)
        seconds.append(time.perf_counter() - start)
        return found

    for name in names:
        setattr(timed, name, partial(call, getattr(timed, name)))
    return seconds


def measure_run_time(place: Place) -> pl.DataFrame:
    """Return the mean time of a step [s] of each estimator in each of some episodes.

    They are played one at a time in this process, estimators in turns, so that a drift of the
    machine hits them all alike. The estimate at the reset is counted with the steps.
    """
    record(CELLS[0].config.corridor, SEEDS[:N_TIMED], place.records)
    timed = []
    for labels in once(labels_of(*pair) for pair in PAIRS):
        with quietly():
            keywords = {**keywords_of(labels), "traffic_seeds": list(SEEDS)}
            env = gym.make(PAPER, **keywords, records=place.records)
        evaluate(env, SCHEDULE, SEEDS[:1])  # kernels load before anything counts
        process = env.get_wrapper_attr("process")
        seconds = time_methods(process.estimator, ("predict", "update", "estimate"))
        timed.append((labels, env, process, seconds))
    version, rows = {"version": code_version()}, []
    for seed in SEEDS[:N_TIMED]:
        for labels, env, process, seconds in timed:
            seconds.clear()
            evaluate(env, SCHEDULE, [seed])
            step = sum(seconds) / float(process.elapsed[0])
            rows.append({**version, **labels, "traffic_seed": seed, SECONDS: step})
    return pl.DataFrame(rows)


def measure_space_time(place: Place) -> pl.DataFrame:
    """Return true and estimated densities of an episode of each estimator, to 1 veh/km."""
    record(CELLS[0].config.corridor, SEEDS[:1], place.records)
    rows = []
    for labels in once(labels_of(*pair, bandwidth=MAP_SEGMENTS) for pair in PAIRS):
        cell = Cell(PAPER, SCHEDULE, keywords_of(labels))
        watched = watch(SCHEDULE, cell, SEEDS[0], place.records)
        row = {"version": code_version(), **labels}
        row |= {name: watched.row[name] for name in ("traffic_seed", DENSITY)}
        for name in ("truth", "estimate"):
            densities = np.array(getattr(watched.history, name))[::MAP_STEP]
            row[name] = np.rint(densities).astype(int).tolist()
        rows.append(row)
    return pl.DataFrame(rows)


class Curve(NamedTuple):
    """A column of the rows of an estimator, along a sweep or at the base point."""

    estimator: str
    metric: str = DENSITY
    field: str | None = None


def with_times(rows: pl.DataFrame, times: pl.DataFrame) -> pl.DataFrame:
    """Return rows with the times of a step, where there are."""
    keys = [*CELLS[0].labels, "traffic_seed"]
    return rows.join(times.drop("version"), keys, "left", maintain_order="left")


def curves_of(rows: pl.DataFrame, setting: str, *wanted: Curve) -> list[FloatArray]:
    """Return curves (n_points, n_seeds), paired by traffic seed.

    Raises:
        UnmeasuredError: A cell was not played, or not with the numbers of the rest.
    """
    rows = rows.drop_nulls({curve.metric for curve in wanted})
    groups = [
        (metric, labels_along(field, estimator, setting)) for estimator, metric, field in wanted
    ]
    return paired(rows, *groups)


class Statistic(NamedTuple):
    """A number taken of curves (n_points, n_seeds).

    Attributes:
        quantity: What it is.
        values: Returns a number for each traffic seed, on the scale on which its mean is taken.
        back: Returns the number on its own scale.
    """

    quantity: str
    values: Callable[..., FloatArray]
    back: Callable[[float], float] = float

    def measure(self, *curves: FloatArray) -> Interval:
        """Return the mean over traffic seeds with its interval."""
        found = mean_interval(self.values(*curves))
        mean, low, high = map(self.back, (found.mean, found.low, found.high))
        return Interval(mean, low, high, found.n)


def correlations(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Pearson's correlation of two curves for each seed, by Fisher's transformation."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    each = (a * b).sum(axis=0) / np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    # A perfect correlation would go to infinity.
    found: FloatArray = np.arctanh(np.clip(each, -1.0 + 1e-9, 1.0 - 1e-9))
    return found


LEVEL = Statistic("mean RMSE", lambda y: y.mean(0))
SLOPE = Statistic(
    "slope of the RMSE [veh/km or km/h]", lambda y: np.polyfit(SWEEPS["bandwidth"], y, 1)[0]
)
GAP = Statistic(
    "mean RMSE of the first minus that of the second [veh/km or km/h]",
    lambda a, b: a.mean(0) - b.mean(0),
)
EXCESS = Statistic(
    "mean RMSE of the first above that of the second [%]",
    lambda a, b: 100.0 * (a.mean(0) / b.mean(0) - 1.0),
)
ROUGHNESS = Statistic(
    "mean size of second differences of the RMSE, first minus second [veh/km]",
    lambda a, b: np.subtract(*(np.abs(np.diff(y, n=2, axis=0)).mean(0) for y in (a, b))),
)
FALL = Statistic(
    "fall of the RMSE from end to end, first minus second [veh/km]",
    lambda a, b: (a[0] - a[-1]) - (b[0] - b[-1]),
)
CORRELATION = Statistic("correlation of both RMSE", correlations, math.tanh)
TIME = Statistic("time of a step [ms]", lambda y: np.log(1e3 * y[0]), math.exp)
RATIO = Statistic("first over second", lambda a, b: np.log(a[0] / b[0]), math.exp)


def growth(field: str, low: float, high: float) -> Statistic:
    """Return by how much the error at one value of a sweep exceeds that at another [%]."""
    a, b = (SWEEPS[field].index(value) for value in (low, high))
    quantity = f"RMSE at {AXES[field]} = {low:g} above that at {high:g} [%]"
    return Statistic(quantity, lambda y: 100.0 * (y[a] / y[b] - 1.0))


Part = tuple[Curve, ...]
"""Curves of which a statistic is taken."""
Kind = tuple[str, str | None]
"""Metric and field of a curve."""
DENSITIES, SPEEDS = (DENSITY, "bandwidth"), (SPEED, "bandwidth")
BY_EPSILON, BY_DELTA = (DENSITY, "epsilon"), (DENSITY, "delta")


def each_of(*kinds: Kind) -> list[Part]:
    """Return a part for each of the paper's estimators, of its curves."""
    return [tuple(Curve(name, *kind) for kind in kinds) for name in PAPER_ESTIMATORS]


def pairs_of(pairs: Iterable[tuple[str, str]], *kinds: Kind) -> list[Part]:
    """Return a part for each kind of curve and pair of estimators, of the curves of both."""
    pairs = list(pairs)
    return [(Curve(a, *kind), Curve(b, *kind)) for kind in kinds for a, b in pairs]


def against(name: str, *kinds: Kind) -> list[Part]:
    """Return `pairs_of` an estimator and each other one of the paper."""
    return pairs_of([(name, other) for other in PAPER_ESTIMATORS if other != name], *kinds)


def name_of(part: Part) -> str:
    """Return the estimators of a part, what is measured, and what varies."""
    estimators = dict.fromkeys(LABELS[curve.estimator] for curve in part)
    kinds = dict.fromkeys(
        f"{METRICS[metric][0]} over {AXES[field]}" if field else "time of a step"
        for _, metric, field in part
    )
    return f"{', '.join(estimators)}: {', '.join(kinds)}"


class Claim(NamedTuple):
    """A statement of the paper, what is measured, and the range that it must lie in."""

    statement: str
    statistic: Statistic
    low: float
    high: float
    parts: list[Part]


INF = math.inf
CLAIMS = (
    Claim("P1. The density error of every technique falls with more CV segments.",
          SLOPE, -INF, 0.0, each_of(DENSITIES)),
    Claim("P2. The speed error of every technique falls with more CV segments.",
          SLOPE, -INF, 0.0, each_of(SPEEDS)),
    Claim("P3. UKF performs best in density.", GAP, -INF, 0.0, against("ukf", DENSITIES)),
    Claim("P4. UKF performs best in speed.", GAP, -INF, 0.0, against("ukf", SPEEDS)),
    Claim("P5. EnKF performs worst in density.", GAP, 0.0, INF, against("enkf", DENSITIES)),
    Claim("P6. EnKF performs worst in speed.", GAP, 0.0, INF, against("enkf", SPEEDS)),
    Claim("P7. In density, MHE and EKF follow UKF closely.",
          EXCESS, -CLOSE, CLOSE, pairs_of([("mhe", "ukf"), ("ekf", "ukf")], DENSITIES)),
    Claim("P8. In speed, EKF follows UKF closely.",
          EXCESS, -CLOSE, CLOSE, pairs_of([("ekf", "ukf")], SPEEDS)),
    Claim("P9. MHE falls behind EKF in speed.", GAP, 0.0, INF, pairs_of([("mhe", "ekf")], SPEEDS)),
    Claim("P10. EKF and MHE perform comparably.",
          EXCESS, -CLOSE, CLOSE, pairs_of([("mhe", "ekf")], DENSITIES, SPEEDS)),
    Claim("P11. EnKF's error varies more from one number of CV segments to the next.",
          ROUGHNESS, 0.0, INF, against("enkf", DENSITIES)),
    Claim("P12. UKF performs best in density under other ε and δ, too.",
          GAP, -INF, 0.0, against("ukf", BY_EPSILON, BY_DELTA)),
    Claim("P13. EnKF performs worst in density under other ε and δ, too.",
          GAP, 0.0, INF, against("enkf", BY_EPSILON, BY_DELTA)),
    Claim("P14. All techniques vary similarly with privacy.", CORRELATION, SIMILAR, INF,
          pairs_of(itertools.combinations(PAPER_ESTIMATORS, 2), BY_EPSILON)),
    Claim("P15. The speed error varies with ε and δ as the density error does.",
          CORRELATION, SIMILAR, INF,
          each_of(BY_EPSILON, (SPEED, "epsilon")) + each_of(BY_DELTA, (SPEED, "delta"))),
    Claim("P16. ε has more influence than δ.", FALL, 0.0, INF, each_of(BY_EPSILON, BY_DELTA)),
    Claim("P17. The variation is small over the full range of δ.",
          growth("delta", 0.001, 0.2), -SMALL, SMALL, each_of(BY_DELTA)),
    Claim("P18. The variation is small for ε above 1.",
          growth("epsilon", 1.0, 10.0), -SMALL, SMALL, each_of(BY_EPSILON)),
    Claim("P19. The error worsens quickly as ε goes from 1 towards 0.",
          growth("epsilon", 0.1, 1.0), SMALL, INF, each_of(BY_EPSILON)),
    Claim("P20. A step takes UKF the least time, then EnKF, MHE and EKF.", RATIO, -INF, 1.0,
          pairs_of(itertools.pairwise(("ukf", "enkf", "mhe", "ekf")), (SECONDS, None))),
)  # fmt: skip
"""Claims of the paper's section on results, in its order."""

HOLDS, FAILS, OPEN = "holds", "does not hold", "undecided"
SIGNS = {HOLDS: "✓", FAILS: "✗", OPEN: "?"}


def judge(interval: Interval, low: float, high: float) -> str:
    """Return whether an interval lies inside a range, outside of it, or across one of its ends."""
    if low < interval.low and interval.high < high:
        return HOLDS
    return FAILS if interval.high < low or interval.low > high else OPEN


def tables_of(rows: pl.DataFrame) -> str:
    """Return the verdicts, the errors and times at the base point, and each claim in numbers."""

    def by_setting(corner: str, lines: Mapping[str, Any], entry: Callable[..., str]) -> str:
        columns = {setting: partial(entry, setting=setting) for setting in SETTINGS}
        return table(corner, lines, columns)

    @cache
    def measure(statistic: Statistic, part: Part, setting: str) -> Interval:
        return statistic.measure(*curves_of(rows, setting, *part))

    def verdict_of(claim: Claim, part: Part, setting: str) -> str:
        return judge(measure(claim.statistic, part, setting), claim.low, claim.high)

    def verdict(claim: Claim, setting: str) -> str:
        verdicts = [verdict_of(claim, part, setting) for part in claim.parts]
        worst = next((each for each in (FAILS, OPEN) if each in verdicts), HOLDS)
        return f"{worst} ({verdicts.count(HOLDS)} of {len(verdicts)})"

    def error(metric: str, name: str, setting: str) -> str:
        own, walk = Curve(name, metric), Curve("random_walk", metric)
        text = format_interval(measure(LEVEL, (own,), setting))
        if own == walk:
            return text
        above = measure(EXCESS, (own, walk), setting)
        return f"{text}; {above.mean:+.1f} ± {above.half_width:.1f} %"

    def milliseconds(name: str, setting: str) -> str:
        return format_interval(measure(TIME, (Curve(name, SECONDS),), setting))

    def number(claim: Claim, part: Part, setting: str) -> str:
        text = format_interval(measure(claim.statistic, part, setting))
        return f"{text} {SIGNS[verdict_of(claim, part, setting)]}"

    def excess(pair: tuple[Curve, Curve], setting: str) -> str:
        above = measure(EXCESS, pair, setting)
        return f"{above.mean:+.1f} ± {above.half_width:.1f}"

    def above_best(metric: str, group: Sequence[str], name: str, setting: str) -> str:
        others = [Curve(each, metric) for each in group]
        best = min(others, key=lambda each: measure(LEVEL, (each,), setting).mean)
        return "least" if best.estimator == name else excess((Curve(name, metric), best), setting)

    names = {LABELS[name]: name for name in ESTIMATORS}
    own = {f"{LABELS[name]}, as published": label for label, name in AS_PUBLISHED.items()}
    seeds = format_range(sorted(rows["traffic_seed"].unique()))
    fixed = ", ".join(f"{AXES[key]} = {value:g}" for key, value in BASE.items())
    where = f"{fixed}, schedule `{SCHEDULE}`, traffic seeds {seeds}"
    text = [
        "# The paper's results",
        f"Claims and tables of errors are of traffic seeds {seeds}, with the schedule `{SCHEDULE}` "
        "and 95 % intervals. Estimators of one name have our settings, those *as published* the "
        "paper's own. A difference in per cent is the mean over episodes of the per cent in each, "
        "paired by traffic and noise.",
        "## Claims of the paper, and how many of their parts hold",
        by_setting("claim", {claim.statement: claim for claim in CLAIMS}, verdict),
    ]
    for metric, (name, unit) in METRICS.items():
        text += [
            f"## RMSE of {name} [{unit}], and by how much it exceeds the random walk's",
            f"At {where}.",
            by_setting("estimator", names | own, partial(error, metric)),
        ]
    for group, whose in ((PAPER_ESTIMATORS, "our"), (tuple(AS_PUBLISHED), "the paper's")):
        text += [
            f"## By how much a filter errs more than the best one, with {whose} settings [%]",
            f"At {where}.",
            by_setting(
                "filter",
                {
                    f"{LABELS[AS_PUBLISHED.get(name, name)]}: {METRICS[metric][0]}": (metric, name)
                    for metric in METRICS
                    for name in group
                },
                lambda key, setting, group=group: above_best(key[0], group, key[1], setting),
            ),
        ]
    text += [
        "## By how much a filter errs more with the paper's settings than with ours [%]",
        f"At {where}.",
        by_setting(
            "filter",
            {
                f"{LABELS[name]}: {METRICS[metric][0]}": (Curve(label, metric), Curve(name, metric))
                for metric in METRICS
                for label, name in AS_PUBLISHED.items()
            },
            excess,
        ),
        "## Time of a step [ms]",
        "One episode at a time. All but the open loop are compiled.",
        by_setting("estimator", names, milliseconds),
    ]
    text.append("## Each claim in numbers: ✓ holds, ✗ does not hold, ? undecided")
    for claim in CLAIMS:
        text += [
            f"### {claim.statement}",
            f"{claim.statistic.quantity}, in ({claim.low:g}, {claim.high:g})",
            by_setting(
                "part", {name_of(each): each for each in claim.parts}, partial(number, claim)
            ),
        ]
    return "\n\n".join(text)


def draw_sweep(rows: pl.DataFrame, field: str, metrics: Sequence[str]) -> Figure:
    """Draw errors along a sweep, a panel for each metric and setting."""
    panels = list(itertools.product(metrics, SETTINGS))
    n_rows = len(panels) // 2
    figure = make_figure(WIDTH, 2.1 * n_rows + 0.6)
    for axis, panel in zip(figure.subplots(n_rows, 2).flat, panels, strict=True):
        metric, setting = panel
        (alone,) = curves_of(rows, setting, Curve("open_loop", metric))
        lines = (*setting.split(", "), error_label(metric), f"open loop: {alone.mean():.1f}")
        axis.set_title("\n".join(lines), fontsize=8, loc="left")
        for k, name in enumerate(ESTIMATORS[:-1]):
            (curve,) = curves_of(rows, setting, Curve(name, metric, field))
            places = shifted(SWEEPS[field], 0.01 * (k - 2), log=field != "bandwidth")
            means = [mean_interval(values) for values in curve]
            draw_curve(axis, places, means, ESTIMATOR_LOOKS[name], LABELS[name])
        axis.set_xlabel(AXES[field])
        if field != "bandwidth":
            set_log(axis, SWEEPS[field][::2], ERROR_TICKS if field == "epsilon" else ())
    return finish_figure(figure)


def draw_space_time(table: pl.DataFrame) -> Figure:
    """Draw maps of density: truth on top, then each estimator; a column for each setting."""
    corridor = CELLS[0].config.corridor
    lengths = corridor.geometry.segment_lengths[: corridor.geometry.n_mainline]
    history = History(0, corridor.conditions.duration, lengths, corridor.scales.density_scale)
    columns = []
    for setting in SETTINGS:
        column: list[RoadMap] = []
        for name in ESTIMATORS:
            labels = labels_of(name, setting, bandwidth=MAP_SEGMENTS)
            (row,) = pick(table, labels).iter_rows(named=True)
            maps = {setting: "truth"} if not column else {}
            maps[f"{LABELS[name]}, {row[DENSITY]:.1f}"] = "estimate"
            for title, content in maps.items():
                column.append(RoadMap(title, np.array(row[content]), history, MAP_STEP))
        columns.append(column)
    # Two settings below one another: four columns are too narrow for a phone.
    return draw_maps([columns[0] + columns[1], columns[2] + columns[3]], height=0.5)


def draw_times(rows: pl.DataFrame) -> Figure:
    """Draw the time of a step beside the paper's."""
    figure = make_figure(WIDTH, 3.6)
    axis = figure.subplots()
    places = np.arange(len(ESTIMATORS))
    for k, setting in enumerate(SETTINGS):
        times = [
            TIME.measure(*curves_of(rows, setting, Curve(name, SECONDS))) for name in ESTIMATORS
        ]
        look = Look(COLOURS[k], "o", "none")
        draw_curve(axis, places + 0.16 * (k - 1.5), times, look, f"here, {setting}")
    for place, name in enumerate(PAPER_SECONDS):
        axis.plot(place, 1e3 * PAPER_SECONDS[name], "kx", label="the paper")
    axis.set_xticks(places, [LABELS[name].replace(" ", "\n") for name in ESTIMATORS])
    set_log(axis, y=(0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0))
    axis.set_ylabel("time of a step [ms]")
    return finish_figure(figure)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the figures."""
    rows = with_times(rows, read_table(folder / RUN_TIME, (*CELLS[0].labels, SECONDS)))
    maps = read_table(folder / SPACE_TIME, ("truth", "estimate"))
    for name, field, metrics in (
        ("fig1_cv_segments.png", "bandwidth", (DENSITY, SPEED)),
        ("fig3_epsilon.png", "epsilon", (DENSITY,)),
        ("fig4_delta.png", "delta", (DENSITY,)),
    ):
        fixed = ", ".join(f"{AXES[key]} = {BASE[key]:g}" for key in AXES if key != field)
        title = f"Error against {AXES[field]}; {fixed}"
        save_measured(folder / name, title, draw_sweep, rows, field, metrics)
    title = f"Density, and estimates from {MAP_SEGMENTS} CV segments with their RMSE [veh/km]"
    save_measured(folder / "fig2_space_time.png", title, draw_space_time, maps)
    title = "Time of predict, update and estimate, one episode at a time"
    save_measured(folder / "fig5_run_time.png", title, draw_times, rows)
    return tables_of(rows)


STUDY = Study(
    "paper",
    CELLS,
    SEEDS,
    report,
    measures={RUN_TIME: measure_run_time, SPACE_TIME: measure_space_time},
)
