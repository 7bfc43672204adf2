import dataclasses
import functools
import gc
import json

import numpy as np
import polars as pl
import pytest

from agents.environments import parse_env
from agents.executors import this_process
from agents.filters.highways import KINDS, draw_highway
from agents.filters.scenarios import ScenarioRanges
from agents.play import Cell, play
from agents.statistics import bootstrap, percent_below
from agents.studies import suite
from agents.studies.suite import entries, scores, tasks
from agents.studies.suite.access import access_of
from agents.studies.suite.entries import (
    CARD,
    begin,
    check,
    make_entry,
    read_entry,
    require_fair,
)
from agents.studies.suite.scores import choose_rules, errors_of, score, seeds_to_see
from agents.studies.suite.tasks import (
    MARKS,
    PAPER_SCHEDULE,
    ROUND_ROBIN,
    RULES,
    TASKS,
    VALIDATION,
    Task,
    make_cell,
)
from agents.study import ROWS, Place, Study, play_study, read_table, run, write_table
from agents.tables import UnmeasuredError
from dptse_env import versions
from dptse_env.config import TEST_SEEDS, VALIDATION_SEEDS
from dptse_env.policies import read_policy, shipped_policies
from dptse_env.process import QueryProcess
from dptse_env.schedules.oracles import OracleGain
from dptse_env.schedules.rules import OldestFirst
from tests.helpers import SHORT, save_untrained, untrained

KEYWORDS = {"estimator": "random_walk", "bandwidth": 2, "horizon": 80}
SMALL = {
    name: Task(SHORT, {**KEYWORDS, **more}, (2000, 2001, 2002), (1000, 1001), is_held_out=held)
    for name, more, held in (
        ("plain", {}, False),
        ("paced", {"privacy": "paced", "corridor": {"duration": 100}}, True),
    )
}
FEW = ("static", "oldest-first", ROUND_ROBIN, PAPER_SCHEDULE)


def use_small(patch, folder=None):
    """Make two small tasks and four rules the suite."""
    for module in (tasks, suite, entries, scores):
        patch.setattr(module, "TASKS", SMALL)
    for module in (tasks, suite, scores):
        patch.setattr(module, "RULES", FEW)
    for module in (tasks, suite):
        patch.setattr(module, "MARKS", ())
        patch.setattr(module, "MARKED", ())
    if folder is not None:
        patch.setattr(suite, "RECORDED", folder)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the rows of the small suite."""
    folder = tmp_path_factory.mktemp("recorded")
    with pytest.MonkeyPatch.context() as patch:
        use_small(patch)
        cells = tuple(tasks.validation_cells())
        run(dataclasses.replace(suite.STUDY, cells=cells), Place(folder, this_process))
    return folder


@pytest.fixture
def small(monkeypatch, folder):
    """Make it the suite; return its rows."""
    use_small(monkeypatch, folder)
    return read_table(folder / ROWS)


def enter(path, *policies):
    """Enter the small suite in a folder; return the line of the entry."""
    entry = begin(make_entry([str(each) for each in policies], list(SMALL)), path, None)
    play_study(Study("suite", tuple(entry.cells({})), (), suite.report), Place(path, this_process))
    return suite.read(path / CARD, *suite.recorded())[1]


# Scores.


def test_a_score_is_the_per_cent_below_the_rule_with_the_bootstrap_over_seeds_and_traffic(small):
    rng = np.random.default_rng(0)
    rule = {name: 100.0 + 20.0 * rng.random((1, 30)) for name in SMALL}
    mine = {name: 0.9 * table + 4.0 * rng.random((5, 1)) for name, table in rule.items()}
    found = score(mine, rule)
    for name in SMALL:
        expected = bootstrap(percent_below, mine[name], rule[name])
        assert found.tasks[name].mean == pytest.approx(expected.mean)
        assert found.tasks[name].low == pytest.approx(expected.low, abs=0.15)
        assert found.tasks[name].high == pytest.approx(expected.high, abs=0.15)


def test_the_mean_is_over_all_tasks_and_knows_that_they_share_traffic(small):
    rule = {name: np.array([[100.0, 110.0, 90.0, 100.0]]) for name in SMALL}
    one = np.array([[90.0, 110.0, 80.0, 80.0]])  # 10 % below
    assert score({"plain": one, "paced": one + 10.0}, rule).mean.mean == pytest.approx(5.0)
    found = score({"plain": one, "paced": one}, rule)
    alone = found.tasks["plain"].half_width
    assert found.mean.half_width == pytest.approx(alone)  # the same differences: nothing new
    assert score({"plain": one}, rule).mean is None
    assert dataclasses.astuple(score(rule, rule).mean) == (0.0, 0.0, 0.0, 4)


def test_a_rule_is_fixed_by_validation_traffic(small):
    rules = choose_rules(small)
    assert rules.keys() == SMALL.keys()
    for task, rule in rules.items():
        means = {each: errors_of(small, make_cell(task, each, part=VALIDATION)) for each in FEW}
        assert means[rule].mean() == min(each.mean() for each in means.values())
    worse = pl.when(pl.col("part") != VALIDATION, pl.col("policy") == rules["plain"])
    assert choose_rules(small.with_columns(reward=worse.then(-9.0).otherwise("reward"))) == rules
    assert choose_rules(small.filter(pl.col("policy") != "static")) == {}


def test_the_number_of_seeds_shows_two_per_cent():
    deviation, n = 6.0, seeds_to_see(6.0)
    rng = np.random.default_rng(0)
    means = 2.0 + deviation * rng.standard_normal((4000, n)).mean(axis=1)
    seen = np.mean(means > 1.96 * deviation / np.sqrt(n))
    assert 0.88 < seen < 0.92


# Entries.


def test_a_policy_for_all_tasks_has_a_mean_and_the_round_robin_where_it_does_not_suit(
    small, tmp_path
):
    files = [
        save_untrained(tmp_path / str(k) / "best.safetensors", seed=k, estimator="random_walk")
        for k in range(2)
    ]
    line = enter(tmp_path / "mine", *files)
    shapes = {name: table.shape for name, table in line.errors.items()}
    assert shapes == {"plain": (2, 3), "paced": (1, 3)}
    entry = line.entry
    assert entry.left.keys() == {"paced"}
    assert (entry.training_seeds, entry.steps, entry.track) == (2, 100, "1 million")
    assert entry.reads == "observations"
    assert entry.parameters == sum(each.size for each in read_policy(files[0]).weights.values())
    assert line.scores.mean is not None
    assert "mine/policies/" in entry.policies["plain"][1]  # a copy
    assert check(tmp_path / "mine" / CARD, 2) < 1e-6


def test_a_file_names_policies_by_task(small, tmp_path):
    save_untrained(tmp_path / "0.safetensors", estimator="random_walk")
    path = tmp_path / "mine.toml"
    path.write_text(
        'minutes = 3.5\ntuning = "none"\n[policies]\nplain = "0.safetensors"\nothers = "static"\n'
    )
    entry = make_entry([str(path)], list(SMALL))
    assert (entry.name, entry.minutes, entry.tuning) == ("mine", 3.5, "none")
    assert entry.policies == {"plain": [str(tmp_path / "0.safetensors")], "paced": ["static"]}
    for text, message in (
        ('[policies]\nnowhere = "static"', r"policies must be a table of .*, got 'nowhere'"),
        ('[policies]\npaced = "0.safetensors"', r"mine\.toml: paced must be what suits it: "),
        ('[policies]\nplain = ["static", "none"]\npaced = ["a", "b", "c"]', "as many"),
        ('policies = ["static", "static"]', "different"),
        ('polices = "static"', r"an entry with keys .*polices"),
        ('policies = "static"\nminutes = -1', "minutes"),
        ('policies = "static"\nparameters = 9', "parameters must be left out"),
        ("policies = 3", "policies"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            make_entry([str(path)], list(SMALL))
    entry = make_entry([f"{__name__}:Peeking"], list(SMALL))
    assert (entry.steps, entry.parameters, entry.track) == (None, None, "unlimited")
    path.write_text(f'policies = "{__name__}:Peeking"\nsteps = 5_000\nparameters = 9')
    entry = make_entry([str(path)], list(SMALL))
    assert (entry.steps, entry.parameters, entry.track) == (5000, 9, "1 million")


# Cheats.


class Denying(OracleGain):
    """Reads the truth, and denies it."""

    name = "my-transformer"
    uses_truth = False


class Peeking(OldestFirst):
    """Has got at the process by a way of its own."""

    @functools.cached_property
    def process(self):
        found = (each for each in gc.get_objects() if isinstance(each, QueryProcess))
        return next(each for each in found if each.interface is self.interface)

    def select(self, step, observation):
        self.process.truth(np.arange(len(step)))
        return super().select(step, observation)


@pytest.mark.parametrize(
    ("policy", "reads"),
    [
        (f"{__name__}:Denying", "truth"),
        (f"{__name__}:Peeking", "truth"),
        ("oracle-gain", "truth"),
        ("expected-reduction", "process"),
        ("oldest-first", "observations"),
    ],
)
def test_what_a_policy_reads_is_found_out(small, policy, reads):
    cell = make_cell("plain", policy, seeds=(2000,))
    assert access_of(dataclasses.replace(cell, keywords={**cell.keywords, "horizon": 62})) == reads


def test_a_cheat_is_marked_on_its_card_and_comes_last_in_the_tables(small, tmp_path):
    place = tmp_path / suite.ENTRIES
    for folder, policy in (("a", f"{__name__}:Denying"), ("b", "random")):
        assert enter(place / folder, policy).name.endswith(" ‡") == (folder == "a")
    table = suite.report(small, tmp_path).split("\n## ")[0].splitlines()
    (head,) = (line for line in table if line.startswith("| task"))
    assert head.endswith(f"| random | {__name__}:Denying ‡ |")
    assert (tmp_path / suite.FIGURE).is_file()


def test_an_edited_row_is_caught_when_it_is_played_again(small, tmp_path):
    enter(tmp_path, "oldest-first")
    assert check(tmp_path / CARD, 1) < 1e-6
    rows, share = read_table(tmp_path / ROWS), pl.col("traffic_seed") == 2001
    better = pl.when(share, pl.col("task") == "paced").then(0.9).otherwise(1.0)
    write_table(tmp_path / ROWS, rows.with_columns(reward=pl.col("reward") * better))
    with pytest.raises(ValueError, match=r"'oldest-first' in 'paced' must .* traffic seed 2001"):
        check(tmp_path / CARD, 1)
    write_table(tmp_path / ROWS, rows.with_columns(reward=pl.col("reward") * 0.99))
    with pytest.raises(ValueError, match=r"and 1\.00%"):
        check(tmp_path / CARD, 1)


def test_rows_of_another_policy_task_or_version_are_not_those_of_an_entry(
    small, tmp_path, monkeypatch
):
    files = [
        save_untrained(tmp_path / str(k) / "best.safetensors", seed=k, estimator="random_walk")
        for k in range(2)
    ]
    path, recorded = tmp_path / "mine" / CARD, suite.recorded()
    entry, written = enter(path.parent, files[0]).entry, path.read_text()
    copy = path.parent / json.loads(written)["policies"]["plain"][0]
    kept = copy.read_bytes()
    copy.write_bytes(files[1].read_bytes())
    with pytest.raises(UnmeasuredError, match="plain"):
        suite.read(path, *recorded)
    copy.write_bytes(kept)
    for key, value in (("suite", "query-suite-v3"), ("fresh", [2000])):
        path.write_text(json.dumps({**json.loads(written), key: value}))
        with pytest.raises(ValueError, match=rf"card\.json: {key} must be"):
            read_entry(path)
    path.write_text(written)
    assert suite.read(path, *recorded)[1].entry == entry
    with monkeypatch.context() as patch:
        patch.setattr(versions, "digest", lambda: "moved")
        with pytest.raises(ValueError, match=r"\+moved, so nothing can be scored"):
            suite.recorded()
    other = {**SMALL, "plain": SMALL["plain"]._replace(keywords={**KEYWORDS, "horizon": 90})}
    for module in (tasks, suite, entries, scores):
        monkeypatch.setattr(module, "TASKS", other)
    with pytest.raises(UnmeasuredError, match="plain"):
        suite.read(path, *recorded)


def test_training_on_test_traffic_or_on_a_held_out_road_is_refused(small, tmp_path):
    from dptse_env.sb3 import save_policy

    path = tmp_path / "leak.safetensors"
    told = {"traffic seeds": "0..7", "validation seeds": "1000..1003, 2002"}
    for keywords, training, message in (
        ({"traffic_seeds": "1990:2010"}, {"seed": 0}, "seed 2000"),  # as the page has it
        ({}, told, "test traffic, seed 2002"),
        (SMALL["paced"].keywords, {}, "the road of 'paced', which is held out"),
    ):
        policy, config = untrained(**{**keywords, "estimator": "random_walk"})
        about = {"env": SHORT, "keywords": {}, "figures": {}, "training": training}
        save_policy(path, policy, config, **about)
        with pytest.raises(ValueError, match=message):
            make_entry([str(path)], list(SMALL))


def test_the_report_says_what_was_not_played(small, tmp_path):
    whole = suite.report(small, tmp_path)
    assert all(f"\n| {task} | " in whole for task in SMALL)
    part = suite.report(small.filter(pl.col("policy") != "static"), tmp_path)
    assert "\n| static | - | - |" in part
    assert "\n| plain | " not in part.split("\n## ")[0]


# The suite itself.


def test_tasks_have_their_own_test_traffic_and_only_known_rules():
    assert PAPER_SCHEDULE in RULES
    assert not {*RULES} & {*MARKS, "none", "all"}
    for name, task in TASKS.items():
        assert task.keywords["estimator"] == "recurrent", name
        assert {*task.seeds} <= {*TEST_SEEDS[500:]}, name
        assert {*task.validation} <= {*VALIDATION_SEEDS[500:]}, name
        # Tasks have the first seeds of one range, by which a resample is shared.
        assert task.seeds[0] == TEST_SEEDS[500], name
        make_cell(name, ROUND_ROBIN).check()


def test_no_shipped_policy_was_trained_on_test_traffic_or_a_held_out_road():
    for name in shipped_policies():
        require_fair(name)


def test_no_weights_were_trained_on_the_road_with_lorries():
    road = make_cell("lorries", ROUND_ROBIN).config.corridor.geometry
    drawn = [
        draw_highway(number, kind).corridor.geometry
        for kind in KINDS
        for number in range(*ScenarioRanges().highways)
    ]
    parsed = map(parse_env, ScenarioRanges().envs)
    named = [Cell(env, keywords=given).config.corridor.geometry for env, given in parsed]
    assert road not in [*drawn, *named]


@pytest.mark.slow
@pytest.mark.skipif(not suite.RECORDED.is_dir(), reason="a source archive has no results")
def test_recorded_rules_and_entries_are_as_they_say_when_they_are_played_again():
    rules, rows = suite.recorded()
    for task, rule in rules.items():
        cell = make_cell(task, rule)
        found = [-1000.0 * row["reward"] for row in play(cell, cell.seeds)]
        assert found == pytest.approx(errors_of(rows, cell)[0], rel=entries.TOLERANCE), task
    for path in (suite.RECORDED / suite.ENTRIES).glob(f"*/{CARD}"):
        check(path, 1)
