import pytest

pytest.importorskip("torch")
pytest.importorskip("tyro")

import gymnasium as gym
import tyro

from agents.filters.plan import OWN, Round
from agents.training.run_files import read_progress
from scripts import train_estimator
from scripts.train_estimator import Args, make_plan, parse_round

SHORT = "dptse_env:dptse/ShortHighway-v0"
SMALL = [
    "--traffic", "0:2", "--validation", "1000:1001", "--validation-envs", SHORT, "--width", "4",
    "--ranges.envs", SHORT, "--ranges.mechanisms", "capped", "paced", "--episodes", "2",
    "--rounds", "ekf:1:2", "own:1:1", "--checkpoint-every", "1", "--no-tensorboard",
]  # fmt: skip


def arguments(output, *more):
    return tyro.cli(Args, args=["--output", str(output), *SMALL, *more])


def test_it_trains_a_network_that_an_environment_takes(tmp_path, capsys):
    train_estimator.main(arguments(tmp_path))
    assert f"the network is in {tmp_path / 'network.safetensors'}" in capsys.readouterr().out
    assert [row["round"] for row in read_progress(tmp_path)] == [1, 1, 2]
    weights = {"recurrent": {"weights": str(tmp_path / "network.safetensors")}}
    env = gym.make(SHORT, estimator="recurrent", privacy="capped", estimator_settings=weights)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"trained on flows in \[1, 1\], .* has \[0, 0\]"):
        gym.make(SHORT, estimator="recurrent", estimator_settings=weights).reset(seed=0)
    before = (tmp_path / "network.safetensors").read_bytes()
    train_estimator.main(arguments(tmp_path))
    assert (tmp_path / "network.safetensors").read_bytes() == before
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"):
        train_estimator.main(arguments(tmp_path, "--seed", "1"))


def test_rounds_are_read_from_text():
    assert parse_round("own:3:40") == Round(OWN, 3, 40)
    for text in ("own", "own:3", "own:a:4", "own:3:4:5", "own:-1:4"):
        with pytest.raises(ValueError, match=rf"rounds must be like 'ekf:72:200', got '{text}'"):
            parse_round(text)
    with pytest.raises(ValueError, match=r"rounds\.scenarios must be an integer in 1\.\."):
        parse_round("own:0:4")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--traffic", "0:2000"], r"traffic must be traffic seeds in 0\.\.999"),
        (["--validation", "2000:2001"], r"validation must be traffic seeds in 1000\.\.1999"),
        (["--rounds", "own:1:1"], "rounds must begin with one of another estimator"),
    ],
)
def test_bad_arguments_are_named(more, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        make_plan(arguments(tmp_path, *more))
