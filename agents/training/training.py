"""`train`: runs a plan in a folder, and goes on there after an interruption."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch

from agents.environments import make_vector
from agents.executors import AnyExecutor, ExecutorError, run_shown
from agents.play import record
from agents.seeds import training_seed
from agents.training.episodes import make_episodes
from agents.training.plan import (
    Algorithm,
    MaskablePPOSettings,
    PlackettLuceSettings,
    PPOSettings,
    Regression,
    TrainingPlan,
)
from agents.training.ppo import train_by_ppo
from agents.training.regression import Practice, regress
from agents.training.run import POLICY, Progress, Run, Watcher
from agents.training.run_files import Row, check_plan, read_checkpoint
from agents.training.swaps import raise_scores, try_swaps
from dptse_env.sb3 import RoadPolicy
from dptse_env.traffic import Records


def train(
    plan: TrainingPlan,
    folder: Path,
    *,
    records: Records = None,
    watchers: Sequence[Watcher] = (),
    progress: Progress = lambda stage, fraction: None,
) -> list[Row]:
    """Train to the end of a plan in its folder, and return the learning curve.

    The folder gets ``plan.json``, ``checkpoint.pt``, ``progress.csv`` (the curve),
    ``best.safetensors`` and ``policy.safetensors`` (the policy best in validation, and the last).
    What is there already is gone on with.

    Args:
        plan: The plan.
        folder: The folder; made if it is missing.
        records: Library of records, or its folder; None for the user's cache.
        watchers: Receive every row of the curve, those of the checkpoint first.
        progress: Called between two rows with the name of a stage and the fraction of it that is
            done.

    Raises:
        ValueError: The algorithm cannot train in the environments, the folder belongs to another
            plan, or its checkpoint is damaged.
        OSError: The folder cannot be written; the last checkpoint stays.
    """
    run = Run(plan, folder, records, watchers, progress)
    TRAINERS[type(plan.algorithm)](run)
    return run.rows


def train_in_rounds(run: Run) -> None:
    """Train a `RoadPolicy` in rounds: the regression, then those of swaps.

    Every round leaves a checkpoint with everything that the next one depends on: a training that
    was killed goes on to the same bits, on the same machine with the same number of torch's
    threads, and repeats at most the round that it was in.
    """
    plan, algorithm, kept = run.plan, run.plan.algorithm, run.checkpoint
    assert isinstance(algorithm, PlackettLuceSettings)
    torch.manual_seed(plan.seed)
    policies = algorithm.make_policies(plan.worlds)
    # Draws of the training must not depend on how many weights were drawn before them.
    torch.manual_seed(training_seed(plan.seed))
    if kept is not None:
        policies[0].load_state_dict(kept["policy"])
        torch.set_rng_state(kept["torch"])

    def end(update: int, steps: int, values: Row) -> None:
        errors = run.validate(policies, steps)
        run.add(update, steps, {**values, **errors})
        run.keep(update=update, policy=policies[0].state_dict(), torch=torch.get_rng_state())

    if kept is None:
        end(0, _regress(run, algorithm.regression, policies), {})
    done, settings = len(run.rows) - 1, algorithm.swaps
    environments = [
        make_vector(world.env, world.part(settings.episodes), {**world.keywords, **run.keywords})
        for world in plan.worlds
        if done < settings.rounds
    ]
    # In every fork the seconds of an episode pass once more, under noise and its opposite.
    seconds = sum(env.num_envs * env.config.horizon_steps for env in environments)
    seconds *= 1 + 2 * (1 + settings.trials)
    for index in range(done, settings.rounds):
        tried = [
            try_swaps(policy, env, settings, index, plan.seed, partial(run.progress, "swaps"))
            for policy, env in zip(policies, environments, strict=True)
        ]
        step = settings.step_of(index)
        raise_scores(policies, tried, settings, step, partial(run.progress, "fit"))
        error = sum(float(swaps.error.mean()) for swaps in tried) / len(tried)
        end(index + 1, int(run.rows[-1]["steps"]) + seconds, {"error": error})
    run.save(POLICY, policies[0], run.rows[-1])


def _regress(run: Run, settings: Regression, policies: Sequence[RoadPolicy]) -> int:
    """Do the regression; return the seconds of traffic that it took. Its memory is freed then."""
    if not settings.rounds:
        return 0
    practice, seconds = [], 0
    for world, policy in zip(run.plan.worlds, policies, strict=True):
        episodes = make_episodes(run.plan, world, run.keywords)
        practice.append(Practice(policy, episodes, world.part(settings.batch_size)))
        seconds += episodes.num_envs * settings.seconds * settings.rounds
    regress(practice, settings, partial(run.progress, "regression"))
    return seconds


TRAINERS: dict[type[Algorithm], Callable[[Run], None]] = {
    PlackettLuceSettings: train_in_rounds,
    PPOSettings: train_by_ppo,
    MaskablePPOSettings: train_by_ppo,
}
"""Functions that train, by the type of the algorithm's settings."""


def train_all(
    plans: Mapping[Path, TrainingPlan],
    executor: AnyExecutor,
    *,
    records: Records = None,
    threads: int = 1,
    progress: bool = True,
) -> None:
    """Train every plan in its folder to the end; what the folders have is gone on with.

    A worker trains in the folder itself. Where it is lost, the executor runs its task again, and
    the training goes on from its last checkpoint.

    Args:
        plans: Plans by folder; folders are made where they are missing. Nodes of a cluster have to
            share them.
        executor: Runs the trainings.
        records: Library of records, or its folder; None for the user's cache.
        threads: Threads of torch in each training; numbers depend on it in the last digits.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: A folder belongs to another plan, or its checkpoint is damaged.
        OSError: A folder cannot be written.
        ExecutorError: Workers died again and again, or write to other disks than this machine's.
    """
    for folder, plan in plans.items():
        read_checkpoint(folder)
        check_plan(folder, plan.content())
    work = partial(_train_there, records=records, threads=threads)
    tasks = [(plan, folder.absolute()) for folder, plan in plans.items()]

    def take(task: tuple[TrainingPlan, Path], _: None) -> None:
        if not (task[1] / POLICY).exists():
            raise ExecutorError(
                f"a worker has trained in {task[1]}, which is not on a disk that it shares "
                "with this machine: choose an --output that all nodes have"
            )

    run_shown(executor, work, tasks, take, progress=progress, desc="training", unit="training")


def _train_there(task: tuple[TrainingPlan, Path], records: Records, threads: int) -> None:
    plan, folder = task
    torch.set_num_threads(threads)
    for world in plan.worlds:
        seeds = (*plan.traffic_seeds, *plan.validation_seeds)
        record(world.config.corridor, seeds, records)
    train(plan, folder, records=records)
