"""Estimators side by side, and what they make of traffic in which not every vehicle answers.

In the part ``estimators`` every vehicle answers queries: errors of every estimator under every
release model, how honest its deviations are, and how the recurrent network does away from what it
was trained on. In the part ``penetration`` a share p of the vehicles is connected and answers
queries, beside three detectors on the mainline that count every vehicle.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from agents.environments import make_vector
from agents.figures import (
    ERROR_TICKS,
    ESTIMATOR_LOOKS,
    LABELS,
    Look,
    add_frame,
    draw_curve,
    draw_dot,
    draw_level,
    finish_figure,
    make_figure,
    save_figure,
    set_log_axes,
    set_log_ticks,
)
from agents.play import Cell, corridor_of, record
from agents.statistics import Interval, geometric_mean_interval, mean_interval
from agents.study import Place, Study, read_table
from agents.tables import (
    DENSITY,
    ERROR,
    SPEED,
    Labels,
    UnmeasuredError,
    below,
    format_interval,
    format_range,
    grid,
    mean,
    pick_paired,
    values,
    values_of,
)
from agents.watchers import JUMP, LEVELS, REGIMES, SLOW

PAPER, PRIVATE = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/PrivateHighway-v0"
PACED, SHORT = "dptse_env:dptse/PrivateHighway-v1", "dptse_env:dptse/ShortHighway-v0"
SEEDS = tuple(range(2000, 2064))
EKF, WALK, LEARNED = "ekf", "random_walk", "recurrent"
ROUND_ROBIN = "round-robin"

# ---- The first part: every vehicle answers. ----

QUICK, SLOW_FILTERS = (EKF, WALK, "blend", LEARNED), ("ukf", "enkf", "mhe")
POLICIES = ("paper", ROUND_ROBIN, "oldest-first", "stale-variance", "largest-deviation")
SHIPPED = "private-highway"
"""A learned query policy for the world `CAPPED`, trained with the EKF."""
CAPPED = "PrivateHighway-v0"
MAIN: dict[str, tuple[str, dict[str, Any]]] = {
    "PaperHighway-v0": (PAPER, {}),
    "PaperHighway-v0, corrected": (PAPER, {"privacy": "corrected"}),
    CAPPED: (PRIVATE, {}),
    "PrivateHighway-v1": (PACED, {}),
}
"""Environment and keywords of the worlds in which estimators meet query policies."""
_SUMS = {"query_spans": [2], "bandwidth_unit": "sums"}
GUARANTEES: dict[str, tuple[str, dict[str, Any]]] = {
    "PrivateHighway-v1, five sums": (PACED, _SUMS),
    "PrivateHighway-v1, ε = 1": (PACED, {"epsilon": 1.0}),
    "PrivateHighway-v1, ε = 1, five sums": (PACED, {"epsilon": 1.0, **_SUMS}),
}
_LONG_ROAD = {
    "n_mainline": 60,
    "on_ramps": [9, 29, 49],
    "off_ramps": [19, 39, 54],
    "exit_shares": [0.1, 0.1, 0.1],
    "fixed_sensors": [59, 63, 64, 65],
    "average_dwell": 10.25,
    "demand": {
        "base": {
            "mainline": [[0.0, 2500.0], [150.0, 5400.0], [500.0, 2500.0]],
            "on_ramps": [300.0, 300.0, 300.0],
        }
    },
    "incident": {"segments": list(range(59))},
}
_TWO_PEAKS = {
    "base": {
        "mainline": [[0.0, 5000.0], [120.0, 2000.0], [300.0, 5600.0], [420.0, 3000.0]],
        "on_ramps": [150.0, 600.0],
    }
}
_INCIDENT = {"segment": 10, "phases": [[200.0, 400.0, 10.08], [400.0, 500.0, 50.95]]}
_DRIVERS = {
    "drivers by Krauss": {"model": "Krauss"},
    "drivers by IDM": {"model": "IDM"},
    "headways of 0.6 s, mixed speeds": {"headway": 0.6, "speed_deviation": 0.2},
    "headways of 2 s": {"headway": 2.0},
}
ELSEWHERE: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (PACED, {"corridor": {"drivers": drivers}}) for name, drivers in _DRIVERS.items()},
    "no incident": (PACED, {"incident": "none"}),
    "the paper's incident": (PACED, {"incident": _INCIDENT}),
    "demand with two peaks": (PACED, {"demand": _TWO_PEAKS}),
    "a road of 6 km, B = 20": (PACED, {"corridor": _LONG_ROAD, "bandwidth": 20}),
    "ShortHighway-v0": (SHORT, {}),
    **{f"ε = {epsilon:g}": (PACED, {"epsilon": epsilon}) for epsilon in (0.5, 2.0, 10.0, 20.0)},
    **{f"B = {bandwidth}": (PACED, {"bandwidth": bandwidth}) for bandwidth in (1, 2, 10, 15)},
}
"""Worlds that differ from PrivateHighway-v1 in one thing, and a road of its own."""
MOVED = (EKF, WALK, LEARNED)
MOVED_SEEDS = SEEDS[:24]
N_NETWORKS = 5
"""Training seeds of networks with recorded rows; the first comes with the package."""


def in_world(
    world: str, estimator: str = LEARNED, policy: str = ROUND_ROBIN, network: int = 0
) -> Labels:
    """Return the labels of an estimator in a world."""
    labels = {"world": world, "estimator": estimator, "policy": policy, "network": network}
    return {"part": "estimators", **labels}


def world_cell(labels: Labels) -> Cell:
    """Return the cell of `in_world` labels, with the network that comes with the package."""
    world, policy = labels["world"], labels["policy"]
    env, changes = {**MAIN, **GUARANTEES, **ELSEWHERE}[world]
    keywords = {**changes, "estimator": labels["estimator"]}
    if labels["estimator"] == LEARNED:
        keywords["estimator_settings"] = {"recurrent": {"weights": "highway", "outside": True}}
    seeds = MOVED_SEEDS if world in ELSEWHERE else None
    transferred = policy == SHIPPED
    return Cell(
        env, policy, keywords, labels, transferred=transferred, watchers=("honesty",), seeds=seeds
    )


def policies_of(world: str) -> tuple[str, ...]:
    """Return the query policies that are compared in a main world."""
    return (*POLICIES, SHIPPED) if world == CAPPED else POLICIES


def world_cells() -> list[Cell]:
    """Return the cells of the first part."""
    found = []
    for world in MAIN:
        found += [in_world(world, *pair) for pair in itertools.product(QUICK, policies_of(world))]
        some = itertools.product(SLOW_FILTERS, ("paper", ROUND_ROBIN))
        found += [in_world(world, *pair) for pair in some]
    found += [in_world(*p) for p in itertools.product(GUARANTEES, (*QUICK, *SLOW_FILTERS))]
    found += [in_world(*pair) for pair in itertools.product(ELSEWHERE, MOVED)]
    return [world_cell(labels) for labels in found]


# ---- The second part: a share of the vehicles answers, beside detectors. ----

RELEASES = ("paper", "corrected", "capped", "paced")
GUARANTEED = ("capped", "paced")
"""Release models in which queries and detectors share a budget."""
ESTIMATORS = (EKF, "ukf", "enkf", "mhe", LEARNED, WALK)
SHARES = {f"{percent} %": percent / 100 for percent in (1, 3, 10, 30, 100)}
BASE_SHARE = 0.1
UNKNOWN_SHARES = [0.02, 0.3]
"""Range of a share that is drawn for each traffic seed; its middle is published."""
DETECTORS = (3, 7, 11)
BOTH, QUERIES, PART, WHOLE = ("both", "queries", "detectors", "detectors, whole budget")
EPSILON, WHOLE_EPSILON = 5.0, 8.449590646976443
"""Epsilon of both mechanisms; the second one makes the detectors' part worth `EPSILON`."""
UNKNOWN, MISREPORTING, WITHOUT = ("unknown share", "misreporting", "without")
FACTORS = {"high": 4.0 / 3.0, "low": 2.0 / 3.0}
"""Factor on the counts of a detector that miscounts."""
FAULTY_RELEASES = ("paper", "paced")
RANKED = (ROUND_ROBIN, "paper", "oldest-first", "largest-variance", "static")
RANKED_SHARES = ("100 %", "30 %", "10 %", "3 %")
SENSED_SEEDS = SEEDS[:20]


def sensed(
    release: str, estimator: str, share: float = BASE_SHARE, sensors: str = BOTH, **changes: Any
) -> Labels:
    """Return the labels of an estimator with some sensors at a share of connected vehicles."""
    labels = {"release": release, "estimator": estimator, "share": share, "sensors": sensors}
    others = {"policy": ROUND_ROBIN, "fault": "none", "detector": -1}
    return {"part": "penetration", **labels, **others, **changes}


def alone(release: str, estimator: str, sensors: str = WHOLE) -> Labels:
    """Return the labels of detectors alone, which no share changes.

    Without a guarantee there is no budget, and a part of it is all of it.
    """
    sensors = sensors if release in GUARANTEED else PART
    return sensed(release, estimator, sensors=sensors, policy="none")


def unknown(release: str, estimator: str) -> Labels:
    """Return the labels of a share that nobody knows."""
    return sensed(release, estimator, sum(UNKNOWN_SHARES) / 2, fault=UNKNOWN)


def miscounting(release: str, estimator: str, *faults: str) -> list[Labels]:
    """Return the labels of faults of each detector in turn."""
    pairs = itertools.product(faults, range(len(DETECTORS)))
    return [sensed(release, estimator, fault=fault, detector=k) for fault, k in pairs]


def sensed_cell(labels: Labels) -> Cell:
    """Return the cell of `sensed` labels."""
    fault, sensors = labels["fault"], labels["sensors"]
    places = [] if sensors == QUERIES else list(DETECTORS)
    if fault == WITHOUT:
        del places[labels["detector"]]
    penetration = {"share": UNKNOWN_SHARES if fault == UNKNOWN else labels["share"]}
    if fault == MISREPORTING:
        penetration |= {"misreporting": 0.3, "misreport_factor": 0.5}
    keywords: dict[str, Any] = {
        "privacy": labels["release"],
        "epsilon": WHOLE_EPSILON if sensors == WHOLE else EPSILON,
        "estimator": labels["estimator"],
        "bandwidth": 5,
        "penetration": penetration,
        "corridor": {"fixed_sensors": places},
    }
    if fault in FACTORS:
        factors = [1.0] * len(places)
        factors[labels["detector"]] = FACTORS[fault]
        keywords["detectors"] = {"factor": factors}
    if labels["estimator"] == LEARNED:  # its deviations are honest, filters do better without
        keywords["fusion"] = {"dwell_factor": 1.0}
    return Cell(PACED, labels["policy"], keywords, labels, seeds=SENSED_SEEDS)


def sensed_cells() -> list[Cell]:
    """Return the cells of the second part."""
    found = []
    for pair in itertools.product(RELEASES, ESTIMATORS):
        for share in SHARES.values():
            found += [sensed(*pair, share), sensed(*pair, share, QUERIES)]
        found += [alone(*pair, PART)] + [alone(*pair)] * (pair[0] in GUARANTEED)
    for estimator, name, policy in itertools.product((EKF, LEARNED), RANKED_SHARES, RANKED[1:]):
        found.append(sensed("paced", estimator, SHARES[name], policy=policy))
    for pair in itertools.product(FAULTY_RELEASES, ESTIMATORS):
        found.append(unknown(*pair))
        if pair[1] != WALK:
            found += [*miscounting(*pair, *FACTORS, WITHOUT), sensed(*pair, fault=MISREPORTING)]
    return [sensed_cell(labels) for labels in found]


# ---- Times of a step. ----

TIMES = "times.parquet"
N_EPISODES, TURNS, STEPS = 1024, 15, 5


def measure_times(place: Place) -> pl.DataFrame:
    """Return the time of a step with each quick estimator over that with the EKF.

    They take turns, so that all meet the same state of the machine. A step is one of a batch of
    `N_EPISODES` on one core; ratios are geometric means over turns with 95 % intervals.
    """
    envs = {}
    for estimator in QUICK:
        cell, seeds = world_cell(in_world(CAPPED, estimator)), SEEDS[:32]
        record(corridor_of(cell), seeds, place.records)
        more = {"records": place.records, "traffic_seeds": list(seeds), "threads": 1}
        keywords = {**cell.keywords, **more, "action": "scores"}
        envs[estimator] = make_vector(cell.env, N_EPISODES, keywords)
        envs[estimator].reset(seed=0)
    shape = (N_EPISODES, envs[EKF].interface.n_mainline)
    scores = np.random.default_rng(0).random(shape, dtype=np.float32)
    seconds: dict[str, list[float]] = {estimator: [] for estimator in envs}
    for turn in range(TURNS + 1):
        for estimator, env in envs.items():
            started = time.perf_counter()
            for _ in range(STEPS):
                env.step(scores)
            if turn > 0:  # the first turn compiles
                seconds[estimator].append(time.perf_counter() - started)
    found = []
    for estimator, own in seconds.items():
        ratio = geometric_mean_interval(np.array(own) / np.array(seconds[EKF]))
        found.append((estimator, ratio.mean, ratio.low, ratio.high))
    return pl.DataFrame(found, schema=["estimator", "ratio", "low", "high"], orient="row")


# ---- Tables. ----

Columns = Mapping[str, Callable[[Any], str]]
"""Headers, and what stands under them for what a line is about."""

Pair = tuple[str, str]
"""A release model and an estimator."""


def table(corner: str, lines: Mapping[str, Any], columns: Columns) -> str:
    """Return a table of the columns for what each named line is about; dashes where unmeasured."""
    return grid(corner, list(lines), list(columns), lambda name, head: columns[head](lines[name]))


def named(estimators: Sequence[str]) -> dict[str, str]:
    """Return estimators by their names in tables."""
    return {LABELS[estimator]: estimator for estimator in estimators}


def tenths(interval: Interval) -> str:
    """Return a mean with the ends of its interval, a decimal each."""
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def give_or_take(interval: Interval) -> str:
    """Return a mean and half the length of its interval, a decimal each."""
    return f"{interval.mean:.1f} ± {interval.half_width:.1f}"


def below_ekf(rows: pl.DataFrame, labels: Labels) -> Interval:
    """Return by how much the error lies below that of the EKF in the same world [%]."""
    return below(rows, labels, {**labels, "estimator": EKF, "network": 0})


def chi2(rows: pl.DataFrame, labels: Labels) -> str:
    """Return the mean squares of errors over deviations, of densities and of speeds."""
    means = (mean(rows, labels, f"chi2_{kind}").mean for kind in ("density", "speed"))
    return ", ".join(f"{each:.2f}" for each in means)


def coverage(rows: pl.DataFrame, labels: Labels) -> str:
    """Return the coverage of intervals [%] by their levels, of densities and of speeds."""
    names = ([f"{kind}_{level}" for level in LEVELS] for kind in ("density", "speed"))
    return "; ".join(" ".join(f"{mean(rows, labels, n).mean:.0f}" for n in each) for each in names)


def in_regime(rows: pl.DataFrame, regime: str, labels: Labels) -> str:
    """Return RMSE of density and of speed in a regime."""
    n = max(values(rows, labels, f"n_{regime}").sum(), 1.0)
    squares = (values(rows, labels, f"{kind}_{regime}").sum() for kind in ("density", "speed"))
    return " / ".join(f"{np.sqrt(each / n):.1f}" for each in squares)


def regime_shares(rows: pl.DataFrame, labels: Labels) -> str:
    """Return the shares of segments in the regimes [%]."""
    counts = np.array([values(rows, labels, f"n_{regime}").sum() for regime in REGIMES])
    return " / ".join(f"{100.0 * share:.0f}" for share in counts / counts.sum())


WORLD_NOTES = f"""Round robin, traffic seeds {format_range(SEEDS)}. *Error*: minus the reward after
the warm-up. *χ²*: mean square of errors over reported deviations, of densities and of speeds.
*Covered*: errors within intervals of {format_range(LEVELS)} %, of densities; of speeds."""
REGIME_NOTES = f"""RMSE of density [veh/km] / speed [km/h] of occupied segments. *Front*: the speed
of a segment and of a neighbour differ by more than {JUMP:g} km/h. *Jam*: any other segment below
{SLOW:g} km/h."""
MOVED_NOTES = f"Error x 1000, traffic seeds {format_range(MOVED_SEEDS)}."


def world_tables(rows: pl.DataFrame, times: pl.DataFrame) -> list[str]:
    """Return the tables of the first part."""

    def error(policy: str, world: str, estimator: str) -> str:
        return tenths(mean(rows, in_world(world, estimator, policy), ERROR))

    def moved(estimator: str, world: str) -> str:
        return error(ROUND_ROBIN, world, estimator)

    everyone = named((*QUICK, *SLOW_FILTERS))
    columns: dict[str, Callable[[Any], str]] = {
        "error x 1000": lambda c: tenths(mean(rows, c, ERROR)),
        "below EKF [%]": lambda c: (
            "-" if c["estimator"] == EKF else format_interval(below_ekf(rows, c))
        ),
        "density [veh/km]": lambda c: format_interval(mean(rows, c, DENSITY)),
        "speed [km/h]": lambda c: format_interval(mean(rows, c, SPEED)),
        "χ²": lambda c: chi2(rows, c),
        "covered [%]": lambda c: coverage(rows, c),
    }
    parts = ["# Every vehicle answers", WORLD_NOTES, "![Errors](fig_estimators.png)"]
    for world in (*MAIN, *GUARANTEES):
        lines = {name: in_world(world, each) for name, each in everyone.items()}
        parts += [f"## {world}", table("estimator", lines, columns)]
    parts += ["## Query policies", "Error x 1000."]
    for world in MAIN:
        columns = {f"`{each}`": partial(error, each, world) for each in policies_of(world)}
        parts.append(table(world, everyone, columns))
    columns = {regime: partial(in_regime, rows, regime) for regime in REGIMES}
    columns["share of segments [%]"] = lambda c: regime_shares(rows, c)
    lines = {f"{w}, {LABELS[e]}": in_world(w, e) for w, e in itertools.product(MAIN, QUICK)}
    parts += ["## By regime of traffic", REGIME_NOTES, table("", lines, columns)]
    columns = {name: partial(moved, each) for name, each in named(MOVED).items()}
    columns["recurrent below EKF [%]"] = lambda w: format_interval(below_ekf(rows, in_world(w)))
    columns["χ² of recurrent"] = lambda w: chi2(rows, in_world(w))
    parts += ["## Away from the training", MOVED_NOTES, "![Gains](fig_elsewhere.png)"]
    parts.append(table("PrivateHighway-v1 but for", {each: each for each in ELSEWHERE}, columns))

    def network(world: str, k: str) -> str:
        labels = in_world(world, network=int(k))
        return f"{mean(rows, labels, ERROR).mean:.1f} ({chi2(rows, labels)})"

    numbers = [str(k) for k in range(N_NETWORKS)]
    parts += ["## Training seeds of the network", "Error x 1000 (χ²). Only 0 is in the package."]
    parts.append(grid("", [*MAIN, *GUARANTEES], numbers, network))
    lines = {LABELS[each["estimator"]]: each for each in times.iter_rows(named=True)}
    text = "{ratio:.2f} [{low:.2f}, {high:.2f}]"
    parts += ["## Time", f"A step of {CAPPED}, {N_EPISODES:,} episodes on one core."]
    parts.append(table("estimator", lines, {"over the EKF": lambda each: text.format(**each)}))
    return parts


def loss(rows: pl.DataFrame, cells: Sequence[Labels], reference: Labels) -> Interval:
    """Return by how much the mean error of cells lies above that of a reference [%], paired."""
    pairs = [
        [values_of(each, ERROR) for each in pick_paired(rows, labels, reference)]
        for labels in cells
    ]
    change = np.mean([own - base for own, base in pairs], axis=0)
    return mean_interval(100.0 * change / pairs[0][1].mean())


SENSED_NOTES = f"""PrivateHighway-v1, detectors on segments {format_range(DETECTORS)}, round robin
with 5 queries a second, traffic seeds {format_range(SENSED_SEEDS)}. Gains are in per cent of the
error that they are compared with, paired, and bold where they are certain. Detectors alone have the
part of the budget that they have beside queries, or all of it (ε = {WHOLE_EPSILON:.2f} for both, of
which their part is worth ε = {EPSILON:g}); without a guarantee the two are one."""
SHARE_NOTES = f"""RMSE of density [veh/km], then of speed [km/h]. *Unknown*: p is drawn from
{UNKNOWN_SHARES} for each traffic seed, and the middle is published."""
FAULT_NOTES = f"""p = {BASE_SHARE:g}, errors above those of healthy sensors [%]. *Miscounts*: one
detector counts a third too many or too few, the mean over all cases. *Misreported*: three of ten
connected vehicles report half their speed."""


def sensed_tables(rows: pl.DataFrame) -> list[str]:
    """Return the tables of the second part, most of a line for each release and estimator."""

    def error(labels: Labels) -> str:
        return give_or_take(mean(rows, labels, ERROR))

    def errors(labels: Labels) -> str:
        return ", ".join(give_or_take(mean(rows, labels, metric)) for metric in (DENSITY, SPEED))

    def gain(labels: Labels, reference: Labels) -> str:
        found = below(rows, labels, reference)
        return f"**{tenths(found)}**" if found.low > 0.0 else tenths(found)

    def lines(releases: Sequence[str], estimators: Sequence[str]) -> dict[str, Pair]:
        pairs = itertools.product(releases, estimators)
        return {f"`{release}`, {LABELS[each]}": (release, each) for release, each in pairs}

    def by_share(entry: Callable[[float, Pair], str]) -> dict[str, Callable[[Pair], str]]:
        return {name: partial(entry, share) for name, share in SHARES.items()}

    everyone = lines(RELEASES, ESTIMATORS)
    columns: dict[str, Callable[[Pair], str]] = {
        "both, error x 1000": lambda c: error(sensed(*c)),
        "below queries alone": lambda c: gain(sensed(*c), sensed(*c, sensors=QUERIES)),
        "below detectors alone": lambda c: gain(sensed(*c), alone(*c, PART)),
        "below detectors with the whole budget": lambda c: gain(sensed(*c), alone(*c)),
    }
    parts = ["# A share of the vehicles answers", SENSED_NOTES, "![Errors](fig_arms.png)"]
    parts += [f"## Both or either alone, p = {BASE_SHARE:g}", table("", everyone, columns)]
    columns = by_share(lambda p, c: gain(sensed(*c, p), alone(*c)))
    parts += ["## Both below detectors with the whole budget", table("", everyone, columns)]
    columns = by_share(lambda p, c: gain(sensed(*c, p), sensed(*c, p, QUERIES)))
    parts += ["## Both below queries alone", table("", everyone, columns)]
    columns = by_share(lambda p, c: errors(sensed(*c, p)))
    columns["unknown"] = lambda c: errors(unknown(*c))
    columns["detectors alone"] = lambda c: errors(alone(*c, PART))
    columns["with the whole budget"] = lambda c: errors(alone(*c))
    parts += ["## Errors by share", SHARE_NOTES, table("", everyone, columns)]

    def ranked(estimator: str, policy: str, share: str) -> str:
        own = sensed("paced", estimator, SHARES[share], policy=policy)
        text = f"{mean(rows, own, ERROR).mean:.1f}"
        against = {**own, "policy": ROUND_ROBIN}
        return text if own == against else f"{text}, {gain(own, against)}"

    parts += ["## Query policies", f"`paced`: error x 1000, and below `{ROUND_ROBIN}` [%]."]
    for each in (EKF, LEARNED):
        parts.append(grid(LABELS[each], RANKED, RANKED_SHARES, partial(ranked, each)))

    def above(pair: Pair, cells: Sequence[Labels]) -> str:
        return tenths(loss(rows, cells, sensed(*pair)))

    columns = {
        "healthy, error x 1000": lambda c: error(sensed(*c)),
        "miscounts": lambda c: above(c, miscounting(*c, *FACTORS)),
        "that detector left out": lambda c: above(c, miscounting(*c, WITHOUT)),
        "speeds misreported": lambda c: above(c, [sensed(*c, fault=MISREPORTING)]),
    }
    faulty = lines(FAULTY_RELEASES, ESTIMATORS[:-1])
    return [*parts, "## Faulty sensors", FAULT_NOTES, table("", faulty, columns)]


# ---- Figures. ----

LOOKS = {**ESTIMATOR_LOOKS, LEARNED: Look("#000000", "*")}


def measured(cells: Mapping[Any, Any], entry: Callable[[Any], Interval]) -> dict[Any, Interval]:
    """Return what ``entry`` gives for cells, by their keys, without those that are unmeasured."""
    found = {}
    for place, labels in cells.items():
        try:
            found[place] = entry(labels)
        except UnmeasuredError:
            continue
    return found


def draw_worlds(rows: pl.DataFrame, path: Path) -> None:
    """Draw the error of every estimator in each main world."""
    figure = make_figure(11.0, 3.4, dpi=100)
    names = (*QUICK, *SLOW_FILTERS)
    for axis, world in zip(figure.subplots(1, len(MAIN), sharey=True), MAIN, strict=True):
        cells = {name: in_world(world, name) for name in names}
        for name, interval in measured(cells, lambda c: mean(rows, c, ERROR)).items():
            draw_dot(axis, interval, names.index(name), LOOKS[name].colour, None)
        axis.set_title(world, fontsize=9)
        axis.set_xlabel("error x 1000", fontsize=8)
        axis.set_yticks(range(len(names)), [LABELS[name] for name in names])
        add_frame(axis, "x")
        axis.set_xlim(0.0, 1.15 * axis.get_xlim()[1])  # room for the numbers
    axis.invert_yaxis()  # shared by all
    save_figure(figure, path, "Error of the estimate under a round robin, 95 % intervals")


def draw_elsewhere(rows: pl.DataFrame, path: Path) -> None:
    """Draw by how much the network's error lies below the EKF's away from the training."""
    figure, worlds = make_figure(7.4, 5.0, dpi=100), tuple(ELSEWHERE)
    axis = figure.subplots()
    cells = {world: in_world(world) for world in worlds}
    for world, gain in measured(cells, lambda c: below_ekf(rows, c)).items():
        draw_dot(axis, gain, worlds.index(world), LOOKS[LEARNED].colour, None)
    axis.set_yticks(range(len(worlds)), worlds)
    axis.axvline(0.0, color="#333333", linewidth=1.0)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.set_xlabel("error of the network below that of the EKF [%]", fontsize=8)
    add_frame(axis, "x")
    save_figure(figure, path, "The recurrent network away from PrivateHighway-v1, 95 % intervals")


def draw_arms(rows: pl.DataFrame, path: Path) -> None:
    """Draw the error of both kinds of sensors, and of either alone, against the share."""
    figure = make_figure(11.0, 6.0, dpi=100)
    looks = {BOTH: Look("#d55e00", "s"), QUERIES: Look("#0072b2", "o", "--")}
    names = {BOTH: "queries and detectors", QUERIES: "queries alone"}
    axes = figure.subplots(2, len(RELEASES), sharex=True, sharey="row").ravel()
    for axis, pair in zip(axes, itertools.product((EKF, LEARNED), RELEASES), strict=True):
        estimator, release = pair
        level = {"detectors alone, with the whole budget": alone(release, estimator)}
        for name, interval in measured(level, lambda c: mean(rows, c, ERROR)).items():
            draw_level(axis, interval, label=name)
        for arm, look in looks.items():
            cells = {100.0 * p: sensed(release, estimator, p, arm) for p in SHARES.values()}
            means = measured(cells, lambda c: mean(rows, c, ERROR))
            if means:
                draw_curve(axis, list(means), list(means.values()), look, names[arm])
        set_log_axes(axis, [100.0 * share for share in SHARES.values()])
        set_log_ticks(axis.yaxis, ERROR_TICKS)
        axis.set_title(f"{release}, {LABELS[estimator]}", fontsize=9)
    for axis in axes[len(RELEASES) :]:
        axis.set_xlabel("connected vehicles [%]", fontsize=8)
    for axis in axes[:: len(RELEASES)]:
        axis.set_ylabel("error x 1000", fontsize=8)
    title = "Queries and detectors together, and either alone, 95 % intervals"
    save_figure(finish_figure(figure), path, title)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables of both parts, and draw their figures."""
    # An interrupted run may have the rows, and so the labels, of one part alone.
    lacking = {*in_world(""), *sensed("", "")} - {*rows.columns}
    rows = rows.with_columns(pl.lit(None).alias(name) for name in lacking)
    draw_worlds(rows, folder / "fig_estimators.png")
    draw_elsewhere(rows, folder / "fig_elsewhere.png")
    draw_arms(rows, folder / "fig_arms.png")
    times = read_table(folder / TIMES, ("estimator", "ratio", "low", "high"))
    return "\n\n".join([*world_tables(rows, times), *sensed_tables(rows)])


STUDY = Study(
    "estimators",
    (*world_cells(), *sensed_cells()),
    SEEDS,
    report,
    measures={TIMES: measure_times},
)
