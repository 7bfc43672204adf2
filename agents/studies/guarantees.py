"""The cost of a privacy guarantee, and what paced ledgers save of it.

The part ``privacy`` plays one query schedule under the paper's noise and under capped
contributions, whose guarantee holds, for every epsilon, cap and protected unit. The part ``ledger``
holds capped contributions against paced ledgers at the same guarantee, and follows who runs out of
budget. All cells have the same traffic; a number of one part is never held against the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from agents.environments import GUARANTEE, PRIVATE, guarantee_of
from agents.figures import (
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
from agents.study import Study
from agents.tables import (
    DENSITY,
    METRICS,
    cell,
    difference,
    error_label,
    format_interval,
    format_number,
    grid,
    markdown,
    mean,
)
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.privacy import epsilon_of, mu_of, rounded_up
from dptse_env.release import Paced, Pacing, ReleaseModel, Task, Traffic
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

SEEDS = tuple(range(2000, 2020))
DELTA, CAP = 0.05, 64

# What the ledgers are held against: no noise


class AnyPrice(Pacing):
    """A price for every query that leaves a count the noise of a thousandth of a vehicle."""

    def prices(
        self, episodes: IntArray, observed: BoolArray, density: FloatArray, speed: FloatArray
    ) -> FloatArray:
        """See `Pacing.prices`."""
        return np.full(observed.shape, 1e6)

    def expected_prices(self, speed: FloatArray) -> FloatArray:
        """See `Pacing.expected_prices`."""
        return np.full(self.budget.shape, 1e6)


class Exact(Paced):
    """The sums that `Paced` releases, of all vehicles and with negligible noise.

    It protects nobody: a floor for the errors of one filter. Centres and clip are those of `Paced`;
    epsilon and delta have no effect.
    """

    claims_guarantee: ClassVar[bool] = False
    # What is known of a release without a guarantee, and without budgets.
    spent, report = ReleaseModel.spent, ReleaseModel.report
    private = ReleaseModel.private

    def __init__(self, task: Task, traffic: Traffic) -> None:
        """Make ledgers without a limit."""
        super().__init__(task, traffic)
        self.ledgers.terms.budget[:] = math.inf
        self.pacing = AnyPrice(task, self.pacing.budget)


SETTINGS_OF_EXACT: dict[str, Any] = {
    "process_noise": [0.001012, 5.239e-05], "noise_scale": [1.0, 2.947],
    "vehicle_noise": [0.09821, 0.08092], "flicker": True,
    "demand": {"deviation": 0.02614, "memory": 261.7},
}  # fmt: skip
"""Those of the EKF, tuned for `Exact` as those that ship are for other releases: ``dptse fit --tune
--env 'dptse_env:dptse/PrivateHighway-v1 {"privacy": {"preset": "agents.studies.guarantees:Exact"}}'
--estimators ekf --policies round-robin --also demand noise-scale --train-seeds 0:16``."""

# Cells of the part "privacy"

ESTIMATORS = ("ekf", "random_walk")
EPSILONS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
BOUNDARIES, BANDWIDTHS = ("nominal", "private", "true"), (3, 5, 8, 15)
TRIP, PRINTED, CORRECTED = "trip, C = 64", "`printed` noise", "`corrected` noise"
PROTECTIONS: dict[str, dict[str, Any]] = {
    "event": {"preset": "capped", "unit": "event"},
    **{f"trip, C = {c}": {"preset": "capped", "unit": "trip", "cap": c} for c in (4, 16, CAP)},
    "horizon": {"preset": "capped", "unit": "trip", "cap": 700},
    PRINTED: {"preset": "printed"},
    CORRECTED: {"preset": "corrected"},
}
"""Privacy settings by their name in the tables."""
SPEEDS = (PRINTED, CORRECTED)


def priced(estimator: str, protection: str = TRIP, **changes: Any) -> Cell:
    """Return a cell of the price of a guarantee; the boundary is by default the preset's own."""
    given = {
        "estimator": estimator, "protection": protection, "epsilon": 5.0, "bandwidth": 5,
        "boundary": "true" if protection in SPEEDS else "nominal",
    } | changes  # fmt: skip
    privacy = {"epsilon": given["epsilon"], "delta": DELTA, "boundary_inputs": given["boundary"]}
    privacy |= PROTECTIONS[protection]
    keywords = {"estimator": estimator, "bandwidth": given["bandwidth"], "privacy": privacy}
    return Cell(PRIVATE, "shift-ahead", keywords, {"part": "privacy", **given})


# Cells of the part "ledger"

SETTINGS: dict[str, Any] = {
    "epsilon": 5.0, "delta": DELTA, "adjacency": "replace", "unit": "trip",
    "clip": 25.0, "ratio": 1.0,
}  # fmt: skip
"""Privacy settings of a cell of the ledgers, but for what it varies."""
BASE = SETTINGS | {
    "release": "paced", "estimator": "ekf", "schedule": "round-robin",
    "boundary": "nominal", "queries": "5 segments",
}  # fmt: skip
LACKS = {
    "paced": (),
    "capped": ("clip", "ratio"),
    "exact": ("epsilon", "delta", "adjacency", "unit", "ratio"),
}
"""Value of a setting that a release model does not have."""
QUERIES: dict[str, dict[str, Any]] = {
    "5 segments": {"bandwidth": 5},
    "10 segments": {"bandwidth": 10},
    "5 sums of 2": {"bandwidth": 5, "query_spans": [2], "bandwidth_unit": "sums"},
    "2 sums of 2": {"bandwidth": 4, "query_spans": [2], "bandwidth_unit": "segments"},
    "3 sums of 2": {"bandwidth": 6, "query_spans": [2], "bandwidth_unit": "segments"},
}
"""Queries of a second; a sum is over neighbouring segments."""
CURVE = (0.5, 1.0, 2.0, 5.0, 10.0)
VARIANTS: dict[str, dict[str, Any]] = {
    "a trip, replaced": {},
    "added or removed": {"adjacency": "add_remove"},
    "a second": {"unit": "event"},
    "private boundary inputs": {"boundary": "private"},
}
GUARANTEES = ((5.0, DELTA), (1.0, DELTA), (5.0, 1e-6))
CAPPED, SHIFTING = {"release": "capped"}, {"schedule": "shift-ahead"}
LADDER: tuple[tuple[str, dict[str, Any], int], ...] = (
    ("1. `capped`, EKF, `shift-ahead`", {**SHIFTING, **CAPPED}, 1),
    ("2. `paced`, EKF, `shift-ahead`", SHIFTING, 1),
    ("3. `paced`, EKF, `round-robin`", {}, 2),
    ("4. `capped`, EKF, `round-robin`", CAPPED, 1),
    ("5. `paced`, 10 segments a second", {"queries": "10 segments"}, 3),
    ("6. `paced`, 5 sums of 2", {"queries": "5 sums of 2"}, 3),
    ("7. `paced`, 2 sums of 2, 4 segments", {"queries": "2 sums of 2"}, 6),
    ("8. `paced`, 3 sums of 2, 6 segments", {"queries": "3 sums of 2"}, 6),
    ("9. `capped`, random walk, `round-robin`", {"estimator": "random_walk", **CAPPED}, 4),
    ("10. `paced`, random walk, `round-robin`", {"estimator": "random_walk"}, 9),
    ("11. no noise, EKF, `round-robin`", {"release": "exact"}, 3),
    ("12. no noise, 5 sums of 2", {"release": "exact", "queries": "5 sums of 2"}, 6),
)
"""Rungs: a label, what differs from `BASE`, and the number of the rung that it is held against,
which differs from it in one thing."""


def paid(**changes: Any) -> Cell:
    """Return a cell whose vehicles are followed: `BASE` but for what is given."""
    given = BASE | changes
    given = {name: given[name] for name in given if name not in LACKS[given["release"]]}
    is_exact = given["release"] == "exact"
    privacy = {key: value for key, value in given.items() if key in SETTINGS}
    privacy["preset"] = f"{__name__}:Exact" if is_exact else given["release"]
    privacy["boundary_inputs"] = given["boundary"]
    keywords = {
        "estimator": given["estimator"], "privacy": privacy, **QUERIES[given["queries"]],
    }  # fmt: skip
    if is_exact:
        keywords["estimator_settings"] = SETTINGS_OF_EXACT
    labels = {"part": "ledger", **given}
    return Cell(PRIVATE, given["schedule"], keywords, labels, watchers=("contributions",))


# What noise is worth


def met_epsilon(config: EnvConfig, *, alone: bool = False) -> float:
    """Return epsilon of the paper's noise for a vehicle that is met `CAP` times and replaced.

    The vehicle that replaces it is met as often, elsewhere. Boundary inputs are left out; with true
    ones no finite epsilon holds.

    Args:
        config: Its configuration.
        alone: Whether it stands and is alone on its segment, so that it is the mean speed there,
            and an empty segment releases the speed limit. Otherwise only densities count, which
            bounds epsilon from below whatever the vehicle does.
    """
    density_std, speed_std = (each.noise_std for each in privacy_report(config).releases)
    norm = math.sqrt(2.0 * CAP)  # of the numbers of two vehicles, each at its own places
    density = norm / min(config.corridor.geometry.segment_lengths) / density_std
    speed = norm * config.corridor.geometry.largest_speed_limit / speed_std if alone else 0.0
    return epsilon_of(math.hypot(density, speed), config.privacy.delta)


CLAIMS: dict[str, Callable[[EnvConfig], float]] = {
    "composed": lambda config: privacy_report(config).epsilon,
    f"met {CAP} times, at least": met_epsilon,
    f"met {CAP} times, alone, standing": partial(met_epsilon, alone=True),
}
"""Accounts of the paper's noise, by assumption."""
CLAIMED = [f"{noise}: {claim}" for noise, claim in product(SPEEDS, CLAIMS)]


def true_epsilon(line: str, claimed: float) -> float:
    """Return epsilon of a kind of noise under an assumption, given as ``noise: assumption``."""
    noise, claim = line.split(": ")
    return CLAIMS[claim](priced("ekf", noise, epsilon=claimed).config)


# Tables, which ask for numbers of cells and so say which ones are played

REFUSED = "refused [%]"
ERRORS = {metric: error_label(metric) for metric in METRICS}

Ask = Callable[..., str]
"""Returns the mean of a column of a cell, or by how much it exceeds that of another one."""
Line = tuple[str, Callable[..., Cell]] | tuple[str, Callable[..., Cell], Callable[..., Cell]]
"""A column of the rows, and what makes the cell, or the two cells, of what a table varies."""
Columns = Mapping[str, Mapping[str, Any]]
"""Headers, and what is varied below them."""


def along(epsilons: Iterable[float]) -> Columns:
    """Return a column for each epsilon."""
    return {f"ε = {value:g}": {"epsilon": value} for value in epsilons}


def sweep(ask: Ask, corner: str, columns: Columns, lines: Mapping[str, Line]) -> str:
    """Return a table whose columns vary something in every line."""

    def entry(line: str, head: str) -> str:
        column, *makers = lines[line]
        return ask(column, *(make(**columns[head]) for make in makers))

    return grid(corner, list(lines), list(columns), entry)


def compared(ask: Ask, reference: str, lines: Mapping[str, tuple[Cell, Cell]], *more: str) -> str:
    """Return a table of both errors of cells, each against another cell, and of more columns."""
    found = []
    for name, (own, base) in lines.items():
        line = [name, ask(GUARANTEE, own)]
        for metric in METRICS:
            line += [ask(metric, own), "-" if own == base else ask(metric, own, base)]
        found.append([*line, *(ask(column, own) for column in more)])
    header = chain.from_iterable((name, f"against {reference}") for name in ERRORS.values())
    return markdown(["", GUARANTEE, *header, *more], found)


def price_tables(ask: Ask) -> Iterator[str]:
    """Yield the tables of the part ``privacy``, each below its title."""
    for name, (metric, error) in product(ESTIMATORS, ERRORS.items()):
        yield f"## {LABELS[name]}: {error} against ε, δ = {DELTA:g}"
        makers = {each: partial(priced, name, each) for each in PROTECTIONS}
        lines: dict[str, Line] = {each: (metric, make) for each, make in makers.items()}
        for noise in SPEEDS:
            lines[f"{TRIP} − {noise}"] = metric, makers[TRIP], makers[noise]
        yield sweep(ask, "protection", along(EPSILONS), lines)
    yield "## Boundary inputs"
    boundaries = {
        f"{LABELS[name]}, {each}": (priced(name, boundary=each), priced(name))
        for name, each in product((*ESTIMATORS, "open_loop"), BOUNDARIES)
    }
    yield compared(ask, "nominal", boundaries)
    yield "## Bandwidth"
    bandwidths = {
        f"{LABELS[name]}, {each} a second": (priced(name, bandwidth=each), priced(name))
        for name, each in product(ESTIMATORS, BANDWIDTHS)
    }
    yield compared(ask, "5", bandwidths)


def ledger_tables(ask: Ask) -> Iterator[str]:
    """Yield the tables of the part ``ledger``, each below its title."""
    yield "## Ladder"
    ladder = {
        f"{name} ({base})": (paid(**changes), paid(**LADDER[base - 1][1]))
        for name, changes, base in LADDER
    }
    yield compared(ask, "(rung)", ladder, REFUSED)
    yield f"## Ladder at other (ε, δ): {ERRORS[DENSITY]}"
    at = {
        f"({e:g}, {d:g}), μ = {rounded_up(mu_of(e, d), '.2f')}": {"epsilon": e, "delta": d}
        for e, d in GUARANTEES
    }
    again = {name: (DENSITY, partial(paid, **changes)) for name, changes, _ in LADDER}
    yield sweep(ask, "rung", at, again)
    capped = partial(paid, **CAPPED)
    lines: dict[str, Line] = {}
    for column, name in (ERRORS | {REFUSED: REFUSED}).items():
        lines[f"{name}: `capped`"] = column, capped
        lines[f"{name}: `paced`"] = column, paid
        lines[f"{name}: `paced` − `capped`"] = column, paid, capped
    yield f"## Errors against ε, δ = {DELTA:g}"
    yield sweep(ask, "", along(CURVE), lines)
    yield f"## What is protected, ε = {SETTINGS['epsilon']:g}, δ = {DELTA:g}"
    yield sweep(ask, "", VARIANTS, lines)


def all_cells() -> tuple[Cell, ...]:
    """Return the cells that the tables ask for."""
    found: dict[str, Cell] = {}

    def note(_: str, *cells: Cell) -> str:
        found.update({str(each.labels): each for each in cells})
        return ""

    list(chain(price_tables(note), ledger_tables(note)))
    return tuple(found.values())


def number(rows: pl.DataFrame, column: str, own: Cell, base: Cell | None = None) -> str:
    """Return the mean of a column of a cell, or by how much it exceeds that of another, paired.

    `GUARANTEE` is what a cell has whether it was played or not.
    """
    if column == GUARANTEE:
        return guarantee_of(own.env, own.keywords)
    if base is None:
        return format_interval(mean(rows, own.labels, column))
    return format_interval(difference(rows, own.labels, base.labels, column))


PRICE_NOTE = (
    f"Schedule `shift-ahead`, 5 segments a second, δ = {DELTA:g}, and {TRIP} where a table does "
    "not say otherwise; boundary inputs are nominal under a guarantee and true under the paper's "
    "noise. Intervals are Student's t at 95 % over traffic seeds, differences paired by traffic "
    "and noise."
)
CLAIMED_NOTE = (
    "On the road of PrivateHighway. *Composed*: of both releases, if the preset's own "
    f"sensitivities held. *Met {CAP} times*: of the densities alone. *Alone, standing*: of both, "
    "for a vehicle that is the mean speed of its segment. Boundary inputs are left out: with true "
    "ones no finite ε holds."
)
LEDGER_NOTE = (
    f"Where a table does not say otherwise: (ε, δ) = (5, {DELTA:g}) for a whole trip that is "
    "replaced by another, nominal boundary inputs, 5 segments a second, schedule `round-robin`, "
    "the EKF, and for `paced` a clip of 25 km/h and a ratio of 1. Without noise the EKF has "
    "settings that were tuned without noise. *Refused*: contributions that a cap or a ledger did "
    "not cover, known from the true traffic and for evaluation alone."
)

# Figures, each drawn where all of its cells were played

LOOKS = {
    "event": Look("#009e73", "s"),
    "trip, C = 4": Look("#92c5de", "o"),
    "trip, C = 16": Look("#56a9dd", "P"),
    TRIP: Look("#1a80c4", "X"),
    "horizon": Look("#d55e00", "^"),
    PRINTED: Look("#cc79a7", "D"),
    CORRECTED: Look("#9370bd", "v"),
}


def draw_price(rows: pl.DataFrame) -> Figure:
    """Draw errors against epsilon for every protection and estimator."""
    figure = make_figure(WIDTH, 6.0)
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for axis, (metric, name) in zip(axes.flat, product(METRICS, ESTIMATORS), strict=True):
        for protection, look in LOOKS.items():
            cells = [priced(name, protection, epsilon=value) for value in EPSILONS]
            means = [mean(rows, each.labels, metric) for each in cells]
            draw_curve(axis, EPSILONS, means, look, protection.replace("`", ""))
        draw_level(axis, mean(rows, priced("open_loop").labels, metric), label="open loop")
        set_log(axis, EPSILONS, ERROR_TICKS)
        axis.set_title(LABELS[name], fontsize=9, loc="left")
        axis.set_xlabel("ε claimed")
        axis.set_ylabel(error_label(metric))
    return finish_figure(figure)


def draw_ladder(rows: pl.DataFrame) -> Figure:
    """Draw the errors of every rung, from top to bottom."""
    rungs = {
        label.replace("`", ""): {
            error: mean(rows, paid(**changes).labels, metric) for metric, error in ERRORS.items()
        }
        for label, changes, _ in LADDER
    }
    return draw_errors(list(rungs), {"": rungs})


FIGURES = {
    "fig_price.png": (draw_price, f"Errors against the claimed ε, δ = {DELTA:g}"),
    "fig_ladder.png": (draw_ladder, f"(ε, δ) = (5, {DELTA:g}) for a whole trip, replaced"),
}


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the figures."""
    if "n_met" in rows.columns:  # an interrupted run may have the rows of one part alone
        met = pl.col("n_met").cast(pl.Float64).clip(1.0)
        rows = rows.with_columns((100.0 * pl.col("n_refused") / met).alias(REFUSED))
    for name, (draw, title) in FIGURES.items():
        save_measured(folder / name, title, draw, rows)
    ask = partial(cell, number, rows)
    return "\n\n".join(
        [
            "# What a guarantee costs",
            PRICE_NOTE,
            "## ε claimed against ε true",
            CLAIMED_NOTE,
            grid("claimed", CLAIMED, EPSILONS, lambda *at: format_number(true_epsilon(*at))),
            *price_tables(ask),
            "# What paced ledgers save",
            LEDGER_NOTE,
            *ledger_tables(ask),
        ]
    )


STUDY = Study("guarantees", all_cells(), SEEDS, report)
