"""`FilterTraining`: a training in a folder, which continues there after an interruption."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from agents.executors import Executor, run_in_order, this_process
from agents.filters.collecting import Batch, Episodes, collect, draw_batch
from agents.filters.network import RecurrentNetwork, second_loss, teacher_loss
from agents.filters.plan import OWN, FilterPlan, played_by
from agents.play import play
from agents.training.run_files import Row, TrainingFolder
from dptse_env.estimators.recurrent import outside, read_weights, write_weights
from dptse_env.estimators.recurrent_kernels import LONGEST_AGE, Weights
from dptse_env.importers.folder import ROAD, new_folder
from dptse_env.traffic import Records, open_library
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.progress import make_bar

WEIGHTS, PLAYED = "weights.safetensors", "played.safetensors"
"""The trained weights, and those that the scenarios of a round are collected with."""
SECTIONS = "sections"
"""Folder of the sections to validate on."""
WINDOW = 50
"""Seconds over which gradients are propagated."""
LIKELIHOOD, PREDICTION = 0.03, 0.3
"""Weights in the loss of the likelihood, and of the predictions."""
LARGEST_NORM = 1.0
"""Norm to which longer gradients are clipped."""
AVERAGING = 0.998
"""Decay of the moving average of weights in an update. Batches differ so much that the last weights
are biased towards the last batches: densities were 4 to 11 veh/km too large."""


class State(NamedTuple):
    """The state of C cells after a second."""

    hidden: Tensor  # (C, H)
    predicted: FloatArray  # of the next second, with deviations, (C, 4)
    age: FloatArray  # seconds since the last measurement of each cell, (C,)


def _begin(batch: Batch, width: int) -> State:
    """Return the state before the first second."""
    n = len(batch.start)
    return State(torch.zeros(n, width), batch.start, np.full(n, LONGEST_AGE))


def _advance(
    network: RecurrentNetwork, batch: Batch, window: range, state: State
) -> tuple[State, Tensor, Tensor]:
    """Return the state after some seconds, and the estimates of them and of the next ones."""
    (hidden, predicted, age), kept = state, []
    hidden = hidden.detach()
    for t in window:
        hidden = network(batch.roads, batch.features(t, predicted, age), hidden)
        predicted = network.read(batch.roads, hidden.detach())[1].detach().numpy().astype(float)
        kept.append(hidden)
    return State(hidden, predicted, age), *network.read(batch.roads, torch.stack(kept))


class FilterTraining(TrainingFolder):
    """The training of a recurrent network.

    A training that was killed continues from its last checkpoint to the same numbers, on the same
    machine with the same number of torch's threads. Scenarios are not stored: they are collected
    again, with the weights of the first time.

    Attributes:
        plan: The plan.
        network: The network after the last update; its moving average is played and saved.
        done: Number of passes that are done.
    """

    def __init__(
        self,
        plan: FilterPlan,
        folder: Path,
        *,
        records: Records = None,
        executor: Executor = this_process,
    ) -> None:
        """Take a folder, and what it has; see `TrainingFolder`.

        Args:
            plan: The plan.
            folder: The folder; made if it is missing.
            records: Library of records, or its folder; None for the user's cache.
            executor: Plays the scenarios.
        """
        super().__init__(folder, plan.settings())
        self.plan, self._records, self._executor = plan, records, executor
        torch.manual_seed(plan.seed)
        self.network = RecurrentNetwork(plan.width)
        if plan.initial is not None:
            self.network.take(read_weights(plan.initial).weights)
        self._optimiser = torch.optim.Adam(self.network.parameters(), plan.learning_rate)
        self._average = copy.deepcopy(self.network)
        self._taught_by = read_weights(plan.teacher_weights) if plan.teacher_weights else None
        self._teacher = None
        if self._taught_by is not None and plan.teacher > 0.0:
            weights = self._taught_by.weights
            self._teacher = RecurrentNetwork(weights.width)
            self._teacher.take(weights)
        self.done, self._seconds = 0, 0.0
        if self.checkpoint is not None:
            self.network.load_state_dict(self.checkpoint["network"])
            self._optimiser.load_state_dict(self.checkpoint["optimiser"])
            self._average.load_state_dict(self.checkpoint["average"])
            self.done, self._seconds = self.checkpoint["done"], self.checkpoint["seconds"]

    def run(self) -> None:
        """Train to the end of the plan, and save the weights beside the checkpoint."""
        last, n = 0, self.plan.n_passes
        with make_bar(n, desc="training", unit="pass", initial=self.done) as bar:
            for index, each in enumerate(self.plan.rounds):
                first, last = last, last + each.passes
                if self.done == first:
                    self._save(PLAYED)
                collected = self.collect(index) if self.done < last else []
                while self.done < last:
                    row = self._pass(index, collected)
                    bar.update()
                    if "validation" in row:
                        bar.set_postfix_str(f"error {1000 * row['validation']:.1f}")
        self._save(WEIGHTS)
        self.write_curve()

    def collect(self, index: int) -> list[Episodes]:
        """Play the scenarios of a round, and return what a batch is drawn from."""
        name = self.plan.rounds[index].estimator
        estimator = played_by(self.folder / PLAYED) if name == OWN else {"estimator": name}
        work = partial(collect, estimator=estimator, records=self._records)
        found = run_in_order(self._executor, work, self.plan.scenarios(index), progress=False)
        return [replace(each, is_taught=each.is_taught and self._knows(each)) for each in found]

    def _knows(self, episodes: Episodes) -> bool:
        """Return whether the teacher was trained on roads like that of some episodes."""
        saved, flows = self._taught_by, float(self.plan.kind == "flows")
        return saved is not None and not outside(saved, episodes.corridor.road, {"flows": (flows,)})

    def _pass(self, index: int, collected: Sequence[Episodes]) -> Row:
        """Pass over some episodes, drawn from all scenarios; return the row of the curve."""
        started = time.perf_counter()
        plan, rate = self.plan, self.plan.rate(self.done)
        for group in self._optimiser.param_groups:
            group["lr"] = rate
        rng = np.random.default_rng([plan.seed, 2**31, self.done])
        batch = draw_batch(rng, collected, plan.episodes)
        taught = batch.taught if self._teacher is not None else None
        states = [_begin(batch, plan.width)]
        if taught is not None and self._teacher is not None:
            states.append(_begin(taught, self._teacher.width))
        losses, errors = [], []
        for first in range(0, plan.seconds, WINDOW):
            window = range(first, min(first + WINDOW, plan.seconds))
            loss, error = self._window(batch, taught, window, states)
            losses.append(loss)
            errors.append(error)
        self.done += 1
        self._seconds += time.perf_counter() - started
        row: Row = {
            "update": self.done, "steps": self.done * plan.seconds * plan.episodes,
            "seconds": round(self._seconds, 1), "round": index + 1, "rate": rate,
            "loss": float(np.mean(losses)), "error": float(np.mean(errors[1:] or errors)),
        }  # fmt: skip
        is_due = self.done % plan.checkpoint_every == 0 or self.done == plan.n_passes
        if is_due:
            self._save(WEIGHTS)
            row |= self.validate(self.folder / WEIGHTS)
        self.append(row)
        if is_due:
            self.keep(
                network=self.network.state_dict(),
                optimiser=self._optimiser.state_dict(),
                average=self._average.state_dict(),
                done=self.done,
                seconds=self._seconds,
            )
        return row

    def _window(
        self, batch: Batch, taught: Batch | None, window: range, states: list[State]
    ) -> tuple[float, float]:
        """Update the weights on some seconds and replace the states; return loss and error."""
        plan, network, roads = self.plan, self.network, batch.roads
        states[0], present, ahead = _advance(network, batch, window, states[0])
        truth, after = (batch.truth[window.start + k : window.stop + k] for k in (0, 1))
        weight = 1.0 - plan.teacher * roads.taught if taught is not None else None
        loss = second_loss(roads, present, truth, LIKELIHOOD, weight)
        error = float(second_loss(roads, present.detach(), truth, 0.0))
        if len(after) > 0:
            of_next = second_loss(roads, ahead[: len(after)], after, LIKELIHOOD, weight)
            loss = loss + PREDICTION * of_next
        if taught is not None and self._teacher is not None:
            with torch.no_grad():
                states[1], *said = _advance(self._teacher, taught, window, states[1])
            n = len(taught.start)  # they come first
            for own, of_teacher, factor in zip(
                (present, ahead), said, (1.0, PREDICTION), strict=True
            ):
                lesson = teacher_loss(taught.roads, own[:, :n], of_teacher)
                share = taught.roads.n_episodes / roads.n_episodes
                loss = loss + plan.teacher * share * factor * lesson
        self._optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), LARGEST_NORM)
        self._optimiser.step()
        with torch.no_grad():
            for mean, last in zip(self._average.parameters(), network.parameters(), strict=True):
                mean.lerp_(last, 1.0 - AVERAGING)
        return float(loss.detach()), error

    def validate(self, weights: Path) -> Row:
        """Return mean errors of weights over all cells of a validation, and over the sections."""
        roads, errors, chi2 = self._validation_roads(), list[float](), list[float]()
        for cell in self.plan.validation_cells(roads, played_by(weights)):
            rows = play(cell, cell.seeds or self.plan.validation_seeds, self._records)
            errors.append(-float(np.mean([row["reward"] for row in rows])))
            chi2 += [row[f"chi2_{of}"] for row in rows for of in ("density", "speed")]
        found = {"validation": float(np.mean(errors)), "chi2": float(np.mean(chi2))}
        if roads:
            found["sections"] = float(np.mean(errors[-len(roads) :]))
        return found

    def _validation_roads(self) -> list[Path]:
        """Return the road files of the sections to validate on; write those that are missing."""
        library, roads = open_library(self._records), list[Path]()
        for section in self.plan.validation_sections():
            folder = self.folder / SECTIONS / f"{section.kind}-{section.highway}"
            if not folder.exists():
                with new_folder(folder) as made:
                    section.write(made, library)
            roads.append(folder / ROAD)
        return roads

    def _save(self, name: str) -> None:
        card = self.plan.card(self.done, self.folder.name)
        write_weights(self.folder / name, self._average.weights(), card)


def write_mean(path: Path, folders: Sequence[Path]) -> None:
    """Write the mean of the weights of trainings that began with the same ones.

    It errs less than any of them on roads that none was trained on, as means of fine-tuned models
    often do (Wortsman et al., 2022, "Model soups").
    """
    saved = [read_weights(str(folder / WEIGHTS)) for folder in folders]
    arrays = zip(*(each.weights for each in saved), strict=True)
    means = Weights(*(np.mean(each, axis=0, dtype=float).astype(np.float32) for each in arrays))
    names = [each.card["name"] for each in saved]
    card = {**saved[0].card, "name": path.parent.name, "mean_of": names}
    write_weights(path, means, {key: value for key, value in card.items() if key != "sha256"})
