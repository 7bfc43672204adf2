"""The error over bandwidth and epsilon, with what a fit has chosen: where queries pay."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from agents.fitting.choice import FEW, Choice, interval, is_less
from agents.tables import ERROR, Labels, markdown, values
from dptse_env.utils.arrays import FloatArray

EPSILONS = (0.5, 1.0, 2.0, 5.0, 10.0)
"""Privacy losses of the table, beside that of the environment."""

SEEDS = 8
"""Seeds of test traffic at most, so that the table costs no more than the choices before it."""

NOTHING = "none"
"""The query policy that is played at bandwidth 0."""

Errors = Mapping[tuple[int, float], FloatArray]
"""Errors x 1000 on each seed of test traffic, by bandwidth and epsilon."""


def play_budgets(choice: Choice) -> Errors:
    """Play what was chosen over bandwidths and epsilons, and without queries at each epsilon.

    What the environment refuses is left out.
    """
    config = choice.road.config
    n, own = config.corridor.geometry.n_mainline, config.privacy.epsilon
    ladder = sorted({2**k for k in range(n.bit_length()) if 2**k < n} | {n, config.bandwidth})
    wanted: dict[tuple[int, float], Labels] = {}
    for epsilon in sorted({*EPSILONS, own}):
        wanted[0, epsilon] = choice.labels("test", policy=NOTHING, epsilon=epsilon)
        for bandwidth in ladder:
            wanted[bandwidth, epsilon] = choice.labels("test", bandwidth=bandwidth, epsilon=epsilon)
    seeds = choice.road.seeds["test"][:SEEDS]
    played = choice.play([*wanted.values()], seeds)
    rows = choice.rows.filter(pl.col("traffic_seed").is_in(seeds))
    return {key: values(rows, labels, ERROR) for key, labels in wanted.items() if labels in played}


def budget_table(errors: Errors) -> str:
    """Return a Markdown table of errors, a row for each bandwidth and a column for each epsilon."""
    bandwidths, epsilons = (sorted({*each}) for each in zip(*errors, strict=True))
    return markdown(
        ["bandwidth", *(f"ε = {epsilon:g}" for epsilon in epsilons)],
        [
            [
                f"{bandwidth or 'no queries'}",
                *(interval(errors.get((bandwidth, epsilon))) for epsilon in epsilons),
            ]
            for bandwidth in bandwidths
        ],
    )


def advice(errors: Errors, own: float) -> str:
    """Return where the error is least, and where queries stop paying, in sentences.

    Args:
        errors: What `play_budgets` gives.
        own: The environment's epsilon.
    """
    queried = {key: each for key, each in errors.items() if key[0]}
    column = {bandwidth: each for (bandwidth, epsilon), each in queried.items() if epsilon == own}
    bandwidth, epsilon = min(queried, key=lambda key: float(queried[key].mean()))
    best = min(column, key=lambda key: float(column[key].mean()))
    enough = min(key for key, each in column.items() if not is_less(column[best], each))
    certain = "certain " if len(column[best]) >= FEW else ""
    said = (
        f"The error is least at bandwidth {bandwidth} and ε = {epsilon:g}. At the environment's "
        f"ε = {own:g} it is least at bandwidth {best}; more than {enough} is no {certain}gain."
    )
    compared = sorted(epsilon for bandwidth, epsilon in errors if not bandwidth)
    idle = [
        f"{epsilon:g}"
        for epsilon in compared
        if not any(is_less(e, errors[0, epsilon]) for (_, k), e in queried.items() if k == epsilon)
    ]
    if not compared:
        said += " No episode without queries can be played here, to compare with."
    elif idle:
        said += (
            f" At ε = {', '.join(idle)} queries do not pay: they are no {certain}gain over none."
        )
    else:
        said += f" At each of these ε queries pay: some bandwidth is a {certain}gain over none."
    if len({each.tobytes() for (bandwidth, _), each in queried.items() if bandwidth == best}) == 1:
        said += " Errors do not depend on ε: the release model has none."
    return said
