import csv
import dataclasses
import json
import re
from pathlib import Path

import gymnasium as gym
import pytest
from PIL import Image

from agents.evaluation.episodes import run_episode
from agents.suite.card import Card
from agents.suite.cells import SUITES
from dptse_env.sb3 import load_policy
from dptse_env.schedules import make_schedule
from scripts.evaluate import Args, main, reference_config
from tests.agents.policies import SHORT, save
from tests.agents.suite.small import SMALL


def test_it_leaves_table_scores_and_figures(tmp_path, capsys):
    main(
        Args(
            env=SHORT, schedules=("round-robin", "none"), estimators=("random_walk",),
            seeds="2000:2002", output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    printed = capsys.readouterr().out
    for word in ("random_walk", "round-robin", "none", "paper", "±"):
        assert word in printed
    with (tmp_path / "out" / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["schedule"], row["traffic_seed"]) for row in rows} == {
        (name, seed) for name in ("round-robin", "none", "paper") for seed in ("2000", "2001")
    }
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())["rows"]
    by_name = {row["policy"]: row for row in summary}
    scores = [float(row["rmse_density"]) for row in rows if row["schedule"] == "none"]
    assert by_name["none"]["mean"]["rmse_density"]["mean"] == pytest.approx(sum(scores) / 2)
    assert by_name["paper"]["difference"]["rmse_density"]["mean"] == 0.0
    assert (
        by_name["none"]["mean"]["rmse_density"]["mean"]
        > by_name["paper"]["mean"]["rmse_density"]["mean"]
    )
    for name in ("schedules.png", "space_time.png"):
        with Image.open(tmp_path / "out" / name) as image:
            assert image.format == "PNG"


def test_two_runs_agree(tmp_path):
    for name in ("first", "second"):
        main(
            Args(
                env=SHORT, schedules=("random",), estimators=("ekf",), seeds="2000:2002",
                output=tmp_path / name, workers=1,
            )
        )  # fmt: skip
    first, second = ((tmp_path / name / "episodes.csv").read_text() for name in ("first", "second"))
    assert first == second


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schedules": ("best",)}, "schedule must be one of .*, got 'best'"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed, got 'all'"),
        ({"privacy": "none"}, r"privacy\.preset must be one of"),
        ({"keywords": "[]"}, r"keywords must be a JSON object, got '\[\]'"),
        ({"keywords": "{"}, "keywords must be a JSON object, got '{'"),
        ({"keywords": '{"cargo": 1}'}, "cargo"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{"env": SHORT, "output": Path(tmp_path / "out"), **changes}))
    assert not (tmp_path / "out").exists()


def test_a_saved_policy_stands_beside_schedules(tmp_path, capsys):
    paths = [save(tmp_path / f"run-{seed}" / "best.zip", seed=seed) for seed in range(2)]
    main(
        Args(
            env=SHORT, schedules=("round-robin",), policies=tuple(map(str, paths)),
            estimators=("random_walk",), seeds="2000:2002", output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    assert "run-1/best" in capsys.readouterr().out
    with (tmp_path / "out" / "episodes.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["schedule"] == "run-0/best"]
    env = gym.make(
        SHORT, action="slots", estimator="random_walk", traffic_seeds="2000:2002",
        parameters="w99-3lane",
    )  # fmt: skip
    for row in rows:
        seed = int(row["traffic_seed"])
        expected = run_episode(env, load_policy(paths[0], env), traffic_seed=seed, seed=seed)
        assert float(row["rmse_density"]) == pytest.approx(expected.rmse_density, abs=1e-9)
    assert len(rows) == 2


def test_scores_are_those_of_one_episode_after_another(tmp_path):
    main(
        Args(
            env=SHORT, schedules=("oldest-first",), estimators=("ekf",), seeds="2000:2003",
            noise_seed=5, output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    with (tmp_path / "out" / "episodes.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["schedule"] == "oldest-first"]
    env = gym.make(SHORT, traffic_seeds="2000:2003", parameters="w99-3lane")
    schedule = make_schedule("oldest-first", env)
    for seed, row in zip(range(2000, 2003), rows, strict=True):
        expected = run_episode(env, schedule, traffic_seed=seed, seed=5 + seed)
        for key, value in dataclasses.asdict(expected).items():
            assert float(row[key]) == pytest.approx(value, abs=1e-9)


def test_privacy_is_the_environments_own_unless_given():
    private = Args(env="dptse_env:dptse/PrivateHighway-v0")
    privacy = reference_config(private).privacy
    assert (privacy.preset, privacy.epsilon) == ("capped", 5.0)
    given = reference_config(dataclasses.replace(private, epsilon=2.0)).privacy
    assert (given.preset, given.epsilon) == ("capped", 2.0)


def test_keywords_reach_the_environment():
    args = Args(
        env=SHORT,
        keywords='{"reward": "speed", "privacy": {"preset": "capped", "cap": 9}, "bandwidth": 1}',
    )
    config = reference_config(args)
    assert (config.reward, config.privacy.cap, config.bandwidth) == ("speed", 9, 1)
    assert reference_config(dataclasses.replace(args, bandwidth=3)).bandwidth == 3


@pytest.mark.parametrize(
    ("seeds", "kind"), [("500:502", "training"), ("1000:1002", "validation"), ("999:1001", "mixed")]
)
def test_seeds_are_called_what_they_are(seeds, kind, tmp_path, capsys):
    main(
        Args(
            env=SHORT, schedules=(), estimators=("open_loop",), seeds=seeds,
            output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    assert f"2 episodes on {kind} traffic" in capsys.readouterr().out
    title = json.loads((tmp_path / "out" / "summary.json").read_text())["title"]
    assert f"on {kind} traffic" in title


def test_policies_that_do_not_fit_or_share_a_name_are_refused(tmp_path):
    path = str(save(tmp_path / "run" / "best.zip", bandwidth=3))
    arguments = Args(env=SHORT, policies=(path,), seeds="2000:2002", output=tmp_path / "out")
    with pytest.raises(ValueError, match="bandwidth is 3 for the policy and 2 for the environment"):
        main(arguments)
    with pytest.raises(ValueError, match="'run/best' is there twice"):
        main(dataclasses.replace(arguments, policies=(path, path)))
    with pytest.raises(FileNotFoundError, match=r"no saved policy 'nobody\.zip'"):
        main(dataclasses.replace(arguments, policies=("nobody.zip",)))
    with pytest.raises(ValueError, match=r"schedule must be one of .*, got 'nobody'"):
        main(dataclasses.replace(arguments, policies=("nobody",)))
    assert not (tmp_path / "out").exists()


@pytest.fixture
def _small_suite(monkeypatch):
    """Make the small suite known, without cards that ship."""
    monkeypatch.setitem(SUITES, "small-v1", SMALL)


@pytest.mark.usefixtures("_small_suite")
def test_policies_are_scored_in_a_suite(tmp_path, capsys):
    args = Args(
        suite="small-v1", policies=("paper", "oracle-error", "tests.agents.suite.small:Raising"),
        workers=1, output=tmp_path / "cards",
    )  # fmt: skip
    main(args)
    printed = capsys.readouterr().out
    assert "| `oracle-error` | 1.00 |" in printed
    assert "tests.agents.suite.small-Raising failed in wide: raised KeyError" in printed
    assert {path.name for path in (tmp_path / "cards").iterdir()} == {
        "paper.json", "oracle-error.json", "tests.agents.suite.small-Raising.json",
    }  # fmt: skip


@pytest.mark.usefixtures("_small_suite")
def test_a_card_is_verified(tmp_path, capsys):
    args = Args(suite="small-v1", policies=("paper",), workers=1, output=tmp_path / "cards")
    main(args)
    path = tmp_path / "cards" / "paper.json"
    main(Args(suite="small-v1", verify=path))
    assert ": errors agree, mean error x 1000 " in capsys.readouterr().out
    main(Args(suite="small-v1", verify=path, json=True))
    assert json.loads(capsys.readouterr().out)["is_same"] is True
    card = Card.read(path)
    better = {
        name: dataclasses.replace(each, error=tuple(0.5 * value for value in each.error))
        for name, each in card.results.items()
    }
    dataclasses.replace(card, results=better).write(path)
    with pytest.raises(SystemExit) as ended:
        main(Args(suite="small-v1", verify=path))
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert re.search(r"the mean error x 1000 is .* on the card and .* now", said)
    with pytest.raises(ValueError, match="policies must be one, that of the card"):
        main(Args(suite="small-v1", verify=path, policies=("paper", "static")))
    with pytest.raises(ValueError, match="'static' is not the policy of the card"):
        main(Args(suite="small-v1", verify=path, policies=("static",)))


@pytest.mark.usefixtures("_small_suite")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"suite": "v9"}, "suite must be one of .*query-suite-v2, small-v1, got 'v9'"),
        (
            {"seeds": "2000:2004"},
            "seeds has no use with a suite, whose cells say all: leave it out",
        ),
        ({"env": SHORT}, "env has no use with a suite"),
        ({"force": True}, "force has no use with a suite"),
        ({"policies": ()}, "policies must be one or more, to be scored in small-v1"),
        ({"suite": None, "verify": Path("card.json")}, "verify needs the suite of the card"),
        ({"workers": 0}, "workers must be"),
    ],
)
def test_bad_arguments_of_a_suite_are_named(changes, message, tmp_path):
    given = {"suite": "small-v1", "policies": ("paper",), "output": tmp_path / "out", **changes}
    with pytest.raises(ValueError, match=message):
        main(Args(**given))
    assert not (tmp_path / "out").exists()
