import json
from pathlib import Path

import polars as pl
import pytest

from agents.executors import THIS_PROCESS
from agents.statistics import bootstrap, percent_below
from agents.studies import policies
from agents.study import Place, read_rows, run, write_report, write_table
from dptse_env.config import VALIDATION_SEEDS
from tests.helpers import SHORT, save_untrained

RECORDED = Path(__file__).parents[3] / "results" / "policies"
VALIDATION, TEST, PRIMARY = policies.VALIDATION, policies.TEST, policies.PRIMARY


@pytest.fixture(scope="module")
def recorded():
    if not RECORDED.is_dir():
        pytest.skip("a source archive has no results")
    return read_rows("policies", RECORDED)


def errors(rows, **labels):
    """Return errors x 1000, training seeds by traffic seeds."""
    found = rows.filter(**labels).sort("training_seed", "traffic_seed")
    return -1000.0 * found["reward"].to_numpy().reshape(-1, found["traffic_seed"].n_unique())


def line(text, start):
    """Return the entries of the first line of a table that starts so."""
    found = next(each for each in text.splitlines() if each.startswith(f"| {start}"))
    return [each.strip() for each in found.strip("|").split("|")]


def test_the_report_is_that_of_the_rows_and_dashes_stand_for_what_is_missing(recorded, tmp_path):
    names = ["paper", "oldest-first", "plackett-luce"]
    setting = recorded.filter(pl.col("policy").is_in(names), setting="paper")
    world = {"part": "choices", **policies.WORLDS[0]._asdict(), "bandwidth": 2}
    place = recorded.filter(pl.col("policy") != "oracle-gain", **world)
    write_table(tmp_path / "rows.parquet", pl.concat([setting, place]))
    write_report(policies.STUDY, tmp_path)
    text = (tmp_path / "tables.md").read_text()
    own = errors(setting, part=TEST, kind="learned", mode="deterministic")
    assert own.shape == (5, 64)
    below = bootstrap(percent_below, own, errors(setting, part=TEST, policy="oldest-first"))
    entry = f"{below.mean:.2f} [{below.low:.2f}, {below.high:.2f}]"
    for start in ("paper: plackett-luce", "plackett-luce, training seeds: 5"):
        assert line(text, start)[4::2] == [entry, "-"]  # no oracle
    base = errors(place, policy="round-robin")
    gain = bootstrap(percent_below, errors(place, policy="learned"), base)
    entry = f"{gain.mean:.1f} [{gain.low:.1f}, {gain.high:.1f}]"
    assert line(text, "2 (13 %)")[2::2] == [f"{base.mean():.1f}", entry, line(text, "2 (13 %)")[6]]
    assert line(text, "2 (13 %)")[7] == "-"
    assert set(line(text, "5 (33 %)")[1:]) == {"-"}


def test_validation_traffic_alone_decides(recorded):
    rows = recorded.filter(setting="paper")

    def choice(**labels):
        best = pl.all_horizontal(pl.col(name) == value for name, value in labels.items())
        changed = rows.with_columns(reward=pl.when(best).then(0.0).otherwise("reward"))
        return policies.choose(changed)["paper"][:3]

    assert choice(part=TEST, policy="static") == ("oldest-first", "plackett-luce", "deterministic")
    assert choice(part=VALIDATION, policy="static")[0] == "static"
    assert choice(part=VALIDATION, mode="stochastic")[2] == "stochastic"
    traffic = {*policies.RECORDED_TRAFFIC, *policies.VALIDATION_TRAFFIC}
    assert traffic <= set(VALIDATION_SEEDS)


def test_the_recipe_that_was_chosen_is_moved_in_the_mode_that_was(recorded):
    chosen = policies.choose(recorded)
    chosen[PRIMARY] = chosen[PRIMARY]._replace(recipe="b", mode="stochastic")
    given = [policies.Trained(PRIMARY, recipe, 0, f"{recipe}.zip") for recipe in "ab"]
    cells = [each for each in policies.test_cells(chosen, given) if each.policy.endswith(".zip")]
    moved = [each for each in cells if each.transferred]
    assert {each.labels["setting"] for each in cells if each not in moved} == {PRIMARY}
    assert len(cells) == 4 + len(moved) == 4 + len(policies.SETTINGS) - 2
    assert {(each.policy, each.deterministic) for each in moved} == {("b.zip", False)}


def test_policies_that_cannot_be_found_are_refused():
    for given, error in (
        ("nowhere=a.zip", ValueError), ("paper", ValueError), ("paper=missing", FileNotFoundError),
    ):  # fmt: skip
        with pytest.raises(error, match=given.partition("=")[2] or given):
            policies.study([given])


@pytest.mark.slow
def test_a_small_study_plays_validation_then_test_traffic(tmp_path, monkeypatch):
    capped = {"privacy": "capped"}
    keywords = {"estimator": "random_walk", "bandwidth": 2, "horizon": 80, **capped}
    calm = {**keywords, "incident": "none"}
    small = {
        "SETTINGS": {
            PRIMARY: policies.Setting("a short road", keywords, SHORT),
            "moved": policies.Setting("calm", calm, SHORT),
        },
        "WORLDS": (policies.World("highway", "capped", "random_walk"),),
        "RULES": ("paper", "round-robin"), "TOGETHER": (), "EPSILONS": (5.0,),
        "VALIDATION_TRAFFIC": (1000, 1001), "TEST_TRAFFIC": (2000, 2001),
        "ENVS": {"highway": SHORT}, "BANDWIDTHS": {"highway": (1, 2)},
        "CHOICE_TRAFFIC": {"highway": (2000, 2001)},
        "TRAFFIC": {"own": {"horizon": 80}, "krauss-two-peaks": {"horizon": 90}},
    }  # fmt: skip
    for name, value in small.items():
        monkeypatch.setattr(policies, name, value)
    runs = tmp_path / "runs"
    for seed in range(2):
        save_untrained(runs / f"pl-{seed}" / "best.safetensors", seed=seed, **capped)
    with pytest.raises(ValueError, match="both plackett-luce of training seed 0"):
        policies.study([f"primary={runs}", f"primary={runs}/pl-0"])
    study = policies.study([f"primary={runs}", f"capped={runs}"])
    run(study, Place(tmp_path, THIS_PROCESS), progress=False)
    rows = read_rows("policies", tmp_path)
    test = rows.filter(part=TEST)
    assert set(rows.filter(part=VALIDATION)["traffic_seed"]) == {1000, 1001}
    assert rows.filter(part=VALIDATION)["cell"].n_unique() == 2 + 2 + 2 * 2  # both modes of both
    assert test["cell"].n_unique() == 2 + 2 + 2 * 2 + 2 * 1 + 2  # and both oracles, and moved ones
    assert rows.filter(policy="learned")["cell"].n_unique() == 2 * (2 + 1)
    (mode,) = test.filter(setting="moved", kind="learned")["mode"].unique()
    assert mode == json.loads((tmp_path / "chosen.json").read_text())[PRIMARY]["mode"]
    assert "| plackett-luce, training seeds: 2 |" in (tmp_path / "tables.md").read_text()
