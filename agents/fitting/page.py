"""The page about a fit: one file of HTML with its pictures, which needs no network."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from agents.figures import (
    COLOURS,
    RoadMap,
    add_frame,
    draw_maps,
    estimate_map,
    make_figure,
)
from agents.fitting.choice import FILTER, ROUND_ROBIN, Choice
from agents.page import watch
from agents.statistics import mean_interval
from agents.study import Place
from agents.tables import DENSITY, ERROR, SPEED, Labels, give_or_take, pick, values_of
from dptse_env.model import ARZParameters
from dptse_env.privacy import rounded_up
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import FloatArray

STYLE = """
body { font: 16px/1.5 sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse } td, th { padding: .2em .8em; text-align: right }
td:first-child, th:first-child { text-align: left } tr + tr td { border-top: 1px solid #ddd }
th { border-bottom: 1px solid #444; font-weight: 600 } img { max-width: 100% }
pre { background: #f4f5f7; padding: .8em; overflow-x: auto } .chosen { font-weight: 600 }
.answer { font-size: 1.15em; background: #eef3f8; padding: .8em 1em }
"""


HONESTY = ("chi2_density", "chi2_speed")


@dataclass(frozen=True)
class Outcome:
    """The content of a page.

    Attributes:
        choice: What was compared and chosen, with the rows of test traffic.
        sets: The sets that the fundamental diagram shows.
        density: Densities for a lane in training traffic [veh/km], shape (n, S).
        speed: Speeds [km/h] in the same places.
        dwell: Measured average dwell [s].
        notes: What the reader should know of the fit, a sentence each.
        commands: What to do next: a word for each command line.
    """

    choice: Choice
    sets: Mapping[str, ARZParameters]
    density: FloatArray
    speed: FloatArray
    dwell: float
    notes: Sequence[str]
    commands: Sequence[tuple[str, str]]


def interval(values: FloatArray) -> str:
    """Return mean and half of the 95 % interval; of one value that value."""
    if len(values) < 2:
        return f"{values.item():.1f}"
    return give_or_take(mean_interval(values))


def against(choice: Choice, labels: Labels, reference: Labels, metric: str = ERROR) -> str:
    """Return by how many per cent a cell errs more than another one, paired by traffic."""
    own, other = (values_of(pick(choice.rows, each), metric) for each in (labels, reference))
    difference = 100.0 * (own - other) / other.mean()
    if len(own) < 2:
        return f"{difference[0]:+.1f} %"
    found = mean_interval(difference)
    return f"{found.mean:+.1f} ± {found.half_width:.1f} %"


def verdict(choice: Choice) -> str:
    """Return the result in two sentences."""
    chosen = choice.labels("test")
    home = choice.labels("test", parameters=choice.home, estimator=FILTER, policy=ROUND_ROBIN)
    errors = [interval(values_of(pick(choice.rows, each), ERROR)) for each in (chosen, home)]
    return (
        f"On {choice.road.corridor.name} take the estimator {choice.estimator} with the parameters "
        f"{choice.parameters}, and the query policy {choice.policy}: its error x 1000 on test "
        f"traffic is {errors[0]}, that of an EKF with the inherited parameters {choice.home} and a "
        f"round robin {errors[1]} (difference {against(choice, chosen, home)})."
    )


def table_of(choice: Choice, rows: Sequence[tuple[str, Labels]], reference: Labels) -> str:
    """Return a table of errors on test traffic, the smallest error first."""
    body, chosen = [], choice.labels("test")

    def error(row: tuple[str, Labels]) -> float:
        return float(values_of(pick(choice.rows, row[1]), ERROR).mean())

    for name, labels in sorted(rows, key=error):
        found = pick(choice.rows, labels)
        cells = [interval(values_of(found, metric)) for metric in (ERROR, DENSITY, SPEED)]
        is_reference = dict(labels) == dict(reference)
        cells.append("-" if is_reference else against(choice, labels, reference))
        cells += [f"{values_of(found, each).mean():.2f}" for each in HONESTY]
        mark = " class='chosen'" if dict(labels) == dict(chosen) else ""
        entries = "".join(f"<td>{escape(each)}</td>" for each in (name, *cells))
        body.append(f"<tr{mark}>{entries}</tr>")
    head = (
        "", "error x 1000", "density RMSE [veh/km]", "speed RMSE [km/h]", "against the first",
        "χ² density", "χ² speed",
    )  # fmt: skip
    first = next(name for name, labels in rows if dict(labels) == dict(reference))
    titles = "".join(f"<th>{escape(each.replace('the first', first))}</th>" for each in head)
    return f"<table><tr>{titles}</tr>{''.join(body)}</table>"


def tables(choice: Choice, rows: Sequence[Labels]) -> dict[str, str]:
    """Return the tables of parameters, estimators and query policies on test traffic, by title."""
    home = choice.labels("test", parameters=choice.home, estimator=FILTER, policy=ROUND_ROBIN)
    robin = choice.labels("test", policy=ROUND_ROBIN)
    ekf = choice.labels("test", estimator=FILTER, policy=ROUND_ROBIN)

    def where(**fixed: str) -> list[Labels]:
        return [each for each in rows if fixed.items() <= dict(each).items()]

    sets = where(estimator=FILTER, policy=ROUND_ROBIN)
    estimators = where(parameters=choice.parameters, policy=ROUND_ROBIN)
    rules = where(parameters=choice.parameters, estimator=choice.estimator)
    return {
        "Parameters, with an EKF and a round robin": table_of(
            choice, [(str(each["parameters"]), each) for each in sets], home
        ),
        f"Estimators, with the parameters {choice.parameters} and a round robin": table_of(
            choice,
            [(str(each["estimator"]), each) for each in estimators],
            ekf if ekf in estimators else robin,
        ),
        f"Query policies, with the estimator {choice.estimator}": table_of(
            choice, [(str(each["policy"]), each) for each in rules], robin
        ),
    }


def write(outcome: Outcome, rows: Sequence[Labels], place: Place) -> str:
    """Return the page; ``rows`` are the labels of what was played on test traffic."""
    choice, road = outcome.choice, outcome.choice.road
    corridor, privacy = road.corridor, road.config.privacy
    n = len(road.seeds["test"])
    intervals = (
        "There is one test window: its errors have no interval, and another day may differ by more "
        "than the estimators do." if n < 2 else
        f"Means over {n} episodes of test traffic ± half of the 95 % interval, differences paired "
        "by traffic and noise."
    )  # fmt: skip
    parts = [
        f"<h1>{escape(corridor.name)}</h1>",
        f"<p class='answer'>{escape(verdict(choice))}</p>",
        f"<p>{escape(road.env.rpartition('/')[2])}, release model {escape(str(privacy.preset))} "
        f"with ε = {rounded_up(privacy.epsilon)} and δ = {rounded_up(privacy.delta)}, "
        f"bandwidth {road.config.bandwidth}. The estimator, the parameters and the "
        "policy were chosen on validation traffic; all errors below are of test traffic, which was "
        f"played once. {escape(intervals)} χ² is the mean square of errors over the reported "
        "deviations: 1 is honest.</p>",
        "<h2>The road</h2>", image(draw_road(corridor)),
        "<h2>Speed and density</h2>", image(draw_diagram(outcome)),
        f"<p>The average dwell on a mainline segment is {outcome.dwell:g} s. v_f is a shape of the "
        "curve, not a speed that anyone drives.</p>",
        "<h2>Errors on test traffic</h2>",
    ]  # fmt: skip
    for title, table in tables(choice, rows).items():
        parts += [f"<h3>{escape(title)}</h3>", table]
    parts += ["<h2>An episode of test traffic</h2>", image(draw_episode(choice, place))]
    notes = "".join(f"<li>{escape(each)}</li>" for each in outcome.notes)
    parts += ["<h2>What to know</h2>", f"<ul>{notes}</ul>", "<h2>What to do next</h2>"]
    for word, command in outcome.commands:
        parts.append(f"<p>{escape(word)}</p><pre>{escape(command)}</pre>")
    body = "\n".join(parts)
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{escape(corridor.name)}"
        f"</title><style>{STYLE}</style><body>\n{body}\n</body></html>\n"
    )


def image(figure: Figure) -> str:
    """Return a figure as an element of a page."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    content = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f"<img alt='' src='data:image/png;base64,{content}'>"


def draw_road(corridor: Corridor) -> Figure:
    """Draw segments to scale along the road, lanes across it, ramps beside it, and sensors."""
    n, lengths = corridor.geometry.n_mainline, np.array(corridor.geometry.segment_lengths)
    starts = np.concatenate([[0.0], np.cumsum(lengths[:n])])
    figure = make_figure(9.0, 2.4, dpi=120)
    axis = figure.subplots()
    most = corridor.geometry.most_lanes

    def box(segment: int, left: float, bottom: float, colour: str) -> None:
        width, lanes = float(lengths[segment]), corridor.geometry.segment_lanes[segment]
        axis.add_patch(Rectangle((left, bottom), width, lanes, facecolor=colour, edgecolor="white"))
        middle = (left + width / 2, bottom + lanes / 2)
        axis.annotate(f"{segment}", middle, ha="center", va="center", fontsize=7)
        if segment in corridor.fixed_sensors:
            axis.plot(left + width / 2, bottom + lanes - 0.25, "v", color=COLOURS[1], markersize=5)

    for segment in range(n):
        box(segment, float(starts[segment]), 0.0, "#c9d6e3")
    groups = [(*corridor.geometry.on_ramps, *corridor.geometry.off_ramps)]
    ramps = (*corridor.geometry.on_ramp_segments, *corridor.geometry.off_ramp_segments)
    for face, segments in zip(*groups, ramps, strict=True):
        joins = segments[0] in {s for each in corridor.geometry.on_ramp_segments for s in each}
        left = float(starts[face])
        if joins:
            left -= float(lengths[list(segments)].sum())
        for segment in segments:
            box(segment, left, -1.6 - corridor.geometry.segment_lanes[segment], "#e3d6c9")
            left += float(lengths[segment])
        place = float(starts[face])
        ends = ((place, -0.05), (place, -1.5)) if joins else ((place, -1.5), (place, -0.05))
        axis.annotate("", *ends, arrowprops={"arrowstyle": "->", "color": "#777"})
    limits = corridor.geometry.speed_limits[:n]
    for segment in range(n):
        if segment == 0 or limits[segment] != limits[segment - 1]:
            at = (float(starts[segment]), most + 0.3)
            axis.annotate(f"{limits[segment]:g} km/h", at, fontsize=7, color="#555")
    axis.set_xlim(-0.02 * starts[-1], 1.02 * starts[-1])
    axis.set_ylim(-4.2 if corridor.geometry.n_ramps else -0.6, most + 1.2)
    axis.set_yticks([])
    axis.set_xlabel("road [km]; traffic goes right, triangles are fixed sensors", fontsize=8)
    add_frame(axis, "x")
    axis.spines["left"].set_visible(False)
    return figure


def draw_diagram(outcome: Outcome) -> Figure:
    """Draw speeds and flows over densities of the mainline, with the equilibrium of each set."""
    n = outcome.choice.road.corridor.geometry.n_mainline
    density, speed = outcome.density[:, :n].ravel(), outcome.speed[:, :n].ravel()
    occupied = density > 0.0
    density, speed = density[occupied], speed[occupied]
    thinned = np.random.default_rng(0).permutation(density.size)[:8000]
    figure = make_figure(9.0, 3.4, dpi=120)
    axes = figure.subplots(1, 2)
    for axis, values in zip(axes, (speed, density * speed), strict=True):
        axis.plot(
            density[thinned], values[thinned], ".", color="#9aa7b4", markersize=1.5, alpha=0.4
        )
    largest = 1.05 * float(density.max())
    for (name, each), colour in zip(outcome.sets.items(), COLOURS, strict=False):
        jam = each.jam_density / each.lanes
        rho = np.linspace(0.0, min(jam, largest), 200)
        curve = each.free_flow_speed * (1.0 - (rho / jam) ** each.gamma)
        numbers = (
            f"{name}: v_f {each.free_flow_speed:.0f} km/h, {jam:.0f} veh/km, γ {each.gamma:.2f}, "
            f"τ {each.relaxation_time:.0f} s"
        )
        axes[0].plot(rho, curve, color=colour, label=numbers)
        axes[1].plot(rho, rho * curve, color=colour)
    axes[0].set_ylabel("speed [km/h]", fontsize=8)
    axes[1].set_ylabel("flow of a lane [veh/h]", fontsize=8)
    axes[0].set_ylim(0.0, 1.15 * float(speed.max()))
    axes[1].set_ylim(bottom=0.0)
    for axis in axes:
        axis.set_xlabel("density of a lane [veh/km]", fontsize=8)
        axis.set_xlim(0.0, largest)
        add_frame(axis)
    figure.legend(loc="outside lower center", ncols=1, frameon=False, fontsize=8)
    return figure


def draw_episode(choice: Choice, place: Place) -> Figure:
    """Draw truth, estimate and queries of the first seed of test traffic, as it was chosen."""
    seed = choice.road.seeds["test"][0]
    episode = watch(choice.policy, choice.cell(choice.labels("test")), seed, place.records)
    history = episode.history
    title = f"estimate of {choice.estimator}"
    panels = [
        RoadMap(f"true density, traffic seed {seed}", history.truth, history),
        estimate_map(history, episode.row[DENSITY], title),
        RoadMap(f"queried by {choice.policy}", history.queried, history),
    ]
    return draw_maps([panels], width=9.0, dpi=110)
