"""Action encodings: from a policy's action to the segments to query.

Every encoding turns a batch of actions into at most ``bandwidth`` queried mainline segments per
episode, and turns a set of segments back into an action. An encoding holds its Gymnasium space,
so the two cannot drift apart, and no state: the state between actions is part of the process
(`PendingPicks`). Surplus requests are dropped, and missing ones added, from a rotating pointer that
does not depend on the traffic.

Any action that the space can sample is valid. A wrong shape, a wrong dtype, a NaN or an index
outside the road raises ``ValueError``.
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
        picked: Segments picked so far for a decision in progress, shape (n, n_mainline); always
            empty but for the sequential encoding.
        pointer: Segment from which requests are kept or added next, shape (n,).
        n_replaced: Picks of the decision in progress that were replaced, shape (n,).
    """

    def __init__(self, n_episodes: int, n_mainline: int) -> None:
        """Make the state of n episodes without any pick."""
        self.picked = np.zeros((n_episodes, n_mainline), dtype=bool)
        self.pointer = np.zeros(n_episodes, dtype=np.int64)
        self.n_replaced = np.zeros(n_episodes, dtype=np.int64)

    def reset(self, episodes: IntArray) -> None:
        """Clear the state of ``episodes``."""
        self.picked[episodes] = False
        self.pointer[episodes] = 0
        self.n_replaced[episodes] = 0

    def in_turn(self, episodes: IntArray, wanted: BoolArray, limit: IntArray) -> BoolArray:
        """Keep ``limit`` (k,) wanted segments (k, n) from the pointer on, and move it past them."""
        n = wanted.shape[1]
        order = (self.pointer[episodes, None] + np.arange(n)) % n
        turned = np.take_along_axis(wanted, order, axis=1)
        turned &= np.cumsum(turned, axis=1) <= limit[:, None]
        last = n - 1 - np.argmax(turned[:, ::-1], axis=1)
        moved = (order[np.arange(len(episodes)), last] + 1) % n
        self.pointer[episodes] = np.where(turned.any(axis=1), moved, self.pointer[episodes])
        kept = np.zeros_like(wanted)
        np.put_along_axis(kept, order, turned, axis=1)
        return kept


@dataclass(frozen=True)
class Decision:
    """The queries of a batch of actions.

    Attributes:
        queried: Segments to query, shape (k, n_mainline).
        n_dropped: Number of requests that were dropped, repeated or replaced, shape (k,).
        complete: Whether the decision is complete, shape (k,). Only the sequential encoding needs
            several actions for a decision.
    """

    queried: BoolArray
    n_dropped: IntArray
    complete: BoolArray


class ActionEncoding(ABC):
    """Base class of the encodings, made of (n_mainline, bandwidth).

    Attributes:
        space: The Gymnasium space of one action.
        n_mainline: Segments that can be queried, n.
        bandwidth: Largest number of queries in a step, B.
        actions_per_step: Number of actions per decision.
        picks_one_by_one: Whether an action picks one segment, so that segments already picked can
            be masked.
    """

    actions_per_step = 1
    picks_one_by_one: ClassVar[bool] = False

    def __init__(self, space: spaces.Space[Any], n_mainline: int, bandwidth: int) -> None:
        """Store the space and the sizes."""
        self.space = space
        self.n_mainline, self.bandwidth = n_mainline, bandwidth

    @abstractmethod
    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """Turn actions into segments to query.

        Args:
            episodes: The k episodes that act, rows of ``pending``.
            actions: Shape (k, *space.shape).
            pending: State of all episodes; that of ``episodes`` is moved on.

        Raises:
            ValueError: Shape, dtype or a value is wrong; nothing is changed then.
        """

    @abstractmethod
    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """Turn wanted segments, shape (k, n_mainline), into actions of this encoding.

        Args:
            queried: Wanted segments, shape (k, n_mainline).
            picked: Segments already chosen for this decision, shape (k, n_mainline).

        Raises:
            ValueError: The encoding cannot express that set of segments.
        """

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
        array, last = self._checked(episodes, actions), self.n_mainline - 1
        if array.dtype.kind not in "iu":
            raise ValueError(f"action must hold integers for {self.space}, got {array.dtype}")
        if array.size and (array.min() < 0 or array.max() > last):
            raise ValueError(f"action must lie in [0, {last}], got {array.tolist()}")
        return array.astype(np.int64)

    def _require_full(self, queried: BoolArray) -> None:
        counts = queried.sum(axis=1)
        if (counts != self.bandwidth).any():
            raise ValueError(
                f"{self.space} always queries {self.bandwidth} segments, got sets of "
                f"{counts.tolist()}; use action='mask' to query fewer"
            )


def _all_complete(queried: BoolArray, n_dropped: IntArray) -> Decision:
    return Decision(queried, n_dropped, np.ones(len(queried), dtype=bool))


class MaskAction(ActionEncoding):
    """``MultiBinary(n)``: one flag per segment.

    Requests beyond ``bandwidth`` are dropped in rotation. Arrays of any real dtype are accepted if
    all values are exactly 0 or 1, since learning libraries send flags as floats.
    """

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.MultiBinary(n_mainline), n_mainline, bandwidth)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        wanted = array != 0
        if array.dtype.kind != "b" and not np.array_equal(array, wanted):
            raise ValueError(f"action must hold 0 and 1 only, got {array.tolist()}")
        n_dropped = np.maximum(wanted.sum(axis=1) - self.bandwidth, 0)
        cut = n_dropped > 0
        if cut.any():
            limit = np.full(int(cut.sum()), self.bandwidth)
            wanted[cut] = pending.in_turn(episodes[cut], wanted[cut], limit)
        return _all_complete(wanted, n_dropped)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        return queried.astype(np.int8)


class ScoresAction(ActionEncoding):
    """``Box(-1, 1, (n,))``: the ``bandwidth`` segments of highest score; ties go upstream."""

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.Box(-1.0, 1.0, (n_mainline,), np.float32), n_mainline, bandwidth)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"action must hold finite floats, got {array.tolist()}")
        best = np.argsort(-array, axis=1, kind="stable")[:, : self.bandwidth]
        queried = np.zeros(array.shape, dtype=bool)
        np.put_along_axis(queried, best, True, axis=1)
        return _all_complete(queried, np.zeros(len(episodes), dtype=np.int64))

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        return (2.0 * queried - 1.0).astype(np.float32)


class SlotsAction(ActionEncoding):
    """``MultiDiscrete([n] * bandwidth)``: a segment per slot; repeats are replaced in rotation."""

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.MultiDiscrete([n_mainline] * bandwidth), n_mainline, bandwidth)

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        slots = self._checked_indices(episodes, actions)
        queried = np.zeros((len(episodes), self.n_mainline), dtype=bool)
        np.put_along_axis(queried, slots, True, axis=1)
        repeats = self.bandwidth - queried.sum(axis=1)
        short = repeats > 0
        if short.any():
            queried[short] |= pending.in_turn(episodes[short], ~queried[short], repeats[short])
        return _all_complete(queried, repeats)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        return np.nonzero(queried)[1].reshape(len(queried), self.bandwidth)


class SequentialAction(ActionEncoding):
    """``Discrete(n)``: one segment per action, ``bandwidth`` actions a step.

    The traffic does not advance until the last pick. Valid actions, for policies with masks, are
    the segments that are not picked yet; a repeated pick is replaced in rotation.
    """

    picks_one_by_one: ClassVar[bool] = True

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.Discrete(n_mainline), n_mainline, bandwidth)
        self.actions_per_step = bandwidth

    def decode(self, episodes: IntArray, actions: Action, pending: PendingPicks) -> Decision:
        """See `ActionEncoding.decode`."""
        picks = self._checked_indices(episodes, actions)
        taken = pending.picked[episodes, picks]
        pending.picked[episodes, picks] = True
        if taken.any():
            again = episodes[taken]
            limit = np.ones(len(again), dtype=np.int64)
            pending.picked[again] |= pending.in_turn(again, ~pending.picked[again], limit)
            pending.n_replaced[again] += 1
        queried = pending.picked[episodes]
        complete = queried.sum(axis=1) == self.bandwidth
        n_dropped = np.where(complete, pending.n_replaced[episodes], 0)
        pending.picked[episodes[complete]] = False
        pending.n_replaced[episodes[complete]] = 0
        return Decision(queried, n_dropped, complete)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        choice: Action = np.argmax(queried & ~picked, axis=1)
        return choice


def check_decision(encoding: ActionEncoding, decision: Any, n_actions: int) -> None:
    """Refuse a decision of another package that is malformed or exceeds the bandwidth."""
    name, shape = name_of_class(encoding), (n_actions, encoding.n_mainline)
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
    most = int(queried[complete].sum(axis=1).max(initial=0))
    if most > encoding.bandwidth:
        raise ValueError(
            f"action {name}.decode() must query at most {encoding.bandwidth} segments, got {most}"
        )


def _expected(part: Any) -> str | None:
    if not isinstance(part, type):
        return "be a class, made of (n_mainline, bandwidth)"
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
"""Action encodings by name, each a class made of (n_mainline, bandwidth)."""
