"""PPO of stable-baselines3 end to end, and the shares of its time."""

from __future__ import annotations

import time
from typing import Any

from agents.studies.paper import Stopwatch
from benchmarks.throughput.environments import libraries, make_batch
from benchmarks.throughput.measure import Measured, resident, take_turns

STEPS, MINIBATCH, EPOCHS = 32, 2048, 10
"""A rollout of each episode [steps], samples of a gradient step, passes through a rollout."""


def ppo(seconds: float, preset: str, n: int, threads: int, **more: Any) -> Measured:
    """Measure PPO with an MlpPolicy on n episodes; a turn is one rollout and its updates."""
    import torch  # noqa: PLC0415  (only this row pays for it)
    from stable_baselines3 import PPO  # noqa: PLC0415

    from dptse_env.sb3 import SB3VecEnv  # noqa: PLC0415

    torch.set_num_threads(threads)
    loaded = libraries(preset, **more)
    env = SB3VecEnv(make_batch(preset, n, threads, autoreset_mode="SameStep", **more))
    model = PPO(
        "MlpPolicy", env, n_steps=STEPS, batch_size=MINIBATCH, n_epochs=EPOCHS, seed=0, device="cpu"
    )
    size = n * STEPS
    model.learn(size)
    watches = [
        Stopwatch(watched, [name])
        for watched, name in ((env, "step_wait"), (model, "collect_rollouts"), (model, "train"))
    ]
    start = time.perf_counter()

    def turn() -> int:
        model.learn(size, reset_num_timesteps=False)
        return size

    arms = take_turns({"PPO": turn}, seconds)
    total = time.perf_counter() - start
    environment, rollout, update = (watch.seconds / total for watch in watches)
    notes = {
        "environment": environment,
        "rollout beside it": rollout - environment,
        "update": update,
        "rest": 1.0 - rollout - update,
    }
    return Measured(arms, resident("VmHWM"), loaded, notes)
