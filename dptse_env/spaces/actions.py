"""Action encodings: from a policy's action to what is queried.

Every encoding turns a batch of actions into queries that the bandwidth pays for, and turns a set of
queries back into an action. The queries to choose from are the mainline segments, or, with other
spans, those of `dptse_env.release.Queries`. An encoding holds its Gymnasium
space, so the two cannot drift apart, and no state: the state between actions is part of the process
(`PendingPicks`). Surplus requests are dropped, missing ones added, and ties decided, from a
rotating pointer that does not depend on the traffic.

Any action that the space can sample is valid. A wrong shape, a wrong dtype, a NaN or an index
beyond the queries raises ``ValueError``.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces

from dptse_env.release import Queries
from dptse_env.utils.arrays import Action, BoolArray, IntArray
from dptse_env.utils.kernels import kernel
from dptse_env.utils.registry import Registry, name_of_class


class PendingPicks:
    """State of n episodes between actions.

    Attributes:
        picked: Queries picked so far for a decision in progress, shape (n, n_queries); always empty
            but for encodings that pick one by one.
        pointer: Query from which requests are kept or added next, shape (n,).
        n_replaced: Picks of the decision in progress that were replaced, shape (n,).
    """

    def __init__(self, n_episodes: int, n_queries: int) -> None:
        """Make the state of n episodes without any pick."""
        self.picked = np.zeros((n_episodes, n_queries), dtype=bool)
        self.pointer = np.zeros(n_episodes, dtype=np.int64)
        self.n_replaced = np.zeros(n_episodes, dtype=np.int64)

    def reset(self, episodes: IntArray) -> None:
        """Clear the state of ``episodes``."""
        self.picked[episodes] = False
        self.pointer[episodes] = 0
        self.n_replaced[episodes] = 0

    def in_turn(
        self, episodes: IntArray, wanted: BoolArray, limit: IntArray, costs: IntArray
    ) -> BoolArray:
        """Keep wanted queries (k, n) from the pointer on, and move it past them.

        A query that costs more than is left is passed over, and the pointer stops there, so that
        it comes first in the next turn.

        Args:
            episodes: Shape (k,).
            wanted: Shape (k, n).
            limit: Largest total cost of the kept queries of an episode, shape (k,).
            costs: Of the queries, at least 1 each, shape (n,).
        """
        kept = np.zeros_like(wanted)
        _keep_in_turn(episodes, wanted, limit, costs, self.pointer, kept)
        return kept


@kernel
def _keep_in_turn(
    episodes: IntArray,
    wanted: BoolArray,
    limit: IntArray,
    costs: IntArray,
    pointer: IntArray,
    kept: BoolArray,
) -> None:
    """Write what `PendingPicks.in_turn` keeps, and move the pointers (n_episodes,)."""
    n = wanted.shape[1]
    for k in range(episodes.size):
        first, left, is_passed_over = pointer[episodes[k]], limit[k], False
        for turn in range(n):
            query = (first + turn) % n
            if wanted[k, query] and costs[query] <= left:
                kept[k, query] = True
                left -= costs[query]
                if not is_passed_over:
                    pointer[episodes[k]] = (query + 1) % n
            elif wanted[k, query] and costs[query] <= limit[k]:
                is_passed_over = True


def first_that_fit(order: IntArray, costs: IntArray, limit: int) -> BoolArray:
    """Return the first queries of an order that a limit pays for, flags of shape (k, n).

    A query that costs more than is left is passed over.

    Args:
        order: The queries, best first, shape (k, n).
        costs: Of the queries, shape (n,).
        limit: Their largest total cost.
    """
    kept, every = np.zeros(order.shape, dtype=bool), np.arange(len(order))
    if (costs == costs[0]).all():
        kept[every[:, None], order[:, : limit // costs[0]]] = True
        return kept
    left = np.full(len(order), limit)
    for query in order.T:
        fits = costs[query] <= left
        kept[every, query] = fits
        left -= np.where(fits, costs[query], 0)
        if not left.any():
            break
    return kept


class Decision(NamedTuple):
    """The queries of a batch of actions.

    Attributes:
        queried: Queries to query, shape (k, n_queries).
        n_dropped: Number of requests that were dropped, repeated or replaced, shape (k,).
        complete: Whether the decision is complete, shape (k,). Only encodings that pick one by one
            need several actions for a decision.
    """

    queried: BoolArray
    n_dropped: IntArray
    complete: BoolArray


class ActionEncoding(ABC):
    """Base class of the encodings.

    A query is a mainline segment, unless the environment has other spans
    (`dptse_env.release.Queries`).

    Attributes:
        space: The Gymnasium space of one action.
        n_queries: Queries to choose from, n.
        bandwidth: Largest total cost of the queries of a step, B.
        costs: Costs of the queries, 1 each where they do not differ, shape (n,).
        most_queries: Largest number of queries in a step.
        picks_one_by_one: Whether an action picks one query, so that those which cannot be picked
            any more can be masked.
    """

    picks_one_by_one: ClassVar[bool] = False

    def __init__(self, queries: Queries) -> None:
        """Store the sizes, and the space that they give."""
        self.n_queries, self.most_queries = queries.n_queries, queries.most_queries
        self.bandwidth, self.costs = queries.bandwidth, queries.cost
        self.space = self.make_space()
        self._shape = self.space.shape or ()

    @abstractmethod
    def make_space(self) -> spaces.Space[Any]:
        """Return the space of one action, given the sizes."""

    @property
    def actions_per_step(self) -> int:
        """Largest number of actions of a decision."""
        return self.most_queries if self.picks_one_by_one else 1

    @abstractmethod
    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """Turn actions into queries.

        Args:
            episodes: The k episodes that act, indices into ``pending``.
            actions: Shape (k, *space.shape).
            pending: State of all episodes; that of ``episodes`` is moved on.

        Raises:
            ValueError: Shape, dtype or a value is wrong; nothing is changed then.
        """

    @abstractmethod
    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """Turn wanted queries, shape (k, n_queries), into actions of this encoding.

        Args:
            queried: Wanted queries, shape (k, n_queries).
            picked: Queries already chosen for this decision, shape (k, n_queries).

        Raises:
            ValueError: The encoding cannot express that set of options.
        """

    def available(self, picked: BoolArray) -> BoolArray:
        """Return flags (k, n_queries) of what a decision may have beside the picked options.

        They are not picked yet, and do not cost more than is left of the bandwidth.
        """
        left = self.bandwidth - picked.dot(self.costs)
        free: BoolArray = ~picked & (self.costs <= left[:, None])
        return free

    def masks(self, picked: BoolArray) -> BoolArray:
        """Return flags of the valid choices of an action, shape (k, m), as sb3-contrib has them.

        A ``Discrete`` has a flag for each value, a ``MultiDiscrete`` those of each of its numbers
        in turn, a ``MultiBinary`` two for each of its flags. All are set, unless an action picks
        one query: then they are those of `available`.

        Args:
            picked: Queries already chosen for this decision, shape (k, n_queries).
        """
        if self.picks_one_by_one:
            return self.available(picked)
        n_flags = 2 if isinstance(self.space, spaces.MultiBinary) else 1
        return np.ones((len(picked), n_flags * spaces.flatdim(self.space)), dtype=bool)

    def completes(self, queried: BoolArray, picked: BoolArray) -> BoolArray:
        """Return whether the action of `encode` for the same arguments completes a decision."""
        n_actions = queried.sum(axis=1) if self.picks_one_by_one else 1
        complete: BoolArray = picked.sum(axis=1) + 1 == n_actions
        return complete

    def _cut(
        self, episodes: IntArray, wanted: BoolArray, pending: PendingPicks
    ) -> tuple[BoolArray, IntArray]:
        """Cut queries (k, n_queries) in rotation; return the rest, and how many were cut (k,)."""
        over = wanted.dot(self.costs) > self.bandwidth
        if not np.count_nonzero(over):  # faster than any()
            return wanted, np.zeros(len(wanted), dtype=np.int64)
        limit = np.where(over, self.bandwidth, 0)
        kept = pending.in_turn(episodes, wanted, limit, self.costs)
        kept = np.where(over[:, None], kept, wanted)
        return kept, (wanted & ~kept).sum(axis=1)

    def _checked(self, episodes: IntArray, actions: Action) -> Action:
        """Return ``actions`` as an array, checked for its shape and for a numeric dtype."""
        array = np.asarray(actions)
        expected = (len(episodes), *self._shape)
        if array.shape != expected:
            raise ValueError(
                f"action must have shape {expected[1:]} of {self.space}, got {array.shape[1:]}"
            )
        if array.dtype.kind not in "biuf":
            raise ValueError(f"action must be numeric for {self.space}, got {array.dtype}")
        return array

    def _checked_indices(self, episodes: IntArray, actions: Action) -> IntArray:
        array, last = self._checked(episodes, actions), self.n_queries - 1
        if array.dtype.kind not in "iu":
            raise ValueError(f"action must hold integers for {self.space}, got {array.dtype}")
        if np.count_nonzero((array < 0) | (array > last)):
            raise ValueError(f"action must lie in [0, {last}], got {array.tolist()}")
        return array.astype(np.int64)

    def _require_full(self, queried: BoolArray) -> None:
        """Refuse sets to which another query could be added."""
        cost = queried @ self.costs
        if (cost > self.bandwidth).any() or self.available(queried).any():
            raise ValueError(
                f"{self.space} queries as much as the bandwidth of {self.bandwidth} pays for, got "
                f"sets that cost {cost.tolist()}; use action='mask' to query fewer"
            )


def check_decision(encoding: ActionEncoding, decision: Any, n_actions: int) -> None:
    """Refuse a decision of another package that is malformed or exceeds the bandwidth."""
    name, shape = name_of_class(encoding), (n_actions, encoding.n_queries)
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
    most = int((asked @ encoding.costs).max(initial=0))
    if most > encoding.bandwidth:
        raise ValueError(
            f"action {name}.decode() must query at most {encoding.bandwidth} of bandwidth, got "
            f"{most}"
        )


class MaskAction(ActionEncoding):
    """``MultiBinary(n)``: one flag per query.

    Requests beyond the bandwidth are dropped in rotation. Arrays of any real dtype are accepted if
    all values are exactly 0 or 1, since learning libraries send flags as floats.
    """

    def make_space(self) -> spaces.Space[Any]:
        """See `ActionEncoding.make_space`."""
        return spaces.MultiBinary(self.n_queries)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        wanted = array != 0
        if array.dtype.kind != "b" and np.count_nonzero(array != wanted):
            raise ValueError(f"action must hold 0 and 1 only, got {array.tolist()}")
        return Decision(*self._cut(episodes, wanted, pending), np.ones(len(wanted), dtype=bool))

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        return queried.astype(np.int8)


class ScoresAction(ActionEncoding):
    """``Box(-1, 1, (n,))``: the queries of highest score, as many as the bandwidth pays for.

    Scores beyond the bounds count as the bound. Ties are decided in rotation. A query that costs
    more than is left is passed over.
    """

    def make_space(self) -> spaces.Space[Any]:
        """See `ActionEncoding.make_space`."""
        return spaces.Box(-1.0, 1.0, (self.n_queries,), np.float32)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"action must hold finite floats, got {array.tolist()}")
        scores, n = np.clip(array, -1.0, 1.0), self.n_queries
        turn = (np.arange(n) - pending.pointer[episodes, None]) % n
        queried = first_that_fit(np.lexsort((turn, -scores)), self.costs, self.bandwidth)
        # The pointer moves past what was taken of a tie, up to the first that has to wait.
        waits = ~queried & (self.costs <= self.bandwidth)
        is_tied = scores == np.where(waits, scores, -np.inf).max(axis=1, keepdims=True)
        first = np.where(is_tied & waits, turn, n).min(axis=1, keepdims=True)
        passed = np.where(is_tied & queried & (turn < first), turn + 1, 0).max(axis=1)
        pending.pointer[episodes] = (pending.pointer[episodes] + passed) % n
        k = len(episodes)
        return Decision(queried, np.zeros(k, dtype=np.int64), np.ones(k, dtype=bool))

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        return (2.0 * queried - 1.0).astype(np.float32)


class SlotsAction(ActionEncoding):
    """``MultiDiscrete([n] * B)``: a query in each of B slots, as many as there may be.

    Requests beyond the bandwidth are dropped in rotation; in place of repeats, queries are added in
    rotation that the bandwidth pays for.
    """

    def make_space(self) -> spaces.Space[Any]:
        """See `ActionEncoding.make_space`."""
        return spaces.MultiDiscrete([self.n_queries] * self.most_queries)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        slots = self._checked_indices(episodes, actions)
        wanted = np.zeros((len(episodes), self.n_queries), dtype=bool)
        wanted[np.arange(len(slots))[:, None], slots] = True
        queried, n_dropped = self._cut(episodes, wanted, pending)
        left = self.bandwidth - queried.dot(self.costs)
        if np.count_nonzero(left):
            added = pending.in_turn(episodes, self.available(queried), left, self.costs)
            queried = queried | added
            # A repeat that nothing replaces asks for nothing that is not served.
            repeats = self.most_queries - wanted.sum(axis=1)
            n_dropped += np.minimum(repeats, added.sum(axis=1))
        return Decision(queried, n_dropped, np.ones(len(queried), dtype=bool))

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`; slots that are left over repeat the first one."""
        self._require_full(queried)
        chosen_first = np.argsort(~queried, axis=1, kind="stable")[:, : self.most_queries]
        is_chosen = np.take_along_axis(queried, chosen_first, axis=1)
        return np.where(is_chosen, chosen_first, chosen_first[:, :1])


class SequentialAction(ActionEncoding):
    """``Discrete(n)``: one query per action, until the bandwidth pays for no further one.

    The traffic does not advance until the last pick. Valid actions, for policies with masks, are
    the queries that are not picked yet and that the rest of the bandwidth pays for (`available`);
    another pick is replaced in rotation.
    """

    picks_one_by_one: ClassVar[bool] = True

    def make_space(self) -> spaces.Space[Any]:
        """See `ActionEncoding.make_space`."""
        return spaces.Discrete(self.n_queries)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        picks = self._checked_indices(episodes, actions)
        picked = pending.picked[episodes]
        every = np.arange(len(picks))
        refused = ~self.available(picked)[every, picks]
        picked[every, picks] |= ~refused
        if np.count_nonzero(refused):
            one, each = refused.astype(np.int64), np.ones_like(self.costs)
            picked |= pending.in_turn(episodes, self.available(picked), one, each)
            pending.n_replaced[episodes] += refused
        complete = self.available(picked).sum(axis=1) == 0
        n_dropped = np.where(complete, pending.n_replaced[episodes], 0)
        pending.picked[episodes] = picked & ~complete[:, None]
        pending.n_replaced[episodes[complete]] = 0
        return Decision(picked, n_dropped, complete)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        choice: Action = np.argmax(queried & ~picked, axis=1)
        return choice


def _expected(part: Any) -> str | None:
    if isinstance(part, type) and issubclass(part, ActionEncoding):
        return None
    return "be a subclass of dptse_env.spaces.actions.ActionEncoding"


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
"""Action encodings by name, each a class made of `Queries`."""
