"""ARZ parameters by the errors of the filter that has them, on training traffic.

Errors of a model's predictions do not tell what serves a filter: with a higher v_f and a lower
gamma predictions go on improving, to whatever bound the search has, while the filter gets worse. So
the search plays whole episodes and minimises the error that the environment reports. It begins at
a shipped set, and the filter has the tuned settings of that set, which the fitted one inherits.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import optimize

from agents.files import write_json
from agents.play import Cell, play
from agents.terminal import told
from dptse_env.config import TIME_STEP
from dptse_env.model import ARZModel, ARZParameters
from dptse_env.release import Traffic
from dptse_env.traffic import Corridor, RecordLibrary
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.progress import make_bar
from dptse_env.utils.validation import read_json

FIELDS = ("free_flow_speed", "jam_density", "gamma", "relaxation_time")
"""Parameters that are searched, the jam density for one lane."""

TOLD = 20
"""Trials after which a file, which has no bar, is told of them."""

_WIDTH = 0.2  # first steps of the search, as shares of the values
_REFUSED = 1e4  # error x 1000 of parameters that violate the CFL condition

MEANING = {
    ("free_flow_speed", "least"): "traffic is far slower than its limit: check speed_limit",
    ("free_flow_speed", "largest"): (
        "v_f and gamma compensate each other here: v_f shapes the curve, and nobody drives at it"
    ),
    ("free_flow_speed", "cfl"): (
        "the shortest segments and steps of 1 s allow no higher one; longer segments would"
    ),
    ("jam_density", "least"): (
        "the bound is the densest traffic of the records, or 40 veh/km for a lane. The search "
        "wants less because the filter's process noise is in units of it"
    ),
    ("jam_density", "largest"): "no jam was recorded that would tell how dense one is",
    ("gamma", "least"): (
        "speeds fall with the logarithm of density: v_f and the jam density compensate each other"
    ),
    ("gamma", "largest"): "speeds hardly depend on density: there was no queue to learn from",
    ("relaxation_time", "least"): "drivers follow the density at once",
    ("relaxation_time", "largest"): "speeds keep what they had at the entry: none relaxes",
}
"""Meaning of a parameter that ended at a bound."""


@dataclass(frozen=True)
class Fit:
    """Outcome of a search.

    Attributes:
        parameters: The fitted set.
        start: Error x 1000 of the filter on training traffic at the start of the search.
        error: The same with the fitted set.
        at_bounds: Parameters that ended at a bound, and what that means, a sentence each.
    """

    parameters: ARZParameters
    start: float
    error: float
    at_bounds: tuple[str, ...]


def traffic_of(
    corridor: Corridor, seeds: Sequence[int], library: RecordLibrary
) -> tuple[FloatArray, FloatArray]:
    """Return densities for a lane [veh/km] and speeds [km/h] of all segments, shape (n, S)."""
    traffic, s = Traffic(corridor, tuple(seeds), library), corridor.geometry.n_segments
    traffic.load(range(len(seeds)))
    tables = np.concatenate([traffic.complete(index)[:, :s] for index in range(len(seeds))])
    return tables[..., 0] / np.array(corridor.geometry.segment_lanes), tables[..., 1]


def start_from(shipped: ARZParameters, corridor: Corridor, name: str) -> ARZParameters:
    """Return a shipped set for the lanes of a road, slowed down until its CFL condition holds."""
    lanes = max(corridor.geometry.segment_lanes[: corridor.geometry.n_mainline])
    start = dataclasses.replace(
        shipped,
        name=name,
        jam_density=shipped.jam_density / shipped.lanes * lanes,
        lanes=lanes,
        derived_from=shipped.name,
    )
    return slowed(start, corridor)


def slowed(parameters: ARZParameters, corridor: Corridor) -> ARZParameters:
    """Return a set, slowed down until its CFL condition holds on a road."""
    while not is_stable(parameters, corridor):
        slower, flatter = 0.97 * parameters.free_flow_speed, 0.97 * parameters.gamma
        parameters = dataclasses.replace(parameters, free_flow_speed=slower, gamma=flatter)
    return parameters


def is_stable(parameters: ARZParameters, corridor: Corridor) -> bool:
    """Return whether the CFL condition of a set holds on a road."""
    try:
        ARZModel(corridor.road, parameters).require_time_step()
    except ValueError:
        return False
    return True


def fit_parameters(
    cell: Cell,
    corridor: Corridor,
    start: ARZParameters,
    densest: float,
    library: RecordLibrary,
    trials: int,
    kept: Path,
) -> Fit:
    """Search the parameters with which a filter errs least, by Nelder and Mead's method.

    The search is deterministic, and reads what it has tried from a file: it goes on where it was
    interrupted.

    Args:
        cell: The filter and the query policy on training traffic, without parameters.
        corridor: The road.
        start: Where the search begins.
        densest: Largest density for a lane in training traffic [veh/km]; no jam is less dense.
        library: Source of the records.
        trials: Sets to try at most.
        kept: JSON file of what was tried.
    """
    limit = corridor.geometry.largest_speed_limit
    low = np.log([0.4 * limit, max(densest, 40.0), 0.1, 5.0])
    high = np.log([2.5 * limit, max(2.0 * densest, 300.0), 5.0, 500.0])
    tried: dict[tuple[float, ...], float] = {}
    if kept.exists():
        tried = {tuple(values): error for *values, error in read_json(kept)}
    shown = make_bar(trials, desc="ARZ parameters", unit="trial", mininterval=0.5)

    def parameters_at(values: FloatArray) -> ARZParameters:
        found = np.exp(np.clip(values, low, high))
        v_f, jam, gamma, tau = (float(f"{value:.4g}") for value in found)
        return dataclasses.replace(
            start,
            free_flow_speed=v_f,
            jam_density=round(jam * start.lanes, 2),
            gamma=gamma,
            relaxation_time=tau,
        )

    def error_at(values: FloatArray) -> float:
        parameters = parameters_at(values)
        key = tuple(float(getattr(parameters, name)) for name in FIELDS)
        if key not in tried:
            tried[key] = _REFUSED
            if is_stable(parameters, corridor):
                tried[key] = filter_error(cell, parameters, library)
            write_json(kept, [[*each, error] for each, error in tried.items()])
            if shown.disable and len(tried) % TOLD == 0:
                least = min(tried.values())
                told.info("tried %d of %d, error x 1000 %.1f", len(tried), trials, least)
        shown.update()
        shown.set_postfix_str(f"error {min(tried.values()):.1f}")
        return tried[key]

    per_lane = start.jam_density / start.lanes
    first = np.log([start.free_flow_speed, per_lane, start.gamma, start.relaxation_time])
    first = np.clip(first, low, high)
    # Away from the nearer bound, so that no first step is cut to nothing.
    steps = np.where(first + _WIDTH <= high, _WIDTH, -_WIDTH)
    with shown:
        found = optimize.minimize(
            error_at,
            first,
            method="Nelder-Mead",
            bounds=list(zip(low, high, strict=True)),
            options={
                "maxfev": trials,
                "xatol": 5e-3,
                "fatol": 5e-3,
                "initial_simplex": np.vstack([first, first + np.diag(steps)]),
            },
        )
    parameters = parameters_at(found.x)
    return Fit(
        parameters,
        start=error_at(first),
        error=float(found.fun),
        at_bounds=tuple(_at_bounds(found.x, low, high, parameters, corridor)),
    )


def filter_error(cell: Cell, parameters: ARZParameters, library: RecordLibrary) -> float:
    """Return the mean error x 1000 of a filter with given parameters.

    All episodes are one batch: the steps of a batch take little longer than those of an episode.
    """
    keywords = {**cell.keywords, "parameters": dataclasses.asdict(parameters)}
    cell = dataclasses.replace(cell, keywords=keywords, watchers=())
    rows = play(cell, cell.seeds or (), library)
    return float(np.mean([-1000.0 * row["reward"] for row in rows]))


def _at_bounds(
    values: FloatArray,
    low: FloatArray,
    high: FloatArray,
    parameters: ARZParameters,
    corridor: Corridor,
) -> list[str]:
    """Say which parameters ended at a bound of the search, and what that means."""
    found = []
    for name, value, least, largest in zip(FIELDS, values, low, high, strict=True):
        end = "least" if value - least < 0.01 else "largest" if largest - value < 0.01 else None
        if end is not None:
            number = getattr(parameters, name)
            found.append(f"{name} ended at {number:g}, the {end} tried: {MEANING[name, end]}")
    shortest = min(corridor.geometry.segment_lengths)
    if parameters.largest_time_step(shortest) < 1.02 * TIME_STEP:
        number = parameters.free_flow_speed
        found.append(
            f"free_flow_speed ended at {number:g}, the CFL condition's largest on {shortest:g} km: "
            f"{MEANING['free_flow_speed', 'cfl']}"
        )
    return found
