"""Programs that take an id alone, as their users write them, in a few steps."""

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import QRDQN, MaskablePPO, RecurrentPPO
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

from dptse_env.evaluation import evaluate
from dptse_env.registration import ENVIRONMENTS, encoded
from dptse_env.sb3 import SB3VecEnv

(ROAD,) = (name for name in ENVIRONMENTS if "Short" in name)
MASK = f"dptse_env:{ROAD}"
DISCRETE, BOX, SLOTS = (
    f"dptse_env:{encoded(ROAD, suffix)}" for suffix in ("Discrete", "Box", "Slots")
)
ROLLOUT, REPLAY = {"n_steps": 16, "batch_size": 16}, {"learning_starts": 8, "batch_size": 8}
LEARNERS = [
    (PPO, MASK, ROLLOUT), (PPO, DISCRETE, ROLLOUT), (A2C, SLOTS, {"n_steps": 8}),
    (QRDQN, DISCRETE, REPLAY), (SAC, BOX, REPLAY),
    (MaskablePPO, MASK, ROLLOUT), (MaskablePPO, SLOTS, ROLLOUT), (MaskablePPO, DISCRETE, ROLLOUT),
    (RecurrentPPO, SLOTS, ROLLOUT),
]  # fmt: skip
LIKE = {RecurrentPPO: "MlpLstmPolicy"}


@pytest.mark.parametrize(("learner", "env_id", "settings"), LEARNERS)
def test_learners_of_stable_baselines3_take_an_id(learner, env_id, settings):
    model = learner(LIKE.get(learner, "MlpPolicy"), env_id, seed=0, device="cpu", **settings)
    model.learn(24)
    env = gym.make(env_id, traffic_seeds=[0], horizon=65)
    (row,) = evaluate(env, model, [0])
    assert row["reward"] < 0.0


@pytest.mark.parametrize("env_id", [MASK, SLOTS, DISCRETE])
def test_masks_are_found_by_sb3_contrib_and_are_as_many_as_it_expects(env_id):
    envs = make_vec_env(env_id, n_envs=2, env_kwargs={"traffic_seeds": [0], "bandwidth": 2})
    batch = gym.make_vec(
        env_id, num_envs=2, autoreset_mode="SameStep", traffic_seeds=[0], bandwidth=2
    )
    masks = []
    for each in (envs, SB3VecEnv(batch)):
        each.reset()
        masks.append(get_action_masks(each))
    np.testing.assert_array_equal(*masks)
    policy = MaskablePPO("MlpPolicy", envs, **ROLLOUT).policy
    action, _ = policy.predict(envs.reset(), action_masks=masks[0])
    assert envs.action_space.contains(action[0])
