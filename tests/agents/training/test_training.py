import dataclasses
import json
import pathlib
import shutil

import numpy as np
import pytest

from dptse_env.utils.files import write_atomically

pytest.importorskip("sb3_contrib")

import torch

import dptse_env
from agents.training.recipes import RECIPES, RegressionRounds
from agents.training.run_files import CHECKPOINT, PLAN, PROGRESS, read_progress
from agents.training.training import BEST, POLICY, Training
from dptse_env.sb3 import load_policy
from tests.agents.training.plans import (
    StopError,
    make_plan,
    make_recipe,
    stop_at,
    without_time,
)
from tests.helpers import fast_and_slow

PPO_LEARNERS = fast_and_slow(["scores", "mask", "maskable"], ["mask"])


@pytest.mark.parametrize("learner", PPO_LEARNERS)
def test_a_killed_training_continues_to_the_same_curve(learner, trained, tmp_path):
    plan, complete = make_plan(learner), trained(learner)
    assert complete.is_finished
    # Updates 0, 2, 4 are kept: the fifth is lost and done again. At the fourth, after 40 s, the
    # second group of episodes is just begun anew.
    broken = Training(plan, tmp_path / "broken", watchers=(stop_at(5),))
    with pytest.raises(StopError):
        broken.run()
    torch.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002  the generator that stable-baselines3 draws from
    seen = []
    again = Training(plan, tmp_path / "broken", watchers=(seen.append,))
    assert [row["update"] for row in again.rows] == [0, 1, 2, 3, 4]
    again.run()
    assert without_time(again.rows) == without_time(complete.rows)
    assert without_time(seen) == without_time(complete.rows)
    for name in (POLICY, BEST):
        assert (again.folder / name).read_bytes() == (complete.folder / name).read_bytes()
    for name, value in complete.learner.policy.state_dict().items():
        assert torch.equal(again.learner.policy.state_dict()[name], value), name


def test_the_curve_of_ppo(trained):
    training = trained("scores")
    rows = read_progress(training.folder)
    assert [row["update"] for row in rows] == list(range(7))
    assert [row["steps"] for row in rows] == [40 * u for u in range(7)]
    assert [row["update"] for row in rows if "validation" in row] == [0, 3, 6]
    assert all(0.01 < row["error"] < 1 for row in rows[1:])
    assert all(0.01 < row["validation_drawn"] < 1 for row in rows[::3])
    rates = [row["learning_rate"] for row in rows[1:]]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] == pytest.approx(training.plan.recipe.final_learning_rate)


def test_steps_are_decisions_whatever_the_encoding(trained):
    training = trained("maskable")
    assert training.plan.actions_per_step == 2
    assert training.rows[-1]["steps"] == 240
    assert training.learner.model.num_timesteps == 480


def test_every_update_compares_replicas(trained):
    training = trained("scores")
    # Episode by episode, as the minibatches are drawn from. Of two replicas each is compared with
    # the other, so that their advantages are opposite.
    advantages = training.learner.model.rollout_buffer.advantages.reshape(2, 2, 10)
    np.testing.assert_allclose(advantages[:, 0], -advantages[:, 1], atol=1e-6)
    assert np.abs(advantages).max() > 0.01


def test_a_finished_training_is_left_alone(trained, tmp_path):
    folder = shutil.copytree(trained().folder, tmp_path / "run")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    again = Training(make_plan(), folder)
    again.run()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_folder_describes_the_training(trained):
    folder = trained().folder
    assert {path.name for path in folder.iterdir()} == {
        PLAN, PROGRESS, CHECKPOINT, POLICY, BEST,
    }  # fmt: skip
    plan = json.loads((folder / PLAN).read_text())
    assert plan["seed"] == 1
    assert plan["traffic_seeds"] == [0, 1, 2]
    assert plan["recipe"]["n_envs"] == 4
    assert plan["learner"] == "plackett-luce"
    policy = load_policy(folder / POLICY, _env())
    assert policy.card["training"]["steps"] == 36 + 2 * 3 * 80 * 7
    assert policy.card["training"]["traffic seeds"] == "0..2"
    assert policy.card["versions"]["dptse-env"] == dptse_env.__version__


def _env():
    import gymnasium as gym

    return gym.make("dptse_env:dptse/ShortHighway-v0", action="slots", privacy="capped", horizon=80)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 2}, "seed is 1 there and 2 now"),
        ({"steps": 480}, "steps is 240 there and 480 now"),
        ({"keywords": {"horizon": 81, "privacy": "capped"}}, "keywords.horizon is 80 there"),
        ({"traffic_seeds": (0, 1)}, r"traffic_seeds is \[0, 1, 2\] there and \[0, 1\] now"),
        ({"validation_seeds": (1000,)}, "validation_seeds is"),
    ],
)
def test_another_plan_is_refused(tmp_path, changes, message):
    Training(make_plan("mask"), tmp_path)
    with pytest.raises(ValueError, match=message):
        Training(make_plan("mask", **changes), tmp_path)


def test_another_recipe_or_learner_is_refused(tmp_path):
    Training(make_plan("scores"), tmp_path)
    recipe = dataclasses.replace(make_recipe("scores"), gamma=0.9)
    with pytest.raises(ValueError, match=r"recipe\.gamma is 0\.95 there and 0\.9 now"):
        Training(make_plan("scores", recipe=recipe), tmp_path)
    with pytest.raises(ValueError, match="learner is 'scores' there and 'mask' now"):
        Training(make_plan("mask"), tmp_path)


def test_a_missing_or_damaged_checkpoint_is_named(trained, tmp_path):
    folder = shutil.copytree(trained().folder, tmp_path / "run")
    path = folder / CHECKPOINT
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"checkpoint\.pt is damaged"):
        Training(make_plan(), folder)
    path.unlink()
    with pytest.raises(ValueError, match=r"checkpoint\.pt is missing, although progress\.csv"):
        Training(make_plan(), folder)


def test_a_checkpoint_of_a_former_version_is_refused(tmp_path):
    Training(make_plan("mask"), tmp_path)
    torch.save({"update": 3, "rounds": 0}, tmp_path / CHECKPOINT)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"checkpoint\.pt has format 1, and this version"):
        Training(make_plan("mask", validate_every=1), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_with_other_things_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match=r"is not empty and has no plan\.json"):
        Training(make_plan(), tmp_path)


@pytest.mark.parametrize("name", [PROGRESS, CHECKPOINT])
def test_a_full_disk_leaves_a_folder_to_continue_in(trained, tmp_path, monkeypatch, name):
    plan, complete = make_plan("scores"), trained("scores")
    training = Training(plan, tmp_path / "full")
    replace, written = pathlib.Path.replace, []

    def full(path, target):
        written.append(target.name)
        if target.name == name and written.count(name) == 3:
            raise OSError(28, "No space left on device")
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.replace", full)
        with pytest.raises(OSError, match="No space left"):
            training.run()
    again = Training(plan, tmp_path / "full")
    assert again.update == 2
    again.run()
    expected, resumed = read_progress(complete.folder), read_progress(tmp_path / "full")
    assert without_time(expected) == without_time(resumed)


def test_nothing_half_written_stays(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(tmp_path / "file", b"new")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"file": b"old"}


def test_the_regression_moves_the_scorer_and_counts_as_no_update(trained, tmp_path):
    plan = make_plan()
    first = trained()
    before = Training(plan, tmp_path / "one").learner.policy.state_dict()
    recipe = dataclasses.replace(plan.recipe, regression=RegressionRounds(rounds=0))
    second = Training(make_plan(recipe=recipe), tmp_path / "two")
    second.run()
    rows = [training.rows[0] for training in (first, second)]
    assert [row["steps"] for row in rows] == [36, 0]
    assert [row["update"] for row in rows] == [0, 0]
    assert rows[0]["validation_drawn"] != rows[1]["validation_drawn"]
    after = first.learner.policy.state_dict()
    assert all((after[name] != before[name]).any() for name in before)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"traffic_seeds": (0, 2000)}, r"traffic must be traffic seeds in 0\.\.999, got 2000"),
        (
            {"validation_seeds": (2000,)},
            r"validation must be .* 1000\.\.1999, got 2000",
        ),
        ({"seed": -1}, r"seed must be an integer in 0\.\.999"),
        ({"steps": 0, "recipe": RECIPES["mask"]()}, "steps must be an integer >= 1"),
        ({"steps": 240}, "steps must be 0 for plackett-luce, which is trained in rounds, got 240"),
        ({"keywords": {"action": "mask"}}, r"keywords\.action is chosen by the training"),
    ],
)
def test_plans_that_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_plan(**changes)


def test_swaps_under_a_release_whose_noise_cannot_be_set_are_refused_at_once(tmp_path):
    plan = make_plan(keywords={"horizon": 80, "privacy": "tests.helpers:SumRelease"})
    message = r"^recipe.swaps.rounds must be 0 under '.*SumRelease', .*, got 2; recipe:maskable"
    with pytest.raises(ValueError, match=message):
        Training(plan, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_a_bad_keyword_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="estimatr is unknown"):
        Training(make_plan(keywords={"estimatr": "ukf"}), tmp_path / "run")
    assert not (tmp_path / "run").exists()
