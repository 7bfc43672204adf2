"""The report of the study: what it found in sentences, then what they rest on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.evaluation.episodes import WARM_UP
from agents.evaluation.statistics import Interval
from agents.studies.paper.measures import LABELS
from agents.studies.paper.tables import markdown, shown
from agents.studies.privacy.figures import save_claimed, save_epsilon, save_modes
from agents.studies.privacy.plan import OPEN_LOOP, Cell, Design
from agents.studies.privacy.results import DENSITY, METRICS, SPEED, Measured
from agents.studies.privacy.tables import (
    bandwidth_table,
    claimed_table,
    cost_table,
    epsilon_table,
    health_table,
    modes_table,
    noise_table,
    number,
    write_summary,
)

LIMITS = """\
- True ε of the paper's noise is that of a vehicle that is met as often as said and is replaced by
  one that is met as often elsewhere. *At least* counts the densities alone, whatever the vehicle
  does: the mean speeds that are released besides add to it. *Alone and standing* counts both, for
  the vehicle that moves a mean speed most; such vehicles are rare on a busy road, and a guarantee
  must hold for them.
- It leaves the boundary out. Both of the paper's presets feed the estimator unnoised traffic of the
  boundary segments; counted in, no finite ε holds for them.
- How often a vehicle is met depends on the policy. One that hunts a vehicle can meet it at every
  second of its trip, whatever the number of segments queried.
- A guarantee for the unit `event` hides one second of a trip, not the trip. Errors under different
  units are not prices of the same thing.
- Counts under a cap are too low once vehicles have used theirs up. No estimator corrects for that.
- One query schedule and the settings that the environment takes by default; neither is chosen anew
  for each ε, cap or unit."""

CAPTIONS = {
    "fig_epsilon.png": "Density and speed RMSE against ε, for every cap and protected unit.",
    "fig_modes.png": "Density and speed RMSE by boundary mode, and against the bandwidth.",
    "fig_claimed.png": "ε claimed against ε true, and errors over either.",
}


def draw(folder: Path, measured: Measured) -> None:
    """Save the figures and the summary."""
    design = measured.design
    seeds = f"{len(design.seeds)} traffic seeds, 95 % intervals"
    base = f"ε = {design.epsilon:g}, C = {design.cap}"
    save_epsilon(
        folder / "fig_epsilon.png",
        measured,
        f"The price of a guarantee: error against ε, δ = {design.delta:g}, "
        f"{design.bandwidth} segments a second; {seeds}",
    )
    save_modes(folder / "fig_modes.png", measured, f"Error at {base}; {seeds}")
    save_claimed(
        folder / "fig_claimed.png",
        measured,
        f"What the paper's noise gives, δ = {design.delta:g}; {seeds}",
    )
    write_summary(folder / "summary.csv", measured)


def write_report(path: Path, measured: Measured, origin: Mapping[str, Any], command: str) -> None:
    """Write everything as Markdown.

    Args:
        path: Where to.
        measured: What was measured.
        origin: What `provenance` returned.
        command: The command that makes this report.
    """
    design = measured.design
    sections = [
        _head(design, command),
        "## In sentences",
        "\n".join(f"- {sentence}" for sentence in sentences(measured)),
        "## Figures\n\nBars and bands are 95 % intervals over traffic seeds.",
        *(f"![{text}]({name})\n\n{text}" for name, text in CAPTIONS.items()),
        f"## ε claimed against ε true\n\nAt δ = {design.delta:g}. *Composed*: of both releases "
        "together, if the preset's own sensitivities held. *Met n times*: of the density releases "
        "alone, for a vehicle that is queried in n steps and replaced by another. *Alone and "
        "standing*: of both releases, for a vehicle alone on its segment, so that it is the mean. "
        f"{_trips(measured)}",
        claimed_table(measured),
        "## What a guarantee costs\n\nErrors under the guarantee with "
        f"{design.base}, minus those under the paper's noise for the same ε asked for. Paired by "
        "traffic and noise; mean [95 % interval]. The paper's presets also give the estimator the "
        "true boundary, which is part of this difference.",
        *_for_each(measured, cost_table),
        "## Errors against ε",
        *_errors(measured),
        "## Noise\n\nStandard deviation of a density; of a flow or, for the paper's presets, a "
        "mean speed.",
        noise_table(measured),
        f"## Boundary inputs\n\nAt ε = {design.epsilon:g}, {design.base}. With `true` nothing is "
        "guaranteed. With `private` the boundary segments are observed at every step and "
        "appearances there are charged to a vehicle's cap.",
        modes_table(measured),
        f"## Bandwidth\n\nAt ε = {design.epsilon:g}, {design.base}. The guarantee does not depend "
        "on it; more queries use vehicles' caps up sooner.",
        bandwidth_table(measured),
        "## Divergence\n\nSeconds in which an estimator had to start over, and seconds in which "
        "it could not solve for its update and kept the prediction.",
        health_table(measured),
        f"## Limits\n\n{LIMITS}",
        *_origin(design, origin),
    ]
    path.write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def _head(design: Design, command: str) -> str:
    n_cells = len(design.cells())
    seeds = f"{min(design.seeds)} to {max(design.seeds)}"
    return (
        "# What a guarantee of privacy costs\n\n"
        "Errors of traffic estimates under the preset `guaranteed`, whose (ε, δ) holds for every "
        "query policy, and under the paper's noise, as printed (`paper`) and as its cited theorem "
        "needs it (`corrected`), on the same traffic.\n\n"
        f"`{design.env}`, schedule `{design.schedule}`, {n_cells} configurations on "
        f"{len(design.seeds)} held-out traffic seeds ({seeds}), {n_cells * len(design.seeds)} "
        "episodes. The traffic seed is the seed of the noise, too, so all configurations are "
        "paired. Errors are pooled over the mainline segments and the seconds from "
        f"{WARM_UP} on. Intervals are Student's t at 95 % over traffic seeds, none corrected for "
        f"their number. This file is generated by\n\n```\n{command}\n```"
    )


def sentences(measured: Measured) -> Iterator[str]:
    """Say in words what the numbers say."""
    design = measured.design
    for name in design.estimators:
        yield _price(measured, name)
        yield _against_open_loop(measured, name)
        yield _caps(measured, name)
    cap, horizon = measured.meetings
    at, longest = _nearest(design.epsilons, 1.0), int(measured.trips.max())
    for protection in design.printed:
        own = measured.accounts[protection][design.epsilons.index(at)]
        yield (
            f"{protection} that claims ε = {at:g}: under its own sensitivities both releases "
            f"compose to ε = {number(own.composed)}. Densities alone give no less than "
            f"{number(own.met[cap])} for a vehicle that is met in {cap} steps, and no less than "
            f"{number(own.met[longest])} in all {longest} s of the longest trip of this traffic "
            f"({number(own.met[horizon])} in all {horizon} s of an episode); with the mean speeds "
            f"it is {number(own.alone[cap])} for one that is met in {cap} steps, alone and "
            "standing. Counting the unnoised boundary, no finite ε holds."
        )
    yield _trips(measured)
    for name in design.estimators:
        for mode in ("private", "true"):
            cell = design.cell(name, boundary_inputs=mode)
            yield (
                f"{LABELS[name]}, boundary inputs `{mode}` in place of `nominal` at "
                f"ε = {design.epsilon:g}: {_both(measured, cell, design.cell(name))}."
            )
        few, many = (design.cell(name, bandwidth=design.bandwidths[k]) for k in (0, -1))
        yield (
            f"{LABELS[name]}, {many.bandwidth} segments a second in place of {few.bandwidth} at "
            f"ε = {design.epsilon:g}: {_both(measured, many, few)}."
        )


def _price(measured: Measured, name: str) -> str:
    design = measured.design
    cell = design.cell(name)
    parts = [
        f"{_both(measured, cell, design.cell(name, printed))} against {printed} for the same ε"
        for printed in design.printed
    ]
    return (
        f"{LABELS[name]} with a guarantee of ε = {design.epsilon:g} ({design.base}): density RMSE "
        f"{shown(measured.mean(cell, DENSITY))} veh/km, speed RMSE "
        f"{shown(measured.mean(cell, SPEED))} km/h. That is {'; and '.join(parts)}."
    )


def _against_open_loop(measured: Measured, name: str) -> str:
    """Say from which epsilon on measuring beats not measuring."""
    design, alone = measured.design, measured.design.cell(OPEN_LOOP)
    parts = []
    for metric, (says, _) in METRICS.items():
        below = [
            f"{value:g}"
            for value in design.epsilons
            if measured.difference(design.cell(name, epsilon=value), alone, metric).high < 0.0
        ]
        parts.append(f"{says} at ε = {', '.join(below)}" if below else f"{says} at none")
    return (
        f"{LABELS[name]} with a guarantee ({design.base}) errs less than the open loop with "
        f"nominal boundary inputs, the whole interval below zero: {'; '.join(parts)} (of ε = "
        f"{', '.join(f'{value:g}' for value in design.epsilons)})."
    )


def _caps(measured: Measured, name: str) -> str:
    design = measured.design
    low, high = (
        design.cell(name, protection)
        for protection in (design.guaranteed[1], design.guaranteed[-2])
    )
    return (
        f"{LABELS[name]}, cap {high.cap} in place of {low.cap} at ε = {design.epsilon:g}: "
        f"{_both(measured, high, low)}. A smaller cap has less noise, and counts a vehicle in "
        "fewer steps."
    )


def _both(measured: Measured, cell: Cell, reference: Cell) -> str:
    """Say by how much both errors exceed those of another cell."""
    return ", ".join(
        f"{says} {change(measured.difference(cell, reference, metric), unit)}"
        for metric, (says, unit) in METRICS.items()
    )


def change(interval: Interval, unit: str) -> str:
    """Say a difference with its interval and whether it can be told from zero."""
    if interval.low == interval.high == 0.0:
        return f"unchanged to the last digit [{unit}]"
    text = f"{interval.mean:+.2f} [{interval.low:+.2f}, {interval.high:+.2f}] {unit}"
    return text if interval.excludes_zero() else f"{text} (not told from 0)"


def _trips(measured: Measured) -> str:
    median, high = np.quantile(measured.trips, (0.5, 0.99))
    return (
        f"In this traffic a vehicle is on segments that can be queried for {median:.0f} s in the "
        f"median, for {high:.0f} s at the 99th percentile and for {measured.trips.max()} s at most "
        f"({len(measured.trips):,} vehicles): a policy that hunts it can meet it that often."
    )


def _nearest(values: Sequence[float], wanted: float) -> float:
    return min(values, key=lambda value: abs(np.log(value / wanted)))


def _for_each(measured: Measured, table: Any) -> list[str]:
    sections = []
    for name in measured.design.estimators:
        sections += [f"{LABELS[name]}:", table(measured, name)]
    return sections


def _errors(measured: Measured) -> list[str]:
    sections = []
    for name in measured.design.estimators:
        for metric, (says, unit) in METRICS.items():
            sections += [
                f"{LABELS[name]}, {says} RMSE [{unit}], mean [95 % interval]:",
                epsilon_table(measured, name, metric),
            ]
    alone = [
        f"{mode} boundary "
        + " and ".join(
            f"{shown(measured.mean(cell, metric))} {unit}" for metric, (_, unit) in METRICS.items()
        )
        for mode in ("nominal", "true")
        for cell in [measured.design.cell(OPEN_LOOP, boundary_inputs=mode)]
    ]
    return [*sections, f"The open loop, which measures nothing: {'; '.join(alone)}."]


def _origin(design: Design, origin: Mapping[str, Any]) -> list[str]:
    made_with, machine = origin["made_with"], origin["machine"]
    sources = ", ".join(origin["sources"])
    versions = {**made_with["versions"], "source of dptse_env": sources, **machine}
    settings = [
        [f"`{name}`", "yes" if name in origin["tuned"] else "no"] for name in made_with["settings"]
    ]
    sections = [
        "## Origin",
        markdown(["version of", ""], [[name, str(own)] for name, own in versions.items()]),
        f"ARZ parameters: {', '.join(made_with['parameters'])}. Traffic seeds: "
        f"{', '.join(map(str, design.seeds))}. Settings of the estimators by `<estimator>-<ARZ "
        "parameters>-<preset>`, tuned where a set of that name is shipped and plain defaults "
        "elsewhere; `run.json` has their values.",
        markdown(["settings", "tuned"], settings),
    ]
    if len(origin["sources"]) > 1:
        sections.append(
            "**The code of dptse_env changed while this folder was filled**: some results may be "
            "of an earlier state than others. Remove the folder and start over for results of one "
            "state."
        )
    return sections
