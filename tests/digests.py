"""Digests of everything that the environments give, to show that a change of code leaves it alone.

python tests/digests.py record before.json
python tests/digests.py compare before.json

Covers every id x estimator x privacy preset x action encoding over 60 seconds, scalar and
vectorised, variants of the short road, its schedules, the reference backends, and two short
trainings. Digests hold on one machine with one set of packages: compare where they were recorded.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import subprocess
import sys
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from dptse_env.schedules import make_schedule

IDS = ("PaperHighway", "PrivateHighway", "ShortHighway")
ESTIMATORS = ("ekf", "ukf", "enkf", "mhe", "random_walk", "open_loop")
PRESETS = ("paper", "corrected", "capped")
ACTIONS = ("mask", "scores", "slots", "sequential")
VARIANTS: dict[str, dict[str, Any]] = {
    "private boundary": {"privacy": {"preset": "capped", "boundary_inputs": "private"}},
    "nominal boundary": {"privacy": {"preset": "paper", "boundary_inputs": "nominal"}},
    "whole horizon": {"privacy": {"preset": "capped", "unit": "horizon"}},
    "one event, added": {
        "privacy": {"preset": "capped", "unit": "event", "adjacency": "add_remove"}
    },
    "mean speeds": {"privacy": {"preset": "capped", "speed_release": "mean", "cap": 9}},
    "random start": {"horizon": 100, "random_start": True},
    "density reward": {"reward": "density"},
    "speed reward": {"reward": "speed", "bandwidth": 3},
}
SCHEDULES = (
    "static", "paper", "round-robin", "random", "oldest-first", "largest-variance",
    "largest-density-variance", "stale-variance", "none", "greedy-trace",
    "oracle-error",
)  # fmt: skip
SECONDS = 60
EPISODES = 3
TRAININGS = {
    "plackett-luce": [
        "recipe:plackett-luce", "--recipe.n-envs", "8", "--recipe.width", "8",
        "--recipe.regression.rounds", "1", "--recipe.regression.seconds", "60",
        "--recipe.regression.batches", "20", "--recipe.swaps.rounds", "1",
        "--recipe.swaps.episodes", "4", "--recipe.swaps.batches", "10",
    ],
    "scores": [
        "recipe:scores", "--recipe.n-envs", "8", "--recipe.n-steps", "20",
        "--recipe.batch-size", "40", "--recipe.hidden", "8",
    ],
}  # fmt: skip


class Digest:
    """A hash of numbers, in the order in which they come."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._hash = hashlib.sha256()

    def add(self, value: Any) -> None:
        """Take in a number, an array, or a mapping or sequence of them; texts do not count."""
        if isinstance(value, dict):
            for key in sorted(value):
                self.add(value[key])
        elif isinstance(value, list | tuple):
            for item in value:
                self.add(item)
        elif isinstance(value, np.ndarray) and value.dtype == object:
            self.add(value.tolist())
        elif isinstance(value, np.ndarray):
            self._hash.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, bool | int | float | np.generic):
            self._hash.update(np.float64(value).tobytes())

    def __str__(self) -> str:
        """The first 16 hexadecimal digits."""
        return self._hash.hexdigest()[:16]


def rollout(env: Any, actions: list[Any]) -> dict[str, str]:
    """Return digests of what an environment gives for given actions."""
    digests = {name: Digest() for name in ("observation", "reward", "info", "privacy")}

    def take(observation: Any, info: dict[str, Any]) -> None:
        digests["observation"].add(observation)
        for key in ("inherited", "_inherited"):
            info.pop(key, None)
        privacy = {key: info.pop(key) for key in ("privacy", "_privacy") if key in info}
        digests["privacy"].add(privacy.get("privacy", {}))
        digests["info"].add(info)

    take(*env.reset(seed=11))
    for action in actions:
        observation, reward, _, truncated, info = env.step(action)
        digests["reward"].add(reward)
        digests["reward"].add(truncated)
        take(observation, info)
    return {name: str(digest) for name, digest in digests.items()}


def episode(env_id: str, **keywords: Any) -> dict[str, str]:
    """Return digests of one configuration, of a scalar environment and of a batch."""
    keywords = {"traffic_seeds": [0, 1], "truth_in_info": True, **keywords}
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gym.make(env_id, disable_env_checker=True, **keywords)
        picks = 1
        if keywords["action"] == "sequential":
            picks = env.unwrapped.config.bandwidth
        env.action_space.seed(5)
        actions = [env.action_space.sample() for _ in range(SECONDS * picks)]
        found |= {f"scalar {k}": v for k, v in rollout(env, actions).items()}
        batch = gym.make_vec(env_id, num_envs=EPISODES, **keywords)
        batch.action_space.seed(6)
        actions = [batch.action_space.sample() for _ in range(SECONDS * picks)]
        found |= {f"vector {k}": v for k, v in rollout(batch, actions).items()}
    return found


def schedule(name: str) -> dict[str, str]:
    """Return digests of what a schedule meets on the short road."""
    env = gym.make("dptse_env:dptse/ShortHighway-v0", disable_env_checker=True, horizon=SECONDS)
    policy = make_schedule(name, env, 3)
    digests = {part: Digest() for part in ("action", "observation", "reward")}
    observation, _ = env.reset(seed=4)
    state, truncated = None, False
    while not truncated:
        action, state = policy.predict(observation, state, np.array([state is None]), True)
        observation, reward, _, truncated, _ = env.step(action)
        for part, value in zip(digests, (action, observation, reward), strict=True):
            digests[part].add(value)
    return {part: str(digest) for part, digest in digests.items()}


def training(arguments: list[str], folder: Path) -> dict[str, str]:
    """Return digests of a short training: its weights and its learning curve."""
    command = [
        sys.executable, "scripts/train.py", "--env", "dptse_env:dptse/ShortHighway-v0",
        "--keywords", json.dumps({"privacy": "capped"}), "--traffic", "0:4",
        "--validation", "1000:1002", "--output", str(folder), "--no-tensorboard",
    ]  # fmt: skip
    if "recipe:scores" in arguments:
        command += ["--steps", "320"]
    run = subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(run.stderr)
    found = {}
    for name in ("best", "policy"):
        digest = Digest()
        with zipfile.ZipFile(folder / f"{name}.zip") as archive:
            weights = torch.load(io.BytesIO(archive.read("weights.pt")), weights_only=True)
        for key in sorted(weights):
            digest.add(weights[key].numpy())
        found[f"{name} weights"] = str(digest)
    curve = Digest()
    lines = [line.split(",") for line in (folder / "progress.csv").read_text().splitlines()]
    for column in ("update", "steps", "error", "validation", "validation_drawn"):
        place = lines[0].index(column)
        curve.add([float(line[place]) for line in lines[1:] if line[place]])
    found["curve"] = str(curve)
    return found


def record() -> dict[str, dict[str, str]]:
    """Return all digests by case."""
    found = {}
    for name, estimator, preset, action in itertools.product(IDS, ESTIMATORS, PRESETS, ACTIONS):
        case = f"{name} {estimator} {preset} {action}"
        found[case] = episode(
            f"dptse_env:dptse/{name}-v0", estimator=estimator, privacy=preset, action=action
        )
        print(case, flush=True)
    for case, keywords in VARIANTS.items():
        found[case] = episode("dptse_env:dptse/ShortHighway-v0", **{"action": "mask", **keywords})
    for name in SCHEDULES:
        found[f"schedule {name}"] = schedule(name)
    for estimator, preset in itertools.product(ESTIMATORS[:4], ("paper", "capped")):
        case = f"ShortHighway {estimator} {preset} reference"
        found[case] = episode(
            "dptse_env:dptse/ShortHighway-v0", estimator=estimator, privacy=preset,
            action="mask", backend="reference",
        )  # fmt: skip
        print(case, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, arguments in TRAININGS.items():
            found[f"training {name}"] = training(arguments, Path(folder) / name)
            print(f"training {name}", flush=True)
    return found


def main() -> None:
    """Record digests to a file, or compare with those in one."""
    what, path = sys.argv[1], Path(sys.argv[2])
    found = record()
    if what == "record":
        path.write_text(json.dumps(found, indent=1) + "\n")
        return
    before = json.loads(path.read_text())
    differing = [
        f"{case}: {name}"
        for case in before
        for name in before[case]
        if found.get(case, {}).get(name) != before[case][name]
    ]
    print(*differing, sep="\n")
    print(f"{len(differing)} digests differ of {sum(map(len, before.values()))}")
    raise SystemExit(bool(differing))


if __name__ == "__main__":
    main()
