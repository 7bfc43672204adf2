"""Use an installed wheel as another project would: no checkout, no extras, no SUMO_HOME."""

import importlib.util
import sys
from pathlib import Path

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
    for env_id in ("dptse/PaperHighway-v0", "dptse/ShortHighway-v0"):
        env = gym.make(f"dptse_env:{env_id}")
        env.reset(seed=0)
        env.action_space.seed(0)
        for _ in range(30):
            observation, reward, *_ = env.step(env.action_space.sample())
            assert np.isfinite(observation).all()
            assert np.isfinite(reward)
        env.close()
    for estimator in ("random_walk", "ukf", "enkf", "mhe"):
        env = gym.make(
            "dptse_env:dptse/ShortHighway-v0", estimator=estimator, parameters="w99-3lane"
        )
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()
    envs = gym.make_vec("dptse_env:dptse/ShortHighway-v0", num_envs=3, traffic_seeds="0:1")
    envs.reset(seed=0)
    assert np.isfinite(envs.step(envs.action_space.sample())[1]).all()
    use_parts_of_another_package()
    policies = Path(dptse_env.__file__).parent / "policies"
    assert any(policies.glob("*.safetensors")), "a trained policy must come with it"
    print(f"the wheel works with gymnasium {gym.__version__}")


def use_parts_of_another_package() -> None:
    """Run with a part of every kind, by names that the entry point of their package registers."""
    kinds = ("action", "corridor", "estimator", "privacy", "reward")
    keywords = {kind: f"plugin-{kind}" for kind in kinds} | {"bandwidth": 2}
    keywords["observation"] = ["default", "plugin-observation"]
    env = gym.make("dptse_env:dptse/ShortHighway-v0", **keywords)
    env.reset(seed=0)
    assert env.unwrapped.privacy()["preset"] == "plugin-privacy"
    assert np.isfinite(env.step(env.action_space.sample())[1])
    envs = gym.make_vec(
        "dptse_env:dptse/ShortHighway-v0",
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={"context": "spawn"},
        **keywords,
    )
    envs.reset(seed=0)
    assert np.isfinite(envs.step(envs.action_space.sample())[1]).all()
    envs.close()


if __name__ == "__main__":
    main()
