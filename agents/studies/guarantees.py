"""What a guarantee of privacy costs, and what paced ledgers save of it.

The part ``privacy`` plays one query schedule under the paper's noise and under capped
contributions, whose guarantee holds, for every epsilon, cap and protected unit. The part ``ledger``
holds capped contributions against paced ledgers at the same guarantee, and follows who runs out of
budget. All cells have the same traffic; a number of one part is never held against the other.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from agents.environments import make_config, quietly
from agents.figures import (
    ERROR_TICKS,
    GREY,
    LABELS,
    Look,
    add_frame,
    draw_curve,
    draw_dot,
    draw_level,
    error_label,
    finish_figure,
    make_figure,
    save_figure,
    set_log_axes,
    set_log_ticks,
)
from agents.play import Cell
from agents.statistics import Interval, mean_interval
from agents.study import Study
from agents.tables import (
    DENSITY,
    METRICS,
    UnmeasuredError,
    cell,
    compared_header,
    difference,
    format_interval,
    format_number,
    markdown,
    mean,
    pick,
)
from agents.watchers import LENGTHS
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import contribution_sensitivity, epsilon_of
from dptse_env.release import PrivacyReport, PublicStep, ReleaseModel, ReleaseSetup
from dptse_env.release.paced import Paced
from dptse_env.release.pacing import Pacing, TracerPacing
from dptse_env.utils.arrays import FloatArray, IntArray
from dptse_env.utils.vector_info import Rows

ENV = "dptse_env:dptse/PrivateHighway-v0"
SEEDS = tuple(range(2000, 2020))
DELTA, STRICT, CAP = 0.05, 0.001, 64
DECADES = [10.0**k for k in range(-1, 7)]

# What the ledgers are held against: no noise, and prices that do not follow the queries


class AnyPrice(Pacing):
    """A price for every query that leaves a count the noise of a thousandth of a vehicle."""

    def prices(self, step: PublicStep) -> FloatArray:
        """See `Pacing.prices`."""
        return np.full(step.observed.shape, 1e6)

    def expected_price(self, speed: FloatArray) -> float:
        """See `Pacing.expected_price`."""
        return 1e6


class Exact(Paced):
    """The sums that `Paced` releases, of all vehicles and with negligible noise.

    It protects nobody: a floor for the errors of one filter. Centres and clip are those of `Paced`;
    epsilon and delta have no effect.
    """

    claims_guarantee: ClassVar[bool] = False

    def __init__(self, setup: ReleaseSetup) -> None:
        """Make ledgers without a limit."""
        super().__init__(setup)
        self.ledgers.budget = math.inf
        self.pacing = AnyPrice(self.pacing.setup)

    def spent(self, episodes: IntArray, steps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return infinite losses, which is what is known of a release without a guarantee."""
        return ReleaseModel.spent(self, episodes, steps)

    def report(self) -> PrivacyReport:
        """Return the report of a model that states no guarantee."""
        return ReleaseModel.report(self)

    def private_info(self, episodes: IntArray, traffic: IntArray) -> Rows:
        """Return nothing: no vehicle has a budget."""
        return {}


class EqualRates(TracerPacing):
    """`TracerPacing` with equal rates of querying for all mainline segments, whatever is queried.

    A policy that keeps querying the same place is priced as if its queries were spread over the
    road.
    """

    def prices(self, step: PublicStep) -> FloatArray:
        """See `Pacing.prices`."""
        prices = super().prices(step)
        self._rates[step.episodes] = self._first_rates
        return prices


# Cells of the part "privacy"

ESTIMATORS = ("ekf", "random_walk")
EPSILONS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
BOUNDARIES, BANDWIDTHS = ("nominal", "private", "true"), (3, 5, 8, 15)
TRIP, PAPER, CORRECTED = "trip, C = 64", "`paper` noise", "`corrected` noise"
PROTECTIONS: dict[str, dict[str, Any]] = {
    "event": {"preset": "capped", "unit": "event"},
    **{f"trip, C = {c}": {"preset": "capped", "unit": "trip", "cap": c} for c in (4, 16, CAP)},
    "horizon": {"preset": "capped", "unit": "horizon"},
    PAPER: {"preset": "paper"},
    CORRECTED: {"preset": "corrected"},
}
"""Privacy settings by their name in the tables."""
PRINTED = (PAPER, CORRECTED)


def priced(
    estimator: str,
    protection: str = TRIP,
    *,
    epsilon: float = 5.0,
    boundary: str | None = None,
    bandwidth: int = 5,
) -> Cell:
    """Return a cell of the price of a guarantee; the boundary is by default the preset's own.

    The open loop uses the boundary inputs and nothing else. Where these are not released, one cell
    stands for all noise and bandwidths.
    """
    boundary = boundary or ("true" if protection in PRINTED else "nominal")
    if estimator == "open_loop" and boundary != "private":
        protection, epsilon, bandwidth = TRIP, 5.0, 5
    privacy = {"epsilon": epsilon, "delta": DELTA, "boundary_inputs": boundary}
    privacy |= PROTECTIONS[protection]
    labels = {
        "part": "privacy", "estimator": estimator, "protection": protection, "epsilon": epsilon,
        "boundary": boundary, "bandwidth": bandwidth,
    }  # fmt: skip
    keywords = {"estimator": estimator, "bandwidth": bandwidth, "privacy": privacy}
    return Cell(ENV, "paper", keywords, labels)


# Cells of the part "ledger"

BASE: dict[str, Any] = {
    "release": "paced", "estimator": "ekf-demand", "schedule": "round-robin", "epsilon": 5.0,
    "delta": DELTA, "adjacency": "replace", "unit": "trip", "boundary": "nominal",
    "queries": "5 segments", "pace": 0.85, "clip": 25.0, "ratio": 1.0, "pacing": "tracer",
}  # fmt: skip
"""A cell of the ledgers, but for what it varies."""
LACKS = {
    "paced": (),
    "capped": ("pace", "clip", "ratio", "pacing"),
    "exact": ("epsilon", "delta", "adjacency", "unit", "pace", "ratio", "pacing"),
}
"""What a release model has no setting for."""
QUERIES: dict[str, dict[str, Any]] = {
    "5 segments": {"bandwidth": 5},
    "10 segments": {"bandwidth": 10},
    "5 sums of 2": {"bandwidth": 5, "query_spans": [2], "bandwidth_unit": "sums"},
    "2 sums of 2": {"bandwidth": 4, "query_spans": [2], "bandwidth_unit": "segments"},
    "3 sums of 2": {"bandwidth": 6, "query_spans": [2], "bandwidth_unit": "segments"},
}
"""Queries of a second; a sum is over neighbouring segments."""
SAME_COST = ("5 segments", "5 sums of 2")
FILTERS = {
    "ekf-demand": "EKF with demand states",
    "ukf-demand": "UKF with demand states",
    "enkf-demand": "EnKF with demand states",
    "mhe-demand": "MHE with demand states",
    "random_walk": "random walk",
}
SCHEDULES = (
    "static", "paper", "round-robin", "random", "oldest-first", "largest-variance",
    "stale-variance", "greedy-trace",
)  # fmt: skip
CURVE = (0.5, 1.0, 2.0, 5.0, 10.0)
VALUES = {
    "pace": (0.6, 0.7, 0.8, 0.85, 0.9, 1.0),
    "clip": (18.0, 25.0, 35.0, 51.0, 102.0),
    "ratio": (0.25, 0.5, 1.0),
}
"""Values of the settings of ``paced``."""
VARIANTS: dict[str, dict[str, Any]] = {
    "a trip, replaced, with nominal boundary inputs": {},
    "added or removed in place of replaced": {"adjacency": "add_remove"},
    "a second in place of a trip": {"unit": "event"},
    "private boundary inputs in place of nominal ones": {"boundary": "private"},
}
GUARANTEES = ((5.0, DELTA), (1.0, DELTA), (5.0, STRICT))
CAPPED, EQUAL = {"release": "capped"}, {"pacing": "equal-rates"}
LADDER: tuple[tuple[str, dict[str, Any], int], ...] = (
    ("`capped`, EKF, `paper`", {"estimator": "ekf", "schedule": "paper", **CAPPED}, 0),
    ("`capped`, demand states, `paper`", {"schedule": "paper", **CAPPED}, 1),
    ("`paced`, EKF, `paper`", {"estimator": "ekf", "schedule": "paper"}, 1),
    ("`paced`, demand states, `paper`", {"schedule": "paper"}, 2),
    ("`paced`, demand states, `round-robin`", {}, 4),
    ("`capped`, demand states, `round-robin`", CAPPED, 2),
    ("`paced`, 10 segments a second", {"queries": "10 segments"}, 5),
    ("`paced`, 5 sums of 2", {"queries": "5 sums of 2"}, 5),
    ("`paced`, 2 sums of 2, 4 segments", {"queries": "2 sums of 2"}, 5),
    ("`paced`, 3 sums of 2, 6 segments", {"queries": "3 sums of 2"}, 5),
    ("`capped`, random walk, `round-robin`", {"estimator": "random_walk", **CAPPED}, 0),
    ("`paced`, random walk, `round-robin`", {"estimator": "random_walk"}, 11),
    ("no noise, demand states, `round-robin`", {"release": "exact"}, 5),
    ("no noise, 5 sums of 2", {"release": "exact", "queries": "5 sums of 2"}, 8),
)
"""Rungs: a label, what differs from `BASE`, and the number of the rung that it rests on, if any."""


def paid(**changes: Any) -> Cell:
    """Return a cell whose vehicles are followed: `BASE` but for what is given."""
    given = BASE | changes
    given = {name: given[name] for name in given if name not in LACKS[given["release"]]}
    release, name = given["release"], given["estimator"]
    estimator, _, demand = name.partition("-")
    settings = "capped" if release == "capped" or name == "ekf" else "paced"
    settings += "-demand" if release == "capped" and demand else ""
    privacy: dict[str, Any] = {
        key: given[key]
        for key in ("epsilon", "delta", "adjacency", "unit", "pace", "clip", "ratio", "pacing")
        if key in given
    }
    privacy["preset"] = f"{__name__}:Exact" if release == "exact" else release
    privacy["boundary_inputs"] = given["boundary"]
    if privacy.get("pacing") == "equal-rates":
        privacy["pacing"] = f"{__name__}:EqualRates"
    keywords = {
        "estimator": estimator,
        "estimator_settings": f"{estimator}-w99-3lane-{settings}",
        "privacy": privacy,
        **QUERIES[given["queries"]],
    }
    labels = {"part": "ledger", **given}
    return Cell(ENV, given["schedule"], keywords, labels, watchers=("contributions",))


# What noise is worth


def config_of(rows: pl.DataFrame, labels: Mapping[str, Any]) -> EnvConfig:
    """Return the configuration that a cell was played with.

    Raises:
        UnmeasuredError: It was not, or on a road of a file, of which rows know the digest alone.
    """
    content = json.loads(pick(rows, labels)["cell"][0])
    if str(content["keywords"].get("corridor")).startswith("sha256:"):
        raise UnmeasuredError(labels)
    with quietly():
        return make_config(content["env"], content["keywords"])


def met_epsilon(config: EnvConfig, times: int, *, alone: bool = False) -> float:
    """Return epsilon of the paper's noise for a vehicle that is met in some steps and replaced.

    The vehicle that replaces it is met as often, elsewhere. Boundary inputs are left out; with true
    ones no finite epsilon holds.

    Args:
        config: Its configuration.
        times: Steps in which either vehicle is queried.
        alone: Whether it stands and is alone on its segment, so that it is the mean speed there,
            and an empty segment releases the speed limit. Otherwise only densities count, which
            bounds epsilon from below whatever the vehicle does.
    """
    density_std, speed_std = (each.noise_std for each in privacy_report(config).releases)
    largest = config.corridor.largest_speed_limit
    density = contribution_sensitivity(
        contributions=times,
        adjacency="replace",
        segment_length=min(config.corridor.segment_lengths),
        largest_speed=largest,
    ).releases[0]
    speed = math.sqrt(2.0 * times) * largest if alone else 0.0
    mu = math.hypot(density.bound / density_std, speed / speed_std)
    return epsilon_of(mu, config.privacy.delta)


# Tables, whose numbers say which cells are played

REFUSED, SPENT = "refused [%]", "spent above 95 % [%]"
SHARES = {REFUSED: ("n_refused", "n_met"), SPENT: ("n_exhausted", "n_vehicles")}
"""Shares of the rows, by what they are a part of, see `complete`."""
ERRORS = {metric: f"{name} RMSE [{unit}]" for metric, (name, unit) in METRICS.items()}


class Number(NamedTuple):
    """The mean of a column of a cell, or by how much it exceeds that of another, paired."""

    column: str
    own: Cell
    base: Cell | None = None


class Table(NamedTuple):
    """A table of texts and numbers of the rows."""

    title: str
    header: list[str]
    lines: list[list[str | Number]]


Make = Callable[..., Cell]
"""Makes a cell of what a column of a table varies."""
Line = tuple[str, Make] | tuple[str, Make, Make]
"""What is measured, and in which cell, or in which more than in another."""


def sweep(
    title: str,
    corner: str,
    columns: Mapping[str, Mapping[str, Any]],
    lines: Mapping[str, Line],
) -> Table:
    """Return a table whose columns vary something in every line."""
    table = Table(title, [corner, *columns], [])
    for name, (metric, *makes) in lines.items():
        cells = [[make(**varied) for make in makes] for varied in columns.values()]
        table.lines.append([name, *(Number(metric, *each) for each in cells)])
    return table


def compared(
    title: str,
    header: Sequence[str],
    reference: str,
    lines: Iterable[tuple[list[str], Cell, Cell | None]],
    *shares: str,
) -> Table:
    """Return a table of both errors of some cells, each against another one, and of shares."""
    table = Table(title, [*header, *compared_header(reference), *shares], [])
    for names, own, base in lines:
        line: list[str | Number] = list(names)
        for metric in METRICS:
            line.append(Number(metric, own))
            line.append("-" if base in (None, own) else Number(metric, own, base))
        table.lines.append([*line, *(Number(share, own) for share in shares)])
    return table


def price_tables() -> Iterator[Table]:
    """Yield the tables of the part ``privacy``."""
    along = {f"ε = {value:g}": {"epsilon": value} for value in EPSILONS}
    for name in ESTIMATORS:
        more: dict[str, Line] = {
            f"{error} over {noise}": (metric, partial(priced, name), partial(priced, name, noise))
            for noise in PRINTED
            for metric, error in ERRORS.items()
        }
        yield sweep(f"{LABELS[name]}: what {TRIP} costs", "", along, more)
    for name, (metric, error) in itertools.product(ESTIMATORS, ERRORS.items()):
        lines: dict[str, Line] = {
            protection: (metric, partial(priced, name, protection)) for protection in PROTECTIONS
        }
        yield sweep(f"{LABELS[name]}: {error} against ε", "protection", along, lines)
    boundaries = [
        ([LABELS[name], each], priced(name, boundary=each), priced(name))
        for name, each in itertools.product((*ESTIMATORS, "open_loop"), BOUNDARIES)
    ]
    yield compared("Boundary inputs, ε = 5", ["", "boundary inputs"], "nominal", boundaries)
    bandwidths = [
        ([LABELS[name], str(each)], priced(name, bandwidth=each), priced(name))
        for name, each in itertools.product(ESTIMATORS, BANDWIDTHS)
    ]
    yield compared("Bandwidth, ε = 5", ["", "queried a second"], "5", bandwidths)


def ledger_tables() -> Iterator[Table]:
    """Yield the tables of the part ``ledger``."""
    rungs = [paid(**changes) for _, changes, _ in LADDER]
    ladder = [
        ([f"{k}. {label}", f"{base or '-'}"], rungs[k - 1], rungs[base - 1] if base else None)
        for k, (label, _, base) in enumerate(LADDER, start=1)
    ]
    yield compared("Ladder", ["rung", "base"], "base", ladder, REFUSED)
    at = {f"({e:g}, {d:g})": {"epsilon": e, "delta": d} for e, d in GUARANTEES}
    again: dict[str, Line] = {
        names[0]: (DENSITY, partial(paid, **changes))
        for (names, _, _), (_, changes, _) in zip(ladder, LADDER, strict=True)
    }
    yield sweep(f"Ladder at other (ε, δ): {ERRORS[DENSITY]}", "rung", at, again)
    along = {f"ε = {value:g}": {"epsilon": value} for value in CURVE}
    for metric, delta in itertools.product(METRICS, (DELTA, STRICT)):
        capped, paced = partial(paid, delta=delta, **CAPPED), partial(paid, delta=delta)
        lines: dict[str, Line] = {
            "`capped`": (metric, capped),
            "`paced`": (metric, paced),
            "difference": (metric, paced, capped),
        }
        yield sweep(f"{ERRORS[metric]} against ε, δ = {delta:g}", "", along, lines)
    filters = [
        ([queries, label], paid(estimator=name, queries=queries), paid(queries=queries))
        for queries, (name, label) in itertools.product(SAME_COST, FILTERS.items())
    ]
    yield compared("Filters, `paced`", ["queries", "filter"], "the first", filters, REFUSED)
    variants = [
        ([f"`{release}`", label], paid(release=release, **changes), paid(release=release))
        for release, (label, changes) in itertools.product(("capped", "paced"), VARIANTS.items())
    ]
    yield compared("What is protected", ["", "protected"], "the first", variants, REFUSED)
    settings = [
        ([f"{name} {value:g}", f"{delta:g}"], paid(**{name: value}, delta=delta), paid(delta=delta))
        for name, delta in (("pace", DELTA), ("pace", STRICT), ("clip", DELTA), ("ratio", DELTA))
        for value in VALUES[name]
    ]
    yield compared("Settings, `paced`", ["setting", "δ"], "base", settings, REFUSED, SPENT)
    schedules: dict[str, Line] = {
        f"{name}, {label}": (column, partial(paid, **changes))
        for column, name in {**ERRORS, REFUSED: REFUSED, SPENT: SPENT}.items()
        for label, changes in (("`capped`", CAPPED), ("`paced`", {}), ("equal rates", EQUAL))
    }
    schedules["density RMSE, `paced` − `capped`"] = DENSITY, paid, partial(paid, **CAPPED)
    schedules["density RMSE, equal rates − `paced`"] = DENSITY, partial(paid, **EQUAL), paid
    yield sweep("Schedules", "", {f"`{name}`": {"schedule": name} for name in SCHEDULES}, schedules)


PRICE, LEDGER = list(price_tables()), list(ledger_tables())


def all_cells() -> tuple[Cell, ...]:
    """Return the cells that the tables ask for."""
    found: dict[str, Cell] = {}
    for line in itertools.chain(*(table.lines for table in (*PRICE, *LEDGER))):
        for each in line:
            if isinstance(each, Number):
                found |= {str(own.labels): own for own in (each.own, each.base) if own is not None}
    return tuple(found.values())


def number(rows: pl.DataFrame, asked: Number) -> str:
    """Return a number of a table."""
    if asked.base is None:
        return format_interval(mean(rows, asked.own.labels, asked.column))
    return format_interval(difference(rows, asked.own.labels, asked.base.labels, asked.column))


def render(rows: pl.DataFrame, table: Table) -> str:
    """Return a table below its title."""
    lines = [
        [each if isinstance(each, str) else cell(number, rows, each) for each in line]
        for line in table.lines
    ]
    return f"## {table.title}\n\n{markdown(table.header, lines)}"


def claimed_table(rows: pl.DataFrame) -> str:
    """Return epsilon claimed against epsilon true, for the paper's noise."""
    longest = rows["longest"].drop_nulls().to_list()
    met = [CAP, max(longest)] if longest else [CAP]
    header = ["composed", *(f"met {times} times, at least" for times in met)]
    header += ["met every second, at least", f"met {CAP} times, alone, standing"]
    lines = []
    for noise, epsilon in itertools.product(PRINTED, EPSILONS):
        try:
            config = config_of(rows, priced("ekf", noise, epsilon=epsilon).labels)
        except UnmeasuredError:
            lines.append([noise, f"{epsilon:g}", *["-"] * len(header)])
            continue
        found = [privacy_report(config).epsilon]
        found += [met_epsilon(config, times) for times in (*met, config.horizon_steps)]
        found += [met_epsilon(config, CAP, alone=True)]
        lines.append([noise, f"{epsilon:g}", *map(format_number, found)])
    return markdown(["noise", "claimed", *header], lines)


def equal_errors(rows: pl.DataFrame) -> str:
    """Return the epsilons at which ``paced`` has the density error of ``capped`` at 5.

    The interval holds every epsilon at which the paired difference may be zero.
    """

    def equal(reference: Cell, delta: float) -> str:
        excess = [
            difference(rows, paid(epsilon=each, delta=delta).labels, reference.labels, DENSITY)
            for each in CURVE
        ]
        middle, low, high = (
            crossing(CURVE, [getattr(each, end) for each in excess])
            for end in ("mean", "low", "high")
        )
        return format_interval(Interval(middle, low, high, excess[0].n))

    matched = [
        ("demand states, `round-robin`", paid(**CAPPED), DELTA),
        ("demand states, `round-robin`", paid(delta=STRICT, **CAPPED), STRICT),
        ("EKF, `paper`", paid(estimator="ekf", schedule="paper", **CAPPED), DELTA),
    ]
    lines = [[name, f"{delta:g}", cell(equal, own, delta)] for name, own, delta in matched]
    return markdown(["`capped` at ε = 5", "δ", "ε of `paced`"], lines)


def crossing(places: Sequence[float], values: Sequence[float]) -> float:
    """Return where falling values cross zero, linear in the logarithm of their places.

    Returns:
        0 if all values are below zero, infinity if none is.
    """
    k = next((k for k, value in enumerate(values) if value <= 0.0), None)
    if not k:
        return math.inf if k is None else 0.0
    share = values[k - 1] / (values[k - 1] - values[k])
    return math.exp(math.log(places[k - 1]) + share * math.log(places[k] / places[k - 1]))


def complete(rows: pl.DataFrame) -> pl.DataFrame:
    """Return rows with `SHARES`, and with empty columns for a part that was not played yet."""
    names = {**priced("ekf").labels, **paid().labels}.keys() | {"longest"}.union(*SHARES.values())
    rows = rows.with_columns(pl.lit(None).alias(name) for name in names if name not in rows.columns)
    return rows.with_columns(
        (100.0 * pl.col(part) / pl.col(whole).cast(pl.Float64).clip(1.0)).alias(name)
        for name, (part, whole) in SHARES.items()
    )


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the figures."""
    rows = complete(rows)
    for name, (draw, title) in FIGURES.items():
        path = folder / f"fig_{name}.png"
        try:
            save_figure(draw(rows), path, title)
        except UnmeasuredError:
            path.unlink(missing_ok=True)
    lost = {
        "n_diverged": "started over [s]",
        "n_fallback": "kept the prediction [s]",
        "n_dropped": "dropped requests",
    }
    sums = rows.group_by("part", "estimator").agg(pl.col(*lost).sum().cast(int), pl.len())
    return "\n\n".join(
        [
            "# What a guarantee costs",
            PRICE_NOTE,
            "## ε claimed against ε true",
            CLAIMED_NOTE,
            claimed_table(rows),
            *(render(rows, table) for table in PRICE),
            "# What paced ledgers save",
            LEDGER_NOTE,
            *(render(rows, table) for table in LEDGER),
            "## Equal density errors",
            equal_errors(rows),
            "# What estimators lost",
            markdown(
                ["part", "estimator", *lost.values(), "episodes"],
                [list(map(str, line)) for line in sums.sort("part", "estimator").iter_rows()],
            ),
        ]
    )


PRICE_NOTE = (
    f"Schedule `paper`, 5 segments a second, δ = {DELTA:g}, and {TRIP} where a table does not say "
    "otherwise; boundary inputs are nominal under a guarantee and true under the paper's noise. "
    "Intervals are Student's t at 95 % over traffic seeds, differences paired by traffic and noise."
)
CLAIMED_NOTE = (
    "*Composed*: of both releases, if the preset's own sensitivities held. *Met n times*: of the "
    "densities alone, for a vehicle that is queried in n seconds: those of the cap, of the longest "
    "trip, of an episode. *Alone, standing*: of both, for a vehicle that is the mean speed of its "
    "segment. Boundary inputs are left out: with true ones no finite ε holds."
)
LEDGER_NOTE = (
    f"Where a table does not say otherwise: (ε, δ) = (5, {DELTA:g}) for a whole trip that is "
    "replaced by another, nominal boundary inputs, 5 segments a second, schedule `round-robin`, "
    "the EKF with demand states, and for `paced` a pace of 0.85, a clip of 25 km/h and a ratio of "
    "1. *Refused*: contributions that a cap or a ledger did not cover; *spent*: vehicles that end "
    "above 95 % of their budget. Both are known from the true traffic and serve evaluation alone."
)

# Figures, each drawn where all of its cells were played

COLOURS = {"capped": "#d55e00", "paced": "#0072b2", "exact": GREY}
LOOKS = {
    "event": Look("#009e73", "s"),
    "trip, C = 4": Look("#92c5de", "o"),
    "trip, C = 16": Look("#4393c3", "o"),
    TRIP: Look("#08306b", "o"),
    "horizon": Look("#d55e00", "^"),
    PAPER: Look("#cc79a7", "D"),
    CORRECTED: Look("#7d5ba6", "v"),
}
WATCHED: dict[str, tuple[dict[str, Any], Look]] = {
    "capped, round-robin": (CAPPED, Look("#d55e00", "v")),
    "capped, paper": ({"schedule": "paper", **CAPPED}, Look("#e69f00", "x")),
    "paced, round-robin": ({}, Look("#0072b2", "o")),
    "paced, paper": ({"schedule": "paper"}, Look("#56b4e9", "s")),
    "paced, largest-variance": ({"schedule": "largest-variance"}, Look("#009e73", "^")),
    "paced, round-robin, pace 1": ({"pace": 1.0}, Look("#cc79a7", "D")),
}


def draw_price(rows: pl.DataFrame) -> Figure:
    """Draw errors against epsilon for every protection and estimator."""
    figure = make_figure(9.4, 7.0, dpi=120)
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for axis, (metric, name) in zip(axes.flat, itertools.product(METRICS, ESTIMATORS), strict=True):
        for protection, look in LOOKS.items():
            cells = [priced(name, protection, epsilon=value) for value in EPSILONS]
            means = [mean(rows, each.labels, metric) for each in cells]
            draw_curve(axis, EPSILONS, means, look, protection.replace("`", ""))
        draw_level(axis, mean(rows, priced("open_loop").labels, metric), label="open loop")
        set_log_axes(axis, EPSILONS)
        axis.set_title(LABELS[name], fontsize=9, loc="left")
        axis.set_xlabel("ε claimed")
        axis.set_ylabel(error_label(metric))
    return finish_figure(figure)


def draw_claimed(rows: pl.DataFrame) -> Figure:
    """Draw epsilon claimed against epsilon true, and the density error over the true one."""
    figure = make_figure(9.8, 4.4, dpi=120)
    left, right = figure.subplots(1, 2)
    left.plot(EPSILONS, EPSILONS, color=LOOKS[TRIP].colour)
    for protection in (TRIP, *PRINTED):
        cells = [priced("ekf", protection, epsilon=value) for value in EPSILONS]
        true, look = list(EPSILONS), LOOKS[protection]
        if protection in PRINTED:
            configs = [config_of(rows, each.labels) for each in cells]
            true = [met_epsilon(each, CAP, alone=True) for each in configs]
            least = [met_epsilon(each, CAP) for each in configs]
            left.plot(EPSILONS, true, color=look.colour)
            left.plot(EPSILONS, least, ":", color=look.colour)
        means = [mean(rows, each.labels, DENSITY) for each in cells]
        draw_curve(right, true, means, look, protection.replace("`", ""))
    set_log_axes(left, EPSILONS)
    set_log_axes(right, DECADES)
    set_log_ticks(left.yaxis, DECADES)
    left.set_xlabel("ε claimed")
    left.set_ylabel("ε true (dotted: of densities alone)")
    right.set_xlabel("ε true")
    right.set_ylabel(f"EKF: {error_label(DENSITY)}")
    return finish_figure(figure)


def draw_ladder(rows: pl.DataFrame) -> Figure:
    """Draw the errors of every rung, coloured by release model, from top to bottom."""
    figure = make_figure(9.8, 1.4 + 0.34 * len(LADDER))
    axes = figure.subplots(1, 2, sharey=True)
    for axis, metric in zip(axes, METRICS, strict=True):
        for k, (_, changes, _) in enumerate(LADDER):
            colour = COLOURS[changes.get("release", "paced")]
            draw_dot(axis, mean(rows, paid(**changes).labels, metric), -k, colour, None)
        axis.set_xscale("log")
        set_log_ticks(axis.xaxis, ERROR_TICKS)
        axis.margins(x=0.12)
        axis.set_xlabel(error_label(metric))
        add_frame(axis, "x")
    labels = [f"{k}. {label}".replace("`", "") for k, (label, _, _) in enumerate(LADDER, start=1)]
    axes[0].set_yticks([-k for k in range(len(LADDER))], labels)
    return figure


def draw_budgets(rows: pl.DataFrame) -> Figure:
    """Draw the contributions that were refused, by length of trip and by place."""
    figure = make_figure(9.8, 4.4, dpi=120)
    axes = figure.subplots(1, 2)
    for axis, suffix in zip(axes, ("_of", ""), strict=True):
        for k, (name, (changes, look)) in enumerate(WATCHED.items()):
            found = pick(rows, paid(**changes).labels)
            shares = refused_shares(found, f"refused{suffix}", f"met{suffix}")
            places = [place + 0.09 * (k - 2.5) for place in shares]
            draw_curve(axis, places, list(shares.values()), look, name)
        axis.set_ylim(bottom=0.0)
    bins = [*(f"{a}–{b}" for a, b in itertools.pairwise(LENGTHS)), f"{LENGTHS[-1]}+"]
    axes[0].set_xticks(range(len(bins)), bins)
    axes[0].set_xlabel("time on the mainline [s]")
    axes[1].set_xlabel("mainline segment")
    axes[0].set_ylabel("contributions refused [%]")
    return finish_figure(figure, axes[:1], columns=3)


def refused_shares(rows: pl.DataFrame, part: str, whole: str) -> dict[int, Interval]:
    """Return the mean ratio [%] of two columns of lists by place in the list.

    Seeds with nothing of the whole are left out, and so are places where fewer than two are left.

    Raises:
        UnmeasuredError: Vehicles were not followed.
    """
    if part not in rows.columns or rows[part].null_count():
        raise UnmeasuredError(part)
    parts, wholes = (np.array(rows[name].to_list(), dtype=np.float64).T for name in (part, whole))
    return {
        place: mean_interval(100.0 * a[b > 0.0] / b[b > 0.0])
        for place, (a, b) in enumerate(zip(parts, wholes, strict=True))
        if (b > 0.0).sum() > 1
    }


FIGURES = {
    "price": (draw_price, "Errors against the claimed ε, δ = 0.05"),
    "claimed": (draw_claimed, "ε of a vehicle met 64 times, alone and standing, δ = 0.05"),
    "ladder": (draw_ladder, "(ε, δ) = (5, 0.05) for a whole trip, replaced"),
    "budgets": (draw_budgets, "Who runs out (true traffic, for evaluation alone)"),
}
STUDY = Study("guarantees", all_cells(), SEEDS, report)
