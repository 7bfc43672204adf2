"""Learned query policies and rules: which err least, and where a choice of queries pays.

Rules and trained policies play validation traffic in nine settings. The best rule and the best
recipe of each are chosen there and written to ``chosen.json``, then all play test traffic. Beside
that, rules and learned policies are held against a round robin on two roads, by bandwidth.

Trained policies are files, each given as ``place=path``: the place is the setting that it was
trained in, or, for the gains over a round robin, a release model. ``place:recipe=path`` tells apart
policies that one recipe trained with other arguments. A path may be a folder of runs.

python scripts/study.py policies --report
python scripts/study.py policies --output results/mine --policies primary=results/training/primary \
    primary:regression=results/training/regression paced=results/training/paced-roads
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from agents.figures import (
    COLOURS,
    GREY,
    LABELS,
    Look,
    draw_curve,
    draw_dot,
    error_label,
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
    iqm,
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
    format_interval,
    grid,
    markdown,
    values_of,
)
from agents.tables import mean as mean_of
from agents.watchers import BIN, NEAR, PHASES, by_offset, by_segment, near_since_start
from dptse_env.config import VALIDATION_SEEDS
from dptse_env.traffic import CORRIDORS
from dptse_env.utils.arrays import FloatArray

# What is played: nine settings, first on validation traffic, then on test traffic.

PRIVATE = "dptse_env:dptse/PrivateHighway-v0"
PRIMARY = "primary"


class Setting(NamedTuple):
    """An environment in which policies are compared.

    Attributes:
        is_moved_to: Whether policies that were trained in the primary one are played in it, too.
    """

    description: str
    keywords: Mapping[str, Any]
    env: str = PRIVATE
    is_moved_to: bool = True


def _private(description: str, **keywords: Any) -> Setting:
    return Setting(description, {"estimator": "ekf", "bandwidth": 5, **keywords})


_INCIDENT: Any = CORRIDORS["paper-highway"].incident
SETTINGS = {
    PRIMARY: _private("PrivateHighway, EKF, B = 5")._replace(is_moved_to=False),
    "paper": Setting(
        "PaperHighway, EKF, B = 5",
        {"estimator": "ekf", "bandwidth": 5},
        env="dptse_env:dptse/PaperHighway-v0",
        is_moved_to=False,
    ),
    "bandwidth-3": _private("B = 3", bandwidth=3),
    "bandwidth-7": _private("B = 7", bandwidth=7),
    "ukf": _private("UKF", estimator="ukf"),
    "mhe": _private("MHE", estimator="mhe"),
    "epsilon-1": _private("ε = 1", epsilon=1.0),
    "epsilon-10": _private("ε = 10", epsilon=10.0),
    "paper-incident": _private(
        "the paper's incident in place of random ones", incident=dataclasses.asdict(_INCIDENT)
    ),
}
REFERENCE, ROUND_ROBIN, ORACLE, GAIN = "paper", "round-robin", "oracle-error", "oracle-gain"
RULES = (
    "static", REFERENCE, ROUND_ROBIN, "random", "oldest-first", "largest-variance",
    "largest-density-variance", "stale-variance", "greedy-trace", "inflated-trace",
)  # fmt: skip
"""Policies that need no training."""
VALIDATION_TRAFFIC, TEST_TRAFFIC = tuple(range(1000, 1064)), tuple(range(2064, 2128))
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
    found = sorted([*path.glob("best.zip"), *path.glob("*/best.zip")])
    if not found:
        raise FileNotFoundError(f"there is no best.zip in {path} nor one folder below it")
    return found


def rule(setting: str, name: str, part: str = TEST) -> Labels:
    """Return the labels of a rule in a setting, or of the oracle."""
    kind = "bound" if name == ORACLE else "rule"
    return {
        "part": part, "setting": setting, "kind": kind, "policy": name, "trained_in": "",
        "mode": LIKELIEST,
    }  # fmt: skip


def learned(setting: str, recipe: str, mode: str, origin: str, part: str = TEST) -> Labels:
    """Return the labels of what a recipe trained in its setting of origin, all training seeds."""
    return {
        "part": part, "setting": setting, "kind": "learned", "policy": recipe,
        "trained_in": origin, "mode": mode,
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
        seeds=TEST_TRAFFIC if is_test else VALIDATION_TRAFFIC,
    )


def validation_cells(trained: Sequence[Trained]) -> Iterator[Cell]:
    """Yield rules, and trained policies in both modes, where they were trained."""
    for setting in SETTINGS:
        for name in RULES:
            yield _cell(rule(setting, name, VALIDATION), name)
        yield from _own(setting, trained, VALIDATION)


def _own(setting: str, trained: Sequence[Trained], part: str) -> Iterator[Cell]:
    for each, mode in product(trained, (LIKELIEST, DRAWN)):
        if each.place == setting:
            labels = learned(setting, each.recipe, mode, setting, part)
            yield _cell(labels, each.file, each.seed)


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
        groups = groups_of(rows, VALIDATION, setting)
        errors = [float(table(rows, ERROR, labels).mean()) for labels in groups]
        ranked = sorted(zip(errors, groups, strict=True), key=lambda pair: pair[0])
        rules = [labels["policy"] for _, labels in ranked if labels["kind"] == "rule"]
        recipes = [labels for _, labels in ranked if labels["kind"] == "learned"]
        if rules:
            best = recipes[0] if recipes else {"policy": "", "mode": ""}
            by_name = {name_of(labels): round(error, 4) for error, labels in ranked}
            found[setting] = Chosen(rules[0], best["policy"], best["mode"], by_name)
    return found


def test_cells(chosen: Mapping[str, Chosen], trained: Sequence[Trained]) -> Iterator[Cell]:
    """Yield what validation asks for: all that was played there, the oracle, and moved policies.

    A policy that was trained in the primary setting is moved to others where its recipe was chosen,
    in the mode that was.
    """
    for setting, choice in chosen.items():
        for name in RULES:
            if name in choice.errors:
                yield _cell(rule(setting, name), name)
        yield _cell(rule(setting, ORACLE), ORACLE)
        yield from _own(setting, trained, TEST)
        if SETTINGS[setting].is_moved_to and PRIMARY in chosen:
            best = chosen[PRIMARY]
            for each in trained:
                if (each.place, each.recipe) == (PRIMARY, best.recipe):
                    labels = learned(setting, best.recipe, best.mode, PRIMARY)
                    yield _cell(labels, each.file, each.seed)


# What is played: gains over a round robin, by world and bandwidth.

CAPPED, PACED = "capped", "paced"
EKF, RECURRENT = "ekf", "recurrent"
HIGHWAY, LONG = "highway", "long"
OWN_TRAFFIC, OTHER_TRAFFIC = "own", "krauss-two-peaks"
ENVS = {
    (HIGHWAY, CAPPED): PRIVATE,
    (HIGHWAY, PACED): "dptse_env:dptse/PrivateHighway-v1",
    (LONG, CAPPED): "dptse_env:dptse/LongHighway-v0",
    (LONG, PACED): "dptse_env:dptse/LongHighway-v0",
}
TRAFFIC: dict[str, dict[str, Any]] = {
    OWN_TRAFFIC: {},
    OTHER_TRAFFIC: {
        "corridor": {"drivers": {"model": "Krauss"}},
        "demand": {
            "base": {
                "mainline": [[0.0, 5000.0], [120.0, 2000.0], [300.0, 5600.0], [420.0, 3000.0]],
                "on_ramps": [150.0, 600.0],
            }
        },
    },
}
"""Keywords of drivers and demand that no policy was trained on, for the short road."""
N_SEGMENTS = {HIGHWAY: 15, LONG: 120}
ROADS = {HIGHWAY: "1.5 km, 15 segments", LONG: "12 km, 120 segments"}
BANDWIDTHS = {HIGHWAY: (1, 2, 3, 5, 8, 12), LONG: (2, 4, 8, 24)}
CHOICE_TRAFFIC = {HIGHWAY: tuple(range(2600, 2632)), LONG: tuple(range(2600, 2608))}
EPSILONS, VARIED_BANDWIDTH = (0.5, 1.0, 5.0, 20.0), 2
LEARNED, WORST = "learned", "worst training seed"


class World(NamedTuple):
    """What a curve over bandwidths is about."""

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
        """The same with every epsilon, and with other traffic."""
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


def group(world: World, bandwidth: int, policy: str) -> Labels:
    """Return the labels of a policy in a world; the learned one has several training seeds."""
    return {"part": CHOICES, **world._asdict(), "bandwidth": bandwidth, "policy": policy}


def choice_cells(trained: Sequence[Trained]) -> Iterator[Cell]:
    """Yield rules, oracles and learned policies in every world."""
    for world in WORLDS:
        places = [(world, bandwidth) for bandwidth in world.bandwidths]
        if world.road == HIGHWAY:
            places += [(each, VARIED_BANDWIDTH) for each in world.varied.values()]
        for place, bandwidth in places:
            for policy in (ROUND_ROBIN, REFERENCE, world.rule, *world.bounds):
                yield _choice_cell(place, bandwidth, policy, policy)
            for each in trained:
                if each.place == world.release:
                    yield _choice_cell(place, bandwidth, LEARNED, each.file, each.seed)
    for world in TOGETHER:
        for policy in (REFERENCE, ROUND_ROBIN, world.rule):
            yield _choice_cell(world, JOINT_BANDWIDTH, policy, policy)


def _choice_cell(world: World, bandwidth: int, name: str, policy: str, seed: int = -1) -> Cell:
    keywords = {
        **TRAFFIC[world.traffic],
        "estimator": world.estimator,
        "epsilon": world.epsilon,
        "bandwidth": bandwidth,
    }
    if world.road == LONG:
        keywords["privacy"] = world.release
    if world.span > 1:
        keywords |= {"query_spans": [world.span], "bandwidth_unit": "sums"}
    return Cell(
        env=ENVS[world.road, world.release],
        policy=policy,
        keywords=keywords,
        labels={**group(world, bandwidth, name), "training_seed": seed},
        transferred=True,
        seeds=CHOICE_TRAFFIC[world.road],
    )


# What is measured: tables of training seeds by traffic seeds.


def tables(rows: pl.DataFrame, metric: str, *groups: Labels) -> list[FloatArray]:
    """Return a column of groups of cells, paired by traffic.

    Each group has the cells of all training seeds. All are of the last version that played every
    group, on the traffic seeds that they share.

    Returns:
        For each group an array (n_training_seeds, n_traffic_seeds).

    Raises:
        UnmeasuredError: No version has played all on two traffic seeds.
        ValueError: Two cells have the same labels and training seed.
    """
    found = [rows.filter(**labels) for labels in groups]
    versions = set.intersection(*(set(each["version"]) for each in found))
    if not versions:
        raise UnmeasuredError(*groups)
    last = max(versions, key=lambda text: [int(part) for part in text.split(".")[:3]])
    cells = [
        each.filter(version=last)
        .sort("training_seed", "traffic_seed")
        .partition_by("cell", maintain_order=True)
        for each in found
    ]
    for own, labels in zip(cells, groups, strict=True):
        if len({each["training_seed"][0] for each in own}) < len(own):
            raise ValueError(f"{dict(labels)} are the labels of several cells")
    shared = set.intersection(*(set(each["traffic_seed"]) for own in cells for each in own))
    if len(shared) < 2:
        raise UnmeasuredError(*groups)
    kept = pl.col("traffic_seed").is_in(sorted(shared))
    return [np.stack([values_of(each.filter(kept), metric) for each in own]) for own in cells]


def table(rows: pl.DataFrame, metric: str, labels: Labels) -> FloatArray:
    """Return a column of a group of cells, see `tables`."""
    return tables(rows, metric, labels)[0]


def below(rows: pl.DataFrame, labels: Labels, reference: Labels) -> Interval:
    """Return how far the error of a group lies below that of another one [%]."""
    return bootstrap(percent_below, *tables(rows, ERROR, labels, reference))


def less_than(rows: pl.DataFrame, labels: Labels, reference: Labels) -> str:
    """Return `below` as an entry of a table."""
    return format_interval(below(rows, labels, reference))


def groups_of(rows: pl.DataFrame, part: str, setting: str) -> list[dict[str, Any]]:
    """Return the labels of all groups of cells that were played in a setting."""
    names = list(rule(setting, REFERENCE))
    found = rows.filter(part=part, setting=setting).select(names).unique(maintain_order=True)
    return list(found.iter_rows(named=True))


def name_of(labels: Labels) -> str:
    """Return the name of a group in tables."""
    name: str = labels["policy"]
    if labels["trained_in"] not in ("", labels["setting"]):
        name += f", from {labels['trained_in']}"
    return name + (" (drawn)" if labels["mode"] == DRAWN else "")


def chosen_learners(chosen: Mapping[str, Chosen], setting: str) -> list[Labels]:
    """Return the recipe that was chosen in a setting, and the one that was moved to it."""
    origins = [setting, PRIMARY] if SETTINGS[setting].is_moved_to else [setting]
    return [
        learned(setting, chosen[origin].recipe, chosen[origin].mode, origin)
        for origin in origins
        if origin in chosen and chosen[origin].recipe
    ]


# What is reported: the settings.

COLUMNS = {ERROR: "error x 1000", DENSITY: error_label(DENSITY), SPEED: error_label(SPEED)}


class Rank(NamedTuple):
    """A policy of a setting with its errors on test traffic.

    Attributes:
        n_runs: Training seeds behind it.
        errors: Means by metric.
        iqm: Interquartile mean of the error.
        less: How far its error lies below that of the best rule [%].
    """

    name: str
    kind: str
    n_runs: int
    errors: dict[str, Interval]
    iqm: Interval
    less: str


def ranking(rows: pl.DataFrame, setting: str, best: str) -> list[Rank]:
    """Return all policies that played test traffic in a setting, least error first."""
    ranks = []
    for labels in groups_of(rows, TEST, setting):
        errors = table(rows, ERROR, labels)
        means = {m: bootstrap(mean, table(rows, m, labels)) for m in COLUMNS}
        less = cell(less_than, rows, labels, rule(setting, best))
        interquartile = bootstrap(iqm, errors)
        name, kind = name_of(labels), labels["kind"]
        ranks.append(Rank(name, kind, len(errors), means, interquartile, less))
    return sorted(ranks, key=lambda rank: rank.errors[ERROR].mean)


def ranking_table(ranks: Sequence[Rank], best: str) -> str:
    """Return a ranking."""
    header = ["policy", "kind", "IQM", "below best rule [%]", *COLUMNS.values()]
    lines = []
    for rank in ranks:
        is_best = (rank.name, rank.kind) == (best, "rule")
        seeds = f", {rank.n_runs} training seed(s)" if rank.kind == "learned" else ""
        lines.append(
            [
                f"**{rank.name}**" if rank.kind == "learned" else rank.name,
                rank.kind + seeds,
                format_interval(rank.iqm),
                "best on validation" if is_best else rank.less,
                *(format_interval(rank.errors[metric]) for metric in COLUMNS),
            ]
        )
    return markdown(header, lines)


def choice_table(rows: pl.DataFrame, chosen: Mapping[str, Chosen]) -> str:
    """Return what validation chose, and the rule that was best on test traffic."""

    def hindsight(setting: str) -> str:
        own = rule(setting, chosen[setting].rule)
        names = [g["policy"] for g in groups_of(rows, TEST, setting) if g["kind"] == "rule"]
        if not names:
            raise UnmeasuredError(own)
        best = min(names, key=lambda name: table(rows, ERROR, rule(setting, name)).mean())
        if best == own["policy"]:
            return "the same"
        return f"{best} ({less_than(rows, rule(setting, best), own)} % below)"

    lines = [
        [
            f"{setting}: {SETTINGS[setting].description}",
            choice.rule,
            cell(hindsight, setting),
            f"{choice.recipe}, {choice.mode}" if choice.recipe else "-",
        ]
        for setting, choice in chosen.items()
    ]
    return markdown(["setting", "best rule", "best on test traffic", "recipe and mode"], lines)


def primary_tables(rows: pl.DataFrame, choice: Chosen) -> list[str]:
    """Return the chosen policy of the primary setting by training seed, and more about it."""
    own = learned(PRIMARY, choice.recipe, choice.mode, PRIMARY)
    other = {**own, "mode": DRAWN if choice.mode == LIKELIEST else LIKELIEST}
    best, paper, oracle = (rule(PRIMARY, name) for name in (choice.rule, REFERENCE, ORACLE))
    seeds = rows.filter(**own)["training_seed"].unique().sort()
    references = {f"below {choice.rule} [%]": best, f"below {REFERENCE} [%]": paper}
    groups = {"all": own, **{str(seed): {**own, "training_seed": seed} for seed in seeds}}

    def entry(seed: str, column: str) -> str:
        if column in references:
            return less_than(rows, groups[seed], references[column])
        return format_interval(bootstrap(mean, table(rows, ERROR, groups[seed])))

    def difference() -> str:
        errors, reference = tables(rows, ERROR, own, best)
        interval, p_value = crossed_t(reference - errors)
        return f"{format_interval(interval)}, p = {p_value:.2g}"

    def way() -> str:
        return format_interval(bootstrap(percent_of_way, *tables(rows, ERROR, own, best, oracle)))

    numbers = {
        f"error of {choice.rule} above its own, x 1000, by crossed t": cell(difference),
        f"its way from {choice.rule} to {ORACLE} [%]": cell(way),
        f"below itself, {other['mode']} [%]": cell(less_than, rows, own, other),
        f"{choice.rule} below {REFERENCE} [%]": cell(less_than, rows, best, paper),
    }
    return [
        f"{choice.recipe}, {choice.mode}:",
        grid("training seed", list(groups), ["error x 1000", *references], entry),
        markdown(["", "mean [95 % interval]"], numbers.items()),
    ]


def secondary_table(rows: pl.DataFrame, chosen: Mapping[str, Chosen]) -> str:
    """Return the chosen policies of all settings but the primary one against the best rules."""
    found: dict[str, tuple[list[str], Interval, float]] = {}
    for setting, choice in chosen.items():
        for labels in chosen_learners(chosen, setting) if setting != PRIMARY else []:
            pair = labels, rule(setting, choice.rule)
            try:
                errors, reference = tables(rows, ERROR, *pair)
            except UnmeasuredError:
                continue
            test = crossed_t(reference - errors)
            line = [setting, name_of(labels), str(len(errors)), choice.rule, less_than(rows, *pair)]
            found[str(labels)] = (line, *test)
    adjusted = holm({name: p_value for name, (_, _, p_value) in found.items()})

    def probability(value: float) -> str:
        return "< 0.0001" if value < 1e-4 else f"{value:.4f}"

    lines = [
        [*line, format_interval(interval), probability(p_value), probability(adjusted[name])]
        for name, (line, interval, p_value) in found.items()
    ]
    header = [
        "setting", "policy", "training seeds", "best rule", "below [%]", "difference x 1000", "p",
        "p (Holm)",
    ]  # fmt: skip
    return markdown(header, lines)


def lost_table(rows: pl.DataFrame) -> str:
    """Return the seconds that estimators lost on test traffic, where they lost any."""
    lost = {
        "n_diverged": "started over [s]",
        "n_fallback": "kept the prediction [s]",
        "n_dropped": "dropped requests",
    }
    found = (
        rows.filter(part=TEST)
        .group_by("setting", "policy", "mode", maintain_order=True)
        .agg(*(pl.col(name).sum() for name in lost), pl.len())
        .filter(pl.any_horizontal(pl.col(name) > 0 for name in lost))
    )
    lines = [[*line[:3], *(f"{value:g}" for value in line[3:])] for line in found.iter_rows()]
    return markdown(["setting", "policy", "mode", *lost.values(), "episodes"], lines)


# What is reported: gains over a round robin.


class Gains(dict[tuple[World, int, str], Interval]):
    """By how much policies lie below the round robin [%], each computed when it is asked for."""

    def __init__(self, rows: pl.DataFrame) -> None:
        """Begin with none."""
        super().__init__()
        self.rows = rows

    def __missing__(self, key: tuple[World, int, str]) -> Interval:
        """Compute one, by training seeds crossed with traffic.

        Raises:
            UnmeasuredError: The policy or the round robin was not played there.
        """
        world, bandwidth, policy = key
        own, base = group(world, bandwidth, policy), group(world, bandwidth, ROUND_ROBIN)
        self[key] = below(self.rows, own, base)
        return self[key]

    def worst(self, world: World, bandwidth: int) -> float:
        """Return the smallest gain of any training seed of the learned policy [%]."""
        own, base = group(world, bandwidth, LEARNED), group(world, bandwidth, ROUND_ROBIN)
        errors, reference = tables(self.rows, ERROR, own, base)
        return min(float(percent_below(e[None, None], reference[None])[0]) for e in errors)

    def saved(self, world: World, bandwidth: int, policy: str) -> Interval:
        """Return the bandwidth that a policy saves at the round robin's error [%].

        With B' the bandwidth at which the round robin has the error that the policy has with B, it
        saves 1 - B / B'. Between the bandwidths that were played, the round robin's error is taken
        as linear in the logarithm of the bandwidth; outside of them B' is the nearest.
        """
        bases = [group(world, each, ROUND_ROBIN) for each in world.bandwidths]
        found = tables(self.rows, ERROR, group(world, bandwidth, policy), *bases)

        def percent(errors: FloatArray, *curve: FloatArray) -> FloatArray:
            curves = np.stack([mean(each) for each in curve], axis=-1)
            matched = matching(np.log(world.bandwidths), curves, mean(errors))
            saved: FloatArray = 100.0 * (1.0 - bandwidth / np.exp(matched))
            return saved

        return bootstrap(percent, *found, n_resamples=2000)

    def table(self, corner: str, places: Mapping[str, tuple[World, int]]) -> str:
        """Return errors of both schedules, and gains over the round robin, at some places."""
        world, _ = next(iter(places.values()))

        def entry(name: str, column: str) -> str:
            place = places[name]
            if column in (REFERENCE, ROUND_ROBIN):
                return f"{mean_of(self.rows, group(*place, column), ERROR).mean:.1f}"
            return f"{self.worst(*place):.1f}" if column == WORST else percent(self[*place, column])

        columns = [REFERENCE, ROUND_ROBIN, world.rule, LEARNED, WORST, *world.bounds]
        return grid(corner, list(places), columns, entry)

    def world_tables(self, world: World) -> Iterator[str]:
        """Yield the tables of a world."""

        def share(bandwidth: int) -> str:
            return f"{bandwidth} ({100.0 * bandwidth / N_SEGMENTS[world.road]:.0f} %)"

        yield f"### {ROADS[world.road]}, {world.name}"
        places = {share(bandwidth): (world, bandwidth) for bandwidth in world.bandwidths}
        yield self.table("B (share of the road)", places)
        yield (
            f"Bandwidth saved at the same error [%]; at least so much where {ROUND_ROBIN} errs "
            "more even with the largest B:"
        )
        yield grid(
            "B",
            world.bandwidths[:-1],
            [world.rule, LEARNED],
            lambda bandwidth, policy: percent(self.saved(world, bandwidth, policy)),
        )
        if world.road == HIGHWAY:
            yield f"B = {VARIED_BANDWIDTH}, by ε and under other traffic:"
            yield self.table("", {k: (each, VARIED_BANDWIDTH) for k, each in world.varied.items()})


def matching(places: FloatArray, errors: FloatArray, reached: FloatArray) -> FloatArray:
    """Return where curves of errors (r, n) at places (n,) first fall to the errors reached (r,)."""
    # Noise may let an error rise with the bandwidth; what counts is the least so far.
    falling = np.minimum.accumulate(errors, axis=-1)
    pairs = zip(falling, reached, strict=True)
    return np.array([np.interp(-value, -curve, places) for curve, value in pairs])


def percent(interval: Interval) -> str:
    """Return a percentage with its interval."""
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def joint_table(rows: pl.DataFrame) -> str:
    """Return errors of everything taken together, by policy."""

    def entry(name: str, column: str) -> str:
        world = worlds[name]
        policy = world.rule if column == "rule" else column
        labels = group(world, JOINT_BANDWIDTH, policy)
        error, density, speed = (mean_of(rows, labels, m) for m in (ERROR, DENSITY, SPEED))
        both = f"({density.mean:.1f}, {speed.mean:.1f})"
        return f"{error.mean:.1f} ± {error.half_width:.1f} {both}"

    sums = {1: "", 2: ", sums over two neighbours"}
    worlds = {f"{each.name}, ε = {each.epsilon:g}{sums[each.span]}": each for each in TOGETHER}
    return grid("", list(worlds), [REFERENCE, ROUND_ROBIN, "rule"], entry)


# Figures.

KIND_COLOURS = {"rule": "#5f6b7a", "bound": COLOURS[4], "learned": COLOURS[0]}


def draw_ladder(ranks: Sequence[Rank], path: Path) -> None:
    """Draw the errors of all policies in the primary setting, a panel for each error."""
    figure = make_figure(10.4, 1.5 + 0.3 * len(ranks), dpi=120)
    axes = figure.subplots(1, len(COLUMNS), sharey=True)
    places = np.arange(len(ranks))[::-1]
    for axis, (metric, label) in zip(axes, COLUMNS.items(), strict=True):
        for place, rank in zip(places, ranks, strict=True):
            draw_dot(axis, rank.errors[metric], place, KIND_COLOURS[rank.kind], rank.kind)
        axis.set_xlabel(label, fontsize=9)
    axes[0].set_yticks(places, [rank.name for rank in ranks])
    title = f"{SETTINGS[PRIMARY].description}; 95 % intervals"
    save_figure(finish_figure(figure, margin=0.12), path, title)


def draw_settings(rows: pl.DataFrame, chosen: Mapping[str, Chosen], path: Path) -> None:
    """Draw how far the chosen policies lie below the best rule and the paper's, by setting."""
    lines = [(setting, labels) for setting in chosen for labels in chosen_learners(chosen, setting)]
    figure = make_figure(9.0, 1.8 + 0.45 * max(len(lines), 1), dpi=120)
    axis = figure.subplots()
    places = np.arange(len(lines))[::-1]
    for place, (setting, labels) in zip(places, lines, strict=True):
        names = {"the best rule": chosen[setting].rule, "the paper's schedule": REFERENCE}
        for k, (label, name) in enumerate(names.items()):
            try:
                less = below(rows, labels, rule(setting, name))
            except UnmeasuredError:
                continue
            draw_dot(axis, less, place + 0.12 - 0.24 * k, COLOURS[k], f"below {label}")
    axis.axvline(0.0, color=GREY, linewidth=1.0)
    axis.set_yticks(places, [f"{setting}: {name_of(labels)}" for setting, labels in lines])
    axis.set_xlabel("error below the reference [%]")
    title = "Learned policies against references; 95 % intervals"
    save_figure(finish_figure(figure, margin=0.12), path, title)


def draw_queries(rows: pl.DataFrame, choice: Chosen, path: Path) -> None:
    """Draw where and when policies of the primary setting query."""
    groups = [rule(PRIMARY, name) for name in dict.fromkeys((choice.rule, REFERENCE, ORACLE))]
    groups.append(learned(PRIMARY, choice.recipe, LIKELIEST, PRIMARY))
    figure = make_figure(9.0, 6.4, dpi=110)
    axes = figure.subplots(2, 2)
    for colour, labels in zip(COLOURS, groups, strict=False):
        episodes = rows.filter(**labels).to_dicts()
        if not episodes or episodes[0].get("incident") is None:
            continue
        shares = by_segment(episodes)
        style: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 3}
        axes[0, 0].plot(1 + np.arange(len(shares)), shares, label=labels["policy"], **style)
        axes[0, 1].plot(*near_since_start(episodes, range(-240, 361, BIN)), color=colour)
        for axis, phase in zip(axes[1], PHASES, strict=False):
            axis.plot(*by_offset(episodes, phase), **style)
    axes[0, 0].set_xlabel("segment")
    axes[0, 1].set_xlabel("time since the start of the incident [s]")
    axes[0, 1].set_ylabel(f"share of queries within {NEAR} segments")
    for axis, phase in zip(axes[1], PHASES, strict=False):
        axis.set_xlabel(f"segments downstream of the incident, {phase} it")
        axis.axvline(0.0, color=GREY, linewidth=0.8)
    for axis in (axes[0, 0], *axes[1]):
        axis.set_ylabel("share of seconds")
        axis.set_ylim(bottom=0.0)
    for axis in axes.ravel():
        axis.xaxis.label.set_size(9)
        axis.yaxis.label.set_size(9)
    title = f"{SETTINGS[PRIMARY].description}: how often segments are queried"
    save_figure(finish_figure(figure), path, title)


LOOKS = {
    "rule": Look("#0072b2", "o"),
    ORACLE: Look("#666666", "^", ":"),
    GAIN: Look("#333333", "v", "--"),
    LEARNED: Look("#d55e00", "s"),
}


def draw_gains(gains: Gains, path: Path) -> None:
    """Draw gains over the round robin against the share of the road that is queried."""
    figure = make_figure(11.0, 5.6, dpi=120)
    axes = figure.subplots(2, 4, sharey=True).ravel()
    for axis, world in zip(axes, WORLDS, strict=False):
        shares = [100.0 * each / N_SEGMENTS[world.road] for each in world.bandwidths]
        for k, (label, look) in enumerate(LOOKS.items()):
            policy = world.rule if label == "rule" else label
            try:
                found = [gains[world, each, policy] for each in world.bandwidths]
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
    names = {*rule(PRIMARY, REFERENCE), *group(WORLDS[0], 1, LEARNED)} - set(rows.columns)
    rows = rows.with_columns(pl.lit(None).alias(name) for name in names)  # of a part not played yet
    chosen = choose(rows)
    rankings = {setting: ranking(rows, setting, each.rule) for setting, each in chosen.items()}
    gains = Gains(rows)
    parts = ["# Query policies", "## Choices on validation traffic", choice_table(rows, chosen)]
    if PRIMARY in chosen:
        choice = chosen[PRIMARY]
        draw_ladder(rankings[PRIMARY], folder / "fig_ladder.png")
        draw_queries(rows, choice, folder / "fig_queries.png")
        parts += [
            "## The primary setting",
            *(primary_tables(rows, choice) if choice.recipe else []),
        ]
    draw_settings(rows, chosen, folder / "fig_settings.png")
    parts += ["## The other settings", secondary_table(rows, chosen), "## Rankings"]
    for setting, ranks in rankings.items():
        parts.append(f"### {setting}: {SETTINGS[setting].description}")
        parts.append(ranking_table(ranks, chosen[setting].rule))
    parts += ["## Lost seconds and dropped requests", lost_table(rows)]
    draw_gains(gains, folder / "fig_gains.png")
    parts.append("## Gains over a round robin: everything together")
    parts.append(f"B = {JOINT_BANDWIDTH}, error x 1000 and RMSE of density [veh/km], speed [km/h]:")
    parts += [joint_table(rows), "## Gains over a round robin: by bandwidth"]
    parts.append(f"Errors x 1000 of {REFERENCE} and {ROUND_ROBIN}, then gains over the latter [%].")
    for world in WORLDS:
        parts += gains.world_tables(world)
    return "\n\n".join(parts)


def study(policies: Sequence[str]) -> Study:
    """Return the study with trained policies, each given as ``place=path``, see `find_trained`."""
    trained = find_trained(policies)

    def follow(rows: pl.DataFrame, folder: Path) -> list[Cell]:
        seeds = rows.filter(part=VALIDATION)["traffic_seed"].unique()
        outside = sorted(set(seeds) - set(VALIDATION_SEEDS))
        if outside:
            raise ValueError(f"choices must rest on validation traffic, got seed {outside[0]}")
        chosen = choose(rows)
        write_json(folder / "chosen.json", {name: each._asdict() for name, each in chosen.items()})
        return list(test_cells(chosen, trained))

    cells = (*validation_cells(trained), *choice_cells(trained))
    return Study("policies", cells, TEST_TRAFFIC, report, follow)


STUDY = study(())
