"""One self-contained HTML page about an evaluation, which works without a network."""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray

from agents.evaluation.report import Report
from agents.evaluation.watched import Watched
from agents.files import write_atomically
from dptse_env.utils.extras import needed_for

LARGEST_PAGE = 5_000_000
"""Most bytes of a page; seconds are left out of its maps until it has no more."""

LEVELS = 254
"""Levels that the values of a map are rounded to, which fit into a byte."""


def write_page(path: Path, report: Report, watched: Sequence[Watched]) -> None:
    """Write the page.

    Args:
        path: The file.
        report: Scores of all policies.
        watched: An episode of some of them, on the same traffic.

    Raises:
        MissingExtraError: plotly is not installed.
        OSError: The file cannot be written.
        ValueError: There is no episode, or one without data, or the page would be too large.
    """
    if not watched or not all(each.history.truth for each in watched):
        raise ValueError("a page needs one watched episode or more, each of a second at least")
    for every in (1, 2, 5, 10, 30, 60):
        page = render(report, watched, every)
        if len(page.encode()) <= LARGEST_PAGE:
            write_atomically(path, page)
            return
    raise ValueError(f"the page would be larger than {LARGEST_PAGE} bytes")


def render(report: Report, watched: Sequence[Watched], every: int) -> str:
    """Return the page, with one second in ``every`` of the episodes."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    template = jinja2.Environment(loader=loader, autoescape=True).get_template("page.html.j2")
    return template.render(
        title=report.title,
        library=plotly_source(),
        data=embedded(page_data(report, watched, every)),
    )


def page_data(report: Report, watched: Sequence[Watched], every: int = 1) -> dict[str, Any]:
    """Return all that the page shows, as plain JSON."""
    first = watched[0]
    corridor, n = first.corridor, first.corridor.n_mainline
    seconds = range(0, len(first.history.truth), every)
    largest = max(corridor.density_scale, *(float(np.max(each.history.truth)) for each in watched))
    return {
        "title": report.title,
        "reference": report.reference,
        "ladder": [
            {
                "estimator": row.estimator,
                "policy": row.policy,
                **{
                    metric: [row.mean[metric].mean, row.mean[metric].half_width]
                    for metric in ("rmse_density", "rmse_speed")
                },
            }
            for estimator in report.estimators
            for row in (report.rows[estimator, name] for name in report.ranked(estimator))
        ],
        "road": {
            "edges": [0.0, *np.cumsum(corridor.segment_lengths[:n]).tolist()],
            "on_ramps": list(corridor.on_ramps),
            "off_ramps": list(corridor.off_ramps),
            "sensors": [each for each in corridor.fixed_sensors if each < n],
            "incidents": [
                {"segment": each.segment, "phases": [list(phase) for phase in each.phases]}
                for each in first.incidents
            ],
        },
        "seconds": list(seconds),
        "traffic_seed": first.traffic_seed,
        "scale": largest,
        "truth": packed(first.history.truth[::every], largest),
        "policies": [
            {
                "name": each.name,
                "density": packed(each.history.estimate[::every], largest),
                "deviation": packed(each.density_std[::every], largest),
                "queried": packed(each.history.queried[::every], 1.0),
                "error": [round(value, 3) for value in each.history.rmse[::every]],
                "epsilon": [
                    round(value, 4) if math.isfinite(value) else None
                    for value in each.epsilon[::every]
                ],
            }
            for each in watched
        ],
    }


def packed(values: Sequence[NDArray[Any]], largest: float) -> dict[str, Any]:
    """Return a map as compressed bytes in base64, in steps of ``largest`` over `LEVELS`."""
    levels = np.clip(np.round(np.stack(values) / largest * LEVELS), 0, LEVELS).astype(np.uint8)
    content = base64.b64encode(zlib.compress(levels.tobytes(), 9)).decode()
    return {"shape": list(levels.shape), "step": largest / LEVELS, "bytes": content}


def embedded(content: Any) -> str:
    """Return plain JSON that can stand in a script element of HTML."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def plotly_source() -> str:
    """Return the source of plotly.js, which the page carries along.

    Raises:
        MissingExtraError: plotly is not installed.
    """
    with needed_for("an HTML page"):
        from plotly.offline import get_plotlyjs  # noqa: PLC0415 (pages alone need it)
    source: str = get_plotlyjs()
    return source
