"""Estimators on roads that nobody trained on: own roads, drawn ones, and sections of longer ones.

Every vehicle answers queries, which go round robin. The filters have the settings that were tuned
for PrivateHighway-v1, and its parameters; on drawn roads parameters that were calibrated on each.
Weights other than those of the package are given with
the name of the study; rows of the others are played once.

dptse study 'roads {"weights": ["results/weights/seed-2/roads"]}' --output results/mine
"""

from __future__ import annotations

import contextlib
import hashlib
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from agents.environments import GUARANTEE, LONG, PAPER, PRIVATE, guarantee_of
from agents.figures import LABELS, draw_errors, save_measured
from agents.play import Cell
from agents.statistics import Interval
from agents.studies.roads import drawn
from agents.studies.roads.recorded import QUEUES, TEST
from agents.study import Study
from agents.tables import (
    DENSITY,
    ERROR,
    Labels,
    UnmeasuredError,
    below,
    cell,
    chi2,
    chi2_text,
    give_or_take,
    mean,
    table,
    tenths,
)
from dptse_env.estimators.recurrent import member_for, shipped_weights
from dptse_env.utils.files import file_digest
from dptse_env.utils.validation import convert

SEEDS, MORE_SEEDS = tuple(range(2000, 2008)), tuple(range(2000, 2016))
FILTERS, RECURRENT = ("ekf", "blend", "asm"), "recurrent"
ALL_FILTERS = ("ekf", "ukf", "enkf", "mhe", "blend", "asm")
"""Filters on drawn roads."""
PACED, CORRECTED = "paced", "corrected"
MUCH_NOISE, LITTLE_NOISE = "paced, ε = 1", "paced, ε = 1000"
RELEASES: dict[str, dict[str, Any]] = {
    PACED: {"privacy": PACED, "epsilon": 5.0},
    CORRECTED: {"privacy": CORRECTED, "epsilon": 1.0},
    "printed": {"privacy": "printed", "epsilon": 1.0},
    MUCH_NOISE: {"privacy": PACED, "epsilon": 1.0},
    LITTLE_NOISE: {"privacy": PACED, "epsilon": 1000.0},
}
"""Keywords of the release models, which are those of the environments that come with them."""


_Part = tuple[dict[str, Any], tuple[int, ...]]


class Road(NamedTuple):
    """A road with its traffic.

    Attributes:
        env: Environment id.
        parts: Keywords, each with traffic seeds that no other one has.
        releases: Release models.
        filters: Filters that the network is held against.
    """

    env: str
    parts: Sequence[_Part]
    releases: Sequence[str] = (PACED, CORRECTED)
    filters: Sequence[str] = FILTERS


def _section(number: int) -> _Part:
    """Return a section as a part; `agents.studies.roads.recorded` has its road."""
    corridor = f"agents.studies.roads.recorded:section_{number}"
    return {"corridor": corridor, "bandwidth": 3, "traffic_seeds": (number,)}, (number,)


def _own_roads() -> dict[str, dict[str, Any]]:
    """Return the keywords of the own roads; TOML has no null for a road without incidents."""
    roads = tomllib.loads(Path(__file__).with_name("own.toml").read_text(encoding="utf-8"))
    for road in roads.values():
        if road["corridor"].get("incident") == "none":
            road["corridor"]["incident"] = None
    return roads


_OWN_ROADS = _own_roads()
KEPT_BACK = [name for name, keywords in _OWN_ROADS.items() if keywords.pop("kept_back", False)]
"""Roads on which nothing was chosen."""
_CALIBRATED, _FIVE = {"parameters": "w99-3lane"}, {"bandwidth": 5}
OTHERS: dict[str, Road] = {
    **{
        f"sections, {queue}": Road(PRIVATE, [*map(_section, numbers)])
        for queue, numbers in QUEUES.items()
    },
    "PrivateHighway-v1": Road(PRIVATE, [(_FIVE, MORE_SEEDS)]),
    "PaperHighway-v0": Road(PAPER, [(_CALIBRATED, MORE_SEEDS)], ("printed", CORRECTED)),
    "LongHighway-v0": Road(LONG, [({"bandwidth": 8}, SEEDS)], (PACED,)),
}
"""Beside the own roads: recorded ones, and those that weights are trained on."""
OWN = {name: Road(PRIVATE, [(_FIVE | each, SEEDS)]) for name, each in _OWN_ROADS.items()}
DRAWN = {
    name: Road(
        PRIVATE,
        [(_FIVE | drawn.keywords(name), TEST)],
        (MUCH_NOISE, PACED, LITTLE_NOISE),
        ALL_FILTERS,
    )
    for name in drawn.NAMES
}
ROADS = {**OWN, **OTHERS, **DRAWN}


def lines(roads: Iterable[str] = (*OWN, *OTHERS)) -> list[tuple[str, str]]:
    """Return each road with each of its release models."""
    return [(name, release) for name in roads for release in ROADS[name].releases]


def on_road(road: str, release: str, estimator: str, network: str = "") -> Labels:
    """Return the labels of an estimator on a road."""
    return {"road": road, "release": release, "estimator": estimator, "network": network}


def member(weights: str, release: str) -> str | None:
    """Return the member of a pair that suits a release model; None where it is missing."""
    found = member_for(weights, flows=RELEASES[release]["privacy"] == PACED)
    return found if found in shipped_weights() or Path(found).is_file() else None


def named(weights: str) -> str:
    """Return the name of weights in tables: their own, and for files that with a digest of them.

    Raises:
        FileNotFoundError: There are no such weights.
    """
    members = sorted({found for each in RELEASES if (found := member(weights, each))})
    if not members:
        raise FileNotFoundError(
            f"weights must be a name of the package, a file, or what the files "
            f"<weights>-flows.safetensors and <weights>-speeds.safetensors begin with, "
            f"got {weights!r}"
        )
    if members[0] in shipped_weights():
        return weights
    digest = hashlib.sha256("".join(map(file_digest, members)).encode()).hexdigest()
    return f"{Path(weights).name} {digest[:6]}"


def study(weights: Sequence[str] = ()) -> Study:
    """Return the study, with some weights beside those of the package.

    Args:
        weights: Each a name or what the files of a pair begin with. One of a pair is played where
            it suits.

    Raises:
        FileNotFoundError: There are no such weights.
        ValueError: They are no list of texts.
    """
    weights = convert(tuple[str, ...], weights, "weights")
    who = [(name, "", "") for name in (*ALL_FILTERS, RECURRENT)]
    who += [(RECURRENT, named(each), each) for each in weights]
    cells = []
    for (name, release), (estimator, network, own) in product(lines(ROADS), who):
        is_other = estimator in ALL_FILTERS and estimator not in ROADS[name].filters
        if is_other or (own and not member(own, release)):
            continue
        more: dict[str, Any] = {**RELEASES[release], "estimator": estimator}
        if own:
            more["estimator_settings"] = {"recurrent": {"weights": own}}
        labels = on_road(name, release, estimator, network)
        cells += [
            Cell(
                ROADS[name].env, "round-robin", {**keywords, **more}, labels,
                watchers=("honesty",), seeds=seeds,
            )
            for keywords, seeds in ROADS[name].parts
        ]  # fmt: skip
    return Study("roads", tuple(cells), SEEDS, report)


# ---- Tables and a figure. ----

NOTES = f"""Errors are minus the reward after the warm-up, x 1000, on {len(SEEDS)} test seeds or
more, with 95 % intervals. *Best filter*: the one with the smallest mean error; differences from it
are paired. *χ²*: mean square of errors over reported deviations, of densities and of speeds.
Nothing was chosen on roads with an asterisk: they were played once, at the end."""


def best_filter(rows: pl.DataFrame, road: str, release: str) -> str:
    """Return the filter with the smallest mean error on a road.

    Raises:
        UnmeasuredError: One of them was not played there.
    """
    filters = ROADS[road].filters
    return min(filters, key=lambda name: mean(rows, on_road(road, release, name), ERROR).mean)


def gain(rows: pl.DataFrame, network: str, road: str, release: str) -> Interval:
    """Return by how much the error of a network lies below that of the best filter [%], paired.

    Raises:
        UnmeasuredError: Something was not played there.
    """
    best = on_road(road, release, best_filter(rows, road, release))
    return below(rows, on_road(road, release, RECURRENT, network), best)


def networks_in(rows: pl.DataFrame) -> list[str]:
    """Return the names of the networks that were played; that of the package, "", comes first."""
    own = rows.filter(pl.col("estimator") == RECURRENT, pl.col("network") != "")
    return ["", *own["network"].unique().sort()]


def table_of(rows: pl.DataFrame, network: str, roads: Iterable[str] = (*OWN, *OTHERS)) -> str:
    """Return the table of a network beside the filters of some roads."""
    filters = ROADS[next(iter(roads))].filters

    def of(estimator: str, line: tuple[str, str]) -> Labels:
        return on_road(*line, estimator, network if estimator == RECURRENT else "")

    def error(estimator: str, line: tuple[str, str]) -> str:
        return give_or_take(mean(rows, of(estimator, line), ERROR))

    def honesty(estimator: str, line: tuple[str, str]) -> str:
        return chi2_text(rows, of(estimator, line))

    def density_ratio(line: tuple[str, str]) -> str:
        errors = [mean(rows, of(each, line), DENSITY).mean for each in (RECURRENT, "ekf")]
        return f"{errors[0] / errors[1]:.2f}"

    columns: dict[str, Callable[[tuple[str, str]], str]] = {
        GUARANTEE: lambda line: guarantee_of(PRIVATE, RELEASES[line[1]]),
        **{LABELS[name]: partial(error, name) for name in (*filters, RECURRENT)},
        "below best filter [%]": lambda line: tenths(gain(rows, network, *line)),
        **{f"χ² of {LABELS[name]}": partial(honesty, name) for name in (filters[-1], RECURRENT)},
        "density RMSE over EKF's": density_ratio,
    }
    heads = {f"{line[0]}{'*' * (line[0] in KEPT_BACK)}, {line[1]}": line for line in lines(roads)}
    return table("", heads, columns)


def losses(rows: pl.DataFrame, network: str) -> str:
    """Return a sentence on how often a network errs more than the best filter on drawn roads.

    Raises:
        UnmeasuredError: Something was not played.
    """
    gains = [gain(rows, network, road, release) for road, release in lines(DRAWN)]
    total, n_lost = np.mean([each.mean for each in gains]), sum(each.high < 0.0 for each in gains)
    return (
        f"{total:.1f} % below the best filter in the mean. It errs more, beyond the interval, on "
        f"{n_lost} of {len(gains)} lines."
    )


def summary(rows: pl.DataFrame, network: str) -> str:
    """Return a sentence for each release model on the own roads together.

    Raises:
        UnmeasuredError: None was played.
    """
    said = []
    for release in (PACED, CORRECTED):
        gains, worst = {}, {}
        for road in OWN:
            with contextlib.suppress(UnmeasuredError):
                gains[road] = gain(rows, network, road, release).mean
                worst[road] = max(chi2(rows, on_road(road, release, RECURRENT, network)))
        if not gains:
            raise UnmeasuredError(network)
        least, largest = min(gains, key=gains.__getitem__), max(worst, key=worst.__getitem__)
        said.append(
            f"`{release}`: {np.mean([*gains.values()]):.1f} % below the best filter in the mean "
            f"over {len(gains)} own roads, at least {gains[least]:.1f} % ({least}); χ² at most "
            f"{worst[largest]:.2f} ({largest})."
        )
    return "\n".join(f"- {each}" for each in said)


def draw_gains(rows: pl.DataFrame) -> Figure:
    """Draw by how much the recurrent network errs less than the best filter of each road."""
    label = "error below that of the best filter [%]"
    names = list(dict.fromkeys(road for road, _ in lines()))
    series = {
        release: {
            road: {label: gain(rows, "", road, release)}
            for road in names
            if release in ROADS[road].releases
        }
        for release in dict.fromkeys(release for _, release in lines())
    }
    return draw_errors(names, series, log=False)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return a table for each network, and draw the gains of `recurrent`."""
    title = f"The network below the best filter, {PACED} at ε = {RELEASES[PACED]['epsilon']:g}"
    save_measured(folder / "fig_roads.png", f"{title}, 95 % intervals", draw_gains, rows)
    parts = ["# Roads that nobody trained on", NOTES, "![Gains](fig_roads.png)"]
    for each in networks_in(rows):
        name = f"`{RECURRENT}` {each}".rstrip()
        parts += [f"## {name}", cell(summary, rows, each), table_of(rows, each)]
        if not rows.filter(pl.col("road").is_in(list(DRAWN))).is_empty():
            parts += [f"### {name} on drawn roads", cell(losses, rows, each)]
            parts.append(table_of(rows, each, DRAWN))
    return "\n\n".join(parts)


STUDY = study()
