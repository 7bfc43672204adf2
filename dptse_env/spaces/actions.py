"""Action encodings: from a policy's action to what is queried.

Every encoding turns a batch of actions into queries that the bandwidth pays for, and turns a set of
queries back into an action. What can be queried are options: the mainline segments, or, with other
spans and price levels, those of `dptse_env.release.QueryOptions`. An encoding holds its Gymnasium
space, so the two cannot drift apart, and no state: the state between actions is part of the process
(`PendingPicks`). Surplus requests are dropped, and missing ones added, from a rotating pointer that
does not depend on the traffic.

Any action that the space can sample is valid. A wrong shape, a wrong dtype, a NaN or an index
beyond the options raises ``ValueError``.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from dptse_env.utils.arrays import Action, BoolArray, IntArray
from dptse_env.utils.registry import Registry, missing_methods, name_of_class


class PendingPicks:
    """State of n episodes between actions.

    Attributes:
        picked: Options picked so far for a decision in progress, shape (n, n_options); always empty
            but for encodings that pick one by one.
        pointer: Option from which requests are kept or added next, shape (n,).
        n_replaced: Picks of the decision in progress that were replaced, shape (n,).
    """

    def __init__(self, n_episodes: int, n_options: int) -> None:
        """Make the state of n episodes without any pick."""
        self.picked = np.zeros((n_episodes, n_options), dtype=bool)
        self.pointer = np.zeros(n_episodes, dtype=np.int64)
        self.n_replaced = np.zeros(n_episodes, dtype=np.int64)

    def reset(self, episodes: IntArray) -> None:
        """Clear the state of ``episodes``."""
        self.picked[episodes] = False
        self.pointer[episodes] = 0
        self.n_replaced[episodes] = 0

    def in_turn(
        self,
        episodes: IntArray,
        wanted: BoolArray,
        limit: IntArray,
        costs: IntArray | None = None,
    ) -> BoolArray:
        """Keep wanted options (k, n) from the pointer on, and move it past them.

        Where options cost different amounts, one that costs more than is left is passed over, and
        the pointer stops there, so that it comes first in the next turn.

        Args:
            episodes: Shape (k,).
            wanted: Shape (k, n).
            limit: What may be kept, shape (k,): a number of options, or the sum of their costs.
            costs: Of the options, shape (n,); None where options are counted.
        """
        n = wanted.shape[1]
        order = (self.pointer[episodes, None] + np.arange(n)) % n
        turned = np.take_along_axis(wanted, order, axis=1)
        if costs is None:
            turned &= np.cumsum(turned, axis=1) <= limit[:, None]
            passed = turned
        else:
            turned &= costs[order] <= limit[:, None]
            asked, turned = turned, affordable(turned, costs[order], limit)
            passed = turned & (np.cumsum(asked & ~turned, axis=1) == 0)
        last = n - 1 - np.argmax(passed[:, ::-1], axis=1)
        moved = (order[np.arange(len(episodes)), last] + 1) % n
        self.pointer[episodes] = np.where(passed.any(axis=1), moved, self.pointer[episodes])
        kept = np.zeros_like(wanted)
        np.put_along_axis(kept, order, turned, axis=1)
        return kept


def affordable(wanted: BoolArray, costs: IntArray, limit: IntArray) -> BoolArray:
    """Return the wanted columns that a limit pays for, from the first column on.

    A column that costs more than is left is passed over.

    Args:
        wanted: Shape (k, n).
        costs: Shape (k, n).
        limit: Shape (k,).
    """
    kept, left = np.zeros_like(wanted), limit.copy()
    for column in range(wanted.shape[1]):
        fits = wanted[:, column] & (costs[:, column] <= left)
        kept[:, column] = fits
        left -= np.where(fits, costs[:, column], 0)
        if not left.any():
            break
    return kept


def most_affordable(limit: int, costs: IntArray | None) -> int:
    """Return the most options that a limit pays for; without costs, they are counted."""
    if costs is None:
        return limit
    return int(np.count_nonzero(np.cumsum(np.sort(costs)) <= limit))


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


def _all_complete(queried: BoolArray, n_dropped: IntArray) -> Decision:
    return Decision(queried, n_dropped, np.ones(len(queried), dtype=bool))


class MaskAction(ActionEncoding):
    """``MultiBinary(n)``: one flag per option.

    Requests beyond the bandwidth are dropped in rotation. Arrays of any real dtype are accepted if
    all values are exactly 0 or 1, since learning libraries send flags as floats.
    """

    def __init__(self, n_options: int, bandwidth: int, costs: IntArray | None = None) -> None:
        """See `ActionEncoding`."""
        super().__init__(spaces.MultiBinary(n_options), n_options, bandwidth, costs)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        wanted = array != 0
        if array.dtype.kind != "b" and not np.array_equal(array, wanted):
            raise ValueError(f"action must hold 0 and 1 only, got {array.tolist()}")
        n_dropped = self._cut(episodes, wanted, pending)
        return _all_complete(wanted, n_dropped)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        return queried.astype(np.int8)


class ScoresAction(ActionEncoding):
    """``Box(-1, 1, (n,))``: the options of highest score, as many as the bandwidth pays for.

    An option that costs more than is left is passed over. Ties go to the first option, upstream.
    """

    def __init__(self, n_options: int, bandwidth: int, costs: IntArray | None = None) -> None:
        """See `ActionEncoding`."""
        space = spaces.Box(-1.0, 1.0, (n_options,), np.float32)
        super().__init__(space, n_options, bandwidth, costs)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"action must hold finite floats, got {array.tolist()}")
        order = np.argsort(-array, axis=1, kind="stable")
        queried = np.zeros(array.shape, dtype=bool)
        if self.costs is None:
            np.put_along_axis(queried, order[:, : self.bandwidth], True, axis=1)
        else:
            limit = np.full(len(episodes), self.bandwidth)
            kept = affordable(np.ones_like(queried), self.costs[order], limit)
            np.put_along_axis(queried, order, kept, axis=1)
        return _all_complete(queried, np.zeros(len(episodes), dtype=np.int64))

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        return (2.0 * queried - 1.0).astype(np.float32)


class SlotsAction(ActionEncoding):
    """``MultiDiscrete([n] * B)``: an option for each of the B queries, as many as there may be.

    Requests beyond the bandwidth are dropped in rotation; in place of repeats, options are added in
    rotation that the bandwidth pays for.
    """

    def __init__(self, n_options: int, bandwidth: int, costs: IntArray | None = None) -> None:
        """See `ActionEncoding`."""
        self._n_slots = most_affordable(bandwidth, costs)
        space = spaces.MultiDiscrete([n_options] * self._n_slots)
        super().__init__(space, n_options, bandwidth, costs)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        slots = self._checked_indices(episodes, actions)
        queried = np.zeros((len(episodes), self.n_options), dtype=bool)
        np.put_along_axis(queried, slots, True, axis=1)
        repeats = slots.shape[1] - queried.sum(axis=1)
        n_dropped, left = np.zeros_like(repeats), repeats
        if self.costs is not None:
            n_dropped = self._cut(episodes, queried, pending)
            left = self.bandwidth - self._cost(queried)
        short = left > 0
        if short.any():
            free = self.available(queried[short])
            added = pending.in_turn(episodes[short], free, left[short], self.costs)
            queried[short] |= added
            # A repeat that nothing replaces asks for nothing that is not served.
            n_dropped[short] += np.minimum(repeats[short], added.sum(axis=1))
        return _all_complete(queried, n_dropped)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`; slots that are left over repeat the first one."""
        self._require_full(queried)
        chosen_first = np.argsort(~queried, axis=1, kind="stable")[:, : self._n_slots]
        is_chosen = np.take_along_axis(queried, chosen_first, axis=1)
        return np.where(is_chosen, chosen_first, chosen_first[:, :1])


class SequentialAction(ActionEncoding):
    """``Discrete(n)``: one option per action, until the bandwidth pays for no further one.

    The traffic does not advance until the last pick. Valid actions, for policies with masks, are
    the options that are not picked yet and that the rest of the bandwidth pays for (`available`);
    another pick is replaced in rotation.
    """

    picks_one_by_one: ClassVar[bool] = True

    def __init__(self, n_options: int, bandwidth: int, costs: IntArray | None = None) -> None:
        """See `ActionEncoding`."""
        super().__init__(spaces.Discrete(n_options), n_options, bandwidth, costs)
        self.actions_per_step = most_affordable(bandwidth, costs)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        picks = self._checked_indices(episodes, actions)
        if self.costs is None:
            refused = pending.picked[episodes, picks]
            pending.picked[episodes, picks] = True
        else:
            free = self.available(pending.picked[episodes])
            refused = ~free[np.arange(len(episodes)), picks]
            pending.picked[episodes, picks] |= ~refused
        if refused.any():
            again = episodes[refused]
            limit = np.ones(len(again), dtype=np.int64)
            others = self.available(pending.picked[again])
            pending.picked[again] |= pending.in_turn(again, others, limit)
            pending.n_replaced[again] += 1
        queried = pending.picked[episodes]
        if self.costs is None:
            complete = queried.sum(axis=1) == self.bandwidth
        else:
            complete = ~self.available(queried).any(axis=1)
        n_dropped = np.where(complete, pending.n_replaced[episodes], 0)
        pending.picked[episodes[complete]] = False
        pending.n_replaced[episodes[complete]] = 0
        return Decision(queried, n_dropped, complete)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        choice: Action = np.argmax(queried & ~picked, axis=1)
        return choice


def _expected(part: Any) -> str | None:
    if not isinstance(part, type):
        return "be a class, made of (n_options, bandwidth)"
    return missing_methods(part, ("decode", "encode"))


ACTION_ENCODINGS = Registry(
    "action",
    {
        "mask": MaskAction,
        "scores": ScoresAction,
        "slots": SlotsAction,
        "sequential": SequentialAction,
    },
    check=_expected,
)
"""Action encodings by name, each a class made of (n_options, bandwidth)."""
