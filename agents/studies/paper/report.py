"""The report of a reproduction: verdicts first, then what they rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.episodes import WARM_UP
from agents.studies.paper.claims import RULE
from agents.studies.paper.figures import LOOKS, OFF_SCALE, save_sweeps, save_times
from agents.studies.paper.measures import DENSITY, SPEED
from agents.studies.paper.paper_claims import CLAIMS, CLOSE, SIMILAR, SMALL, TARGETS
from agents.studies.paper.plan import DELTA, EPSILON, Design
from agents.studies.paper.results import Measured
from agents.studies.paper.space_time import save_space_time, watch
from agents.studies.paper.tables import (
    base_table,
    detail,
    health_table,
    markdown,
    outcomes,
    time_table,
    verdict_table,
    write_summary,
)

LIMITS = """\
- The paper's RMSE values exist only in figures that are lost. Nothing here claims to match them;
  claims are compared in words alone.
- Settings do not change with ε, δ or the number of CV segments. The filters know the mechanism's
  noise exactly and so follow it; the paper tunes anew for every configuration.
- The paper's values of ε and δ are lost, too. The grids are ours; P16 to P19 depend on their ends.
- The paper runs one simulation; here every number is a mean over traffic seeds.
- The open loop takes in nothing that is released, so it is run once for each ARZ parameter set and
  stands for all kinds of noise, ε, δ and numbers of CV segments.
- Figure 2 shows one traffic seed. The paper draws it without a claim in words, so there is none to
  judge.
- Run times compare different machines and languages: the paper's are MATLAB R2019b on a 3.6 GHz
  i7-7700, those here are compiled kernels called from Python. Only their order and ratios within
  one column mean something."""


def draw(folder: Path, measured: Measured, records: str | None) -> None:
    """Save the five figures and the summary."""
    design = measured.design
    seeds = f"traffic seeds {_seeds(design.seeds)}, 95 % intervals"
    point = f"(ε, δ) = ({EPSILON:g}, {DELTA:g})"
    titles = {
        "fig1_cv_segments.png": f"Error against the number of CV segments, {point}; {seeds}",
        "fig3_epsilon.png": f"Density error against ε, δ = {DELTA:g}, "
        f"{design.privacy_segments} CV segments; {seeds}",
        "fig4_delta.png": f"Density error against δ, ε = {EPSILON:g}, "
        f"{design.privacy_segments} CV segments; {seeds}",
    }
    for name, look in LOOKS.items():
        save_sweeps(folder / name, measured, look, titles[name])
    save_space_time(
        folder / "fig2_space_time.png",
        design,
        watch(design, records),
        f"Density over space and time, traffic seed {design.seeds[0]}, "
        f"{design.picture_segments} CV segments, {point}",
    )
    save_times(
        folder / "fig5_run_time.png",
        measured,
        f"Wall time of predict, update and estimate, one episode at a time, {point}, "
        f"{design.privacy_segments} CV segments",
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
    claims, targets = outcomes(CLAIMS, measured), outcomes(TARGETS, measured)
    point = (
        f"ε = {EPSILON:g}, δ = {DELTA:g}, {design.privacy_segments} CV segments, paper's schedule"
    )
    sections = [
        _head(design, command),
        "## The paper's claims\n\nIn brackets: how many parts of the claim hold.",
        verdict_table(claims),
        "## This project's targets",
        verdict_table(targets),
        f"## How a verdict is made\n\n{RULE}\n\n{_bounds()}",
        f"## Errors at the base point\n\n{point}. Mean over traffic seeds with its 95 % interval; "
        "then how much it exceeds the random walk's.\n\nDensity RMSE [veh/km]:",
        base_table(measured, DENSITY),
        "Speed RMSE [km/h]:",
        base_table(measured, SPEED),
        *_figures(),
        "## Run time\n\nTime of a step [ms], geometric mean over episodes with its 95 % interval; "
        f"then relative to the EKF's. {point}.",
        time_table(measured),
        "## Divergence\n\nSeconds in which an estimator had to start over, and seconds in which "
        "it could not solve for its update and kept the prediction, over all episodes.",
        health_table(measured),
        "## Each claim in numbers\n\nMean [95 % interval]; ✓ holds, ✗ does not hold, ? undecided.",
        *(detail(own) for own in (*claims.values(), *targets.values())),
        f"## Limits\n\n{LIMITS}",
        *_origin(design, origin),
    ]
    path.write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def _head(design: Design, command: str) -> str:
    n_cells = len(design.cells())
    return (
        "# The paper's results, reproduced\n\n"
        "S. C. Vishnoi, A. F. Taha, S. A. Nugroho and C. G. Claudel, *On Differential Privacy and "
        "Traffic State Estimation Problem for Connected Vehicles*: its five results under the "
        "noise as printed (`paper`) and as its theorem needs it (`corrected`), each with the "
        "paper's ARZ parameters and with calibrated ones (`w99-3lane`).\n\n"
        f"{n_cells} configurations on {len(design.seeds)} held-out traffic seeds "
        f"({_seeds(design.seeds)}), {n_cells * len(design.seeds)} episodes. The traffic seed is "
        "the seed of the noise, too, so all configurations are paired. Errors are pooled over the "
        f"mainline segments and the seconds from {WARM_UP} on. This file is generated by\n\n"
        f"```\n{command}\n```"
    )


def _bounds() -> str:
    return (
        "Where the paper gives no number, the bound is ours, fixed in the code before the full "
        "run, after a look at three traffic seeds: errors are *close* or *comparable* within "
        f"{CLOSE:g} %, a variation is *small* below {SMALL:g} %, curves are *similar* if they "
        "correlate by more than "
        f"{SIMILAR:g} along the grid."
    )


def _figures() -> list[str]:
    captions = {
        "fig1_cv_segments.png": "Result 1: density and speed RMSE against the number of CV "
        "segments.",
        "fig2_space_time.png": "Result 2: true and estimated density over space and time, one "
        "traffic seed.",
        "fig3_epsilon.png": "Result 3: density RMSE against ε, both axes logarithmic.",
        "fig4_delta.png": "Result 4: density RMSE against δ.",
        "fig5_run_time.png": "Result 5: wall time of a step, absolute and relative to the EKF's.",
    }
    note = (
        "Bars and bands are 95 % intervals. Points of different estimators are moved a little "
        "aside so that their bars can be told apart. Where the open loop's error is more than "
        f"{OFF_SCALE:g} times everything else in a panel, it is named at the edge instead of drawn."
    )
    pictures = [f"![{text}]({name})\n\n{text}" for name, text in captions.items()]
    return [f"## Figures\n\n{note}", *pictures]


def _origin(design: Design, origin: Mapping[str, Any]) -> list[str]:
    made_with, machine = origin["made_with"], origin["machine"]
    sources = ", ".join(origin["sources"])
    versions = {**made_with["versions"], "source of dptse_env": sources, **machine}
    names = {
        "number of CV segments": design.sweeps["bandwidth"].values,
        "ε": design.sweeps["epsilon"].values,
        "δ": design.sweeps["delta"].values,
    }
    grids = [[name, ", ".join(f"{value:g}" for value in own)] for name, own in names.items()]
    settings = [
        [f"`{name}`", "yes" if name in origin["tuned"] else "no", _relevant(name, own)]
        for name, own in made_with["settings"].items()
    ]
    return [
        "## Origin",
        markdown(["grid", "values"], grids),
        markdown(["version of", ""], [[name, str(own)] for name, own in versions.items()]),
        *_mixed(origin["sources"]),
        "Settings of the estimators by `<estimator>-<ARZ parameters>-<noise>`, those that the "
        "environment takes by default: the tuned set of that name where one is shipped. Shown is "
        "what an estimator reads; `run.json` has all.",
        markdown(["settings", "tuned", "values"], settings),
    ]


def _mixed(sources: Sequence[str]) -> list[str]:
    if len(sources) == 1:
        return []
    return [
        "**The code of dptse_env changed while this folder was filled**: some results may be of an "
        "earlier state than others. Remove the folder and start over for results of one state."
    ]


_FILTER = ("process_noise", "noise_scale", "initial_variance", "bounds")
_RELEVANT = {
    "ekf": _FILTER,
    "ukf": (*_FILTER, "ukf"),
    "enkf": (*_FILTER, "enkf"),
    "mhe": ("process_noise", "noise_scale", "mhe"),
    "random_walk": ("walk_noise", "noise_scale", "initial_variance"),
    "open_loop": ("bounds",),
}
"""Fields of the settings that an estimator reads."""


def _relevant(name: str, settings: Mapping[str, Any]) -> str:
    """Say in one line what of its settings an estimator reads."""
    return _brief({key: settings[key] for key in _RELEVANT[name.partition("-")[0]]})


def _brief(settings: Mapping[str, Any]) -> str:
    """Say settings in one line."""
    return ", ".join(
        f"{key} ({_brief(value)})" if isinstance(value, Mapping) else f"{key} {value}"
        for key, value in settings.items()
    )


def _seeds(seeds: Sequence[int]) -> str:
    """Say a set of seeds briefly."""
    if list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))
