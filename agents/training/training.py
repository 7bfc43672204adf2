"""`Training`: runs a plan in a folder, and goes on in it after an interruption."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from agents.evaluation.episodes import make_vector
from agents.experiments.provenance import take_folder
from agents.training.episodes import TrainingEpisodes
from agents.training.folder import (
    Row,
    read_checkpoint,
    read_progress,
    write_checkpoint,
    write_progress,
)
from agents.training.improvement import swap_round
from agents.training.learners import acting, make_episodes, make_model
from agents.training.plan import TrainingPlan
from agents.training.pretraining import pretrain
from agents.training.recipes import PlackettLuceRecipe
from agents.training.validation import Validation
from dptse_env.sb3 import PlackettLucePolicy
from dptse_env.sb3.saved import save_policy

POLICY, BEST = "policy.zip", "best.zip"

_LOGGED = {
    "learning_rate": "train/learning_rate",
    "kl": "train/approx_kl",
    "clipped": "train/clip_fraction",
    "entropy": "train/entropy_loss",
    "explained_variance": "train/explained_variance",
    "value_loss": "train/value_loss",
}


class Watcher(Protocol):
    """Is told of every row of the learning curve as it comes."""

    def __call__(self, row: Row) -> None:
        """Take a row."""


def _silent(_what: str, _share: float) -> None:
    """Tell nobody."""


class Training:
    """A plan in a folder: a pretraining, rounds of swaps, updates of PPO, whichever it has.

    After every round and update the whole state is at hand: weights, optimiser, generators, and of
    PPO's episodes their seeds and actions so far (`agents.training.episodes`); rounds begin
    episodes of their own. A checkpoint holds it, so that a training that was killed goes on to the
    same numbers as one that was not, on the same machine with the same number of torch's threads.
    """

    def __init__(
        self,
        plan: TrainingPlan,
        folder: Path,
        *,
        records: str | None = None,
        commit: str | None = None,
        watchers: tuple[Watcher, ...] = (),
        on_share: Callable[[str, float], None] = _silent,
    ) -> None:
        """Take the folder and pick up what is in it.

        Args:
            plan: What is trained.
            folder: Where; made if it is missing.
            records: Folder of the record cache; None for the user's cache.
            commit: State of the sources, for the record.
            watchers: Told of every row, of those read back first.
            on_share: Told what is being done between two rows, and the share of it that is done.

        Raises:
            ValueError: The folder belongs to another plan, or its checkpoint is damaged.
            OSError: The folder cannot be written.
        """
        self.plan, self.folder, self._watchers = plan, folder, watchers
        self._on_share = on_share
        self.config = plan.config
        take_folder(folder, plan.provenance(commit))
        keywords = {**plan.keywords, "records": records}
        recipe = plan.recipe
        self._keywords = {**keywords, "traffic_seeds": list(plan.traffic_seeds)}
        self._episodes = make_episodes(plan.env, self._keywords, recipe, plan.seed)
        self._validation = Validation(
            plan.env, {**keywords, "action": recipe.action}, plan.validation_seeds
        )
        self.model: OnPolicyAlgorithm = make_model(recipe, self._episodes, plan.seed)
        self.rows: list[Row] = []
        self._rounds, self._seconds, self._best = 0, 0.0, float("inf")
        self._resume()

    @property
    def update(self) -> int:
        """Rounds and updates done."""
        return self._rounds + self.model.num_timesteps // self.plan.recipe.steps_per_update

    @property
    def is_finished(self) -> bool:
        """Whether all updates are done."""
        return self.update >= self.plan.n_updates

    def run(self) -> None:
        """Train until the plan is fulfilled; leave the policy beside the checkpoint.

        Raises:
            OSError: The disk is full or cannot be written; the last checkpoint stays.
        """
        if not self.rows:
            self._at_boundary(self._pretrain())
        if self._rounds < self.plan.recipe.rounds.rounds:
            self._swap()
        left = self.plan.n_updates - self.update
        if left > 0:
            callback = _Boundary(self._at_boundary, self._episodes)
            steps = left * self.plan.recipe.steps_per_update
            self.model.learn(steps, callback=callback, log_interval=None, reset_num_timesteps=False)
        self._save(POLICY)

    def _pretrain(self) -> float:
        """Do what the recipe holds ahead of everything else; return the seconds it took."""
        recipe, began = self.plan.recipe, time.perf_counter()
        if isinstance(recipe, PlackettLuceRecipe) and recipe.pretraining_rounds:
            pretrain(self._policy, self._episodes, recipe, partial(self._on_share, "regression"))
        return time.perf_counter() - began

    def _swap(self) -> None:
        """Do the rounds of swaps that are left, in episodes that go when they are done."""
        plan, rounds = self.plan, self.plan.recipe.rounds
        keywords = {**self._keywords, "action": plan.recipe.action}
        env = make_vector(plan.env, rounds.episodes, keywords)
        actor = acting(self.model, self._episodes)
        while self._rounds < rounds.rounds:
            began = time.perf_counter()
            error = swap_round(plan, self._rounds, env, self._policy, actor, self._on_share)
            self._rounds += 1
            self._at_boundary(time.perf_counter() - began, error)

    @property
    def _policy(self) -> PlackettLucePolicy:
        policy = self.model.policy
        assert isinstance(policy, PlackettLucePolicy)
        return policy

    def _at_boundary(self, seconds: float, error: float | None = None) -> None:
        """Note a round or an update that is done; PPO calls it before its first one, too."""
        update, plan = self.update, self.plan
        if self.rows and self.rows[-1]["update"] == update:
            return  # where a training was picked up, or PPO begins
        self._seconds += seconds
        row: Row = {
            "update": update,
            "steps": plan.steps_at(update),
            "seconds": round(self._seconds, 1),
        }
        by_ppo, last = update - plan.recipe.rounds.rounds, update == plan.n_updates
        if by_ppo > 0:
            values = self.model.logger.name_to_value
            row["error"] = -self._episodes.take_mean_reward()
            row |= {name: float(values[key]) for name, key in _LOGGED.items()}
        elif error is not None:
            row["error"] = error
        if by_ppo <= 0 or by_ppo % plan.validate_every == 0 or last:
            self._validate(row)
        self.rows.append(row)
        for watcher in self._watchers:
            watcher(row)
        if by_ppo <= 0 or by_ppo % plan.checkpoint_every == 0 or last:
            self._keep()

    def _validate(self, row: Row) -> None:
        policy = acting(self.model, self._episodes)
        for name, deterministic in (("validation", True), ("validation_drawn", False)):
            row[name] = float(self._validation.errors(policy, deterministic=deterministic).mean())
        if row["validation"] < self._best:
            self._best = row["validation"]
            self._save(BEST, row)

    def _save(self, name: str, row: Row | None = None) -> None:
        plan, shown = self.plan, row or self.rows[-1]
        figures = {
            f"error on {len(plan.validation_seeds)} validation episodes, {how}": shown[key]
            for key, how in (("validation", "deterministic"), ("validation_drawn", "drawn"))
        }
        save_policy(
            self.folder / name,
            self.model.policy,
            self.config,
            env=plan.env,
            keywords=plan.keywords,
            training={
                "learner": plan.recipe.learner,
                "seed": plan.seed,
                "steps": int(shown["steps"]),
                "traffic seeds": _range(plan.traffic_seeds),
                "validation seeds": _range(plan.validation_seeds),
            },
            figures=figures,
        )

    def _keep(self) -> None:
        write_progress(self.folder, self.rows)
        model = self.model
        name, keys, *position = np.random.get_state()  # noqa: NPY002  stable-baselines3 draws there
        assert isinstance(name, str)
        # Ahead of PPO, which begins them, there is nothing to keep of its episodes.
        state = self._episodes.state() if model.num_timesteps else {}
        content = {
            "update": self.update,
            "rounds": self._rounds,
            "steps": model.num_timesteps,
            "n_updates": model._n_updates,
            "policy": model.policy.state_dict(),
            "optimizer": model.policy.optimizer.state_dict(),
            "torch": torch.get_rng_state(),
            "numpy": [torch.from_numpy(np.asarray(keys).astype(np.int64)), *position],
            "starts": torch.from_numpy(self._last_starts()),
            "episodes": {key: torch.from_numpy(value) for key, value in state.items()},
            "best": self._best,
        }
        write_checkpoint(self.folder, content)

    def _last_starts(self) -> Any:
        starts = self.model._last_episode_starts
        if starts is None:
            return np.ones(self.plan.recipe.n_envs, dtype=bool)
        return starts

    def _resume(self) -> None:
        """Pick up the checkpoint of the folder, if there is one."""
        kept = read_checkpoint(self.folder)
        if kept is None:
            return
        self.rows = [row for row in read_progress(self.folder) if row["update"] <= kept["update"]]
        self._best, self._seconds = kept["best"], self.rows[-1]["seconds"]
        self._rounds = kept["rounds"]
        model = self.model
        model.policy.load_state_dict(kept["policy"])
        model.policy.optimizer.load_state_dict(kept["optimizer"])
        model.num_timesteps, model._n_updates = kept["steps"], kept["n_updates"]
        if kept["steps"]:
            state = {key: value.numpy() for key, value in kept["episodes"].items()}
            model._last_obs = self._episodes.restore(state)
            model._last_episode_starts = kept["starts"].numpy()
        torch.set_rng_state(kept["torch"])
        keys, *position = kept["numpy"]
        np.random.set_state(("MT19937", keys.numpy().astype(np.uint32), *position))  # noqa: NPY002
        for row in self.rows:
            for watcher in self._watchers:
                watcher(row)


class _Boundary(BaseCallback):
    """Calls back between two updates, when all episodes stand still, with the seconds passed."""

    def __init__(self, call: Callable[[float], None], episodes: TrainingEpisodes) -> None:
        super().__init__()
        self._call, self._episodes, self._since = call, episodes, time.perf_counter()

    def _on_rollout_start(self) -> None:
        self._tell()

    def _on_rollout_end(self) -> None:
        buffer = self.locals["rollout_buffer"]
        self._episodes.recentre(buffer.advantages)

    def _on_training_end(self) -> None:
        self._tell()

    def _on_step(self) -> bool:
        return True

    def _tell(self) -> None:
        now = time.perf_counter()
        self._call(now - self._since)
        self._since = time.perf_counter()


def _range(seeds: tuple[int, ...]) -> str:
    contiguous = seeds == tuple(range(seeds[0], seeds[0] + len(seeds)))
    return f"{seeds[0]}..{seeds[-1]}" if contiguous else ", ".join(map(str, seeds))
