"""Tables of reports in Markdown, numbers as text, and the summary of a study as CSV."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.cells import METRICS, CellT, DesignT, Results
from agents.files import write_csv
from agents.statistics import Interval


def markdown(
    header: Sequence[str], rows: Iterable[Sequence[str]], first: str = "---", rest: str = ":-:"
) -> str:
    """Return a Markdown table, its first column and the rest with the given rules below them."""
    lines = [header, [first, *[rest] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def format_interval(interval: Interval) -> str:
    """Return a mean with its interval, three significant digits or two decimals each."""

    def digits(value: float) -> str:
        if 0.0 < abs(value) < 0.1:
            return f"{value:.2g}"
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.2f}"

    return f"{digits(interval.mean)} [{digits(interval.low)}, {digits(interval.high)}]"


def format_number(value: float) -> str:
    """Return three significant digits without an exponent."""
    return f"{float(f'{value:.3g}'):g}" if abs(value) < 1e5 else f"{value:,.0f}"


def format_range(values: Sequence[int]) -> str:
    """Return integers briefly, as their first and last where none is left out."""
    if list(values) == list(range(values[0], values[-1] + 1)):
        return f"{values[0]} to {values[-1]}"
    return ", ".join(map(str, values))


def compared_header(reference: str) -> list[str]:
    """Return the headers of the columns of `compared_errors`."""
    columns = [(f"{name} RMSE [{unit}]", f"against {reference}") for name, unit in METRICS.values()]
    return [column for pair in columns for column in pair]


def compared_errors(
    results: Results[DesignT, CellT], cell: CellT, reference: CellT | None
) -> list[str]:
    """Return both errors of a cell, each with its paired difference to a reference, if any."""
    row = []
    for metric in METRICS:
        row.append(format_interval(results.mean(cell, metric)))
        if reference is None or cell == reference:
            row.append("-")
        else:
            row.append(format_interval(results.difference(cell, reference, metric)))
    return row


def health_table(
    header: Sequence[str], groups: Mapping[tuple[str, ...], Sequence[EpisodeScore]]
) -> str:
    """Return the seconds that the estimator lost, summed over the episodes of each group.

    Args:
        header: Headers of the groups' names.
        groups: Episodes by the names of their group, one for each header.
    """
    fields = {
        "n_diverged": "started over [s]",
        "n_fallback": "kept the prediction [s]",
        "n_dropped": "dropped requests",
    }
    rows = [
        [
            *names,
            *(f"{sum(getattr(score, field) for score in scores):.0f}" for field in fields),
            str(len(scores)),
        ]
        for names, scores in groups.items()
    ]
    return markdown([*header, *fields.values(), "episodes"], rows)


def versions_table(provenance: Mapping[str, Any]) -> str:
    """Return the versions behind results: packages, states of the code, and the machine."""
    made_with = provenance["made_with"]
    # Results of several environments have the same versions under each of them.
    versions = made_with.get("versions") or next(iter(made_with["cells"].values()))["versions"]
    sources = {"source of dptse_env": ", ".join(provenance["sources"])}
    rows = {**versions, **sources, **provenance["machine"]}
    return markdown(["version of", ""], [[name, str(value)] for name, value in rows.items()])


_FILTER = (
    "process_noise", "process_noise_in", "density_growth", "count_noise", "demand", "speed_cap",
    "noise_scale", "initial_variance", "bounds",
)  # fmt: skip
_READ_BY = {
    "ekf": (*_FILTER, "band"),
    "ukf": (*_FILTER, "band", "ukf"),
    "enkf": (*_FILTER, "enkf"),
    "mhe": (
        "process_noise", "density_growth", "count_noise", "demand", "speed_cap", "noise_scale",
        "mhe",
    ),
    "random_walk": ("walk_noise", "speed_cap", "noise_scale", "initial_variance"),
    "blend": (*_FILTER, "band", "walk_noise", "blend"),
    "open_loop": ("speed_cap", "bounds"),
    "recurrent": ("speed_cap", "noise_scale", "initial_variance", "recurrent"),
}  # fmt: skip
"""Fields of the settings that an estimator reads; those at zero, none or psi are not shown."""
_UNSAID = (None, 0.0, "psi")


def settings_table(provenance: Mapping[str, Any]) -> str:
    """Return the estimators' settings, as far as each estimator reads them."""
    rows = []
    for name, settings in provenance["made_with"]["settings"].items():
        read = _READ_BY[name.partition("-")[0]]
        fields = {key: settings[key] for key in read if settings.get(key) not in _UNSAID}
        tuned = "yes" if name in provenance["tuned"] else "no"
        rows.append([f"`{name}`", tuned, _one_line(fields)])
    return markdown(["settings", "tuned", "values"], rows)


def _one_line(settings: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{key} ({_one_line(value)})" if isinstance(value, Mapping) else f"{key} {value}"
        for key, value in settings.items()
    )


def interval_columns(interval: Interval) -> list[str]:
    """Return a mean and the ends of its interval as cells of a CSV file."""
    return [f"{value:.6g}" for value in (interval.mean, interval.low, interval.high)]


def write_summary(path: Path, results: Results[Any, Any], fields: Sequence[str] = ()) -> None:
    """Write means with intervals as CSV, one row for each cell.

    Args:
        path: The CSV file.
        results: The results.
        fields: Further fields of the scores.
    """
    cells = sorted(results.design.cells(), key=dataclasses.astuple)
    columns = [*(field.name for field in dataclasses.fields(cells[0])), "n_seeds"]
    for metric, unit in zip(METRICS, ("veh_km", "km_h"), strict=True):
        columns += [f"{metric}_{unit}", f"{metric}_low", f"{metric}_high"]
    for name in ("reward", *fields):
        columns += [name, f"{name}_low", f"{name}_high"]
    columns += ["n_diverged", "n_fallback"]

    def rows() -> Iterator[list[Any]]:
        for cell in cells:
            row = [*dataclasses.astuple(cell), len(results.design.traffic_seeds)]
            for metric in (*METRICS, "reward", *fields):
                row += interval_columns(results.mean(cell, metric))
            yield row + [
                results.values(cell, f"n_{kind}").sum() for kind in ("diverged", "fallback")
            ]

    write_csv(path, columns, rows())
