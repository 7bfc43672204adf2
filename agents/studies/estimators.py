"""Estimators side by side, and what they make of traffic in which not every vehicle answers.

In the part ``estimators`` every vehicle answers queries: errors of every estimator under every
release model, how honest its deviations are, and how the recurrent network does away from what it
was trained on. In the part ``penetration`` a share p of the vehicles is connected and answers
queries, beside three fixed sensors on the mainline that count every vehicle. In the part ``loops``
stations of loops stand in place of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import polars as pl
from matplotlib.figure import Figure

from agents.environments import (
    GUARANTEE,
    OTHER_DRIVERS,
    PAPER,
    PRIVATE,
    SHORT,
    guarantee_of,
)
from agents.figures import (
    COLOURS,
    ERROR_TICKS,
    LABELS,
    WIDTH,
    Look,
    draw_curve,
    draw_errors,
    draw_level,
    finish_figure,
    make_figure,
    save_measured,
    set_log,
)
from agents.play import Cell
from agents.statistics import Interval
from agents.study import Study
from agents.tables import (
    DENSITY,
    ERROR,
    SPEED,
    Labels,
    below,
    chi2_text,
    format_interval,
    format_number,
    format_range,
    give_or_take,
    mean,
    table,
    tenths,
)

SEEDS = tuple(range(2000, 2064))
EKF, WALK, SMOOTHING, LEARNED = "ekf", "random_walk", "asm", "recurrent"
ROUND_ROBIN = "round-robin"

# ---- The first part: every vehicle answers. ----

EVERYONE = (EKF, WALK, "blend", SMOOTHING, LEARNED, "ukf", "enkf", "mhe")
World = tuple[str, dict[str, Any]]
"""An environment and its keywords."""
_CALIBRATED = {"parameters": "w99-3lane"}
"""Those of PrivateHighway-v1, so that every filter is calibrated."""


def _private(**changes: Any) -> World:
    """Return the road with a guarantee, by default with five queries a second."""
    return PRIVATE, {"bandwidth": 5, **changes}


_SUMS = {"query_spans": [2], "bandwidth_unit": "sums"}
WORLDS: dict[str, World] = {
    "PaperHighway-v0": (PAPER, _CALIBRATED),
    "PaperHighway-v0, corrected": (PAPER, {**_CALIBRATED, "privacy": "corrected"}),
    "PrivateHighway-v1, capped": _private(privacy="capped"),
    "PrivateHighway-v1": _private(),
    "PrivateHighway-v1, five sums": _private(**_SUMS),
    "PrivateHighway-v1, ε = 1": _private(epsilon=1.0),
    "PrivateHighway-v1, ε = 1, five sums": _private(epsilon=1.0, **_SUMS),
}
MAIN = tuple(WORLDS)[:4]
"""Worlds of the figure."""
_INCIDENT = {"segment": 10, "phases": [[200.0, 400.0, 10.08], [400.0, 500.0, 50.95]]}
ELSEWHERE: dict[str, World] = {
    "no incident": _private(incident="none"),
    "the paper's incident": _private(incident=_INCIDENT),
    "demand with two peaks": _private(demand=OTHER_DRIVERS["demand"]),
    "ShortHighway-v0": (SHORT, {**_CALIBRATED, "bandwidth": 2}),
    **{f"ε = {epsilon:g}": _private(epsilon=epsilon) for epsilon in (0.5, 2.0, 10.0, 20.0)},
    **{f"B = {bandwidth}": _private(bandwidth=bandwidth) for bandwidth in (1, 2, 10, 15)},
}
"""Worlds that differ from PrivateHighway-v1 with five queries a second in one thing, and
ShortHighway-v0 with two; other roads and drivers are in the study of roads."""
ALL_WORLDS = {**WORLDS, **ELSEWHERE}
MOVED = (EKF, WALK, SMOOTHING, LEARNED)
MOVED_SEEDS = SEEDS[:24]


def in_world(world: str, estimator: str = LEARNED) -> Labels:
    """Return the labels of an estimator in a world; network 0 has the weights of the package."""
    labels = {"world": world, "estimator": estimator, "policy": ROUND_ROBIN, "network": 0}
    return {"part": "estimators", **labels}


def world_cell(world: str, estimator: str) -> Cell:
    """Return the cell of an estimator in a world."""
    env, changes = ALL_WORLDS[world]
    keywords = {**changes, "estimator": estimator}
    if estimator == LEARNED:
        keywords["estimator_settings"] = {"recurrent": {"weights": "highway"}}
    return Cell(
        env,
        ROUND_ROBIN,
        keywords,
        in_world(world, estimator),
        watchers=("honesty",),
        seeds=MOVED_SEEDS if world in ELSEWHERE else None,
    )


WORLD_CELLS = [
    world_cell(*each) for each in (*product(WORLDS, EVERYONE), *product(ELSEWHERE, MOVED))
]

# ---- The second part: a share of the vehicles answers, beside fixed sensors. ----

RELEASES = ("printed", "corrected", "capped", "paced")
GUARANTEED = ("capped", "paced")
"""Release models in which queries and fixed sensors share a budget."""
ESTIMATORS = (EKF, "ukf", "enkf", "mhe", LEARNED, SMOOTHING, WALK)
SHARES = {f"{percent} %": percent / 100 for percent in (1, 3, 10, 30, 100)}
BASE_SHARE = 0.1
FIXED_SENSORS = (3, 7, 11)
BOTH, QUERIES, PART, WHOLE = ("both", "queries", "fixed sensors", "fixed sensors, whole budget")
EPSILON, WHOLE_EPSILON = 5.0, 8.449590646976443
"""Epsilon of both mechanisms; the second one makes the part of fixed sensors worth `EPSILON`."""
SENSED_SEEDS = SEEDS[:20]


def sensed(
    release: str,
    estimator: str,
    share: float = BASE_SHARE,
    sensors: str = BOTH,
    policy: str = ROUND_ROBIN,
) -> Labels:
    """Return the labels of an estimator with some sensors at a share of connected vehicles."""
    labels = {"release": release, "estimator": estimator, "share": share, "sensors": sensors}
    others = {"policy": policy, "fault": "none", "sensor": -1}
    return {"part": "penetration", **labels, **others}


def alone(release: str, estimator: str, sensors: str = WHOLE) -> Labels:
    """Return the labels of fixed sensors alone, which no share changes.

    Without a guarantee there is no budget, and a part of it is all of it.
    """
    sensors = sensors if release in GUARANTEED else PART
    return sensed(release, estimator, sensors=sensors, policy="none")


def sensed_cell(labels: Labels) -> Cell:
    """Return the cell of `sensed` labels."""
    sensors = labels["sensors"]
    keywords: dict[str, Any] = {
        "privacy": labels["release"],
        "epsilon": WHOLE_EPSILON if sensors == WHOLE else EPSILON,
        "estimator": labels["estimator"],
        "bandwidth": 5,
        "penetration": {"share": labels["share"]},
        "corridor": {"fixed_sensors": [] if sensors == QUERIES else list(FIXED_SENSORS)},
    }
    if labels["estimator"] == LEARNED:  # its deviations are honest, filters do better without
        keywords["fusion"] = {"dwell_factor": 1.0}
    return Cell(PRIVATE, labels["policy"], keywords, labels, seeds=SENSED_SEEDS)


SENSED_CELLS = [
    sensed_cell(labels)
    for labels in (
        *(sensed(*e) for e in product(RELEASES, ESTIMATORS, SHARES.values(), [BOTH, QUERIES])),
        *(alone(*each) for each in product(RELEASES, ESTIMATORS, [PART])),
        *(alone(*each) for each in product(GUARANTEED, ESTIMATORS)),
    )
]

# ---- The third part: loops beside queries, and alone. ----

LOOPED = (LEARNED, "ukf", SMOOTHING)
"""The network, the best filter beside loops, and adaptive smoothing."""
LINES = "straight lines"
STATIONS = (0.0, 0.5, 1.0, 1.5)
"""Positions of stations [km]."""
LOOP_INTERVALS = (20, 60, 300)
LOOP_SHARES = (1.0, 0.2, 0.1)
NOBODY = "none"
"""The policy that queries nothing."""
LOOP_SEEDS = SEEDS[:8]


def beside_loops(
    estimator: str, interval: int, share: float = 1.0, policy: str = ROUND_ROBIN
) -> Labels:
    """Return the labels of an estimator with loops of an interval [s], 0 for none of them."""
    own = {"estimator": estimator, "share": share, "policy": policy}
    return {"part": "loops", "interval": interval, **own}


def looped_cell(labels: Labels) -> Cell:
    """Return the cell of `beside_loops` labels."""
    estimator, share, interval = (labels[name] for name in ("estimator", "share", "interval"))
    keywords: dict[str, Any] = {
        "estimator": "agents.studies.straight_lines:StraightLines"
        if estimator == LINES
        else estimator,
        "bandwidth": 5,
        "corridor": {"fixed_sensors": []},
    }
    if interval:
        keywords["loops"] = {"positions": list(STATIONS), "interval": interval}
    if share < 1.0:
        keywords["penetration"] = {"share": share}
        if estimator == LEARNED:
            keywords["fusion"] = {"dwell_factor": 1.0}
    seeds, watchers = LOOP_SEEDS, ("honesty",)
    return Cell(PRIVATE, labels["policy"], keywords, labels, watchers=watchers, seeds=seeds)


LOOPED_CELLS = [
    looped_cell(labels)
    for labels in (
        *(beside_loops(*each) for each in product(LOOPED, (0, *LOOP_INTERVALS), LOOP_SHARES)),
        *(beside_loops(*each, policy=NOBODY) for each in product(LOOPED, (0, *LOOP_INTERVALS))),
        *(beside_loops(LINES, interval, policy=NOBODY) for interval in LOOP_INTERVALS),
    )
]

# ---- Tables. ----


def lines_of(
    groups: Iterable[str], estimators: Iterable[str], make: Callable[[str, str], Any]
) -> dict[str, Any]:
    """Return a line for each world or release model and estimator."""
    return {
        f"{each}, {LABELS[name]}": make(each, name) for each, name in product(groups, estimators)
    }


def below_ekf(rows: pl.DataFrame, labels: Labels) -> Interval:
    """Return by how much the error lies below that of the EKF in the same world [%]."""
    return below(rows, labels, {**labels, "estimator": EKF})


def best_filter(rows: pl.DataFrame, world: str) -> Labels:
    """Return the labels of the filter that errs least in a world.

    Raises:
        UnmeasuredError: A filter was not played there.
    """
    filters = [in_world(world, name) for name in EVERYONE if name != LEARNED]
    return min(filters, key=lambda labels: mean(rows, labels, ERROR).mean)


WORLD_NOTES = f"""Round robin, parameters `{_CALIBRATED["parameters"]}`, traffic seeds
{format_range(SEEDS)}. *Error*: minus the reward after the warm-up. *Best filter*: the one of these
that errs least on this traffic. *χ²*: mean square of errors over reported deviations, of densities
and of speeds."""
MOVED_NOTES = f"Error x 1000, traffic seeds {format_range(MOVED_SEEDS)}."


def world_tables(rows: pl.DataFrame) -> list[str]:
    """Return the tables of the first part."""

    def error(labels: Labels, **changes: str) -> str:
        return tenths(mean(rows, {**labels, **changes}, ERROR))

    def gain(labels: Labels) -> str:
        return "-" if labels["estimator"] == EKF else format_interval(below_ekf(rows, labels))

    def best(labels: Labels) -> str:
        return tenths(below(rows, labels, best_filter(rows, labels["world"])))

    parts = ["# Every vehicle answers", WORLD_NOTES, "![Errors](fig_estimators.png)"]
    columns: dict[str, Callable[[Any], str]] = {
        GUARANTEE: lambda c: guarantee_of(*ALL_WORLDS[c["world"]]),
        "error x 1000": error,
        "below EKF [%]": gain,
        "below the best filter [%]": best,
        "density [veh/km]": lambda c: format_interval(mean(rows, c, DENSITY)),
        "speed [km/h]": lambda c: format_interval(mean(rows, c, SPEED)),
        "χ²": partial(chi2_text, rows),
    }
    parts.append(table("", lines_of(WORLDS, EVERYONE, in_world), columns))
    columns = {GUARANTEE: columns[GUARANTEE]}
    columns |= {LABELS[each]: partial(error, estimator=each) for each in MOVED}
    columns |= {"recurrent below EKF [%]": gain, "χ² of recurrent": partial(chi2_text, rows)}
    moved = {world: in_world(world) for world in ELSEWHERE}
    parts += ["## Away from the training", MOVED_NOTES, "![Gains](fig_elsewhere.png)"]
    return [*parts, table("PrivateHighway-v1 but for", moved, columns)]


SENSED_NOTES = f"""PrivateHighway-v1, fixed sensors on segments {format_range(FIXED_SENSORS)},
round robin with 5 queries a second, traffic seeds {format_range(SENSED_SEEDS)}. Gains are in per
cent of the error that they are compared with, paired, and bold where they are certain. Fixed
sensors alone have the part of the budget that they have beside queries, or all of it
(ε = {WHOLE_EPSILON:.2f} for both, of which their part is worth ε = {EPSILON:g}); without a
guarantee the two are one."""
Pair = tuple[str, str]
"""A release model and an estimator."""


def sensed_tables(rows: pl.DataFrame) -> list[str]:
    """Return the tables of the second part, most of a line for each release and estimator."""

    def error(labels: Labels) -> str:
        return give_or_take(mean(rows, labels, ERROR))

    def gain(labels: Labels, reference: Labels) -> str:
        found = below(rows, labels, reference)
        return f"**{tenths(found)}**" if found.low > 0.0 else tenths(found)

    def of_share(share: float, pair: Pair) -> str:
        return gain(sensed(*pair, share), alone(*pair))

    def guarantee(pair: Pair) -> str:
        release, _ = pair
        return guarantee_of(PRIVATE, {"privacy": release, "epsilon": EPSILON})

    everyone = lines_of(RELEASES, ESTIMATORS, lambda *pair: pair)
    columns: dict[str, Callable[[Pair], str]] = {
        GUARANTEE: guarantee,
        "both, error x 1000": lambda c: error(sensed(*c)),
        "below queries alone": lambda c: gain(sensed(*c), sensed(*c, sensors=QUERIES)),
        "below fixed sensors alone": lambda c: gain(sensed(*c), alone(*c, PART)),
        "below fixed sensors with the whole budget": lambda c: gain(sensed(*c), alone(*c)),
    }
    parts = ["# A share of the vehicles answers", SENSED_NOTES, "![Errors](fig_arms.png)"]
    parts += [f"## Both or either alone, p = {BASE_SHARE:g}", table("", everyone, columns)]
    columns = {GUARANTEE: guarantee}
    columns |= {name: partial(of_share, share) for name, share in SHARES.items()}
    title = "## Both below fixed sensors with the whole budget"
    return [*parts, title, table("", everyone, columns)]


LOOP_NOTES = f"""PrivateHighway-v1 without fixed sensors, round robin with 5 queries a second or no
query, stations at {", ".join(f"{at:g}" for at in STATIONS)} km, traffic seeds
{format_range(LOOP_SEEDS)}. Density RMSE [veh/km]; in brackets by how many per cent of the error
without loops it lies below that, paired, and bold where it is certain. Readings are outside of the
budget. Straight lines between stations stay until the next reading."""


def loop_table(rows: pl.DataFrame) -> list[str]:
    """Return the table of the third part: a line for each estimator and share, and for none."""

    def error(labels: Labels, interval: int) -> str:
        own = {**labels, "interval": interval}
        text = format_number(mean(rows, own, DENSITY).mean)
        if interval == 0 or labels["estimator"] == LINES:
            return text
        found = below(rows, own, {**labels, "interval": 0}, DENSITY)
        gain = f"{found.mean:.0f}"
        return f"{text} ({f'**{gain}**' if found.low > 0.0 else gain})"

    lines = {
        f"{LABELS[name]}, queries, p = {share:g}": beside_loops(name, 0, share)
        for share, name in product(LOOP_SHARES, LOOPED)
    }
    lines |= {f"{LABELS[each]}": beside_loops(each, 0, policy=NOBODY) for each in LOOPED}
    lines[LINES] = beside_loops(LINES, 0, policy=NOBODY)
    columns: dict[str, Callable[[Any], str]] = {
        f"every {interval} s" if interval else "no loops": partial(error, interval=interval)
        for interval in (0, *LOOP_INTERVALS)
    }
    columns["χ², every 60 s"] = lambda c: chi2_text(rows, {**c, "interval": 60})
    title = f"# Loops, {guarantee_of(PRIVATE, {})}"
    return [title, LOOP_NOTES, table("", lines, columns)]


# ---- Figures. ----


def draw_worlds(rows: pl.DataFrame) -> Figure:
    """Draw the error of every estimator in each main world."""
    errors = {
        LABELS[name]: {world: mean(rows, in_world(world, name), ERROR) for world in MAIN}
        for name in EVERYONE
    }
    return draw_errors(list(errors), {"": errors})


def draw_elsewhere(rows: pl.DataFrame) -> Figure:
    """Draw by how much the network's error lies below the EKF's away from the training."""
    label = "error of the network below that of the EKF [%]"
    gains = {world: {label: below_ekf(rows, in_world(world))} for world in ELSEWHERE}
    return draw_errors(list(gains), {"": gains}, log=False)


def draw_arms(rows: pl.DataFrame) -> Figure:
    """Draw the error of both kinds of sensors, and of either alone, against the share."""
    figure = make_figure(WIDTH, 7.6)
    axes = figure.subplots(len(RELEASES), 2, sharex=True, sharey="col")
    percent = [100.0 * share for share in SHARES.values()]
    arms = {
        "queries and fixed sensors": (BOTH, Look("#d55e00", "s")),
        "queries alone": (QUERIES, Look(COLOURS[0], "o", "--")),
    }
    for axis, pair in zip(axes.flat, product(RELEASES, (EKF, LEARNED)), strict=True):
        release, estimator = pair
        level = mean(rows, alone(release, estimator), ERROR)
        draw_level(axis, level, label="fixed sensors alone, with the whole budget")
        for name, (arm, look) in arms.items():
            cells = [sensed(release, estimator, share, arm) for share in SHARES.values()]
            draw_curve(axis, percent, [mean(rows, each, ERROR) for each in cells], look, name)
        set_log(axis, percent, ERROR_TICKS)
        axis.set_title(f"{release}, {LABELS[estimator]}", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("connected vehicles [%]", fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("error x 1000", fontsize=8)
    return finish_figure(figure)


FIGURES = {
    "fig_estimators.png": (
        draw_worlds,
        f"Error x 1000 under a round robin, PrivateHighway-v1 at ε = {EPSILON:g}",
    ),
    "fig_elsewhere.png": (
        draw_elsewhere,
        f"The recurrent network away from PrivateHighway-v1, at ε = {EPSILON:g} unless named",
    ),
    "fig_arms.png": (
        draw_arms,
        f"Queries and fixed sensors together, and either alone, at ε = {EPSILON:g}",
    ),
}


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables of all parts, and draw their figures."""
    for name, (draw, title) in FIGURES.items():
        save_measured(folder / name, f"{title}, 95 % intervals", draw, rows)
    return "\n\n".join([*world_tables(rows), *sensed_tables(rows), *loop_table(rows)])


STUDY = Study("estimators", (*WORLD_CELLS, *SENSED_CELLS, *LOOPED_CELLS), SEEDS, report)
