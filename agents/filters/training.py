"""`FilterTraining`: runs a plan in a folder, and continues there after an interruption."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from agents.executors import THIS_PROCESS, AnyExecutor, run_in_order
from agents.filters.batches import Batch, draw_batch
from agents.filters.card import make_card
from agents.filters.collecting import Collected, CollectTask, run_collect
from agents.filters.plan import OWN, FilterPlan
from agents.filters.torch_network import RecurrentNetwork, State, second_loss
from agents.play import play
from agents.training.run_files import (
    Row,
    keep_plan,
    read_checkpoint,
    read_progress,
    write_checkpoint,
    write_progress,
)
from dptse_env.estimators.recurrent import read_network, write_network
from dptse_env.traffic import Records

WEIGHTS, PLAYED = "network.safetensors", "played.safetensors"
"""The trained network, and the network that the scenarios of a round are collected with."""
COLUMNS = ("update", "steps", "seconds", "round", "loss", "error", "rate", "validation", "chi2")
Watcher = Callable[[Row], None]


class FilterTraining:
    """A plan in a folder: a network, its optimiser, learning curve and checkpoints.

    A training that was killed continues from its last checkpoint to the same numbers, on the same
    machine with the same number of torch's threads. Scenarios are not stored: they are collected
    again, with the network that played them at first.

    Attributes:
        plan: The plan.
        folder: The folder.
        network: The network.
        done: Number of passes that are done.
        rows: The learning curve so far.
    """

    def __init__(
        self,
        plan: FilterPlan,
        folder: Path,
        *,
        records: Records = None,
        watchers: Sequence[Watcher] = (),
        progress: Callable[[str, float], None] = lambda stage, fraction: None,
        compiled: bool = False,
        executor: AnyExecutor = THIS_PROCESS,
    ) -> None:
        """Take the folder and restore its state.

        Args:
            plan: The plan.
            folder: The folder; made if it is missing.
            records: Library of records, or its folder; None for the user's cache.
            watchers: Receive every row of the learning curve, those read from the folder first.
            progress: Called with the name of a stage and the fraction of it that is done.
            compiled: Whether torch compiles the step, which takes a C++ compiler and half a minute
                and makes passes some 1.6 times as fast; the last digits of numbers depend on it.
            executor: Plays the scenarios.

        Raises:
            ValueError: The folder belongs to another plan, or its checkpoint is damaged.
            OSError: The folder cannot be written.
        """
        self.plan, self.folder, self._records = plan, folder, records
        self._executor = executor
        self._watchers, self._progress = watchers, progress
        checkpoint = read_checkpoint(folder)
        keep_plan(folder, plan.settings())
        torch.manual_seed(plan.seed)
        self.network = RecurrentNetwork(plan.width)
        if plan.initial is not None:
            self.network.take(read_network(plan.initial).network)
        self._step = torch.compile(self.network) if compiled else self.network
        self._optimiser = torch.optim.Adam(self.network.parameters(), plan.learning_rate)
        self.done, self._seconds = 0, 0.0
        self.rows: list[Row] = []
        if checkpoint is not None:
            self.network.load_state_dict(checkpoint["network"])
            self._optimiser.load_state_dict(checkpoint["optimiser"])
            self.done, self._seconds = checkpoint["done"], checkpoint["seconds"]
            self.rows = [row for row in read_progress(folder) if row["update"] <= self.done]
            for row in self.rows:
                self._watch(row)

    def run(self) -> None:
        """Train to the end of the plan, and leave the network beside the checkpoint."""
        while self.done < self.plan.n_passes:
            index = self.plan.round_of(self.done)
            first = sum(each.passes for each in self.plan.rounds[:index])
            if self.done == first:
                self._save(PLAYED)
            collected = self._collect(index)
            while self.done < first + self.plan.rounds[index].passes:
                self._pass(index, collected)
        self._save(WEIGHTS)

    def _collect(self, index: int) -> list[Collected]:
        estimator, network = self.plan.rounds[index].estimator, None
        if estimator == OWN:
            estimator, network = "recurrent", (self.folder / PLAYED).read_bytes()
        tasks = [
            CollectTask(scenario, estimator, network, self._records)
            for scenario in self.plan.scenarios(index)
        ]
        on_done = partial(self._progress, f"round {index + 1}, collecting")
        return run_in_order(self._executor, run_collect, tasks, on_done, progress=False)

    def _pass(self, index: int, collected: Sequence[Collected]) -> None:
        """Pass over some episodes, drawn from all scenarios on a road."""
        started = time.perf_counter()
        plan, rate = self.plan, self.plan.rate(self.done)
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        rng = np.random.default_rng([plan.seed, 2**31, self.done])
        batch = draw_batch(rng, collected, plan.episodes)
        state = self.network.begin(batch.start)
        losses, errors = [], []
        for first in range(0, len(batch.truth), plan.window):
            state, loss, error = self._window(batch, first, state)
            losses.append(loss)
            errors.append(error)
        self.done += 1
        self._seconds += time.perf_counter() - started
        row: Row = {
            "update": self.done, "steps": self.done * len(batch.truth) * len(batch.start),
            "seconds": round(self._seconds, 1), "round": index + 1, "rate": rate,
            "loss": float(np.mean(losses)), "error": float(np.mean(errors[1:] or errors)),
        }  # fmt: skip
        is_due = self.done % plan.checkpoint_every == 0 or self.done == plan.n_passes
        if is_due:
            row |= self._validate()
        self.rows.append(row)
        self._watch(row)
        if is_due:
            self._keep()

    def _window(self, batch: Batch, first: int, state: State) -> tuple[State, float, float]:
        """Update the weights by some seconds; return the state after them, loss and error."""
        plan, road, last = self.plan, batch.road, len(batch.truth)
        seconds = range(first, min(first + plan.window, last))
        # A leaf with gradients, like what follows: the step is then compiled once, not twice.
        state = state._replace(hidden=state.hidden.detach().requires_grad_())
        kept = []
        for t in seconds:
            state = self._step(road, batch.second(t), batch.outside[t], state)
            kept.append(state.hidden)
        present, ahead = self.network.read(road, torch.stack(kept))
        truth, after = (batch.truth[seconds.start + k : seconds.stop + k] for k in (0, 1))
        loss = second_loss(road, present, truth, plan.likelihood)
        error = float(second_loss(road, present.detach(), truth, 0.0))
        if len(after) > 0:
            of_next = second_loss(road, ahead[: len(after)], after, plan.likelihood)
            loss = loss + plan.prediction * of_next
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), plan.clip_norm)
        self._optimiser.step()
        return state, float(loss.detach()), error

    def _validate(self) -> Row:
        self._save(WEIGHTS)
        plan, cells = self.plan, self.plan.validation_cells(str(self.folder / WEIGHTS))
        played = [play(cell, plan.validation_seeds, self._records, threads=None) for cell in cells]
        rows = [row for each in played for row in each]
        return {
            "validation": -float(np.mean([row["reward"] for row in rows])),
            "chi2": float(np.mean([row["chi2_density"] for row in rows])),
        }

    def _save(self, name: str) -> None:
        card = make_card(self.plan, self.done, self.folder.name)
        write_network(self.folder / name, self.network.weights(), card)

    def _keep(self) -> None:
        write_progress(self.folder, self.rows, COLUMNS)
        content = {
            "network": self.network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "done": self.done,
            "seconds": self._seconds,
        }
        write_checkpoint(self.folder, content)

    def _watch(self, row: Row) -> None:
        for watcher in self._watchers:
            watcher(row)
