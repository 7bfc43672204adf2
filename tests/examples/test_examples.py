"""Every example runs with a few steps, and leaves a policy that can be evaluated."""

import math
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from agents.study import read_rows

ROOT = Path(__file__).resolve().parents[2]
ENV = "dptse_env:dptse/ShortHighway-v0"

pytestmark = pytest.mark.slow


def need(module):
    """Skip where a library is missing; its import must not meet this project's strict warnings."""
    code = f"import {module}"
    if find_spec(module.partition(".")[0]) is None:
        pytest.skip(f"{module} is not installed")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{module} cannot be imported: {done.stderr.strip().splitlines()[-1]}")


def run(*arguments):
    """Run Python on arguments in the root of the checkout and return what it prints."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def errors(printed):
    """Return the mean errors that an example prints: untrained, trained, and of a schedule."""
    found = re.search(r"mean error: untrained (\S+), trained (\S+), round robin (\S+)", printed)
    assert found, printed
    values = [float(value) for value in found.groups()]
    assert all(0.0 < value < 1000.0 for value in values)
    return values


def ladder(folder, *policies):
    """Evaluate policies beside a schedule, each in a process of its own; return errors by name."""
    run(
        "scripts/evaluate.py", "--env", ENV, "--parameters", "paper", "--schedules", "round-robin",
        "--seeds", "2000:2002", "--estimators", "random_walk", "--workers", 2,
        "--output", folder, "--policies", *policies,
    )  # fmt: skip
    rows = read_rows("evaluation", folder)
    assert rows["policy"].n_unique() == len(policies) + 2  # those, the round robin, the reference
    assert all(math.isfinite(error) for error in rows["rmse_density"])
    return {
        name: own["rmse_density"].to_list()
        for (name,), own in rows.sort("traffic_seed").partition_by("policy", as_dict=True).items()
    }


@pytest.mark.ray
def test_rllib_trains_alike_on_single_episodes_and_on_a_batch(tmp_path):
    need("ray.rllib.algorithms.ppo")
    tiny = ("--envs", 2, "--steps", 512, "--batch", 512)
    found = {}
    for mode in ("sync", "vector_entry_point"):
        printed = run(
            "examples/rllib_ppo.py", *tiny, "--vectorize", mode, "--output", tmp_path / mode
        )
        found[mode] = errors(printed)
        assert (tmp_path / mode / "checkpoint" / "rllib_checkpoint.json").is_file()
        assert (tmp_path / mode / "policy.zip").is_file()
    assert found["sync"] == found["vector_entry_point"]
    assert found["sync"][0] != found["sync"][1]
    policies = [f"examples.rllib_policy:RLlibPolicy={tmp_path / mode}/policy.zip" for mode in found]
    scores = ladder(tmp_path / "ladder", *policies)
    assert scores["sync/policy"] == scores["vector_entry_point/policy"]
    assert scores["sync/policy"] != scores["round-robin"]


@pytest.mark.ray
def test_rllib_trains_with_a_memory_and_the_policy_keeps_it(tmp_path):
    need("ray.rllib.algorithms.ppo")
    tiny = ("--envs", 2, "--steps", 512, "--batch", 512, "--lstm")
    errors(run("examples/rllib_ppo.py", *tiny, "--output", tmp_path))
    path = tmp_path / "policy.zip"
    ladder(tmp_path / "ladder", f"examples.rllib_policy:RLlibPolicy={path}")
    code = f"""
import numpy as np
from examples.rllib_policy import RLlibPolicy
policy = RLlibPolicy.load({str(path)!r})
seen = np.random.default_rng(0).normal(size=(3, *policy.observation_space.shape))
first, state = policy.predict(seen, None, np.ones(3, bool), deterministic=True)
_, later = policy.predict(seen, state, np.array([False, True, False]), deterministic=True)
print(first.shape == (3, *policy.action_space.shape), policy.predict(seen[0])[0].shape)
print([bool((later["h"][i] == state["h"][i]).all()) for i in range(3)])
"""
    # The same observation again changes the memory, but for the episode that begins anew.
    assert run("-c", code).splitlines()[-2:] == ["True (2,)", "[False, True, False]"]


@pytest.mark.parametrize("arguments", [("--envs", 4), ("--scalar",)])
def test_torchrl(arguments, tmp_path):
    need("torchrl")
    tiny = ("--steps", 512, "--batch", 256, "--output", tmp_path)
    untrained, trained, _ = errors(run("examples/torchrl_ppo.py", *tiny, *arguments))
    assert untrained != trained
    ladder(tmp_path / "ladder", f"examples.slots_policy:SlotsPolicy={tmp_path}/policy.zip")


def test_tianshou(tmp_path):
    need("tianshou")
    tiny = ("--envs", 2, "--steps", 512, "--batch", 256, "--output", tmp_path)
    untrained, trained, _ = errors(run("examples/tianshou_ppo.py", *tiny))
    assert untrained != trained
    ladder(tmp_path / "ladder", f"examples.slots_policy:SlotsPolicy={tmp_path}/policy.zip")


def test_cleanrl_repeats_itself(tmp_path):
    need("torch")
    tiny = ("--envs", 4, "--steps", 512, "--output", tmp_path)
    printed = [errors(run("examples/cleanrl_ppo.py", *tiny)) for _ in range(2)]
    assert printed[0] == printed[1]
    policy = f"examples.slots_policy:SlotsPolicy={tmp_path}/policy.zip"
    scores = ladder(tmp_path / "ladder", policy)
    assert len({tuple(each) for each in scores.values()}) == len(scores)


@pytest.mark.parametrize(
    ("algorithm", "kind"),
    [("ppo", "stable_baselines3:PPO"), ("ppo_lstm", "sb3_contrib:RecurrentPPO")],
)
def test_rl_zoo3(algorithm, kind, tmp_path):
    need("rl_zoo3")
    run(
        "-m", "rl_zoo3.train", "--algo", algorithm, "--env", "dptse/ShortHighway-v0",
        "--gym-packages", "dptse_env", "--conf-file", f"examples/rl_zoo3/{algorithm}.yml",
        "--log-folder", tmp_path, "--seed", 0, "-n", 2048, "--eval-freq", 1024,
        "--eval-episodes", 2, "--eval-env-kwargs", "action:'slots'", "traffic_seeds:'1000:1002'",
    )  # fmt: skip
    folder = tmp_path / algorithm / "dptse-ShortHighway-v0_1"
    rewards = np.load(folder / "evaluations.npz")["results"]
    assert (rewards < 0.0).all()
    ladder(tmp_path / "ladder", f"{kind}={folder}/dptse-ShortHighway-v0.zip")
