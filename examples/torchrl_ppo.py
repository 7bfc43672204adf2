"""PPO made of TorchRL's parts, on a batch of episodes that steps as one.

pip install -e '.[train]' torchrl
python examples/torchrl_ppo.py --steps 300000

`GymWrapper` takes our vector environment where it is made with ``autoreset_mode="Disabled"``:
TorchRL resets each episode itself when it has ended (it refuses ``NextStep``, and ``SameStep``
fails in its reader of ``info``). All encodings work; ``slots`` suits PPO, with one categorical
choice for each query.
"""

import gymnasium as gym
import numpy as np
import torch
import tyro
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical, Independent
from torchrl.collectors import Collector
from torchrl.envs.libs.gym import GymWrapper
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import dptse_env

ENV = "dptse_env:dptse/ShortHighway-v0"
KEYWORDS = {"estimator": "ekf", "parameters": "published", "action": "slots"}
N_ENVS, BATCH, MINIBATCH = 64, 4096, 512
HELD_OUT = range(1000, 1008)


class Choices(Independent):
    """A categorical distribution for each of B slots, with logits of shape (..., B, n)."""

    def __init__(self, logits: torch.Tensor) -> None:
        """Take the logits of the options."""
        super().__init__(Categorical(logits=logits), 1)


class Policy:
    """A network of logits as a policy: what `dptse_env.evaluate` asks for."""

    def __init__(self, logits: nn.Module) -> None:
        """Take the network."""
        self.logits = logits

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        """Return actions and no state."""
        choices = Choices(self.logits(torch.as_tensor(observation)))
        return (choices.mode if deterministic else choices.sample()).numpy(), None


def error(policy) -> float:
    """Return the error x 1000 on held-out traffic of a policy, or of a schedule by its name."""
    env = gym.make_vec(ENV, num_envs=len(HELD_OUT), traffic_seeds=list(HELD_OUT), **KEYWORDS)
    return -1000 * np.mean([row["reward"] for row in dptse_env.evaluate(env, policy, HELD_OUT)])


def main(steps: int = 300_000, seed: int = 0) -> None:
    """Train, and compare the policy with its untrained self and a rule on held-out traffic."""
    torch.manual_seed(seed)
    envs = gym.make_vec(
        ENV, num_envs=N_ENVS, autoreset_mode="Disabled", horizon=120, random_start=True, **KEYWORDS
    )
    size, options = envs.single_observation_space.shape[0], envs.single_action_space.nvec
    layers = [nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, int(options.sum()))]
    logits = nn.Sequential(*layers, nn.Unflatten(-1, (len(options), -1)))
    actor = ProbabilisticActor(
        TensorDictModule(logits, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=Choices,
        return_log_prob=True,
    )
    critic = ValueOperator(nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 1)))
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.003)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    untrained = error(Policy(logits))
    env = GymWrapper(envs)
    env.set_seed(seed)
    collector = Collector(
        env, actor, frames_per_batch=BATCH, total_frames=-(-steps // BATCH) * BATCH,
        auto_register_policy_transforms=False,  # they serve policies with a memory
    )  # fmt: skip
    for iteration, data in enumerate(collector, start=1):
        for _ in range(4):
            with torch.no_grad():
                advantage(data)
            flat = data.reshape(-1)
            for rows in torch.randperm(len(flat)).split(MINIBATCH):
                parts = loss(flat[rows])
                optimiser.zero_grad()
                (parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        reward = data["next", "reward"].mean().item()
        print(f"{iteration * BATCH} steps, mean reward {reward:.4f}")
    trained, rule = error(Policy(logits)), error("speed-front")
    print(f"error x 1000: untrained {untrained:.1f}, trained {trained:.1f}, rule {rule:.1f}")


if __name__ == "__main__":
    tyro.cli(main)
