"""Trainings in their folders: killed and gone on with, validated, refused, several at once."""

import json
import shutil
from itertools import count
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import gymnasium as gym
import torch
from PIL import Image

from agents.environments import make_vector
from agents.executors import ExecutorError, this_process
from agents.files import PLAN
from agents.play import Cell, play
from agents.seeds import TRAINING_VALIDATION
from agents.training import training
from agents.training.plan import make_policies
from agents.training.run import BEST, CURVE, POLICY, RULES, RULES_FILE, Run, least
from agents.training.run_files import CHECKPOINT, PROGRESS, read_checkpoint, read_progress
from agents.training.settings import ALGORITHMS, parse_algorithm
from agents.training.training import train, train_all
from dptse_env.evaluation import evaluate
from dptse_env.sb3 import ReplicaBaseline, load_policy
from dptse_env.utils.files import read_tensors
from tests.agents.training.plans import (
    ENV,
    ONE,
    SMALL,
    STEPS,
    WIDE,
    StopError,
    ended_at,
    make_algorithm,
    make_plan,
    stop,
)
from tests.helpers import SHORT, fast_and_slow
from tests.test_non_interference import blind, make_private, unlike

PRIVATE = "dptse_env:dptse/PrivateHighway-v1"
KEYWORDS = {"horizon": 80, "privacy": "capped"}
POLICIES = (POLICY, BEST)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A function that returns the folder and the curve of a finished training; leave it alone."""
    done = {}

    def get(name="plackett-luce", **changes):
        if (name, *changes) not in done:
            folder = tmp_path_factory.mktemp(name)
            done[name, *changes] = folder, train(make_plan(name, **changes), folder)
        return done[name, *changes]

    return get


# --- going on -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_full_disk_leaves_a_folder_to_go_on_in(whole, tmp_path, monkeypatch):
    replace, written = Path.replace, []

    def full(path, target):
        written.append(target.name)
        if target.name == CHECKPOINT and written.count(CHECKPOINT) == 2:
            raise OSError(28, "No space left on device")
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.replace", full)
        with pytest.raises(OSError, match="No space left"):
            train(make_plan(), tmp_path / "full")
    with monkeypatch.context() as patch:
        patch.setattr("agents.training.training.regress", None)  # it is not done again
        train(make_plan(), tmp_path / "full")
    for name in POLICIES:
        assert (tmp_path / "full" / name).read_bytes() == (whole()[0] / name).read_bytes()


@pytest.mark.parametrize("name", ["plackett-luce", "ppo"])
def test_a_finished_training_is_left_alone(name, whole, tmp_path):
    folder = shutil.copytree(whole(name)[0], tmp_path / "run")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    left = {PLAN, PROGRESS, CHECKPOINT, RULES_FILE, CURVE, *POLICIES}
    assert set(before) == left
    (folder / PROGRESS).unlink()  # as if it was killed right after its last checkpoint
    train(make_plan(name), folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("name", fast_and_slow(list(SMALL)[1:], ["ppo"]))
def test_an_algorithm_goes_on_from_its_last_checkpoint(name, tmp_path):
    # Weights stay what they were, where they are not lost.
    still = {"learning_rate": 1e-12, "final_learning_rate": 1e-12}
    changes = {"policy": "mlp"} if name == "ppo" else {}
    plan = make_plan(make_algorithm(name, **still, **changes))
    with pytest.raises(StopError), ended_at(2, stop):
        train(plan, tmp_path)
    kept = read_checkpoint(tmp_path)
    rows = train(plan, tmp_path)
    assert rows[:2] == kept["rows"]
    assert [row["update"] for row in rows] == [0, 1, 2, 3]
    assert [row["steps"] for row in rows] == [0, 80, 160, 240]
    end = read_checkpoint(tmp_path)
    for key, value in kept["parameters"]["policy"].items():
        torch.testing.assert_close(end["parameters"]["policy"][key], value, rtol=0, atol=1e-6)
    counts = [each["statistics"]["obs_rms"]["count"] for each in (kept, end)]
    assert counts[1] - counts[0] >= 160


def test_every_update_of_ppo_compares_replicas(tmp_path, monkeypatch):
    sums = []

    class Watched(ReplicaBaseline):
        def _on_rollout_end(self):
            super()._on_rollout_end()
            sums.append(self.model.rollout_buffer.advantages.reshape(10, -1, 2).sum(axis=2))

    monkeypatch.setattr("agents.training.learning.ReplicaBaseline", Watched)
    train(make_plan("ppo"), tmp_path)
    assert np.shape(sums) == (6, 10, 2)
    np.testing.assert_allclose(sums, 0.0, atol=1e-5)


# --- what a training leaves -----------------------------------------------------------------------


def test_the_curve_of_rounds(whole):
    folder, rows = whole()
    assert rows == read_progress(folder)
    # Four episodes are simulated for nine seconds ahead of the rounds; in a round three of 80 s,
    # each with 1 + 2 forks under noise and its opposite.
    assert [row["steps"] for row in rows] == [36, 36 + 1680, 36 + 2 * 1680]
    assert len({row["validation_drawn"] for row in rows}) == 3
    assert all(0.01 < row["error"] < 1 for row in rows[1:])


@pytest.mark.parametrize(("name", "actions"), [("ppo", 1), ("maskable-ppo", 2)])
def test_the_curve_counts_seconds_whatever_the_encoding(name, actions, whole):
    folder, rows = whole(name)
    assert make_plan(name).actions_per_step == actions
    assert [row["steps"] for row in rows] == [0, 80, 160, 240]
    assert rows == read_progress(folder)
    # A third and two thirds of the training are done at the updates before these rows.
    rates = [row["learning_rate"] for row in rows[1:]]
    first, last = (1e-3 if name == "ppo" else 5e-4), 5e-5
    done = np.array([40, 120, 200]) / STEPS
    assert rates == pytest.approx((first + (last - first) * done).tolist())
    with Image.open(folder / CURVE) as image:
        assert image.format == "PNG"


@pytest.fixture
def clock(monkeypatch):
    """A clock of the processor that is 50 ms later each time."""
    now = count(step=0.05)
    monkeypatch.setattr("time.process_time", lambda: next(now))


def test_a_training_by_minutes_ends_in_time(tmp_path, clock):
    rows = train(make_plan("ppo", steps=None, minutes=0.05), tmp_path)
    assert 3.0 <= rows[-1]["seconds"] < 4.0
    assert rows[-1]["steps"] > 0


@pytest.mark.parametrize(
    "name", fast_and_slow(SMALL, ["plackett-luce", "ppo", "recurrent-ppo", "qr-dqn"])
)
def test_the_best_policy_is_the_best_in_validation(name, whole):
    folder, rows = whole(name)
    plan, seeds = make_plan(name), (1000, 1001)
    errors = [min(row["validation"], row["validation_drawn"]) for row in rows]
    assert errors == [*map(least, rows)]
    (world,) = plan.worlds
    given = {"action": plan.algorithm.action, "traffic_seeds": list(seeds)}
    env = make_vector(world.env, 2, {**world.keywords, **given})
    best = errors.index(min(errors))
    for file, row in ((BEST, rows[best]), (POLICY, rows[-1])):
        policy = load_policy(folder / file, env)
        column = {"deterministic": "validation", "drawn": "validation_drawn"}[policy.card["acts"]]
        assert row[column] == min(row["validation"], row["validation_drawn"])
        played = evaluate(env, policy, seeds, TRAINING_VALIDATION.start, deterministic=True)
        error = -np.mean([row["reward"] for row in played])
        assert error == pytest.approx(row["validation"], rel=1e-6)
        assert policy.card["figures"]["validation"] == row["validation"]
        assert policy.card["training"]["steps"] == row["steps"]
    training = load_policy(folder / BEST, env).card["training"]
    assert (training["learner"], training["seed"]) == (name, 1)
    assert training["traffic seeds"] == "0..2"


def test_rules_are_played_once_on_the_same_traffic(whole, monkeypatch, tmp_path):
    folder = shutil.copytree(whole()[0], tmp_path / "run")
    kept = json.loads((folder / RULES_FILE).read_text())
    assert list(kept) == list(RULES)
    cell = Cell(SHORT, "speed-front", KEYWORDS, noise_seed=TRAINING_VALIDATION.start)
    rewards = [row["reward"] for row in play(cell, (1000, 1001))]
    assert kept["speed-front"] == pytest.approx(-np.mean(rewards))
    monkeypatch.setattr("agents.training.run.RULES", ("none",))
    run = Run(make_plan(), folder, None)
    assert run.rules == kept


def test_ppo_begins_with_a_policy_by_another_algorithm(whole, tmp_path):
    still = make_algorithm("ppo", learning_rate=1e-12, final_learning_rate=1e-12)
    plan = make_plan(still, initial=str(whole()[0] / BEST))
    plan.check()
    first = train(plan, tmp_path)[0]
    figures = read_tensors(whole()[0] / BEST)[0]["figures"]
    assert first["validation"] == pytest.approx(figures["validation"], rel=1e-5)


@pytest.mark.slow
def test_ppo_learns_to_err_less_than_the_best_rule(tmp_path):
    plan = make_plan(
        parse_algorithm('ppo {"validations": 4}', 6),
        envs=(f'{SHORT} {{"bandwidth": 1}}',),
        traffic_seeds=tuple(range(32)),
        validation_seeds=tuple(range(1000, 1016)),
        steps=100_000,
    )
    rows = train(plan, tmp_path)
    rules = json.loads((tmp_path / RULES_FILE).read_text())
    assert rows[-1]["validation"] < 0.98 * min(rules.values())


def test_a_validation_is_seeded_and_leaves_the_draws_of_the_training_alone(whole, tmp_path):
    plan = make_plan()
    run = Run(plan, shutil.copytree(whole()[0], tmp_path / "run"), None)
    policies, state = make_policies(plan.algorithm, plan.worlds), torch.get_rng_state()
    row = run.validate(policies, 0)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(99)
    assert run.validate(policies, 0) == row
    env = make_vector(SHORT, 2, {**KEYWORDS, "action": "slots", "traffic_seeds": [1000, 1001]})
    noise = TRAINING_VALIDATION.start
    torch.manual_seed(noise)
    rows = evaluate(env, policies[0], (1000, 1001), noise, deterministic=False)
    assert row["validation_drawn"] == pytest.approx(-np.mean([each["reward"] for each in rows]))


def test_several_environments_teach_one_network(whole):
    folder, rows = whole(envs=(ENV, WIDE))
    regression, forks = 9 * (4 + 4), 1 + 2 * (1 + 2)
    assert rows[-1]["steps"] == regression + 2 * (3 + 3) * 80 * forks
    each = [row for name, row in rows[-1].items() if name.startswith("validation in ")]
    assert len(each) == 2
    assert rows[-1]["validation"] == pytest.approx(sum(each) / 2)
    policy = load_policy(folder / POLICY, gym.make(SHORT, action="slots", **KEYWORDS))
    assert policy.card["training"]["also"] == [WIDE]
    env = gym.make(SHORT, action="slots", bandwidth=3, **KEYWORDS)
    elsewhere = load_policy(folder / BEST, env, allow=("bandwidth",))
    assert env.action_space.contains(elsewhere.predict(env.reset(seed=0)[0])[0])
    one, two = (read_checkpoint(each)["policy"] for each in (folder, whole()[0]))
    assert not any(torch.equal(one[key], two[key]) for key in one if key.startswith("scorer."))


# --- folders that are refused ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 2}, "seed is 1 there and 2 now"),
        ({"envs": (ENV.replace("80", "81"),)}, r"envs is .*80.* there and .*81.* now"),
        ({"algorithm": make_algorithm(width=9)}, r"algorithm\.width is 8 there and 9 now"),
        ({"algorithm": "ppo"}, "algorithm.name is 'plackett-luce' there and 'ppo' now"),
    ],
)
def test_the_folder_of_another_plan_is_refused(changes, message, whole, tmp_path):
    folder = whole()[0]
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    plans = {tmp_path / "first": make_plan(), folder: make_plan(**changes)}
    with pytest.raises(ValueError, match=message):
        train_all(plans, this_process)
    assert not (tmp_path / "first").exists()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_damaged_and_foreign_files_are_refused(whole, tmp_path):
    def refused(name, content, message):
        folder = shutil.copytree(whole()[0], tmp_path / "run", dirs_exist_ok=True)
        (folder / name).unlink()
        if content is not None:
            (folder / name).write_bytes(content)
        with pytest.raises(ValueError, match=message):
            train(make_plan(), folder)

    checkpoint = (whole()[0] / CHECKPOINT).read_bytes()
    refused(CHECKPOINT, checkpoint[:1000], r"checkpoint\.pt is damaged")
    refused(CHECKPOINT, None, r"checkpoint\.pt is missing, although progress\.csv")
    refused(PLAN, b'{"env', r"plan\.json must be JSON: ")
    refused(PLAN, None, "output must not exist yet, got ")


# --- several trainings ----------------------------------------------------------------------------


def apart(work, tasks):
    """Train on the disk of another machine."""
    yield 0, None


def test_rules_are_played_once_for_each_environment(tmp_path, monkeypatch):
    def keep(plan, folder, records):
        played.append(plan.envs)
        return {"static": float(len(played))}

    played = []
    monkeypatch.setattr(training, "keep_rules", keep)
    plans = [make_plan(), make_plan(envs=(ONE,)), make_plan(seed=2)]
    with pytest.raises(ExecutorError, match="--output that all nodes have"):
        train_all({tmp_path / str(k): plan for k, plan in enumerate(plans)}, apart)
    errors = [json.loads((tmp_path / str(k) / RULES_FILE).read_text())["static"] for k in range(3)]
    assert (errors, played) == ([1.0, 2.0, 1.0], [plans[0].envs, (ONE,)])


# --- non-interference; see `tests.test_non_interference` ------------------------------------------


@pytest.fixture(scope="module", params=fast_and_slow(ALGORITHMS, ["recurrent-ppo"]))
def private(request, tmp_path_factory):
    """A policy of every algorithm, trained a little with the truth at hand."""
    keywords = {"horizon": 70, "privacy": "capped", "bandwidth": 1 if "dqn" in request.param else 2}
    plan = make_plan(
        request.param, envs=(f"{PRIVATE} {json.dumps(keywords)}",), traffic_seeds=(0, 1),
        validation_seeds=(1000,),
    )  # fmt: skip
    folder = tmp_path_factory.mktemp(request.param)
    train(plan, folder)
    return {"action": plan.algorithm.action, "bandwidth": keywords["bandwidth"]}, folder / POLICY


class Acting:
    """A policy whose draws begin alike in every episode."""

    def __init__(self, act):
        self.act = act

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if state is None:
            torch.manual_seed(7)
        action, state = self.act(observation, state and state[0])
        return action, (state,)


@pytest.mark.parametrize("deterministic", [True, False])
def test_traffic_does_not_show_through_a_trained_policy(private, deterministic):
    keywords, path = private
    env = blind(make_private(**keywords))
    policy = load_policy(path, env)

    def act(observation, state):
        return policy.predict(observation, state, np.array([state is None]), deterministic)

    assert not unlike(env, Acting(act))
