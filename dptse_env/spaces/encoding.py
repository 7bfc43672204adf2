"""Base class of action encodings, and the decisions that they return."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from dptse_env.spaces.picks import PendingPicks
from dptse_env.utils.arrays import Action, BoolArray, IntArray
from dptse_env.utils.registry import name_of_class


@dataclass(frozen=True)
class Decision:
    """The queries of a batch of actions.

    Attributes:
        queried: Options to query, shape (k, n_options).
        n_dropped: Number of requests that were dropped, repeated or replaced, shape (k,).
        complete: Whether the decision is complete, shape (k,). Only encodings that pick one by one
            need several actions for a decision.
    """

    queried: BoolArray
    n_dropped: IntArray
    complete: BoolArray


class ActionEncoding(ABC):
    """Base class of the encodings, made of (n_options, bandwidth).

    An option is a mainline segment, unless the environment has other spans or price levels
    (`dptse_env.release.QueryOptions`). Where options cost different amounts, an encoding is made of
    (n_options, bandwidth, costs=costs).

    Attributes:
        space: The Gymnasium space of one action.
        n_options: Options that can be queried, n. Also called ``n_mainline``.
        bandwidth: Largest number of queries in a step, B; where options cost different amounts,
            what they may cost together.
        costs: Costs of the options, shape (n,); None where all cost the same.
        actions_per_step: Number of actions per decision; where options cost different amounts and
            are picked one by one, the largest number.
        picks_one_by_one: Whether an action picks one option, so that those which cannot be picked
            any more can be masked.
    """

    actions_per_step = 1
    picks_one_by_one: ClassVar[bool] = False

    def __init__(
        self,
        space: spaces.Space[Any],
        n_options: int,
        bandwidth: int,
        costs: IntArray | None = None,
    ) -> None:
        """Store the space and the sizes."""
        self.space = space
        self.n_options = self.n_mainline = n_options
        self.bandwidth = bandwidth
        self.costs = None if costs is None else np.asarray(costs, dtype=np.int64)

    @abstractmethod
    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """Turn actions into options to query.

        Args:
            episodes: The k episodes that act, rows of ``pending``.
            actions: Shape (k, *space.shape).
            pending: State of all episodes; that of ``episodes`` is moved on.

        Raises:
            ValueError: Shape, dtype or a value is wrong; nothing is changed then.
        """

    @abstractmethod
    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """Turn wanted options, shape (k, n_options), into actions of this encoding.

        Args:
            queried: Wanted options, shape (k, n_options).
            picked: Options already chosen for this decision, shape (k, n_options).

        Raises:
            ValueError: The encoding cannot express that set of options.
        """

    def available(self, picked: BoolArray) -> BoolArray:
        """Return flags (k, n_options) of what a decision may have beside the picked options.

        They are not picked yet, and do not cost more than is left of the bandwidth.
        """
        free: BoolArray = ~picked
        if self.costs is None:
            return free
        left = self.bandwidth - picked @ self.costs
        return free & (self.costs <= left[:, None])

    def completes(self, queried: BoolArray, picked: BoolArray) -> BoolArray:
        """Return whether the action of `encode` for the same arguments completes a decision."""
        n_actions: Any = self.actions_per_step
        if self.picks_one_by_one and self.costs is not None:
            n_actions = queried.sum(axis=1)
        complete: BoolArray = picked.sum(axis=1) + 1 == n_actions
        return complete

    def _cost(self, options: BoolArray) -> IntArray:
        """Return what options (k, n_options) cost of the bandwidth, shape (k,)."""
        cost: IntArray = options.sum(axis=1) if self.costs is None else options @ self.costs
        return cost

    def _cut(self, episodes: IntArray, wanted: BoolArray, pending: PendingPicks) -> IntArray:
        """Cut options (k, n_options), in place and in rotation; return how many, shape (k,)."""
        n_cut = np.zeros(len(episodes), dtype=np.int64)
        over = self._cost(wanted) > self.bandwidth
        if over.any():
            n_cut[over] = wanted[over].sum(axis=1)
            limit = np.full(int(over.sum()), self.bandwidth)
            wanted[over] = pending.in_turn(episodes[over], wanted[over], limit, self.costs)
            n_cut[over] -= wanted[over].sum(axis=1)
        return n_cut

    def _checked(self, episodes: IntArray, actions: Action) -> Action:
        """Return ``actions`` as an array, checked for its shape and for a numeric dtype."""
        array = np.asarray(actions)
        expected = (len(episodes), *(self.space.shape or ()))
        if array.shape != expected:
            raise ValueError(
                f"action must have shape {expected[1:]} of {self.space}, got {array.shape[1:]}"
            )
        if array.dtype.kind not in "biuf":
            raise ValueError(f"action must be numeric for {self.space}, got {array.dtype}")
        return array

    def _checked_indices(self, episodes: IntArray, actions: Action) -> IntArray:
        array, last = self._checked(episodes, actions), self.n_options - 1
        if array.dtype.kind not in "iu":
            raise ValueError(f"action must hold integers for {self.space}, got {array.dtype}")
        if array.size and (array.min() < 0 or array.max() > last):
            raise ValueError(f"action must lie in [0, {last}], got {array.tolist()}")
        return array.astype(np.int64)

    def _require_full(self, queried: BoolArray) -> None:
        """Refuse sets to which another option could be added."""
        cost = self._cost(queried)
        if self.costs is None:
            if (cost != self.bandwidth).any():
                raise ValueError(
                    f"{self.space} always queries {self.bandwidth} options, got sets of "
                    f"{cost.tolist()}; use action='mask' to query fewer"
                )
        elif (cost > self.bandwidth).any() or self.available(queried).any():
            raise ValueError(
                f"{self.space} queries as much as the bandwidth of {self.bandwidth} pays for, got "
                f"sets that cost {cost.tolist()}; use action='mask' to query fewer"
            )


def check_decision(encoding: ActionEncoding, decision: Any, n_actions: int) -> None:
    """Refuse a decision of another package that is malformed or exceeds the bandwidth."""
    name, shape = name_of_class(encoding), (n_actions, encoding.n_options)
    queried, complete = np.asarray(decision.queried), np.asarray(decision.complete)
    expected = {"queried": (queried, shape), "complete": (complete, shape[:1])}
    for field, (flags, flags_shape) in expected.items():
        if flags.shape != flags_shape or flags.dtype != np.bool_:
            raise ValueError(
                f"action {name}.decode() must return flags of shape {flags_shape} as {field}, got "
                f"{flags.dtype} of shape {flags.shape}"
            )
    if np.shape(decision.n_dropped) != shape[:1]:
        raise ValueError(
            f"action {name}.decode() must return n_dropped of shape {shape[:1]}, got "
            f"{np.shape(decision.n_dropped)}"
        )
    asked = queried[complete]
    cost = asked.sum(axis=1) if encoding.costs is None else asked @ encoding.costs
    most, unit = int(cost.max(initial=0)), "options" if encoding.costs is None else "of bandwidth"
    if most > encoding.bandwidth:
        raise ValueError(
            f"action {name}.decode() must query at most {encoding.bandwidth} {unit}, got {most}"
        )
