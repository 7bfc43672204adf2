"""PPO of Ray RLlib (new API stack), on single episodes or on a batch that steps as one.

pip install -e '.[train]' 'ray[rllib]==2.60.0'
python examples/rllib_ppo.py
python examples/rllib_ppo.py --lstm
python examples/rllib_ppo.py --vectorize sync --envs 4
dptse evaluate --env dptse_env:dptse/ShortHighway-v0 \
    --policies examples.rllib_policy:RLlibPolicy=results/rllib/policy.zip

RLlib makes its environments with ``gym.make_vec``, and ``gym_env_vectorize_mode`` says how. Its
default, ``sync``, steps scalar environments in turn; ``vector_entry_point`` asks for
`dptse_env.vector_env.SensorQueryVectorEnv`, which steps them at once. RLlib expects the autoreset
of the next step, our default.

RLlib cannot act in `MultiBinary`, the space of the default encoding. ``slots`` suits it best: one
categorical choice for each query. ``--lstm`` adds a memory. The new API stack has no model with
attention; one would be a module of one's own (``RLModuleSpec(module_class=...)``).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import ray
import torch
import tyro
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from dptse_env.schedules import make_schedule
from examples.held_out import make_held_out, mean_error
from examples.rllib_policy import RLlibPolicy


@dataclass(frozen=True)
class Args:
    """Train with PPO of RLlib."""

    env: str = "dptse_env:dptse/ShortHighway-v0"
    """Environment id."""
    action: Literal["slots", "scores", "sequential"] = "slots"
    """Action encoding."""
    vectorize: Literal["sync", "vector_entry_point"] = "vector_entry_point"
    """How RLlib steps its environments: one by one, or as a batch."""
    envs: int = 64
    """Episodes at once in each env runner."""
    runners: int = 0
    """Processes that collect episodes; with 0 the main process does."""
    lstm: bool = False
    """Whether the network has a memory."""
    steps: int = 300_000
    """Steps to train for, at least."""
    batch: int = 4096
    """Steps of one iteration."""
    seed: int = 0
    """Seeds the environments, the actions and the weights."""
    output: Path = Path("results/rllib")
    """Folder for the checkpoint of the algorithm and for policy.zip."""


def one_thread(**_: Any) -> None:
    """Keep each env runner to one core: the networks are small, and there may be many runners."""
    torch.set_num_threads(1)


def make_config(args: Args, keywords: dict[str, Any]) -> PPOConfig:
    """Return the configuration of the algorithm."""
    if args.vectorize == "vector_entry_point":
        keywords = {**keywords, "threads": 1}  # the estimator's; only the batch has this keyword
    model = DefaultModelConfig(
        fcnet_hiddens=[64, 64], use_lstm=args.lstm, lstm_cell_size=64, max_seq_len=20
    )
    return (
        PPOConfig()
        .environment(args.env, env_config=keywords)
        .env_runners(
            num_env_runners=args.runners,
            num_envs_per_env_runner=args.envs,
            gym_env_vectorize_mode=args.vectorize,
        )
        .callbacks(on_environment_created=one_thread)
        .rl_module(model_config=model)
        .training(train_batch_size_per_learner=args.batch, minibatch_size=256, num_epochs=4)
        .training(lr=3e-4, gamma=0.9, entropy_coeff=0.003)
        .debugging(seed=args.seed)
    )


def main(args: Args) -> None:
    """Train, and compare the policy with its untrained self and a schedule on held-out traffic."""
    keywords = {"action": args.action, "horizon": 120, "random_start": True}
    held_out = make_held_out(args.env, keywords)
    ray.init(
        address="local", include_dashboard=False, log_to_driver=False,
        runtime_env={"env_vars": {"OMP_NUM_THREADS": "1"}},
    )  # fmt: skip
    algorithm = make_config(args, keywords).build_algo()
    untrained = mean_error(held_out, RLlibPolicy(algorithm.get_module()))
    steps = 0
    while steps < args.steps:
        collected = algorithm.train()["env_runners"]
        steps = int(collected["num_env_steps_sampled_lifetime"])
        print(
            f"{steps} steps, mean return {collected.get('episode_return_mean', float('nan')):.2f}"
        )
    folder = args.output.resolve()
    algorithm.save_to_path(folder / "checkpoint")
    policy = RLlibPolicy(algorithm.get_module())
    policy.save(folder / "policy.zip")
    trained = mean_error(held_out, policy)
    algorithm.stop()
    ray.shutdown()
    rule = mean_error(held_out, make_schedule("round-robin", held_out))
    print(f"mean error: untrained {untrained:.1f}, trained {trained:.1f}, round robin {rule:.1f}")
    print(f"the policy is in {args.output}/policy.zip")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
