"""PPO of Tianshou, on episodes that step in turn.

pip install -e '.[train]' tianshou
python examples/tianshou_ppo.py
dptse evaluate --env dptse_env:dptse/ShortHighway-v0 \
    --policies examples.slots_policy:SlotsPolicy=results/tianshou/policy.zip

Tianshou has batches of its own, made of scalar environments, and takes no vector environment of
Gymnasium. It has no distribution for several choices at once, so ``slots`` needs the four lines of
`slot_choices`; its `DiscreteActorPolicy` is for one choice, as in ``sequential``.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OnPolicyTrainerParams
from torch import nn
from torch.distributions import Categorical, Independent

from dptse_env.schedules import make_schedule
from examples.held_out import make_held_out, mean_error
from examples.slots_policy import SlotsPolicy


@dataclass(frozen=True)
class Args:
    """Train with PPO of Tianshou."""

    env: str = "dptse_env:dptse/ShortHighway-v0"
    """Environment id."""
    envs: int = 8
    """Episodes at once."""
    steps: int = 50_000
    """Steps to train for, at least."""
    batch: int = 2048
    """Steps of one iteration."""
    seed: int = 0
    """Seeds the environments, the actions and the weights."""
    output: Path = Path("results/tianshou")
    """Folder for policy.zip."""


class Network(nn.Module):
    """A perceptron with the call that Tianshou makes: a hidden state goes in and comes back."""

    def __init__(self, n_inputs: int, n_outputs: int) -> None:
        """Make layers for so many inputs and outputs."""
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(n_inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(),
            nn.Linear(64, n_outputs),
        )  # fmt: skip

    def forward(self, obs: Any, state: Any = None, info: Any = None) -> tuple[torch.Tensor, Any]:
        """Return the outputs for a batch of observations."""
        return self.layers(torch.as_tensor(obs, dtype=torch.float32)), state


class Critic(Network):
    """A network whose output is the value alone, as Tianshou expects of a critic."""

    def forward(self, obs: Any, **_: Any) -> torch.Tensor:  # type: ignore[override]
        """Return the values of a batch of observations, shape (n, 1)."""
        return super().forward(obs)[0]


def main(args: Args) -> None:
    """Train, and compare the policy with its untrained self and a schedule on held-out traffic."""
    torch.manual_seed(args.seed)
    np.random.seed(args.seed)  # noqa: NPY002 (Tianshou shuffles with the global generator)
    torch.set_num_threads(1)
    keywords = {"action": "slots", "horizon": 120, "random_start": True}
    held_out = make_held_out(args.env, keywords)
    observations, actions = held_out.single_observation_space, held_out.single_action_space
    size, n_slots = observations.shape[0], len(actions.nvec)

    def slot_choices(logits: torch.Tensor) -> Independent:
        return Independent(Categorical(logits=logits.unflatten(-1, (n_slots, -1))), 1)

    network = Network(size, int(actions.nvec.sum()))
    actor = ProbabilisticActorPolicy(
        actor=network, dist_fn=slot_choices, action_space=actions, observation_space=observations,
        action_scaling=False, action_bound_method=None,
    )  # fmt: skip
    algorithm = PPO(
        policy=actor, critic=Critic(size, 1), optim=AdamOptimizerFactory(lr=3e-4), gamma=0.9,
        ent_coef=0.01, max_grad_norm=0.5,
    )  # fmt: skip
    policy = SlotsPolicy(network.layers, observations, actions)
    untrained = mean_error(held_out, policy)

    envs = DummyVectorEnv([lambda: gym.make(args.env, **keywords) for _ in range(args.envs)])
    envs.seed(args.seed)
    collector = Collector(algorithm, envs, VectorReplayBuffer(2 * args.batch, args.envs))
    training = OnPolicyTrainerParams(
        training_collector=collector, max_epochs=1, epoch_num_steps=args.steps,
        collection_step_num_env_steps=args.batch, update_step_num_repetitions=4, batch_size=256,
        show_progress=False, verbose=False,
    )  # fmt: skip
    result = algorithm.run_training(training)
    policy.save(args.output / "policy.zip")
    trained = mean_error(held_out, policy)
    rule = mean_error(held_out, make_schedule("round-robin", held_out))
    print(f"{result.train_step} steps, {result.update_step} updates")
    print(f"mean error: untrained {untrained:.1f}, trained {trained:.1f}, round robin {rule:.1f}")
    print(f"the policy is in {args.output}/policy.zip")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
