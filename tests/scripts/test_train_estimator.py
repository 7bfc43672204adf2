import json
import re
from dataclasses import replace
from itertools import product

import pytest

pytest.importorskip("torch")
pytest.importorskip("tyro")

import gymnasium as gym
import numpy as np
import tyro

from agents.training.run_files import read_progress
from dptse_env.estimators.recurrent import read_weights, write_weights
from scripts import train_estimator
from scripts.train_estimator import Args, make_plan
from tests.estimators.helpers import card, random_weights
from tests.helpers import SHORT

PLAN = {
    "width": 4,
    "checkpoint_every": 2,
    "seconds": 100,
    "validation_highways": [1000, 1000],
    "ranges": {"sections": 0.0, "highways": [0, 1], "schedules": ["round-robin"]},
}
SMALL = [
    "--env", SHORT, "--train-seeds", "0:2", "--validation-env", SHORT,
    "--validation-seeds", "1000:1001", "--initial", "None", "--rounds", "ekf:1:2", "own:1:1",
    "--seed", "0:2", "--workers", "1", "--plan", json.dumps(PLAN),
]  # fmt: skip


def arguments(output, *more):
    return tyro.cli(Args, args=["--output", str(output), *SMALL, *more])


@pytest.mark.slow
def test_it_trains_a_pair_that_an_environment_takes(tmp_path, capsys):
    train_estimator.main(arguments(tmp_path))
    printed = capsys.readouterr().out
    keywords, best = json.loads(printed.splitlines()[-1]), {}
    train_estimator.main(arguments(tmp_path, "--json"))
    found = json.loads(capsys.readouterr().out)
    assert found["keywords"] == keywords
    for kind, seed in product(("flows", "speeds"), (0, 1)):
        rows = read_progress(tmp_path / f"{kind}-{seed}")
        assert [row["round"] for row in rows] == [1, 1, 2]
        best.setdefault(kind, []).append((rows[-1]["validation"], seed))
        said = found["trainings"][f"{kind}-{seed}"]
        assert said == {name: rows[-1][name] for name in ("validation", "chi2")}
        assert re.search(
            rf"{kind}-{seed} +{1000 * said['validation']:.1f} +{said['chi2']:.2f}", printed
        )
    for kind, privacy in (("flows", "capped"), ("speeds", "printed")):
        taken = read_weights(str(tmp_path / f"weights-{kind}.safetensors")).card["name"]
        assert taken == f"{kind}-{min(best[kind])[1]}"
        gym.make(SHORT, privacy=privacy, **keywords).reset(seed=0)
    with pytest.raises(ValueError, match="width is 4 there and 8 now"):
        train_estimator.main(arguments(tmp_path, "--plan", json.dumps({**PLAN, "width": 8})))


@pytest.mark.slow
def test_the_mean_of_trainings_that_begin_alike_is_one_more(tmp_path, capsys):
    initial = tmp_path / "initial.safetensors"
    write_weights(initial, random_weights(4), card())
    more = ("--kinds", "flows", "--initial", str(initial), "--rounds", "own:1:1", "--json")
    train_estimator.main(arguments(tmp_path / "out", *more))
    trainings = json.loads(capsys.readouterr().out)["trainings"]
    assert list(trainings) == ["flows-0", "flows-1", "flows-mean"]
    ends = [
        read_weights(str(tmp_path / "out" / name / "weights.safetensors")) for name in trainings
    ]
    for first, second, mean in zip(*(each.weights for each in ends), strict=True):
        np.testing.assert_allclose(mean, 0.5 * (first + second), rtol=1e-6)
    assert ends[2].card["mean_of"] == ["flows-0", "flows-1"]


def test_an_episode_is_no_longer_than_the_records_of_the_roads(tmp_path):
    short = arguments(tmp_path, "--env", SHORT)
    assert make_plan(replace(short, plan="{}"), "flows", 0).seconds == 240
    long = make_plan(replace(short, plan='{"seconds": 241}'), "flows", 0)
    message = r"plan\.seconds must be at most 240 s, the length of a record of .*, got 241"
    with pytest.raises(ValueError, match=message):
        long.check()
