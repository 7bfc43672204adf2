"""`train`: runs a plan in a folder, and goes on there after an interruption."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

from agents.environments import make_vector
from agents.executors import Executor, ExecutorError, run_shown
from agents.files import check_plan, keep_plan, write_json
from agents.play import record
from agents.seeds import training_seed
from agents.training.learning import learn
from agents.training.plan import TrainingPlan, make_policies
from agents.training.regression import Practice, regress
from agents.training.run import POLICY, RULES_FILE, Run, keep_rules
from agents.training.run_files import Row, read_checkpoint
from agents.training.settings import PlackettLuceSettings
from agents.training.swaps import raise_scores, try_swaps
from dptse_env.sb3 import RoadPolicy, SB3VecEnv
from dptse_env.traffic import Records


def train(plan: TrainingPlan, folder: Path, *, records: Records = None) -> list[Row]:
    """Train to the end of a plan in its folder, and return the learning curve.

    The folder gets ``plan.json``, ``rules.json`` (errors of rules on validation traffic),
    ``checkpoint.pt``, ``progress.csv`` and ``curve.png`` (the learning curve),
    ``best.safetensors`` and ``policy.safetensors`` (the policy best in validation, and the last).
    What is there already is gone on with.

    Args:
        plan: The plan.
        folder: The folder; made if it is missing.
        records: Library of records, or its folder; None for the user's cache.

    Raises:
        ValueError: The algorithm cannot train in the environments, the folder belongs to another
            plan, or its checkpoint is damaged.
        OSError: The folder cannot be written; the last checkpoint stays.
    """
    run = Run(plan, folder, records)
    with run.bar:
        (train_in_rounds if isinstance(plan.algorithm, PlackettLuceSettings) else learn)(run)
    run.finish()
    return run.rows


def train_in_rounds(run: Run) -> None:
    """Train a `RoadPolicy` in rounds: the regression, then those of swaps.

    Every round leaves a checkpoint with everything that the next one depends on: a training that
    was killed repeats at most the round that it was in. With a number of rounds it goes on to the
    same bits, on the same machine with the same number of torch's threads.
    """
    plan, algorithm, kept = run.plan, run.plan.algorithm, run.checkpoint
    assert isinstance(algorithm, PlackettLuceSettings)
    torch.manual_seed(plan.seed)
    policies = make_policies(algorithm, plan.worlds)
    # Draws of the training must not depend on how many weights were drawn before them.
    torch.manual_seed(training_seed(plan.seed))
    if kept is not None:
        policies[0].load_state_dict(kept["policy"])
        torch.set_rng_state(kept["torch"])

    def end(steps: int, values: Row) -> None:
        run.add(steps, {**values, **run.validate(policies, steps)})
        run.keep(policy=policies[0].state_dict(), torch=torch.get_rng_state())

    if kept is None:
        end(_regress(run, algorithm, policies), {})
    settings, lasted = algorithm.swaps, 0.0

    def next_round() -> float | None:
        """Return the fraction of the way to the last round; None if there is no further one."""
        if plan.minutes is not None and settings.rounds:
            done = run.done(run.steps)
            return done if done + 0.5 * lasted < 1.0 else None  # half of it must fit
        index = len(run.rows) - 1
        return index / max(settings.rounds - 1, 1) if index < settings.rounds else None

    environments = [
        make_vector(world.env, world.part(settings.episodes), {**world.keywords, **run.keywords})
        for world in plan.worlds
        if next_round() is not None
    ]
    # In every fork the seconds of an episode pass once more, under noise and its opposite.
    seconds = sum(env.num_envs * env.config.horizon_steps for env in environments)
    seconds *= 1 + 2 * (1 + settings.trials)
    while (done := next_round()) is not None:
        index = len(run.rows) - 1
        tried = [
            try_swaps(policy, env, settings, index, plan.seed)
            for policy, env in zip(policies, environments, strict=True)
        ]
        step = settings.step + (settings.final_step - settings.step) * done
        raise_scores(policies, tried, settings, step)
        error = sum(float(swaps.error.mean()) for swaps in tried) / len(tried)
        end(run.steps + seconds, {"error": error})
        lasted = run.done(run.steps) - done if plan.minutes is not None else 0.0


def _regress(run: Run, algorithm: PlackettLuceSettings, policies: Sequence[RoadPolicy]) -> int:
    """Do the regression; return the seconds of traffic that it took. Its memory is freed then."""
    settings = algorithm.regression
    if not settings.rounds:
        return 0
    practice, seconds = [], 0
    for world, policy in zip(run.plan.worlds, policies, strict=True):
        given = {**world.keywords, **run.keywords, "autoreset_mode": "SameStep"}
        n = world.part(algorithm.n_envs, algorithm.replicas)
        episodes = SB3VecEnv(gym.make_vec(world.env, num_envs=n, **given), algorithm.replicas)
        episodes.seed(training_seed(run.plan.seed))
        practice.append(Practice(policy, episodes, world.part(settings.batch_size)))
        seconds += n * settings.seconds * settings.rounds
    regress(practice, settings)
    return seconds


def train_all(
    plans: Mapping[Path, TrainingPlan],
    executor: Executor,
    *,
    records: Records = None,
) -> None:
    """Train every plan in its folder to the end; what the folders have is gone on with.

    A worker trains in the folder itself. Where it is lost, the executor runs its task again, and
    the training goes on from its last checkpoint.

    Args:
        plans: Plans by folder. Folders are made where they are missing; nodes of a cluster have to
            share them.
        executor: Runs the trainings.
        records: Library of records, or its folder; None for the user's cache.

    Raises:
        ValueError: A folder belongs to another plan, or its checkpoint is damaged.
        OSError: A folder cannot be written.
        ExecutorError: Workers died again and again, or write to other disks than this machine's.
    """
    for folder, plan in plans.items():
        read_checkpoint(folder)
        check_plan(folder, plan.content())
    for folder, plan in plans.items():
        keep_plan(folder, plan.content())
    rules: dict[Any, dict[str, float]] = {}
    for folder, plan in plans.items():
        traffic = plan.envs, plan.validation_seeds
        if traffic not in rules:
            rules[traffic] = keep_rules(plan, folder, records)
        write_json(folder / RULES_FILE, rules[traffic])
    work = partial(_train_there, records=records)
    tasks = [(plan, folder.absolute()) for folder, plan in plans.items()]

    def take(index: int, _: None) -> None:
        folder = tasks[index][1]
        if not (folder / POLICY).exists():
            raise ExecutorError(
                f"a worker has trained in {folder}, which is not on a disk that it shares "
                "with this machine: choose an --output that all nodes have"
            )

    run_shown(executor, work, tasks, take, desc="training", unit="training")


def _train_there(task: tuple[TrainingPlan, Path], records: Records) -> None:
    plan, folder = task
    torch.set_num_threads(1)
    for world in plan.worlds:
        seeds = (*plan.traffic_seeds, *plan.validation_seeds)
        record(world.config.corridor, seeds, records)
    train(plan, folder, records=records)
