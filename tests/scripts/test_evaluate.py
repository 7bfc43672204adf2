import dataclasses
import json
from pathlib import Path

import gymnasium as gym
import polars as pl
import pytest
from PIL import Image

from agents.study import read_rows, write_table
from dptse_env.evaluation import evaluate
from dptse_env.sb3 import load_policy
from scripts.evaluate import Args, main, reference_config
from tests.helpers import SHORT, save_untrained


def rows_of(folder, policy=None):
    rows = read_rows("evaluation", folder)
    return rows if policy is None else rows.filter(pl.col("policy") == policy)


def test_it_writes_tables_rows_and_figures(tmp_path, capsys):
    args = Args(
        env=SHORT, schedules=("none",), estimators=("random_walk",),
        seeds="2000:2002", output=tmp_path / "out", workers=1, html=True,
    )  # fmt: skip
    main(args)
    printed = capsys.readouterr().out
    for word in ("random_walk", "none", "paper", "±", "page.html"):
        assert word in printed
    rows = rows_of(tmp_path / "out")
    assert set(rows.select("policy", "traffic_seed").iter_rows()) == {
        (name, seed) for name in ("none", "paper") for seed in (2000, 2001)
    }
    tables = (tmp_path / "out" / "tables.md").read_text()
    assert f"| none | {rows_of(tmp_path / 'out', 'none')['rmse_density'].mean():.2f} [" in tables
    for name in ("schedules.png", "space_time.png"):
        with Image.open(tmp_path / "out" / name) as image:
            assert image.format == "PNG"
    with pytest.raises(FileExistsError, match=r"rows\.parquet.* would be replaced"):
        main(args)


def test_json_has_means_and_paired_differences(tmp_path, capsys):
    main(
        Args(
            env=SHORT, schedules=("none",), estimators=("random_walk",), seeds="2000:2002",
            output=tmp_path / "out", workers=1, json=True,
        )
    )  # fmt: skip
    by_name = {row["policy"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    expected = {name: rows_of(tmp_path / "out", name)["rmse_density"].mean() for name in by_name}
    for name, row in by_name.items():
        assert row["mean"]["rmse_density"]["mean"] == pytest.approx(expected[name])
        less = expected[name] - expected["paper"]
        assert row["difference"]["rmse_density"]["mean"] == pytest.approx(less)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_and_a_forced_one_begins_anew(tmp_path):
    args = Args(
        env=SHORT, schedules=("random",), estimators=("random_walk",), seeds="2000:2002",
        output=tmp_path, workers=1,
    )  # fmt: skip
    main(args)
    first = rows_of(tmp_path).drop("version")
    marked = rows_of(tmp_path).with_columns(rmse_density=pl.lit(1.0))
    (tmp_path / "rows").mkdir()
    write_table(tmp_path / "rows" / "cell.parquet", marked.filter(pl.col("policy") == "random"))
    for name in ("rows.parquet", "tables.md", "schedules.png", "space_time.png"):
        (tmp_path / name).unlink()
    main(args)
    assert rows_of(tmp_path, "random")["rmse_density"].to_list() == [1.0, 1.0]
    main(dataclasses.replace(args, force=True))
    assert rows_of(tmp_path).drop("version").sort(first.columns).equals(first.sort(first.columns))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schedules": ("best",)}, "schedule must be one of .*, got 'best'"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed, got 'all'"),
        ({"env": f'{SHORT} {{"privacy": "none"}}'}, r"privacy\.preset must be one of"),
        ({"env": f"{SHORT} []"}, r"env must be an id and a JSON object, got '\[\]'"),
        ({"env": f'{SHORT} {{"cargo": 1}}'}, "cargo"),
        (
            {
                "estimators": ("ekf", "recurrent"),
                "env": f'{SHORT} {{"estimator_settings": {{"recurrent": {{"weights": "none"}}}}}}',
            },
            r"estimator_settings\.recurrent\.weights must be a file or one of .*, got 'none'",
        ),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{"env": SHORT, "output": Path(tmp_path / "out"), **changes}))
    assert not (tmp_path / "out").exists()


def test_a_saved_policy_stands_beside_schedules(tmp_path, capsys):
    path = save_untrained(tmp_path / "run-0" / "best.safetensors")
    main(
        Args(
            env=SHORT, schedules=(), policies=(str(path),),
            estimators=("random_walk",), seeds="2000:2002", output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    assert "run-0/best" in capsys.readouterr().out
    env = gym.make(
        SHORT, action="slots", estimator="random_walk", traffic_seeds="2000:2002",
    )  # fmt: skip
    expected = evaluate(env, load_policy(path, env), (2000, 2001))
    assert rows_of(tmp_path / "out", "run-0/best")["rmse_density"].to_list() == pytest.approx(
        [row["rmse_density"] for row in expected], abs=1e-9
    )


def test_noise_seeds_are_those_of_evaluate(tmp_path):
    main(
        Args(
            env=SHORT, schedules=("oldest-first",), estimators=("ekf",), seeds="2000:2002",
            noise_seed=5, output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    env = gym.make(SHORT, traffic_seeds="2000:2002")
    rows = rows_of(tmp_path / "out", "oldest-first").to_dicts()
    for row, expected in zip(rows, evaluate(env, "oldest-first", (2000, 2001), 5), strict=True):
        assert {key: row[key] for key in expected} == pytest.approx(expected, abs=1e-9)


def test_privacy_is_the_environments_own_unless_given():
    private = Args(env="dptse_env:dptse/PrivateHighway-v0")
    privacy = reference_config(private).privacy
    assert (privacy.preset, privacy.epsilon) == ("capped", 5.0)
    given = reference_config(Args(env=f'{private.env} {{"epsilon": 2.0}}')).privacy
    assert (given.preset, given.epsilon) == ("capped", 2.0)


def test_keywords_reach_the_environment():
    args = Args(
        env=SHORT
        + ' {"reward": "speed", "privacy": {"preset": "capped", "cap": 9}, "bandwidth": 1}'
    )
    config = reference_config(args)
    assert (config.reward, config.privacy.cap, config.bandwidth) == ("speed", 9, 1)


def test_seeds_are_called_what_they_are(tmp_path, capsys):
    main(
        Args(
            env=SHORT, schedules=(), estimators=("open_loop",), seeds="999:1001",
            output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    assert "2 episodes on mixed traffic" in capsys.readouterr().out


def test_policies_that_do_not_fit_or_share_a_name_are_refused(tmp_path):
    path = str(save_untrained(tmp_path / "run" / "best.safetensors", bandwidth=3))
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
