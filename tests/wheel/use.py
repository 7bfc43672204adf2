"""Use an installed wheel as another project would: no checkout, no extras, no SUMO_HOME."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np


def main() -> None:
    """Run an episode of every id and of every estimator."""
    import dptse_env

    assert Path(sys.prefix) in Path(dptse_env.__file__).parents, dptse_env.__file__
    for extra in ("matplotlib", "torch"):
        assert importlib.util.find_spec(extra) is None, f"the core must not need {extra}"
    heavy = {"libsumo", "numba", "torch", "matplotlib"} & set(sys.modules)
    assert not heavy, f"import dptse_env must not import {heavy}"
    short = "dptse_env:dptse/ShortHighway-v0"
    play(gym.make("dptse_env:dptse/PaperHighway-v0"), 30)
    play(gym.make(short), 30)
    for estimator in ("random_walk", "ukf", "enkf", "mhe"):
        play(gym.make(short, estimator=estimator, parameters="w99-3lane"))
    play(gym.make_vec(short, num_envs=3, traffic_seeds="0:1"))
    use_parts_of_another_package()
    policies = Path(dptse_env.__file__).parent / "policies"
    assert any(policies.glob("*.safetensors")), "a trained policy must come with it"
    print(f"the wheel works with gymnasium {gym.__version__}")


def play(env: Any, n_steps: int = 1) -> None:
    """Play some steps of one episode or several."""
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(n_steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
    env.close()


def use_parts_of_another_package() -> None:
    """Run with a part of every kind, by names that the entry point of their package registers."""
    kinds = ("action", "corridor", "estimator", "privacy", "reward")
    keywords = {kind: f"plugin-{kind}" for kind in kinds} | {"bandwidth": 2}
    keywords["observation"] = ["default", "plugin-observation"]
    env = gym.make("dptse_env:dptse/ShortHighway-v0", **keywords)
    assert env.unwrapped.privacy()["preset"] == "plugin-privacy"
    play(env)
    play(
        gym.make_vec(
            "dptse_env:dptse/ShortHighway-v0", num_envs=2, vectorization_mode="async",
            vector_kwargs={"context": "spawn"}, **keywords,
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
