"""Tables of the study of choices."""

from __future__ import annotations

from collections.abc import Sequence

from agents.experiments.cells import DENSITY, ERROR, SPEED
from agents.experiments.old_tables import markdown
from agents.statistics import Interval
from agents.studies.choices.cell import OTHER_TRAFFIC
from agents.studies.choices.plan import REFERENCE, World
from agents.studies.choices.results import ChoiceResults


def map_table(results: ChoiceResults, world: World) -> str:
    """Return errors and gains of a world by bandwidth."""
    design = results.design
    rows = []
    for bandwidth in design.bandwidths_of(world):
        first = f"{bandwidth} ({100.0 * design.cell(world, bandwidth, '').share:.0f} %)"
        rows.append([first, *_gains(results, world, bandwidth)])
    return markdown(_header(results, world, "B (share of the road)"), rows)


def varied_table(results: ChoiceResults, world: World) -> str:
    """Return errors and gains of a world by epsilon, and under other traffic."""
    design = results.design
    rows = []
    for each in design.varied(world):
        first = f"ε = {each.epsilon:g}"
        if each.traffic == OTHER_TRAFFIC:
            first += ", drivers by Krauss, two peaks of demand"
        rows.append([first, *_gains(results, each, design.base_bandwidth)])
    return markdown(_header(results, world, ""), rows)


def saved_table(results: ChoiceResults, world: World) -> str:
    """Return the bandwidth that the rule and the learned policies save, by bandwidth.

    The largest bandwidth is left out: nothing larger was run that could be saved.
    """
    design = results.design
    rows = [
        [
            str(bandwidth),
            *(
                _percent(results.saved(world, bandwidth, policies))
                for policies in _choosers(results, world).values()
            ),
        ]
        for bandwidth in design.bandwidths_of(world)[:-1]
    ]
    return markdown(["B", *_choosers(results, world)], rows)


def joint_table(results: ChoiceResults) -> str:
    """Return errors of everything taken together, by policy."""
    design = results.design
    rows = []
    for world in design.together:
        sums = ", sums over two neighbours" if world.span > 1 else ""
        row = [f"{world.label}, ε = {world.epsilon:g}{sums}"]
        for policy in (REFERENCE, design.schedule, design.rule(world)):
            cell = design.cell(world, design.joint_bandwidth, policy)
            density, speed = (results.mean(cell, metric).mean for metric in (DENSITY, SPEED))
            error = results.mean(cell, ERROR)
            row.append(f"{error.mean:.1f} ± {error.half_width:.1f} ({density:.1f}, {speed:.1f})")
        rows.append(row)
    return markdown(["", f"`{REFERENCE}`", f"`{design.schedule}`", "rule"], rows)


def paying(results: ChoiceResults) -> list[tuple[World, int, str, Interval]]:
    """Return where the rule or the learned policies lie below the base schedule for certain."""
    return _certain(results, pays=True)


def not_paying(results: ChoiceResults) -> list[tuple[World, int, str, Interval]]:
    """Return where neither the rule nor the learned policies lie below it for certain."""
    return _certain(results, pays=False)


def _certain(results: ChoiceResults, pays: bool) -> list[tuple[World, int, str, Interval]]:
    found = []
    for world in results.design.worlds:
        for bandwidth in results.design.bandwidths_of(world):
            gains = {
                name: results.gain(world, bandwidth, policies)
                for name, policies in _choosers(results, world).items()
            }
            name = max(gains, key=lambda each: gains[each].mean)
            if any(gain.low > 0.0 for gain in gains.values()) == pays:
                found.append((world, bandwidth, name, gains[name]))
    return found


def _choosers(results: ChoiceResults, world: World) -> dict[str, Sequence[str]]:
    """Return what is held against the base schedule, by its name."""
    design = results.design
    found: dict[str, Sequence[str]] = {f"`{design.rule(world)}`": [design.rule(world)]}
    if design.learned(world):
        found["learned"] = design.learned(world)
    return found


def _header(results: ChoiceResults, world: World, first: str) -> list[str]:
    design = results.design
    worst = ["worst training seed"] if len(design.learned(world)) > 1 else []
    return [
        first, f"`{REFERENCE}`", f"`{design.schedule}`", *_choosers(results, world), *worst,
        *(f"`{bound}`" for bound in design.bounds(world)),
    ]  # fmt: skip


def _gains(results: ChoiceResults, world: World, bandwidth: int) -> list[str]:
    design, learned = results.design, results.design.learned(world)
    errors = [
        f"{results.mean(design.cell(world, bandwidth, each), ERROR).mean:.1f}"
        for each in (REFERENCE, design.schedule)
    ]
    groups = _choosers(results, world)
    gains = [_percent(results.gain(world, bandwidth, group)) for group in groups.values()]
    worst = [f"{results.worst_gain(world, bandwidth, learned):.1f}"] if len(learned) > 1 else []
    bounds = [_percent(results.gain(world, bandwidth, [each])) for each in design.bounds(world)]
    return [*errors, *gains, *worst, *bounds]


def _percent(interval: Interval) -> str:
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"
