"""A ladder of algorithms: which policy errs least, and how much of what can be won does it win?

In each setting rules and oracles play, and policies that algorithms of ``dptse train`` have trained
for the same time. Validation traffic chooses the best rule, the checkpoint and the mode of every
training, and the learners that get further training seeds. Then all play test traffic, once.

With ``minutes`` it trains what is missing, in ``trainings/SETTING/LEARNER/SEED`` of the output:
every learner with the first of the training seeds, the best two of a setting with the others. The
same command goes on after a kill. The report needs the rows and ``curves.parquet`` alone.

dptse study 'policies {"minutes": 1, "seeds": "0:5"}' --output results/policies --workers 2
dptse study policies --report
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from agents.environments import GUARANTEE, LONG, PAPER, PRIVATE, SHORT, guarantee_of
from agents.figures import (
    COLOURS,
    GREY,
    LABELS,
    Look,
    draw_curve,
    draw_dot,
    finish_figure,
    make_figure,
    save_figure,
    set_log,
    shifted,
)
from agents.play import Cell
from agents.seeds import STUDY_TEST, TRAINING_VALIDATION
from agents.statistics import Interval, bootstrap, interquartile_mean, percent_below
from agents.study import Place, Study, read_table
from agents.tables import (
    ERROR,
    Labels,
    UnmeasuredError,
    grid,
    paired,
    table,
    tenths,
    values,
)
from dptse_env.config import parse_seeds
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.validation import convert, positive, require

Statistic = Callable[..., FloatArray]

# What is played: rules, oracles and learned policies in settings.

ROUND_ROBIN, ORACLE, GAIN = "round-robin", "oracle-error", "oracle-gain"
RULES = (
    ROUND_ROBIN, "shift-ahead", "oldest-first", "largest-variance", "stale-variance",
    "largest-deviation", "speed-front", "expected-reduction",
)  # fmt: skip
"""Policies that need no training; "shift-ahead" is the paper's schedule."""
PLACKETT_LUCE = "plackett-luce"
LEARNERS: dict[str, tuple[str, dict[str, Any]]] = {
    "ppo-perceptron": ("ppo", {"policy": "mlp"}),
    "ppo-road": ("ppo", {"gamma": 0.9}),
    "maskable-ppo": ("maskable-ppo", {}),
    "recurrent-ppo": ("recurrent-ppo", {}),
    "qr-dqn": ("qr-dqn", {}),
    PLACKETT_LUCE: (PLACKETT_LUCE, {}),
}
"""Algorithms of ``dptse train``, with what differs from their tuned settings."""
SHOWN = (*LEARNERS, "ppo-from-plackett-luce")
"""Learners of the figures. The last one is recorded, and trained no more."""
VALIDATION, TEST = "validation", "test"
"""Parts of the study, in the column ``part`` of its rows."""


class Traffic(NamedTuple):
    """Traffic seeds of a setting. The oracle that tries every segment may have fewer."""

    training: tuple[int, ...]
    validation: tuple[int, ...]
    test: tuple[int, ...]
    gain: tuple[int, ...]


TRAFFIC = Traffic(*map(parse_seeds, ("0:128", "1000:1024", "2200:2232", "2200:2216")))
LONG_TRAFFIC = Traffic(*map(parse_seeds, ("0:48", "1000:1004", "2200:2216", "2200:2204")))
CHANGES: dict[str, dict[str, Any]] = {
    **{name: {"validations": 5} for name, _ in LEARNERS.values()},
    PLACKETT_LUCE: {"n_envs": 64, "regression": {"batches": 250}, "swaps": {"episodes": 60}},
}  # fmt: skip
"""Changes of the tuned settings, by algorithm, for trainings of one minute: validations and
rounds that take a fair part of it."""
LONG_CHANGES: dict[str, dict[str, Any]] = {
    **{name: {"validations": 2} for name, _ in LEARNERS.values()},
    PLACKETT_LUCE: {
        "n_envs": 16, "regression": {"batches": 250, "batch_size": 128},
        "swaps": {"episodes": 8, "batch_size": 128},
    },
}  # fmt: skip
"""The same for 120 segments, which take long to validate, and every one of which is a sample for
Plackett-Luce."""


class Setting(NamedTuple):
    """An environment in which policies are compared.

    Attributes:
        description: Its words in tables, without the guarantee.
        env: Environment id.
        keywords: Keywords of the environment.
        traffic: Traffic seeds.
        changes: What differs from tuned settings, by algorithm.
    """

    description: str
    env: str
    keywords: Mapping[str, Any]
    traffic: Traffic = TRAFFIC
    changes: Mapping[str, Mapping[str, Any]] = CHANGES

    @property
    def guarantee(self) -> str:
        """Its guarantee, see `agents.environments.guarantee_of`."""
        return guarantee_of(self.env, self.keywords)

    @property
    def title(self) -> str:
        """Its description with the guarantee, if there is one."""
        return f"{self.description}, {self.guarantee}".removesuffix(", none")


_ONE, _TWO = ({"estimator": "ekf", "bandwidth": bandwidth} for bandwidth in (1, 2))
_PACED: dict[str, Any] = {"privacy": {"preset": "paced", "epsilon": 5.0}}
_RECURRENT: dict[str, Any] = {"estimator": "recurrent", "bandwidth": 2}
_CAPPED: dict[str, Any] = {"bandwidth": 5, "privacy": {"preset": "capped", "epsilon": 5.0}}
_PUBLISHED, _TUNED = {"parameters": "published"}, {"estimator_settings": None}
SETTINGS = {
    "short": Setting("ShortHighway-v0, B = 1", SHORT, _ONE | _PUBLISHED),
    "short-paced": Setting("ShortHighway-v0, paced, B = 1", SHORT, _ONE | _PUBLISHED | _PACED),
    "private-1": Setting("PrivateHighway-v1, B = 1", PRIVATE, _ONE),
    "private-2": Setting("PrivateHighway-v1, B = 2", PRIVATE, _TWO),
    "long": Setting("LongHighway-v0, B = 2", LONG, _TWO, LONG_TRAFFIC, LONG_CHANGES),
    "long-recurrent": Setting(
        "LongHighway-v0, recurrent, B = 2", LONG, _RECURRENT, LONG_TRAFFIC, LONG_CHANGES
    ),
    "capped": Setting("PaperHighway-v0, capped, B = 5", PAPER, _ONE | _CAPPED | _TUNED),
}
CURVES = "curves.parquet"
"""Learning curves of the trainings that are finished, a line for each validation, with the digest
of the best policy."""


def training_folder(study: Path, setting: str, learner: str, seed: int) -> Path:
    """Return the folder of a training in that of the study."""
    return study / "trainings" / setting / learner / str(seed)


def played(setting: str, policy: str, part: str = TEST) -> Labels:
    """Return the labels of a policy in a setting; a learner has several training seeds."""
    return {"part": part, "setting": setting, "policy": policy}


def _cell(
    name: str, policy: str, part: str, seed: int = -1, digest: str = "", file: str = ""
) -> Cell:
    setting, traffic = SETTINGS[name], SETTINGS[name].traffic
    seeds = traffic.gain if policy == GAIN else traffic.test
    return Cell(
        env=setting.env,
        policy=file or policy,
        keywords=setting.keywords,
        labels={**played(name, policy, part), "training_seed": seed, "digest": digest},
        noise_seed=(STUDY_TEST if part == TEST else TRAINING_VALIDATION).start,
        seeds=seeds if part == TEST else traffic.validation,
    )


def test_cells(rows: pl.DataFrame, place: Place) -> list[Cell]:
    """Return what plays test traffic: rules, oracles, and the best policy of each training."""
    del rows  # choices among these are the report's
    cells = [_cell(*each, TEST) for each in product(SETTINGS, (*RULES, ORACLE, GAIN))]
    trained = (
        read_curves(place.folder).select("setting", "policy", "training_seed", "digest").unique()
    )
    for setting, learner, seed, digest in trained.sort(pl.all()).iter_rows():
        file = training_folder(place.folder, setting, learner, seed) / "best.safetensors"
        if setting in SETTINGS and file.exists():
            cells.append(_cell(setting, learner, TEST, seed, digest, file=str(file)))
    return cells


# What is measured: errors by training seeds and traffic seeds.


def measure(rows: pl.DataFrame, statistic: Statistic, *groups: Labels) -> Interval:
    """Return a statistic of the errors of groups, by training seeds crossed with traffic.

    A group has the cells of all training seeds.

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
    return bootstrap(statistic, *paired(rows, *((ERROR, group) for group in cells)))


def read_curves(folder: Path) -> pl.DataFrame:
    """Return the learning curves of a folder, none where nothing was trained.

    Raises:
        ValueError: Their file is damaged.
    """
    columns = {
        "setting": pl.String, "policy": pl.String, "training_seed": pl.Int64,
        "digest": pl.String, "steps": pl.Int64, "seconds": pl.Float64,
        "validation": pl.Float64, "validation_drawn": pl.Float64,
    }  # fmt: skip
    path = folder / CURVES
    curves = read_table(path, tuple(columns)) if path.exists() else pl.DataFrame(schema=columns)
    return curves.with_columns(error=1000.0 * pl.min_horizontal("validation", "validation_drawn"))


def best_rule(rows: pl.DataFrame, setting: str) -> str:
    """Return the rule of least error on validation traffic.

    Raises:
        UnmeasuredError: A rule was not played there.
    """
    return min(RULES, key=lambda rule: validation_error(rows, setting, rule))


def validation_error(rows: pl.DataFrame, setting: str, rule: str) -> float:
    """Return the error x 1000 of a rule on validation traffic.

    Raises:
        UnmeasuredError: It was not played there.
    """
    return float(values(rows, played(setting, rule, VALIDATION), ERROR).mean())


def ranked_learners(curves: pl.DataFrame, setting: str, seed: int | None = None) -> list[str]:
    """Return the learners of a setting, the least error on validation traffic first.

    Args:
        curves: Learning curves.
        setting: Key of `SETTINGS`.
        seed: Training seed by which they are compared; if None, those with the most training seeds
            are, by the mean of these.
    """
    own = curves.filter(setting=setting)
    if seed is not None:
        own = own.filter(training_seed=seed)
    least = own.group_by("policy", "training_seed").agg(pl.min("error"))
    found = least.group_by("policy").agg(pl.mean("error"), n=pl.len())
    found = found.filter(pl.col("n") == pl.max("n")).sort("error", "policy")
    return list(found["policy"])


# What is reported: the settings.

BELOW = "below the best rule [%]"


def error_of(rows: pl.DataFrame, setting: str, policy: str) -> Interval:
    """Return the error x 1000 of a policy in a setting."""
    return measure(rows, interquartile_mean, played(setting, policy))


def below_best_rule(rows: pl.DataFrame, setting: str, policy: str) -> Interval:
    """Return by how much a policy errs less than the best rule of a setting [%]."""
    both = policy, best_rule(rows, setting)
    return measure(rows, percent_below, *(played(setting, each) for each in both))


def summary_table(rows: pl.DataFrame, curves: pl.DataFrame) -> str:
    """Return what is to be won in each setting, and what the best learner wins."""

    def error(policy: str, name: str) -> str:
        return f"{error_of(rows, name, policy).mean:.1f}"

    def rule(name: str) -> str:
        best = best_rule(rows, name)
        return f"{error(best, name)} (`{best}`)"

    def learner(name: str) -> str:
        found = ranked_learners(curves, name)
        if not found:
            raise UnmeasuredError(name)
        return found[0]

    def file(name: str) -> str:
        own = curves.filter(setting=name, policy=learner(name)).sort("error", "training_seed")
        folder = training_folder(Path(), name, learner(name), own["training_seed"][0])
        return f"`{folder.as_posix()}`"

    columns: dict[str, Callable[[str], str]] = {
        GUARANTEE: lambda name: SETTINGS[name].guarantee,
        ROUND_ROBIN: partial(error, ROUND_ROBIN),
        "best rule": rule,
        ORACLE: partial(error, ORACLE),
        GAIN: partial(error, GAIN),
        "learner": learner,
        BELOW: lambda name: tenths(below_best_rule(rows, name, learner(name))),
        "file": file,
    }
    return table("setting", {name: name for name in SETTINGS}, columns)


def setting_table(rows: pl.DataFrame, curves: pl.DataFrame, setting: str) -> str:
    """Return all policies that played test traffic in a setting, the least error first."""
    own = rows.filter(part=TEST, setting=setting)["policy"].unique()
    errors = {policy: error_of(rows, setting, policy) for policy in own}

    def seeds(policy: str) -> str:
        return str(curves.filter(setting=setting, policy=policy)["training_seed"].n_unique() or "-")

    columns: dict[str, Callable[[str], str]] = {
        "error x 1000": lambda policy: tenths(errors[policy]),
        BELOW: lambda policy: tenths(below_best_rule(rows, setting, policy)),
        "training seeds": seeds,
    }
    ranked = sorted(errors, key=lambda each: errors[each].mean)
    return table("policy", dict(zip(ranked, ranked, strict=True)), columns)


def _panels(
    titles: Iterable[str], label: str, left: str = "", fold: int = 30, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure of up to eight panels with titles, which a phone shows without zooming.

    Args:
        titles: Of the panels.
        label: That of all horizontal axes, below the last ones.
        left: That of all vertical axes.
        fold: Letters of a line of a title.
        **options: Of ``subplots``.
    """
    figure, named = make_figure(4.4, 7.8, dpi=130), list(titles)
    axes = list(figure.subplots(4, 2, **options).ravel())
    for axis in axes[len(named) :]:
        axis.remove()
    axes = axes[: len(named)]
    for axis, title in zip(axes, named, strict=True):
        unbroken = title.replace(" = ", "\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}")
        axis.set_title(fill(unbroken, fold), fontsize=7.5, loc="left")
        axis.xaxis.set_major_locator(MaxNLocator(4))
    for axis in axes[-2:]:
        axis.set_xlabel(label, fontsize=8)
    figure.supylabel(left, fontsize=8)
    return figure, axes


def draw_range(axis: Axes, curves: Iterable[pl.DataFrame], colour: str, label: str) -> None:
    """Draw the mean of learning curves, with a band from the least to the largest of them."""
    seeds = [(each["seconds"].to_numpy() / 60.0, each["error"].to_numpy()) for each in curves]
    if not seeds:
        return
    minutes = np.linspace(max(x[0] for x, _ in seeds), min(x[-1] for x, _ in seeds), 40)
    errors = np.array([np.interp(minutes, *seed) for seed in seeds])
    axis.plot(minutes, errors.mean(axis=0), color=colour, linewidth=1.3, label=label)
    axis.fill_between(minutes, *_ends(errors), color=colour, alpha=0.25, linewidth=0)


def _ends(errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    return errors.min(axis=0), errors.max(axis=0)


def draw_curves(rows: pl.DataFrame, curves: pl.DataFrame, path: Path) -> None:
    """Draw errors in validation over the time of training, with rules as lines."""
    titles = (each.title for each in SETTINGS.values())
    figure, axes = _panels(titles, "minutes of training", "error x 1000")
    for axis, name in zip(axes, SETTINGS, strict=True):
        try:
            named = {ROUND_ROBIN: ROUND_ROBIN, "best rule": best_rule(rows, name)}
            shown = {label: validation_error(rows, name, rule) for label, rule in named.items()}
        except UnmeasuredError:
            continue
        for (label, error), line in zip(shown.items(), (":", "--"), strict=True):
            axis.axhline(error, color=GREY, linestyle=line, linewidth=1.0, label=label)
        for learner, colour in zip(SHOWN, COLOURS, strict=True):
            own = curves.filter(setting=name, policy=learner).sort("training_seed", "seconds")
            seeds = (each for _, each in own.group_by("training_seed", maintain_order=True))
            draw_range(axis, seeds, colour, learner)
        # What is not trained yet may err far more than any rule.
        axis.set_ylim(top=1.03 * max(shown.values()))
    title = "Errors on validation traffic; ranges of training seeds"
    save_figure(finish_figure(figure, columns=3), path, title)


def draw_below(rows: pl.DataFrame, path: Path) -> None:
    """Draw how far learners and oracles lie below the best rule."""
    titles = (each.title for each in SETTINGS.values())
    figure, axes = _panels(titles, BELOW, fold=24, sharey=True)
    for axis, name in zip(axes, SETTINGS, strict=True):
        looks = {
            **dict.fromkeys(SHOWN, (COLOURS[0], "learners, a minute")),
            **dict.fromkeys((ORACLE, GAIN), (GREY, "oracles")),
        }
        for place, (policy, look) in enumerate(looks.items()):
            try:
                draw_dot(axis, below_best_rule(rows, name, policy), -place, *look)
            except UnmeasuredError:
                continue
        axis.axvline(0.0, color=GREY, linewidth=0.8)
        axis.margins(x=0.3)
        labels = (*SHOWN, ORACLE, GAIN)
        axis.set_yticks([-place for place in range(len(labels))], labels)
    title = "Errors below the best rule's; 95 % intervals"
    save_figure(finish_figure(figure, columns=1), path, title)


# What is reported: recorded gains over a round robin, by the share of the road that is queried.

CHOICES, LEARNED = "choices", "learned"
HIGHWAY = "highway"
EPSILON = 5.0
N_SEGMENTS = {HIGHWAY: 15, "long": 120}
BANDWIDTHS = {HIGHWAY: (1, 2, 3, 5, 8, 12), "long": (2, 4, 8, 24)}


class World(NamedTuple):
    """The subject of a curve over bandwidths."""

    road: str
    release: str
    estimator: str

    @property
    def name(self) -> str:
        """Its name."""
        n = N_SEGMENTS[self.road]
        return f"{n} segments, {self.release}, ε = {EPSILON:g}, {LABELS[self.estimator]}"

    @property
    def rule(self) -> str:
        """The rule for its estimator, chosen on other traffic."""
        return "speed-front" if self.estimator == "ekf" else "expected-reduction"

    def gain(self, rows: pl.DataFrame, bandwidth: int, policy: str) -> Interval:
        """Return how far a policy lies below the round robin [%]."""
        place = {
            "part": CHOICES, **self._asdict(), "bandwidth": bandwidth, "traffic": "own",
            "epsilon": EPSILON, "span": 1,
        }  # fmt: skip
        both = ({**place, "policy": each} for each in (policy, ROUND_ROBIN))
        return measure(rows, percent_below, *both)


WORLDS = (
    *(World(HIGHWAY, *each) for each in product(("paced", "capped"), ("ekf", "recurrent"))),
    World("long", "paced", "ekf"),
    World("long", "paced", "recurrent"),
    World("long", "capped", "recurrent"),
)
LOOKS = {
    "rule": Look(COLOURS[0], "o"),
    ORACLE: Look(COLOURS[-1], "^", ":"),
    GAIN: Look(GREY, "v", "--"),
    LEARNED: Look(COLOURS[1], "s"),
}


def gain_table(rows: pl.DataFrame, world: World) -> str:
    """Return the gains over the round robin in a world, by bandwidth [%]."""

    def entry(bandwidth: int, column: str) -> str:
        return tenths(world.gain(rows, bandwidth, world.rule if column == "rule" else column))

    return grid(f"B, rule `{world.rule}`", BANDWIDTHS[world.road], list(LOOKS), entry)


def draw_gains(rows: pl.DataFrame, path: Path) -> None:
    """Draw gains over the round robin against the share of the road that is queried."""
    titles = (each.name for each in WORLDS)
    left = f"error below {ROUND_ROBIN} [%]"
    figure, axes = _panels(titles, "segments queried a second [%]", left, sharey=True)
    for axis, world in zip(axes, WORLDS, strict=True):
        bandwidths = BANDWIDTHS[world.road]
        shares = [100.0 * each / N_SEGMENTS[world.road] for each in bandwidths]
        for k, (label, look) in enumerate(LOOKS.items()):
            policy = world.rule if label == "rule" else label
            try:
                found = [world.gain(rows, each, policy) for each in bandwidths]
            except UnmeasuredError:
                continue
            draw_curve(axis, shifted(shares, 0.01 * (k - 1), log=True), found, look, label)
        axis.axhline(0.0, color=GREY, linewidth=0.8)
        set_log(axis, [float(f"{share:.2g}") for share in shares])
    title = f"Gain of choosing queries over {ROUND_ROBIN}; 95 % intervals"
    save_figure(finish_figure(figure, columns=2), path, title)


def report(rows: pl.DataFrame, folder: Path) -> str:
    """Return the tables, and draw the figures."""
    curves = read_curves(folder)
    named = {*played("", ""), "training_seed", "digest"} - set(rows.columns)
    rows = rows.with_columns(pl.lit(None).alias(name) for name in sorted(named))
    # A training that was begun anew has left rows of the policy that it had before.
    present = ["", *curves["digest"].unique()]
    rows = rows.filter(pl.col("digest").cast(pl.String).fill_null("").is_in(present))
    parts = ["# Query policies"]
    if not rows.filter(part=TEST).is_empty():
        parts += ["## Summary", summary_table(rows, curves)]
        for name, setting in SETTINGS.items():
            parts += [f"## {name}: {setting.title}", setting_table(rows, curves, name)]
        draw_curves(rows, curves, folder / "fig_curves.png")
        draw_below(rows, folder / "fig_below.png")
    if not rows.filter(part=CHOICES).is_empty():
        parts.append(f"## Gains over {ROUND_ROBIN} by bandwidth [%]")
        for world in WORLDS:
            parts += [f"### {world.name}", gain_table(rows, world)]
        draw_gains(rows, folder / "fig_gains.png")
    return "\n\n".join(parts)


STUDY = Study(
    "policies",
    tuple(_cell(*each, VALIDATION) for each in product(SETTINGS, RULES)),
    TRAFFIC.test,
    report,
    test_cells,
)


def study(minutes: float | None = None, seeds: str | None = None) -> Study:
    """Return the study, which trains what is missing if a time is given.

    Args:
        minutes: Time of each training.
        seeds: Training seeds, first:stop, 0:5 if not given. Every learner has the first, the best
            two have all.

    Raises:
        ValueError: An argument is out of range, or there are seeds without a time.
    """
    if minutes is None:
        require(seeds is None, "seeds", "left out without minutes, as nothing is trained", seeds)
        return STUDY
    time = positive("minutes", minutes)
    training_seeds = parse_seeds(convert(str, "0:5" if seeds is None else seeds, "seeds"))

    def follow(rows: pl.DataFrame, place: Place) -> list[Cell]:
        from agents.studies.policies.trainings import train_ladder  # noqa: PLC0415 (needs torch)

        train_ladder(place, time, training_seeds)
        return test_cells(rows, place)

    return dataclasses.replace(STUDY, follow=follow)
