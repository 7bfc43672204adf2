"""The page about a fit, in Markdown, and its two figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from agents.environments import heading, release_in_words, settings_of
from agents.figures import (
    COLOURS,
    WIDTH,
    RoadMap,
    draw_maps,
    estimate_map,
    finish_figure,
    make_figure,
    save_figure,
)
from agents.fitting.budget import SEEDS, Errors, advice, budget_table
from agents.fitting.choice import FEW, Choice, interval
from agents.page import watch
from agents.statistics import mean_interval
from agents.tables import DENSITY, ERROR, SPEED, Labels, chi2, error_label, markdown, values
from dptse_env.evaluation import WARM_UP
from dptse_env.model import ARZParameters
from dptse_env.privacy import rounded_up
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.files import write_atomically

PAGE, DIAGRAM, EPISODE = "fit.md", "speed-density.png", "episode.png"
"""Files in the folder of a fit."""
TOO_SURE = 2.0
"""Mean square of errors over reported deviations above which an estimator is too sure."""


def write_page(
    choice: Choice, played: Sequence[Labels], budgets: Errors, following: str, folder: Path
) -> None:
    """Write the page and the figure of an episode into a folder that has the other figure.

    Args:
        choice: What was compared and chosen.
        played: Labels of what was played on test traffic.
        budgets: Errors over bandwidth and epsilon.
        following: Command lines for what to do next.
        folder: The folder.
    """
    road = choice.road
    n, seed = len(road.seeds["test"]), road.seeds["test"][0]
    cell = choice.cell(choice.tested)
    save_figure(
        draw_episode(choice, seed), folder / EPISODE, f"{road.corridor.name}, traffic seed {seed}"
    )
    intervals = (
        "There is one test window: its errors have no interval, and another day may differ by more "
        "than the estimators do." if n < 2 else
        f"Means over {n} episodes ± half of the 95 % interval, differences paired by traffic and "
        "noise."
    )  # fmt: skip
    parts = [
        f"# {road.corridor.name}",
        verdict(choice),
        f"{heading(road.env, cell.all_keywords)}. Settings of {choice.estimator}: "
        f"{settings_of(road.env, cell.all_keywords)}.",
        "## Bandwidth and epsilon",
        f"Error x 1000 of what was chosen at bandwidth {road.config.bandwidth} and ε = "
        f"{road.config.privacy.epsilon:g}, on {min(n, SEEDS)} of {n} episodes of test traffic, "
        f"with δ = {rounded_up(road.config.privacy.delta)} and the same settings at each ε:",
        budget_table(budgets),
        advice(budgets, road.config.privacy.epsilon),
        "## Choices on validation traffic",
        f"{capitalised(reason(choice))}. What was chosen is in bold.",
        choice_table(choice, "estimator"),
        choice_table(choice, "policy"),
        "## Errors on test traffic",
        f"Nothing was chosen on it. Errors leave out the first {WARM_UP} s. {intervals} χ² is the "
        f"mean square of errors over reported deviations: 1 is honest, above {TOO_SURE:g} the "
        "estimator is too sure of itself. "
        f"Plain is an EKF with {choice.home} and a round robin.",
        table(choice, played),
        "## Traffic",
        f"![Speeds over densities of a lane, and the curve of each set of parameters]({DIAGRAM})",
        "v_f is a shape of the curve, not a speed that anyone drives.",
        f"![True and estimated density, and queries, over space and time]({EPISODE})",
        "## What to know",
        "\n".join(f"- {note}" for note in choice.notes),
        "## What to do next",
        f"```bash\n{following}```",
    ]  # fmt: skip
    write_atomically(folder / PAGE, "\n\n".join(parts) + "\n")


def verdict(choice: Choice) -> str:
    """Return the result in two sentences."""
    errors = [interval(choice.errors(each)) for each in (choice.tested, choice.plain)]
    road = choice.road
    return (
        f"On {road.corridor.name}, {release_in_words(road.config)}, take the estimator "
        f"{choice.estimator} with the parameters {choice.parameters}, and the query policy "
        f"{choice.policy}: its error x 1000 on test "
        f"traffic is {errors[0]}, that of an EKF with the inherited parameters {choice.home} and a "
        f"round robin {errors[1]} (difference {against(choice, choice.tested, choice.plain)})."
    )


def reason(choice: Choice) -> str:
    """Return why estimator and policy were chosen."""
    n = len(choice.road.seeds["validation"])
    by = "by the mean alone" if n < FEW else "with 95 % confidence"
    said = []
    for what, tables in choice.compared.items():
        best, now = choice.best(tables), choice.labels("validation")
        least = "" if best == now else f" ({_named(best, what)} has the least mean)"
        said.append(f"no {what} errs less than {_named(now, what)}{least}")
    episodes = f"{n} episode{'s' * (n > 1)}"
    return (
        f"on {episodes} of validation traffic {' and '.join(said)}, {by}; of equals what the "
        "environment has stays, else the simplest is taken"
    )


def _named(labels: Labels, what: str) -> str:
    parameters = f" with {labels['parameters']}" if what == "estimator" else ""
    return f"{labels[what]}{parameters}"


def capitalised(sentence: str) -> str:
    """Return a sentence with a capital letter."""
    return sentence[:1].upper() + sentence[1:]


def against(choice: Choice, labels: Labels, other: Labels) -> str:
    """Return by how many per cent a cell errs more than another one, paired by traffic."""
    errors = choice.errors(other)
    difference = 100.0 * (choice.errors(labels) - errors) / errors.mean()
    if len(errors) < 2:
        return f"{difference[0]:+.1f} %"
    found = mean_interval(difference)
    return f"{found.mean:+.1f} ± {found.half_width:.1f} %"


def choice_table(choice: Choice, what: str) -> str:
    """Return a table of what was compared on validation traffic, the smallest error first."""
    unbeaten, now = choice.unbeaten(choice.compared[what]), choice.labels("validation")
    best, body = choice.best(choice.compared[what]), []
    for labels in _sorted(choice, choice.finalists(what)):
        name = f"**{labels[what]}**" if labels == now else labels[what]
        body.append(
            [
                name,
                *([labels["parameters"]] if what == "estimator" else []),
                interval(choice.errors(labels)),
                "-" if labels == best else against(choice, labels, best),
                "no" if labels in unbeaten else "yes",
                *honesty(choice.rows, labels),
            ]
        )
    parameters = ["parameters"] if what == "estimator" else []
    more = "against the least", "beaten", "χ² density", "χ² speed"
    return markdown([what, *parameters, error_label(ERROR), *more], body)


def honesty(rows: pl.DataFrame, labels: Labels) -> list[str]:
    """Return χ² of densities and of speeds, in words where the estimator is too sure."""
    return [f"{each:.2f}{', too sure' * (each > TOO_SURE)}" for each in chi2(rows, labels)]


def _sorted(choice: Choice, played: Sequence[Labels]) -> list[Labels]:
    return sorted(played, key=lambda labels: float(choice.errors(labels).mean()))


def table(choice: Choice, played: Sequence[Labels]) -> str:
    """Return a table of what was played on test traffic, the smallest error first."""
    body = []
    for labels in _sorted(choice, played):
        names = [labels[key] for key in ("parameters", "estimator", "policy")]
        if labels == choice.tested:
            names = [f"**{name}**" for name in names]
        errors = [interval(values(choice.rows, labels, each)) for each in (ERROR, DENSITY, SPEED)]
        more = "-" if labels == choice.plain else against(choice, labels, choice.plain)
        body.append([*names, *errors, more, *honesty(choice.rows, labels)])
    head = "parameters", "estimator", "policy", *map(error_label, (ERROR, DENSITY, SPEED))
    return markdown([*head, "against plain", "χ² density", "χ² speed"], body)


def draw_diagram(
    density: FloatArray, speed: FloatArray, sets: Mapping[str, ARZParameters]
) -> Figure:
    """Draw speeds over densities, and the equilibrium of each set.

    Args:
        density: Densities for a lane [veh/km], shape (n, S).
        speed: Speeds [km/h] in the same places.
        sets: ARZ parameters by name.
    """
    density, speed = density.ravel(), speed.ravel()
    shown = np.random.default_rng(0).permutation(np.flatnonzero(density > 0.0))[:8000]
    figure = make_figure(WIDTH, 3.6)
    axis = figure.subplots()
    axis.plot(density[shown], speed[shown], ".", color="#9aa7b4", markersize=1.5, alpha=0.4)
    for (name, each), colour in zip(sets.items(), COLOURS, strict=False):
        jam = each.jam_density / each.lanes
        rho = np.linspace(0.0, min(jam, 1.05 * float(density.max())), 200)
        axis.plot(
            rho, each.free_flow_speed * (1.0 - (rho / jam) ** each.gamma), color=colour,
            label=f"{name}: v_f {each.free_flow_speed:.0f} km/h, {jam:.0f} veh/km, "
            f"γ {each.gamma:.2f}, τ {each.relaxation_time:.0f} s",
        )  # fmt: skip
    axis.set_xlabel("density of a lane [veh/km]", fontsize=8)
    axis.set_ylabel("speed [km/h]", fontsize=8)
    axis.set_ylim(0.0, 1.15 * float(speed.max()))
    return finish_figure(figure)


def draw_episode(choice: Choice, seed: int) -> Figure:
    """Draw truth, estimate and queries of an episode of test traffic, as it was chosen."""
    cell = choice.cell(choice.tested)
    episode = watch(choice.policy, cell, seed, choice.place.records)
    history = episode.history
    panels = [
        RoadMap("true density", history.truth, history),
        estimate_map(history, episode.row[DENSITY], f"estimate of {choice.estimator}"),
        RoadMap(f"queried by {choice.policy}", history.queried, history),
    ]
    return draw_maps([panels])
