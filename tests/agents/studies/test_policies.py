import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from agents.executors import this_process
from agents.statistics import bootstrap, percent_below
from agents.studies import policies
from agents.studies.policies import GAIN, ORACLE, ROUND_ROBIN, RULES, TEST, VALIDATION
from agents.studies.policies.trainings import Training, fits, plan_of, train_ladder
from agents.study import Place, read_rows, read_table, run, write_report, write_table
from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from tests.agents.training.plans import SMALL
from tests.helpers import SHORT

RECORDED = Path(__file__).parents[3] / "results" / "policies"
BEST, OTHER = "speed-front", "shift-ahead"


def rows_of(policy, errors, part=TEST, setting="short", seed=-1, digest=""):
    """Return rows of a cell with the given errors x 1000 on traffic from 2200 on."""
    same = {
        "study": "policies", "version": "0.1.0", "part": part, "setting": setting,
        "cell": f"{part} {setting} {policy} {seed} {digest}",
        "policy": policy, "training_seed": seed, "digest": digest,
    }  # fmt: skip
    return [
        {**same, "traffic_seed": 2200 + k, "reward": -error / 1000}
        for k, error in enumerate(errors)
    ]


def curve_of(policy, errors, seed=0, digest="", setting="short", steps=5e5):
    """Return a learning curve: errors x 1000 of the likeliest actions; drawn ones err by 5 more."""
    return [
        {
            "setting": setting, "policy": policy, "training_seed": seed, "digest": digest,
            "steps": int(steps * k), "seconds": 60.0 * k,
            "validation": error / 1000, "validation_drawn": (error + 5) / 1000,
        }
        for k, error in enumerate(errors)
    ]  # fmt: skip


@pytest.fixture
def errors():
    """Errors on test traffic by policy, training seeds by traffic."""
    generator = np.random.default_rng(0)
    traffic = 100.0 + 10.0 * generator.standard_normal(12)
    factors = {
        ROUND_ROBIN: 1.1, BEST: 1.0, OTHER: 0.99, ORACLE: 0.85, GAIN: 0.8, "ppo-road": 0.9,
        "qr-dqn": 1.02,
    }  # fmt: skip
    found = {}
    for policy, factor in factors.items():
        n = 5 if policy == "ppo-road" else 1
        found[policy] = factor * traffic + generator.standard_normal((n, 12))
    found["ppo-road"][3] = 150.0  # a training that failed
    return found


@pytest.fixture
def ladder(errors, tmp_path):
    """The folder of a study of one setting."""
    rows = [
        row
        for policy, table in errors.items()
        for seed, values in enumerate(table)
        for row in rows_of(
            policy, values, seed=seed if policy in policies.LEARNERS else -1,
            digest=f"{policy}{seed}" if policy in policies.LEARNERS else "",
        )
    ]  # fmt: skip
    for rule in RULES:
        rows += rows_of(rule, [90.0 if rule == BEST else 95.0] * 2, VALIDATION)
    rows += rows_of("ppo-road", np.zeros(12), seed=0, digest="of a training begun anew")
    write_table(tmp_path / "rows.parquet", pl.DataFrame(rows))
    curves = [
        row
        for seed in range(5)
        for row in curve_of("ppo-road", (120.0, 85.0, 86.0), seed, f"ppo-road{seed}")
    ]
    curves += curve_of("qr-dqn", (120.0, 80.0), 0, "qr-dqn0")
    write_table(tmp_path / policies.CURVES, pl.DataFrame(curves))
    return tmp_path


def line(text, start):
    """Return the entries of the first line of a table that starts so."""
    found = next(each for each in text.splitlines() if each.startswith(f"| {start} |"))
    return [each.strip() for each in found.strip("|").split("|")]


def entry(interval):
    return f"{interval.mean:.1f} [{interval.low:.1f}, {interval.high:.1f}]"


def test_the_report_compares_with_the_rule_that_validation_chose(ladder, errors):
    write_report(policies.STUDY, ladder)
    text = (ladder / "tables.md").read_text("utf-8")
    own = errors["ppo-road"]
    typical = np.sort(own.mean(axis=1))[1:4].mean()
    found = line(text, "ppo-road")
    assert found[1].startswith(f"{typical:.1f} [")
    assert found[2] == entry(bootstrap(percent_below, own, errors[BEST]))
    assert found[3:] == ["5"]
    assert line(text, "qr-dqn")[3:] == ["1"]
    assert line(text, BEST)[3:] == ["-"]
    # The learner with the most training seeds counts, and its best training in validation.
    summary = line(text, "short")
    assert summary[3] == f"{errors[BEST].mean():.1f} (`{BEST}`)"
    assert summary[6:] == ["ppo-road", found[2], "`trainings/short/ppo-road/0`"]
    assert set(line(text, "private-1")[2:]) == {"-"}
    assert {path.name for path in ladder.glob("*.png")} == {"fig_curves.png", "fig_below.png"}


def test_what_was_not_played_yet_is_a_dash(ladder):
    rows = read_rows("policies", ladder).filter(pl.col("policy") != GAIN)
    write_table(ladder / "rows.parquet", rows)
    (ladder / policies.CURVES).unlink()
    write_report(policies.STUDY, ladder)
    text = (ladder / "tables.md").read_text("utf-8")
    assert line(text, BEST)[2:] == ["0.0 [0.0, 0.0]", "-"]
    assert line(text, "short")[5:] == ["-"] * 4
    assert "| ppo-road |" not in text  # nothing says that these rows are those of its trainings


def test_learners_are_ranked_by_one_training_seed_or_by_all():
    curves = [
        *curve_of("ppo-road", (99.0, 80.0), 0), *curve_of("ppo-road", (99.0, 90.0), 1),
        *curve_of("maskable-ppo", (99.0, 83.0), 0), *curve_of("maskable-ppo", (83.0, 99.0), 1),
        *curve_of("qr-dqn", (70.0,), 0), *curve_of("qr-dqn", (60.0,), 1, setting="private-1"),
    ]  # fmt: skip
    frame = pl.DataFrame(curves).with_columns(error=1000 * pl.col("validation"))
    assert policies.ranked_learners(frame, "short", 0) == ["qr-dqn", "ppo-road", "maskable-ppo"]
    assert policies.ranked_learners(frame, "short") == ["maskable-ppo", "ppo-road"]
    assert policies.ranked_learners(frame, "long") == []


def test_recorded_gains_are_those_of_their_rows(tmp_path):
    if not RECORDED.is_dir():
        pytest.skip("a source archive has no results")
    world = policies.WORLDS[0]
    labels = {**world._asdict(), "part": "choices", "bandwidth": 2}
    rows = read_rows("policies", RECORDED).filter(**labels)
    write_table(tmp_path / "rows.parquet", rows.filter(pl.col("policy") != GAIN))
    write_report(policies.STUDY, tmp_path)

    def errors(policy):
        own = rows.filter(policy=policy).sort("training_seed", "traffic_seed")
        return -1000.0 * own["reward"].to_numpy().reshape(-1, 32)

    gain = bootstrap(percent_below, errors("learned"), errors(ROUND_ROBIN))
    found = line((tmp_path / "tables.md").read_text("utf-8"), "2")
    assert found[3:] == ["-", entry(gain)]


def test_traffic_of_trainings_choices_and_tests_is_apart():
    for setting in policies.SETTINGS.values():
        for own, kind in zip(
            setting.traffic, (TRAINING_SEEDS, VALIDATION_SEEDS, TEST_SEEDS, TEST_SEEDS), strict=True
        ):
            assert set(own) <= set(kind)
        assert set(setting.traffic.gain) <= set(setting.traffic.test)


def test_every_learner_has_a_plan_in_the_settings_that_it_fits():
    pairs = [pair for pair in product(policies.SETTINGS, policies.LEARNERS) if fits(*pair)]
    assert len(pairs) == 7 * 6 - 4
    assert [name for name, learner in pairs if learner == "qr-dqn"] == [
        "short", "short-paced", "private-1",
    ]  # fmt: skip
    for setting, learner in pairs:
        assert plan_of(Training(setting, learner, 0), 10.0).worlds


def test_a_plan_has_the_settings_of_its_road():
    plan = plan_of(Training("long", "plackett-luce", 3), 10.0)
    assert (plan.seed, plan.minutes, plan.algorithm.n_envs) == (3, 10.0, 16)
    assert plan_of(Training("long", "ppo-road", 0), 10.0).algorithm.validations == 2


@pytest.mark.slow
def test_a_small_ladder_is_trained_played_and_goes_on(tmp_path, monkeypatch):
    keywords = {"estimator": "random_walk", "bandwidth": 1, "horizon": 80, "privacy": "capped"}
    traffic = policies.Traffic((0, 1), (1000, 1001), (2000, 2001, 2002), (2000, 2001))
    setting = policies.Setting("a short road", SHORT, keywords, traffic)
    learners = {
        "ppo-perceptron": ("ppo", {**SMALL["ppo"], "policy": "mlp"}),
        "qr-dqn": ("qr-dqn", SMALL["qr-dqn"]),
        "plackett-luce": ("plackett-luce", SMALL["plackett-luce"]),
    }
    for module in (policies, policies.trainings):
        monkeypatch.setattr(module, "LEARNERS", learners)
        monkeypatch.setattr(module, "SETTINGS", {"short": setting})
    monkeypatch.setattr(policies, "RULES", (ROUND_ROBIN, OTHER))
    cells = tuple(policies._cell("short", rule, VALIDATION) for rule in (ROUND_ROBIN, OTHER))
    monkeypatch.setattr(policies, "STUDY", replace(policies.STUDY, cells=cells))
    place = Place(tmp_path, this_process)
    train_ladder(place, 0.05, (0,))
    curves = read_table(tmp_path / policies.CURVES)
    assert set(curves["policy"]) == set(learners)
    kept = tmp_path / "trainings" / "short" / "qr-dqn" / "0" / "checkpoint.pt"
    before = kept.stat().st_mtime_ns
    shutil.rmtree(tmp_path / "trainings" / "short" / "plackett-luce")  # as one that was killed
    run(policies.study(0.05, "0:2"), place)
    assert kept.stat().st_mtime_ns == before
    curves = read_table(tmp_path / policies.CURVES)
    seeds = curves.group_by("policy").agg(pl.col("training_seed").n_unique())
    assert sorted(seeds["training_seed"]) == [1, 2, 2]
    assert curves["seconds"].min() > 0.0
    rows = read_rows("policies", tmp_path).filter(part=TEST)
    assert rows["cell"].n_unique() == 2 + 2 + 5
    assert rows.filter(policy=GAIN)["traffic_seed"].n_unique() == 2
    assert "| plackett-luce |" in (tmp_path / "tables.md").read_text("utf-8")
    with pytest.raises(ValueError, match=r"another plan: minutes is 0\.05 there and 0\.1 now"):
        train_ladder(place, 0.1, (0,))
