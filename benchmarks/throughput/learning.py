"""PPO of stable-baselines3 end to end, and where its time goes."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

from benchmarks.throughput.environments import batch, libraries
from benchmarks.throughput.measure import Measured, resident, take_turns

STEPS, MINIBATCH, EPOCHS = 32, 2048, 10
"""A rollout of each episode [steps], samples of a gradient step, passes through a rollout."""


class Clock:
    """Sums up the time [s] that methods take."""

    def __init__(self) -> None:
        """Start at zero."""
        self.seconds: dict[str, float] = defaultdict(float)

    def watch(self, owner: Any, method: str) -> None:
        """Time every call of a method from now on."""
        run = getattr(owner, method)

        def timed(*arguments: Any, **keywords: Any) -> Any:
            start = time.perf_counter()
            try:
                return run(*arguments, **keywords)
            finally:
                self.seconds[method] += time.perf_counter() - start

        setattr(owner, method, timed)


def ppo(seconds: float, preset: str, n: int, threads: int, **more: Any) -> Measured:
    """Measure PPO with an MlpPolicy on n episodes; a turn is one rollout and its updates."""
    import torch  # noqa: PLC0415  (only this row pays for it)
    from stable_baselines3 import PPO  # noqa: PLC0415

    from dptse_env.sb3 import SB3VecEnv  # noqa: PLC0415

    torch.set_num_threads(threads)
    loaded = libraries(preset, **more)
    env = SB3VecEnv(batch(preset, n, threads, autoreset_mode="SameStep", **more))
    model = PPO(
        "MlpPolicy", env, n_steps=STEPS, batch_size=MINIBATCH, n_epochs=EPOCHS, seed=0, device="cpu"
    )
    size = n * STEPS
    model.learn(size)
    clock = Clock()
    clock.watch(env, "step_wait")
    clock.watch(model, "collect_rollouts")
    clock.watch(model, "train")
    start = time.perf_counter()

    def turn() -> int:
        model.learn(size, reset_num_timesteps=False)
        return size

    arms = take_turns({"PPO": turn}, seconds)
    total = time.perf_counter() - start
    env_share, update = clock.seconds["step_wait"] / total, clock.seconds["train"] / total
    rollout = clock.seconds["collect_rollouts"] / total - env_share
    notes = {
        "environment": env_share,
        "rollout beside it": rollout,
        "update": update,
        "rest": 1.0 - env_share - rollout - update,
    }
    return Measured(arms, resident("VmHWM"), loaded, notes)
