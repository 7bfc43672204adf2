"""Learned query policies and rules: which err least, and where a choice of queries pays.

Rules and trained policies play validation traffic in nine settings. The best rule and the best
recipe of each are chosen there and written to ``chosen.json``, then all play test traffic. Beside
that, rules and learned policies are held against a round robin on two roads, by bandwidth.

Trained policies are files, each given as ``place=path``: the place is the setting that it was
trained in, or, for the gains over a round robin, a release model. ``place:recipe=path`` tells apart
policies that one recipe trained with other arguments. A path may be a folder of runs.

dptse study policies --report
dptse study policies --output results/mine --policies primary=results/training/primary \
    primary:regression=results/training/regression paced=results/training/paced-roads
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from agents.environments import OTHER_DRIVERS
from agents.figures import (
    COLOURS,
    GREY,
    LABELS,
    Look,
    draw_curve,
    draw_errors,
    finish_figure,
    make_figure,
    save_figure,
    set_log_ticks,
    shifted,
)
from agents.files import write_json
from agents.play import Cell
from agents.policies import read_saved_policy
from agents.seeds import STUDY_TEST, STUDY_VALIDATION
from agents.statistics import (
    Interval,
    bootstrap,
    crossed_t,
    holm,
    mean,
    percent_below,
    percent_of_way,
)
from agents.study import Study
from agents.tables import (
    DENSITY,
    ERROR,
    SPEED,
    Labels,
    UnmeasuredError,
    cell,
    error_label,
    format_interval,
    give_or_take,
    grid,
    pick_paired,
    tenths,
    values_of,
)
from agents.tables import mean as mean_of
from agents.watchers import BIN, NEAR, by_offset, by_segment, near_since_start
from dptse_env.traffic import CORRIDORS
from dptse_env.utils.arrays import FloatArray

Statistic = Callable[..., FloatArray]

# What is played: nine settings, first on validation traffic, then on test traffic.

PRIVATE = "dptse_env:dptse/PrivateHighway-v1"
PRIMARY = "primary"


class Setting(NamedTuple):
    """An environment in which policies are compared."""

    description: str
    keywords: Mapping[str, Any]
    env: str = PRIVATE


_EKF_5 = {"estimator": "ekf", "bandwidth": 5}
_CAPPED_5 = {**_EKF_5, "privacy": "capped"}
_INCIDENT: Any = CORRIDORS["paper-highway"].incident
SETTINGS = {
    PRIMARY: Setting("PrivateHighway, EKF, B = 5", _CAPPED_5),
    "paper": Setting("PaperHighway, EKF, B = 5", _EKF_5, "dptse_env:dptse/PaperHighway-v0"),
    "bandwidth-3": Setting("B = 3", {**_CAPPED_5, "bandwidth": 3}),
    "bandwidth-7": Setting("B = 7", {**_CAPPED_5, "bandwidth": 7}),
    "ukf": Setting("UKF", {**_CAPPED_5, "estimator": "ukf"}),
    "mhe": Setting("MHE", {**_CAPPED_5, "estimator": "mhe"}),
    "epsilon-1": Setting("ε = 1", {**_CAPPED_5, "epsilon": 1.0}),
    "epsilon-10": Setting("ε = 10", {**_CAPPED_5, "epsilon": 10.0}),
    "paper-incident": Setting(
        "the paper's incident in place of random ones",
        {**_CAPPED_5, "incident": dataclasses.asdict(_INCIDENT)},
    ),
}
REFERENCE, ROUND_ROBIN, ORACLE, GAIN = "paper", "round-robin", "oracle-error", "oracle-gain"
RULES = (
    "static", REFERENCE, ROUND_ROBIN, "random", "oldest-first", "largest-variance",
    "largest-density-variance", "stale-variance", "greedy-trace",
)  # fmt: skip
"""Policies that need no training."""
RECORDED_TRAFFIC, VALIDATION_TRAFFIC = tuple(range(1000, 1064)), tuple(range(1100, 1164))
"""Validation traffic of the recorded choices, on which trainings keep their best policy, too; and
that of choices among policies that are given."""
TEST_TRAFFIC = tuple(range(2064, 2128))
VALIDATION, TEST, CHOICES = "validation", "test", "choices"
"""Parts of the study, in the column ``part`` of its rows."""
LIKELIEST, DRAWN = "deterministic", "stochastic"
"""Modes of a learned policy: it takes its likeliest action, or draws one."""


class Trained(NamedTuple):
    """The file of a trained policy, with what it was trained for, by which recipe and seed."""

    place: str
    recipe: str
    seed: int
    file: str


def find_trained(given: Sequence[str]) -> list[Trained]:
    """Return the policies that were given.

    Args:
        given: ``place=path`` or ``place:recipe=path``; a path is a saved policy, the folder of a
            training, or a folder of those, of each of which the best policy is taken.

    Raises:
        FileNotFoundError: A path leads to no saved policy.
        ValueError: A place is unknown, a file is no saved policy, or two are of one training seed.
    """
    found: dict[tuple[str, str, int], Trained] = {}
    for text in given:
        name, equals, path = text.partition("=")
        place, _, recipe = name.partition(":")
        if not equals or place not in (*SETTINGS, CAPPED, PACED):
            raise ValueError(
                f"policies must be place=path or place:recipe=path, with a place of "
                f"{', '.join((*SETTINGS, CAPPED, PACED))}, got {text!r}"
            )
        for file in _files(Path(path)):
            saved = read_saved_policy(file)
            key = place, recipe or saved.recipe, saved.training_seed
            if key in found:
                raise ValueError(
                    f"{file} and {found[key].file} are both {key[1]} of training seed {key[2]} for "
                    f"{place!r}; place:recipe=path tells them apart"
                )
            found[key] = Trained(*key, file.as_posix())
    return list(found.values())


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    found = sorted([*path.glob("best.safetensors"), *path.glob("*/best.safetensors")])
    if not found:
        raise FileNotFoundError(f"there is no best.safetensors in {path} nor one folder below it")
    return found


def group(
    setting: str, policy: str, origin: str = "", mode: str = LIKELIEST, part: str = TEST
) -> Labels:
    """Return the labels of a policy in a setting, all training seeds of it.

    Args:
        setting: Key of `SETTINGS`.
        policy: A rule, the oracle, or the recipe of what was trained.
        origin: Setting in which it was trained; empty for what was not.
        mode: `LIKELIEST` or `DRAWN`.
        part: `VALIDATION` or `TEST`.
    """
    kind = "learned" if origin else "bound" if policy == ORACLE else "rule"
    return {
        "part": part, "setting": setting, "kind": kind, "policy": policy, "trained_in": origin,
        "mode": mode,
    }  # fmt: skip


def _cell(labels: Labels, policy: str, seed: int = -1) -> Cell:
    setting, is_test = SETTINGS[labels["setting"]], labels["part"] == TEST
    watched = is_test and labels["setting"] == PRIMARY and labels["mode"] == LIKELIEST
    return Cell(
        env=setting.env,
        policy=policy,
        keywords=setting.keywords,
        labels={**labels, "training_seed": seed},
        noise_seed=(STUDY_TEST if is_test else STUDY_VALIDATION).start,
        deterministic=labels["mode"] == LIKELIEST,
        transferred=labels["trained_in"] not in ("", labels["setting"]),
        watchers=("queries",) if watched else (),
        seeds=TEST_TRAFFIC,
    )


def _played_in(setting: str, trained: Sequence[Trained], part: str) -> Iterator[Cell]:
    """Yield rules, and what was trained in a setting, in both modes."""
    for name in RULES:
        yield _cell(group(setting, name, part=part), name)
    for each, mode in product(trained, (LIKELIEST, DRAWN)):
        if each.place == setting:
            yield _cell(group(setting, each.recipe, setting, mode, part), each.file, each.seed)


class Chosen(NamedTuple):
    """The best of a setting on validation traffic.

    Attributes:
        rule: The rule of least error.
        recipe: The recipe of least error, all training seeds together; empty without any.
        mode: The mode in which it has this error.
        errors: Errors x 1000 of all.
    """

    rule: str
    recipe: str
    mode: str
    errors: dict[str, float]


def choose(rows: pl.DataFrame) -> dict[str, Chosen]:
    """Return the choices that the rows of validation traffic make, by setting."""
    found = {}
    for setting in SETTINGS:
        ranked = rank(rows, VALIDATION, setting)
        rules = [labels["policy"] for _, labels in ranked if labels["kind"] == "rule"]
        recipes = [labels for _, labels in ranked if labels["kind"] == "learned"]
        if rules:
            best = recipes[0] if recipes else {"policy": "", "mode": ""}
            by_name = {name_of(labels): round(error, 4) for error, labels in ranked}
            found[setting] = Chosen(rules[0], best["policy"], best["mode"], by_name)
    return found


def learners(chosen: Mapping[str, Chosen], setting: str) -> list[Labels]:
    """Return the recipe that was chosen in a setting, and that of the primary one moved to it.

    It is moved where observations are the same, in the mode that was chosen.
    """
    is_moved = setting != PRIMARY and SETTINGS[setting].env == SETTINGS[PRIMARY].env
    return [
        group(setting, chosen[origin].recipe, origin, chosen[origin].mode)
        for origin in (setting, *([PRIMARY] if is_moved else []))
        if origin in chosen and chosen[origin].recipe
    ]


def test_cells(chosen: Mapping[str, Chosen], trained: Sequence[Trained]) -> Iterator[Cell]:
    """Yield what validation asks for: all that was played there, the oracle, moved policies."""
    for setting in chosen:
        yield from _played_in(setting, trained, TEST)
        yield _cell(group(setting, ORACLE), ORACLE)
        for labels, each in product(learners(chosen, setting), trained):
            origin = labels["trained_in"]
            if origin != setting and (each.place, each.recipe) == (origin, labels["policy"]):
                yield _cell(labels, each.file, each.seed)


# What is played: gains over a round robin, by world and bandwidth.

CAPPED, PACED = "capped", "paced"
EKF, RECURRENT = "ekf", "recurrent"
HIGHWAY, LONG = "highway", "long"
OWN_TRAFFIC, OTHER_TRAFFIC = "own", "krauss-two-peaks"
ENVS = {HIGHWAY: PRIVATE, LONG: "dptse_env:dptse/LongHighway-v0"}
TRAFFIC: dict[str, dict[str, Any]] = {OWN_TRAFFIC: {}, OTHER_TRAFFIC: OTHER_DRIVERS}
N_SEGMENTS = {HIGHWAY: 15, LONG: 120}
ROADS = {HIGHWAY: "1.5 km, 15 segments", LONG: "12 km, 120 segments"}
BANDWIDTHS = {HIGHWAY: (1, 2, 3, 5, 8, 12), LONG: (2, 4, 8, 24)}
CHOICE_TRAFFIC = {HIGHWAY: tuple(range(2600, 2632)), LONG: tuple(range(2600, 2608))}
EPSILONS, VARIED_BANDWIDTH = (0.5, 1.0, 5.0, 20.0), 2
LEARNED, WORST = "learned", "worst training seed"


class World(NamedTuple):
    """The subject of a curve over bandwidths."""

    road: str
    release: str
    estimator: str
    traffic: str = OWN_TRAFFIC
    epsilon: float = 5.0
    span: int = 1

    @property
    def name(self) -> str:
        """Its name in tables."""
        return f"{self.release}, {LABELS[self.estimator]}"

    @property
    def rule(self) -> str:
        """The rule for its estimator, chosen on other traffic."""
        return "speed-front" if self.estimator == EKF else "expected-reduction"

    @property
    def bounds(self) -> tuple[str, ...]:
        """Its oracles; trying every segment takes too long on the long road."""
        return (ORACLE, GAIN) if self.road == HIGHWAY else (ORACLE,)

    @property
    def bandwidths(self) -> tuple[int, ...]:
        """Bandwidths of its curve."""
        return BANDWIDTHS[self.road]

    @property
    def varied(self) -> dict[str, World]:
        """The same with every epsilon, and with other traffic, on the short road."""
        if self.road == LONG:
            return {}
        found = {f"ε = {each:g}": self._replace(epsilon=each) for each in EPSILONS}
        other = "ε = 5, drivers by Krauss, two peaks of demand"
        return {**found, other: self._replace(traffic=OTHER_TRAFFIC)}


WORLDS = (
    *(World(HIGHWAY, *each) for each in product((PACED, CAPPED), (EKF, RECURRENT))),
    World(LONG, PACED, EKF),
    World(LONG, PACED, RECURRENT),
    World(LONG, CAPPED, RECURRENT),  # the EKF has no settings for it
)
_JOINT = World(HIGHWAY, PACED, RECURRENT)
TOGETHER = (
    World(HIGHWAY, CAPPED, EKF),
    _JOINT,
    *(_JOINT._replace(epsilon=each, span=2) for each in (5.0, 1.0, 0.25)),
)
"""Worlds in which release, estimator and queries are taken together, with `JOINT_BANDWIDTH`."""
JOINT_BANDWIDTH = 5


def at(world: World, bandwidth: int, policy: str) -> Labels:
    """Return the labels of a policy in a world; the learned one has several training seeds."""
    return {"part": CHOICES, **world._asdict(), "bandwidth": bandwidth, "policy": policy}


def choice_cells(trained: Sequence[Trained]) -> Iterator[Cell]:
    """Yield rules, oracles and learned policies in every world."""
    for world in WORLDS:
        places = [(world, bandwidth) for bandwidth in world.bandwidths]
        places += [(each, VARIED_BANDWIDTH) for each in world.varied.values()]
        for where, policy in product(places, (ROUND_ROBIN, REFERENCE, world.rule, *world.bounds)):
            yield _choice_cell(*where, policy, policy)
        for where, each in product(places, trained):
            if each.place == world.release:
                yield _choice_cell(*where, LEARNED, each.file, each.seed)
    for world in TOGETHER:
        for policy in (REFERENCE, ROUND_ROBIN, world.rule):
            yield _choice_cell(world, JOINT_BANDWIDTH, policy, policy)


def _choice_cell(world: World, bandwidth: int, name: str, policy: str, seed: int = -1) -> Cell:
    keywords = {
        **TRAFFIC[world.traffic],
        "privacy": world.release,
        "estimator": world.estimator,
        "epsilon": world.epsilon,
        "bandwidth": bandwidth,
    }
    if world.span > 1:
        keywords |= {"query_spans": [world.span], "bandwidth_unit": "sums"}
    return Cell(
        env=ENVS[world.road],
        policy=policy,
        keywords=keywords,
        labels={**at(world, bandwidth, name), "training_seed": seed},
        transferred=True,
        seeds=CHOICE_TRAFFIC[world.road],
    )


# What is measured: tables of training seeds by traffic seeds.


def tables(rows: pl.DataFrame, metric: str, *groups: Labels) -> list[FloatArray]:
    """Return a column of groups of cells, paired by traffic as `pick_paired` does.

    A group has the cells of all training seeds.

    Returns:
        For each group an array (n_training_seeds, n_traffic_seeds).

    Raises:
        UnmeasuredError: No version has played all on two traffic seeds.
        ValueError: Two cells have the same labels and training seed.
    """
    cells = []
    for labels in groups:
        seeds = rows.filter(**labels)["training_seed"].unique().sort()
        if seeds.is_empty():
            raise UnmeasuredError(dict(labels))
        cells.append([{**labels, "training_seed": seed} for seed in seeds])
    found = iter(pick_paired(rows, *chain.from_iterable(cells)))
    return [np.stack([values_of(next(found), metric) for _ in own]) for own in cells]


def measure(
    rows: pl.DataFrame, statistic: Statistic, *groups: Labels, metric: str = ERROR
) -> Interval:
    """Return a statistic of groups of cells, by training seeds crossed with traffic."""
    return bootstrap(statistic, *tables(rows, metric, *groups))


def rank(rows: pl.DataFrame, part: str, setting: str) -> list[tuple[float, Labels]]:
    """Return the mean errors and labels of what a part played in a setting, least error first."""
    names = list(group(setting, REFERENCE))
    found = rows.filter(part=part, setting=setting).select(names).unique(maintain_order=True)
    errors = [
        (float(tables(rows, ERROR, labels)[0].mean()), labels)
        for labels in found.iter_rows(named=True)
    ]
    return sorted(errors, key=lambda pair: pair[0])


def name_of(labels: Labels) -> str:
    """Return the name of a group in tables."""
    name: str = labels["policy"]
    if labels["trained_in"] not in ("", labels["setting"]):
        name += f", from {labels['trained_in']}"
    return name + (" (drawn)" if labels["mode"] == DRAWN else "")


# What is reported: the settings.

BEST = "the best rule"
METRICS = {"error x 1000": ERROR, error_label(DENSITY): DENSITY, error_label(SPEED): SPEED}
COLUMNS: dict[str, tuple[Statistic, str, tuple[str, ...]]] = {
    **{label: (mean, metric, ()) for label, metric in METRICS.items()},
    f"below {BEST} [%]": (percent_below, ERROR, (BEST,)),
    f"below {REFERENCE} [%]": (percent_below, ERROR, (REFERENCE,)),
    f"way from {BEST} to {ORACLE} [%]": (percent_of_way, ERROR, (BEST, ORACLE)),
}
"""Columns of `results_table`: a statistic of a metric of a policy and of these references."""


def results_table(
    rows: pl.DataFrame, chosen: Mapping[str, Chosen], corner: str, groups: Mapping[str, Labels]
) -> str:
    """Return errors of groups by name, and how they compare with references in their settings."""

    def entry(name: str, column: str) -> str:
        statistic, metric, references = COLUMNS[column]
        setting = groups[name]["setting"]
        best = chosen[setting].rule
        others = [group(setting, best if each == BEST else each) for each in references]
        return format_interval(measure(rows, statistic, groups[name], *others, metric=metric))

    return grid(corner, list(groups), list(COLUMNS), entry)


def learned_tables(rows: pl.DataFrame, chosen: Mapping[str, Chosen]) -> Iterator[str]:
    """Yield the chosen and moved policies of all settings, and that of the primary one by seed."""
    groups = {
        f"{setting}: {name_of(labels)}": labels
        for setting in chosen
        for labels in learners(chosen, setting)
    }

    def largest_p() -> str:
        p_values = []
        for labels in groups.values():
            best = group(labels["setting"], chosen[labels["setting"]].rule)
            errors, reference = tables(rows, ERROR, labels, best)
            p_values.append(crossed_t(reference - errors)[1])
        return f"{holm(p_values):.2g}"

    yield results_table(rows, chosen, "setting: policy", groups)
    yield f"Largest p of no difference to {BEST} (crossed t, Holm): {cell(largest_p)}"
    for labels in learners(chosen, PRIMARY):
        seeds = rows.filter(**labels)["training_seed"].unique().sort()
        by_seed = {str(seed): {**labels, "training_seed": seed} for seed in seeds}
        yield results_table(rows, chosen, f"{PRIMARY}: training seed", by_seed)


def ranking_table(rows: pl.DataFrame, chosen: Mapping[str, Chosen], setting: str) -> str:
    """Return all policies that played test traffic in a setting, the least error first."""
    groups = {}
    for _, labels in rank(rows, TEST, setting):
        n_runs = rows.filter(**labels)["training_seed"].n_unique()
        seeds = f", training seeds: {n_runs}" if labels["kind"] == "learned" else ""
        groups[name_of(labels) + seeds] = labels
    return results_table(rows, chosen, "policy", groups)


# What is reported: gains over a round robin.


def gain(rows: pl.DataFrame, world: World, bandwidth: int, policy: str) -> Interval:
    """Return how far a policy lies below the round robin [%]."""
    base = at(world, bandwidth, ROUND_ROBIN)
    return measure(rows, percent_below, at(world, bandwidth, policy), base)


def saved_bandwidth(rows: pl.DataFrame, world: World, bandwidth: int, policy: str) -> Interval:
    """Return the bandwidth that a policy saves at the round robin's error [%].

    With B' the bandwidth at which the round robin has the error that the policy has with B, it
    saves 1 - B / B'. Between the bandwidths that were played, the round robin's error is taken as
    linear in the logarithm of the bandwidth; outside of them B' is the nearest.
    """
    bases = [at(world, each, ROUND_ROBIN) for each in world.bandwidths]
    logarithms = np.log(world.bandwidths)

    def percent_saved(errors: FloatArray, *curve: FloatArray) -> FloatArray:
        # Noise may let an error rise with the bandwidth; what counts is the least so far.
        falling = np.minimum.accumulate([mean(each) for each in curve]).T
        pairs = zip(mean(errors), falling, strict=True)
        matched = [np.interp(-reached, -each, logarithms) for reached, each in pairs]
        saved: FloatArray = 100.0 * (1.0 - bandwidth / np.exp(matched))
        return saved

    found = tables(rows, ERROR, at(world, bandwidth, policy), *bases)
    return bootstrap(percent_saved, *found, n_resamples=2000)


def gain_table(rows: pl.DataFrame, corner: str, places: Mapping[str, tuple[World, int]]) -> str:
    """Return errors of both schedules, and gains over the round robin, at some places."""
    world, _ = next(iter(places.values()))

    def entry(name: str, column: str) -> str:
        if column in (REFERENCE, ROUND_ROBIN):
            return f"{mean_of(rows, at(*places[name], column), ERROR).mean:.1f}"
        if column == WORST:
            names = LEARNED, ROUND_ROBIN
            errors, base = tables(rows, ERROR, *(at(*places[name], each) for each in names))
            return f"{percent_below(errors[:, None], base).min():.1f}"
        return tenths(gain(rows, *places[name], column))

    columns = [REFERENCE, ROUND_ROBIN, world.rule, LEARNED, WORST, *world.bounds]
    return grid(corner, list(places), columns, entry)


def world_tables(rows: pl.DataFrame, world: World) -> Iterator[str]:
    """Yield the tables of a world."""
    yield f"### {ROADS[world.road]}, {world.name}"
    shares = {each: f"{100.0 * each / N_SEGMENTS[world.road]:.0f} %" for each in world.bandwidths}
    places = {f"{each} ({share})": (world, each) for each, share in shares.items()}
    yield gain_table(rows, "B (share of the road)", places)
    yield (
        f"Bandwidth saved at the same error [%]; at least so much where {ROUND_ROBIN} errs more "
        "even with the largest B:"
    )
    yield grid(
        "B",
        world.bandwidths[:-1],
        [world.rule, LEARNED],
        lambda bandwidth, policy: tenths(saved_bandwidth(rows, world, bandwidth, policy)),
    )
    if world.varied:
        yield f"B = {VARIED_BANDWIDTH}, by ε and under other traffic:"
        varied = {name: (each, VARIED_BANDWIDTH) for name, each in world.varied.items()}
        yield gain_table(rows, "", varied)


def joint_table(rows: pl.DataFrame) -> str:
    """Return errors of everything taken together, by policy."""

    def entry(name: str, column: str) -> str:
        policy = worlds[name].rule if column == "rule" else column
        return give_or_take(mean_of(rows, at(worlds[name], JOINT_BANDWIDTH, policy), ERROR))

    sums = {1: "", 2: ", sums over two neighbours"}
    worlds = {f"{each.name}, ε = {each.epsilon:g}{sums[each.span]}": each for each in TOGETHER}
    return grid("", list(worlds), [REFERENCE, ROUND_ROBIN, "rule"], entry)


# Figures.


def draw_ladder(rows: pl.DataFrame, path: Path) -> None:
    """Draw the errors of all policies in the primary setting, a panel for each error."""
    groups = {name_of(labels): labels for _, labels in rank(rows, TEST, PRIMARY)}
    kinds: dict[str, dict[str, dict[str, Interval]]] = {}
    for name, labels in groups.items():
        kinds.setdefault(labels["kind"], {})[name] = {
            label: measure(rows, mean, labels, metric=metric) for label, metric in METRICS.items()
        }
    title = f"{SETTINGS[PRIMARY].description}; 95 % intervals"
    save_figure(draw_errors(list(groups), kinds, log=False), path, title)


def draw_queries(rows: pl.DataFrame, choice: Chosen, path: Path) -> None:
    """Draw where and when policies of the primary setting query."""
    groups = [group(PRIMARY, name) for name in dict.fromkeys((choice.rule, REFERENCE, ORACLE))]
    groups.append(group(PRIMARY, choice.recipe, PRIMARY))
    figure = make_figure(11.0, 3.8, dpi=110)
    axes = figure.subplots(1, 3)
    for colour, labels in zip(COLOURS, groups, strict=False):
        episodes = rows.filter(**labels).to_dicts()
        if not episodes:
            continue
        shares = by_segment(episodes)
        curves = (
            (1 + np.arange(len(shares)), shares),
            by_offset(episodes, "during"),
            near_since_start(episodes, range(-240, 361, BIN)),
        )
        for axis, curve in zip(axes, curves, strict=True):
            axis.plot(*curve, color=colour, marker="o", markersize=3, label=labels["policy"])
    axes[0].set(xlabel="segment", ylabel="share of seconds")
    axes[1].set(xlabel="segments downstream of an incident", ylabel="share of its seconds")
    axes[2].set(
        xlabel="time since its start [s]", ylabel=f"share of queries within {NEAR} segments"
    )
    for axis in axes:
        axis.set_ylim(bottom=0.0)
    title = f"{SETTINGS[PRIMARY].description}: how often segments are queried"
    save_figure(finish_figure(figure), path, title)


LOOKS = {
    "rule": Look("#0072b2", "o"),
    ORACLE: Look("#666666", "^", ":"),
    GAIN: Look("#333333", "v", "--"),
    LEARNED: Look("#d55e00", "s"),
}


def draw_gains(rows: pl.DataFrame, path: Path) -> None:
    """Draw gains over the round robin against the share of the road that is queried."""
    figure = make_figure(11.0, 5.6, dpi=120)
    axes = figure.subplots(2, 4, sharey=True).ravel()
    for axis, world in zip(axes, WORLDS, strict=False):
        shares = [100.0 * each / N_SEGMENTS[world.road] for each in world.bandwidths]
        for k, (label, look) in enumerate(LOOKS.items()):
            policy = world.rule if label == "rule" else label
            try:
                found = [gain(rows, world, each, policy) for each in world.bandwidths]
            except UnmeasuredError:
                continue
            draw_curve(axis, shifted(shares, 0.01 * (k - 1), log=True), found, look, label)
        axis.axhline(0.0, color=GREY, linewidth=0.8)
        axis.set_xscale("log")
        set_log_ticks(axis.xaxis, [round(share, 1) for share in shares])
        axis.set_title(f"{ROADS[world.road].partition(',')[0]}, {world.name}", fontsize=9)
        axis.set_xlabel("segments queried a second [%]", fontsize=8)
    for axis in axes[len(WORLDS) :]:
        axis.remove()
    for axis in axes[::4]:
        axis.set_ylabel(f"error below {ROUND_ROBIN} [%]", fontsize=8)
    title = f"Gain of choosing queries over {ROUND_ROBIN}; 95 % intervals"
    save_figure(finish_figure(figure, columns=4), path, title)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the figures."""
    names = {*group(PRIMARY, REFERENCE), *at(WORLDS[0], 1, LEARNED)} - set(rows.columns)
    rows = rows.with_columns(pl.lit(None).alias(name) for name in names)  # of a part not played yet
    chosen = choose(rows)
    parts = ["# Query policies", "## Learned policies", *learned_tables(rows, chosen)]
    if PRIMARY in chosen:
        draw_ladder(rows, folder / "fig_ladder.png")
        draw_queries(rows, chosen[PRIMARY], folder / "fig_queries.png")
    parts.append("## Rankings")
    for setting, choice in chosen.items():
        parts.append(f"### {setting}: {SETTINGS[setting].description}, {BEST} {choice.rule}")
        parts.append(ranking_table(rows, chosen, setting))
    parts += ["## Gains over a round robin: everything together"]
    parts += [f"B = {JOINT_BANDWIDTH}, error x 1000:", joint_table(rows)]
    parts.append("## Gains over a round robin: by bandwidth")
    parts.append(f"Errors x 1000 of {REFERENCE} and {ROUND_ROBIN}, then gains over the latter [%].")
    for world in WORLDS:
        parts += world_tables(rows, world)
    draw_gains(rows, folder / "fig_gains.png")
    return "\n\n".join(parts)


def study(policies: Sequence[str]) -> Study:
    """Return the study with trained policies, each given as ``place=path``, see `find_trained`."""
    trained = find_trained(policies)

    def follow(rows: pl.DataFrame, folder: Path) -> list[Cell]:
        chosen = choose(rows)
        write_json(folder / "chosen.json", {name: each._asdict() for name, each in chosen.items()})
        return list(test_cells(chosen, trained))

    first = chain.from_iterable(_played_in(setting, trained, VALIDATION) for setting in SETTINGS)
    seeds = VALIDATION_TRAFFIC if trained else RECORDED_TRAFFIC
    validated = (dataclasses.replace(each, seeds=seeds) for each in first)
    cells = (*validated, *choice_cells(trained))
    return Study("policies", cells, TEST_TRAFFIC, report, follow)


STUDY = study(())
