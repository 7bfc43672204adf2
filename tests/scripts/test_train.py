import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")

import torch
import tyro

from agents.training.recipes import RECIPES, MaskablePPORecipe
from agents.training.run_files import read_progress
from agents.training.tensorboard_writer import make_tensorboard_writer
from scripts import train
from scripts.cli import run
from scripts.train import Args, make_plan

ROOT = Path(__file__).parents[2]
SMALL = [
    "--env", 'dptse_env:dptse/ShortHighway-v0 {"horizon": 64}', "--traffic", "0:2", "--validation", "1000:1001",
    "--no-tensorboard",
]  # fmt: skip
ROUNDS = [
    "recipe:plackett-luce", "--recipe.n-envs", "4", "--recipe.replicas", "2", "--recipe.width", "8",
    "--recipe.regression.rounds", "1", "--recipe.regression.seconds", "6",
    "--recipe.regression.batches", "2", "--recipe.swaps.rounds", "2",
    "--recipe.swaps.episodes", "2", "--recipe.swaps.seconds", "8",
    "--recipe.swaps.trials", "1", "--recipe.swaps.batches", "2",
]  # fmt: skip
PPO = [
    "--steps", "240", "--validate-every", "3", "--checkpoint-every", "2", "recipe:scores",
    "--recipe.n-envs", "4", "--recipe.replicas", "2", "--recipe.n-steps", "10",
    "--recipe.batch-size", "20", "--recipe.hidden", "8",
]  # fmt: skip
STEPS = 24 + 2 * (2 * 64 * 5)
"""Of the regression and of two rounds of swaps."""


def arguments(output, *more):
    return tyro.cli(Args, args=["--output", str(output), *more, *SMALL, *ROUNDS])


def test_it_trains_and_continues(tmp_path, capsys):
    train.main(arguments(tmp_path))
    assert "error in validation 0." in capsys.readouterr().out
    assert read_progress(tmp_path)[-1]["steps"] == STEPS
    before = (tmp_path / "policy.safetensors").read_bytes()
    train.main(arguments(tmp_path))
    assert (tmp_path / "policy.safetensors").read_bytes() == before
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"):
        train.main(arguments(tmp_path, "--seed", "1"))


def test_several_seeds_are_trained_in_folders_of_their_own(tmp_path, capsys):
    train.main(arguments(tmp_path / "all", "--seeds", "0:2", "--workers", "1"))
    assert f"{tmp_path}/all/1: error in validation 0." in capsys.readouterr().out
    kept = [
        torch.load(tmp_path / "all" / seed / "checkpoint.pt", weights_only=True)["learner"]
        for seed in "01"
    ]
    first, second = (each["policy"] for each in kept)
    assert not all(torch.equal(first[name], value) for name, value in second.items())


def test_ctrl_c_leaves_a_training_to_continue(tmp_path, monkeypatch, capsys):
    replace, written = Path.replace, []

    def interrupted(path, target):
        written.append(target.name)
        if written.count("checkpoint.pt") == 2:
            raise KeyboardInterrupt
        return replace(path, target)

    args = arguments(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.replace", interrupted)
        with pytest.raises(SystemExit) as ended:
            run(lambda _: train.main(args), Args, None, words=[])
    assert ended.value.code == 130
    assert "the same command goes on" in capsys.readouterr().err
    train.main(args)
    assert read_progress(tmp_path)[-1]["steps"] == STEPS


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals for a process")
@pytest.mark.parametrize("how", [getattr(signal, "SIGKILL", None), signal.SIGINT])
@pytest.mark.parametrize(("recipe", "n_rows"), [(ROUNDS, 3), (PPO, 7)])
def test_a_killed_program_continues_to_the_same_curve(tmp_path, how, recipe, n_rows):
    def start(output):
        return subprocess.Popen(
            [sys.executable, "-m", "scripts.dptse", "train", "--output", str(output), *SMALL, *recipe],
            cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    process = start(tmp_path / "killed")
    deadline = time.monotonic() + 120
    while not (tmp_path / "killed" / "checkpoint.pt").exists():
        assert time.monotonic() < deadline, process.communicate(timeout=5)
        time.sleep(0.01)
    process.send_signal(how)
    _, err = process.communicate(timeout=120)
    assert process.returncode == (130 if how == signal.SIGINT else -how)
    assert how == signal.SIGKILL or "the same command goes on" in err
    for name in ("killed", "whole"):
        process = start(tmp_path / name)
        process.communicate(timeout=300)
        assert process.returncode == 0
    curves = [
        [{k: v for k, v in row.items() if k != "seconds"} for row in read_progress(tmp_path / name)]
        for name in ("killed", "whole")
    ]
    assert curves[0] == curves[1]
    assert len(curves[0]) == n_rows


def test_every_recipe_is_on_the_command_line():
    for name, recipe in RECIPES.items():
        args = tyro.cli(Args, args=[f"recipe:{name}", "--recipe.n-envs", "8"])
        assert isinstance(args.recipe, recipe)
        assert args.recipe.n_envs == 8
    assert tyro.cli(Args, args=[]).recipe == RECIPES["plackett-luce"]()


def test_arguments_become_the_plan():
    args = Args(
        seed=3,
        traffic="4:6",
        validation="1000",
        env='dptse_env:dptse/PrivateHighway-v0 {"bandwidth": 3}',
    )
    plan = make_plan(args, 3)
    assert (plan.seed, plan.traffic_seeds, plan.validation_seeds) == (3, (4, 5), (1000,))
    assert plan.config.bandwidth == 3
    assert plan.config.action == "slots"
    assert (plan.steps, plan.n_updates) == (0, 8)  # rounds of swaps alone
    sequential = make_plan(Args(recipe=MaskablePPORecipe()), 0)
    assert sequential.n_updates == 313  # 2 million decisions of five picks, 32,000 an update


def test_tensorboard_is_optional_and_its_absence_is_logged(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with caplog.at_level("INFO"):
        assert make_tensorboard_writer(tmp_path) is None
    assert "TensorBoard is not installed" in caplog.text


def test_rows_reach_tensorboard(tmp_path):
    pytest.importorskip("tensorboard")
    writer = make_tensorboard_writer(tmp_path)
    assert list(tmp_path.iterdir()) == []
    writer({"update": 1, "steps": 40, "error": 0.5})
    writer.close()
    assert list(tmp_path.glob("events*"))
