"""The error over bandwidth and epsilon, with what a fit has chosen: where queries pay."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from agents.fitting.choice import FEW, Choice, interval, is_less
from agents.tables import ERROR, Labels, markdown, values
from dptse_env.utils.arrays import FloatArray

BANDWIDTHS = (1, 2, 5)
"""Bandwidths of the table, beside that of the environment and all segments."""

NO_NOISE = 1e4
"""The largest epsilon that there is: as good as no noise."""

EPSILONS = (0.5, 1.0, 5.0, NO_NOISE)
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
    ladder = sorted({*(each for each in BANDWIDTHS if each < n), n, config.bandwidth})
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
    """Return a Markdown table of errors, a row for each bandwidth and a column for each epsilon.

    The least error of a column is in bold. One that is larger than without queries says so.
    """
    bandwidths, epsilons = (sorted({*each}) for each in zip(*errors, strict=True))
    least = [_least(errors, epsilon) for epsilon in epsilons]

    def entry(bandwidth: int, epsilon: float) -> str:
        own, idle = (errors.get((each, epsilon)) for each in (bandwidth, 0))
        text = interval(own)
        if own is not None and idle is not None and is_less(idle, own):
            text += ", worse than no queries"
        return f"**{text}**" if (bandwidth, epsilon) in least else text

    return markdown(
        ["bandwidth", *map(_in_words, epsilons)],
        [
            [f"{bandwidth or 'no queries'}", *(entry(bandwidth, each) for each in epsilons)]
            for bandwidth in bandwidths
        ],
    )


def _in_words(epsilon: float) -> str:
    return "no noise" if epsilon == NO_NOISE else f"ε = {epsilon:g}"


def _least(errors: Errors, epsilon: float) -> tuple[int, float]:
    """Return the key of the smallest mean error at an epsilon."""
    column = [key for key in errors if key[1] == epsilon]
    return min(column, key=lambda key: float(errors[key].mean()))


def advice(errors: Errors, own: float) -> str:
    """Return what noise costs, and where queries stop paying, in sentences.

    Args:
        errors: What `play_budgets` gives.
        own: The environment's epsilon.
    """
    queried = {key: each for key, each in errors.items() if key[0]}
    column = {bandwidth: each for (bandwidth, epsilon), each in queried.items() if epsilon == own}
    best = min(column, key=lambda key: float(column[key].mean()))
    enough = min(key for key, each in column.items() if not is_less(column[best], each))
    certain = "certain " if len(column[best]) >= FEW else ""
    said = (
        f"At the environment's {_in_words(own)} the error is least at bandwidth {best}; more than "
        f"{enough} is no {certain}gain."
    )
    columns = sorted({epsilon for _, epsilon in errors})
    if columns[-1] == NO_NOISE and len(columns) > 1:
        exact = float(errors[_least(errors, NO_NOISE)].mean())
        costs = [
            f"{100.0 * (float(errors[_least(errors, each)].mean()) / exact - 1.0):+.0f} % at "
            f"{_in_words(each)}"
            for each in columns[:-1]
        ]
        said += f" Noise costs {', '.join(costs)}: the least errors over that without noise."
    compared = sorted(epsilon for bandwidth, epsilon in errors if not bandwidth)
    idle = [
        _in_words(epsilon)
        for epsilon in compared
        if not any(is_less(e, errors[0, epsilon]) for (_, k), e in queried.items() if k == epsilon)
    ]
    if not compared:
        said += " No episode without queries can be played here, to compare with."
    elif idle:
        said += f" At {', '.join(idle)} queries do not pay: they are no {certain}gain over none."
    else:
        said += f" At each of these ε queries pay: some bandwidth is a {certain}gain over none."
    if len({each.tobytes() for (bandwidth, _), each in queried.items() if bandwidth == best}) == 1:
        said += " Errors do not depend on ε: the release model has none."
    return said
