"""PPO made of TorchRL's parts, on a batch of episodes that steps as one.

pip install -e '.[train]' torchrl
python examples/torchrl_ppo.py
dptse evaluate --env dptse_env:dptse/ShortHighway-v0 \
    --policies examples.slots_policy:SlotsPolicy=results/torchrl/policy.zip

`GymWrapper` takes our vector environment where it is made with ``autoreset_mode="Disabled"``:
TorchRL resets each episode itself when it has ended. ``--scalar`` shows `GymEnv`, one episode at a
time. All encodings work; here ``slots``, with one categorical choice for each query.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
import tyro
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical, Independent
from torchrl.collectors import Collector
from torchrl.envs.libs.gym import GymEnv, GymWrapper
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from dptse_env.schedules import make_schedule
from examples.held_out import make_held_out, mean_error
from examples.slots_policy import SlotsPolicy


@dataclass(frozen=True)
class Args:
    """Train with PPO of TorchRL."""

    env: str = "dptse_env:dptse/ShortHighway-v0"
    """Environment id."""
    scalar: bool = False
    """Whether to collect one episode at a time."""
    envs: int = 64
    """Episodes at once, if not scalar."""
    steps: int = 300_000
    """Steps to train for, at least."""
    batch: int = 4096
    """Steps of one iteration."""
    seed: int = 0
    """Seeds the environments, the actions and the weights."""
    output: Path = Path("results/torchrl")
    """Folder for policy.zip."""


class SlotChoices(Independent):
    """A categorical distribution for each of B slots, with logits of shape (..., B, n)."""

    def __init__(self, logits: torch.Tensor) -> None:
        """Take the logits of the options."""
        super().__init__(Categorical(logits=logits), 1)


def make_env(args: Args, keywords: dict[str, Any]) -> Any:
    """Return an environment of TorchRL: one episode, or a batch."""
    if args.scalar:
        return GymEnv(args.env, categorical_action_encoding=True, **keywords)
    batch = {"num_envs": args.envs, "autoreset_mode": "Disabled", "threads": 1}
    return GymWrapper(gym.make_vec(args.env, **batch, **keywords))


def main(args: Args) -> None:
    """Train, and compare the policy with its untrained self and a schedule on held-out traffic."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    keywords = {"action": "slots", "horizon": 120, "random_start": True}
    held_out = make_held_out(args.env, keywords)
    observations, actions = held_out.single_observation_space, held_out.single_action_space
    size, n_slots, n_options = observations.shape[0], len(actions.nvec), int(actions.nvec[0])

    network = nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, n_slots * n_options))
    logits = nn.Sequential(network, nn.Unflatten(-1, (n_slots, n_options)))
    actor = ProbabilisticActor(
        TensorDictModule(logits, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=SlotChoices,
        return_log_prob=True,
    )
    critic = ValueOperator(nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 1)))
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)

    policy = SlotsPolicy(network, observations, actions)
    untrained = mean_error(held_out, policy)
    env = make_env(args, keywords)
    env.set_seed(args.seed)
    total = -(-args.steps // args.batch) * args.batch
    collector = Collector(
        env, actor, frames_per_batch=args.batch, total_frames=total,
        auto_register_policy_transforms=False,  # they serve policies with a memory
    )  # fmt: skip
    for iteration, data in enumerate(collector, start=1):
        for _ in range(4):
            with torch.no_grad():
                advantage(data)
            flat = data.reshape(-1)
            for rows in torch.randperm(len(flat)).split(512):
                parts = loss(flat[rows])
                optimiser.zero_grad()
                (parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        reward = data["next", "reward"].mean().item()
        print(f"{iteration * args.batch} steps, mean reward {reward:.4f}")
    policy.save(args.output / "policy.zip")
    trained = mean_error(held_out, policy)
    rule = mean_error(held_out, make_schedule("round-robin", held_out))
    print(f"mean error: untrained {untrained:.1f}, trained {trained:.1f}, round robin {rule:.1f}")
    print(f"the policy is in {args.output}/policy.zip")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
