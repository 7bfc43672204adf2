"""Evaluation by the command: the same numbers in tables, Markdown, JSON and rows."""

import json
from itertools import groupby

import gymnasium as gym
import polars as pl
import pytest
from PIL import Image

from agents.figures import draw_maps
from agents.statistics import mean_interval
from agents.study import read_rows
from dptse_env.estimators.simple import RandomWalk
from dptse_env.evaluation import evaluate
from dptse_env.importers.fields import import_field
from dptse_env.sb3 import load_policy
from dptse_env.schedules import OBSERVATION_SCHEDULES
from scripts import evaluate as evaluate_script
from scripts.evaluate import Args, make_cells
from tests.helpers import SHORT, save_untrained
from tests.importers.test_fields import ROAD, SPLITS, write
from tests.scripts.commands import refused, run_command

WALK = f'{SHORT} {{"estimator": "random_walk"}}'


def rows_of(folder, policy=None):
    rows = read_rows("evaluation", folder)
    return rows if policy is None else rows.filter(pl.col("policy") == policy)


def test_tables_rows_figures_and_json_agree(tmp_path):
    words = ["--env", WALK, "--test-seeds", "2000:2002", "--policies", "none", "--workers", "1"]
    words += ["--output", tmp_path / "out"]
    done = run_command("evaluate", *words, "--html")
    assert done.returncode == 0, done.stderr
    rows = rows_of(tmp_path / "out")
    assert set(rows.select("estimator", "policy", "traffic_seed").iter_rows()) == {
        ("random_walk", name, seed) for name in ("none", "round-robin") for seed in (2000, 2001)
    }
    tables = (tmp_path / "out" / "tables.md").read_text("utf-8")
    settings = "tuned with the parameters published for printed (random_walk-published-printed)"
    assert f". Settings of random_walk: {settings}." in tables
    found = json.loads(run_command("evaluate", *words, "--force", "--json").stdout)
    assert found["settings"] == {"random_walk": settings}
    for row in found["rows"]:
        own = rows_of(tmp_path / "out", row["policy"])
        measured = own["rmse_density"], own["rmse_speed"], own["chi2_density"], own["chi2_speed"]
        expected = [-1000.0 * own["reward"].mean(), *(each.mean() for each in measured)]
        assert [each["mean"] for each in row["means"].values()] == pytest.approx(expected)
        start = f"| random_walk | {row['policy']} "
        line = next(each for each in tables.splitlines() if each.startswith(start))
        places = [line.index(f"| {value:.2f} ±") for value in expected[:3]]
        assert places == sorted(places)
        told = [f"{value:.2f} ±" for value in expected[:3]]
        told.append(", ".join(f"{value:.2f}" for value in expected[3:]))
        assert all(each in done.stdout and each in line for each in told)
    for name in ("errors.png", "space_time.png"):
        with Image.open(tmp_path / "out" / name) as image:
            assert image.format == "PNG"
    assert "page.html" in done.stdout
    assert (tmp_path / "out" / "page.html").is_file()


def test_one_episode_has_no_interval(tmp_path):
    words = ["--env", WALK, "--test-seeds", "2000", "--policies", "none", "--workers", "1"]
    words += ["--output", tmp_path]
    found = json.loads(run_command("evaluate", *words, "--json").stdout)
    (reward,) = rows_of(tmp_path, "none")["reward"]
    row = next(each for each in found["rows"] if each["policy"] == "none")
    error = row["means"]["error"]
    assert error == {"mean": pytest.approx(-1000.0 * reward), "low": None, "high": None, "n": 1}
    tables = (tmp_path / "tables.md").read_text("utf-8")
    assert "one episode has no interval" in tables.lower()
    assert "±" not in tables
    assert "1 episode on test traffic" in tables


def test_what_is_begun_anew_leaves_no_results_that_do_not_describe_it(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    env = f'{SHORT} {{"estimator": "random_walk", "horizon": 64}}'
    words = ["evaluate", "--env", env, "--workers", "1", "--policies", "none"]
    words += ["--output", tmp_path, "--test-seeds"]
    assert run_command(*words, "2000:2002").returncode == 0
    with monkeypatch.context() as patch:
        patch.setattr(evaluate_script, "draw_traffic", interrupt)
        done = run_command(*words, "2000:2002", "--force")
    assert done.returncode == 130
    assert "begins anew" in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"rows.parquet", "errors.png"}
    # What is left has another seed too, which is not asked for.
    found = json.loads(run_command(*words, "2001", "--json").stdout)
    assert {row["means"]["error"]["n"] for row in found["rows"]} == {1}


def test_policies_and_schedules_play_what_gym_make_makes(tmp_path):
    path = save_untrained(tmp_path / "run" / "best.safetensors")
    done = run_command(
        "evaluate", "--env", SHORT, "--policies", "oldest-first", path, "--test-seeds",
        "999:1001", "--seed", "5", "--output", tmp_path / "out", "--workers", "1",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "2 episodes on mixed traffic from second 61 on, seed 5\n" in done.stdout
    for name, action in (("oldest-first", "mask"), ("run/best", "slots")):
        assert name in done.stdout
        env = gym.make(SHORT, traffic_seeds="999:1001", action=action)
        policy = load_policy(path, env) if action == "slots" else name
        expected = evaluate(env, policy, (999, 1000), 5)
        for row, own in zip(rows_of(tmp_path / "out", name).to_dicts(), expected, strict=True):
            assert {key: row[key] for key in own} == pytest.approx(own, abs=1e-9)
    names = "run/best", "oldest-first", "round-robin"
    own, *rules = (rows_of(tmp_path / "out", name)["reward"].mean() for name in names)
    gain = 100.0 * (1.0 - own / max(rules))
    assert f": {abs(gain):.1f} % {'below' if gain >= 0.0 else 'above'}, 95 %" in done.stdout


def test_estimators_come_in_the_order_of_their_errors(tmp_path):
    words = ["--env", SHORT, "--test-seeds", "2000:2002", "--workers", "1", "--output", tmp_path]
    words += ["--policies", "round-robin", "none", "--estimators", "random_walk", "ekf", "--json"]
    rows = json.loads(run_command("evaluate", *words).stdout)["rows"]
    errors = {(row["estimator"], row["policy"]): row["means"]["error"]["mean"] for row in rows}
    (first, second), (third, fourth) = (
        [*own] for _, own in groupby(errors, key=lambda label: label[0])
    )
    assert errors[first] == min(errors.values())
    assert errors[first] < errors[second]
    assert errors[third] < errors[fourth]
    for (estimator, policy), row in zip(errors, rows, strict=True):
        less = errors[estimator, policy] - errors[estimator, "round-robin"]
        assert row["differences"]["error"]["mean"] == pytest.approx(less)
        least = min(errors[name, policy] for name in ("random_walk", "ekf"))
        less = errors[estimator, policy] - least
        assert row["estimator_differences"]["error"]["mean"] == pytest.approx(less)


def test_estimators_of_a_single_policy_are_compared_with_the_best_one(tmp_path, monkeypatch):
    panels = []

    def draw(columns):
        panels.extend(columns[0])
        return draw_maps(columns)

    monkeypatch.setattr("scripts.evaluate.draw_maps", draw)
    words = ["--env", f'{SHORT} {{"horizon": 80}}', "--test-seeds", "2000:2003", "--workers", "1"]
    words += ["--policies", "none", "--estimators", "random_walk", "open_loop", "ekf"]
    words += ["--output", tmp_path]
    done = run_command("evaluate", *words)
    errors = {
        name: -1000.0 * rows_of(tmp_path).filter(estimator=name)["reward"].to_numpy()
        for name in words[words.index("--estimators") + 1 : -2]
    }
    best, *others = sorted(errors, key=lambda name: errors[name].mean())
    least, told = errors[best].mean(), []
    for name in others:
        more = mean_interval(100.0 * (errors[name] - errors[best]) / least)
        told.append(f"{name} {more.mean:.1f} ± {more.half_width:.1f} %")
    line = f"none: {best} has the least error x 1000 ({least:.1f}); more by {', '.join(told)}\n"
    assert line in done.stdout
    assert done.stdout.count("against") == 3
    assert "(estimates and queries, none, traffic seed 2000)" in done.stdout
    assert [each.title for each in panels if each.is_flags] == ["segments queried by none"]


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_estimators_are_judged_on_a_measured_field(tmp_path):
    tests = [each._replace(share=float(each.name == "test")) for each in SPLITS]
    import_field(write(tmp_path), ROAD, tmp_path / "road", tests, 100)

    def words(**keywords):
        own = {"corridor": str(tmp_path / "road" / "road.toml"), "bandwidth": 2, **keywords}
        env = f"dptse_env:dptse/PaperHighway-v0 {json.dumps(own)}"
        more = "--policies", "round-robin", "--estimators", "random_walk", "--workers", "1"
        return "evaluate", "--env", env, "--test-seeds", "2000:2004", *more, "--output"

    errors = []
    for epsilon in (1.0, 1e4):
        given = words(privacy="corrected", epsilon=epsilon)
        found = json.loads(run_command(*given, tmp_path / f"{epsilon}", "--json").stdout)
        assert "road road, " in found["title"]
        errors.append(found["rows"][0]["means"]["error"]["mean"])
    assert errors[1] < 0.5 * errors[0]
    refusal = refused(*words(privacy="paced"), tmp_path / "no")
    assert "on a road of measured fields, got 'paced'" in refusal


class Sure(RandomWalk):
    """An estimator that claims to be exact."""

    def _estimate(self):
        said = super()._estimate()
        return said._replace(density_std=0.0 * said.density, speed_std=0.0 * said.speed)


def test_an_estimator_may_claim_to_be_exact(tmp_path):
    words = ["--env", SHORT, "--test-seeds", "2000:2002", "--workers", "1", "--output", tmp_path]
    words += ["--policies", "round-robin", "--estimators", f"{__name__}:Sure"]
    done = run_command("evaluate", *words)
    assert done.returncode == 0, done.stderr
    assert "inf, inf" in done.stdout
    assert "against" not in done.stdout  # there is nothing to compare
    (row,) = json.loads(run_command("evaluate", *words, "--force", "--json").stdout)["rows"]
    assert row["means"]["chi2_speed"] == {"mean": None, "low": None, "high": None, "n": 1}


def test_estimators_and_keywords_reach_the_environment():
    env = f'{SHORT} {{"privacy": {{"preset": "capped", "cap": 9}}, "bandwidth": 1}}'
    args = Args(env=env, policies=("random", "all"), estimators=("ukf", "ekf", "ukf"))
    title, cells = make_cells(args)
    assert "privacy.cap 9" in title
    keywords = [cell.keywords for cell in cells]
    assert [each["estimator"] for each in keywords] == ["ukf"] * 3 + ["ekf"] * 3
    assert [each["bandwidth"] for each in keywords] == [1, 6, 1] * 2
    assert all(each["privacy"] == {"preset": "capped", "cap": 9} for each in keywords)
    _, (own,) = make_cells(Args(env=SHORT, policies=("round-robin",)))
    assert own.keywords == {}
    assert own.labels == {"estimator": "ekf", "policy": "round-robin"}
    _, rules = make_cells(Args(env=SHORT))
    assert {cell.policy for cell in rules} == {*OBSERVATION_SCHEDULES}
