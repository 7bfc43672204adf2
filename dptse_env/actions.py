"""Action encodings: how a policy says which segments to query.

Every encoding turns a batch of actions into at most ``bandwidth`` queried mainline segments per
episode, and turns a set of segments back into an action. An encoding holds its Gymnasium space,
so the two cannot drift apart. What it cuts or fills in, it does in rotation: a pointer per
episode that knows nothing of the traffic.

Any action that the space can sample is valid. A wrong shape, a wrong dtype, a NaN or an index
outside the road raises ``ValueError``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from dptse_env.arrays import Action, BoolArray, IntArray


@dataclass(frozen=True)
class Decision:
    """What a batch of actions asks for.

    Attributes:
        queried: Segments to query, shape (k, n_mainline).
        n_dropped: Requests that were cut or repeated and so not served as asked, shape (k,).
        complete: Whether the decision is ready to be carried out, shape (k,). Only the sequential
            encoding needs several actions for one decision.
    """

    queried: BoolArray
    n_dropped: IntArray
    complete: BoolArray


class ActionEncoding(ABC):
    """What the encodings share. ``episodes`` holds the k episodes that act.

    Attributes:
        space: The Gymnasium space of one action.
        actions_per_step: Actions that make one decision.
        picked: Segments chosen so far for a decision in progress, shape (n, n_mainline); always
            empty but for the sequential encoding.
    """

    actions_per_step = 1

    def __init__(self, space: spaces.Space[Any], n_mainline: int, bandwidth: int) -> None:
        """Keep the sizes; `start` provides the state of the episodes."""
        self.space = space
        self.n_mainline, self.bandwidth = n_mainline, bandwidth
        self.start(0)

    def start(self, n_episodes: int) -> None:
        """Provide state for ``n_episodes`` episodes."""
        self.picked = np.zeros((n_episodes, self.n_mainline), dtype=bool)
        self._pointer = np.zeros(n_episodes, dtype=np.int64)

    def reset(self, episodes: IntArray) -> None:
        """Forget what earlier actions of ``episodes`` left behind."""
        self.picked[episodes] = False
        self._pointer[episodes] = 0

    @abstractmethod
    def decode(self, episodes: IntArray, actions: Action) -> Decision:
        """Turn actions, shape (k, *space.shape), into segments to query.

        Raises:
            ValueError: A wrong shape, dtype or value; nothing is changed then.
        """

    @abstractmethod
    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """Turn wanted segments, shape (k, n_mainline), into actions of this encoding.

        Args:
            queried: Wanted segments, shape (k, n_mainline).
            picked: Those already chosen for this decision, shape (k, n_mainline).

        Raises:
            ValueError: The encoding cannot express that set of segments.
        """

    def _checked(self, episodes: IntArray, actions: Action) -> Action:
        """Return ``actions`` as an array of the right shape, or say what was wrong."""
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

    def _in_turn(self, episodes: IntArray, wanted: BoolArray, limit: IntArray) -> BoolArray:
        """Keep the first ``limit`` wanted segments from the pointer on, and move it past them."""
        order = (self._pointer[episodes, None] + np.arange(self.n_mainline)) % self.n_mainline
        turned = np.take_along_axis(wanted, order, axis=1)
        turned &= np.cumsum(turned, axis=1) <= limit[:, None]
        last = self.n_mainline - 1 - np.argmax(turned[:, ::-1], axis=1)
        moved = (order[np.arange(len(episodes)), last] + 1) % self.n_mainline
        self._pointer[episodes] = np.where(turned.any(axis=1), moved, self._pointer[episodes])
        kept = np.zeros_like(wanted)
        np.put_along_axis(kept, order, turned, axis=1)
        return kept

    def _require_full(self, queried: BoolArray) -> None:
        counts = queried.sum(axis=1)
        if (counts != self.bandwidth).any():
            raise ValueError(
                f"{self.space} always queries {self.bandwidth} segments, asked to encode "
                f"{counts.tolist()}; use action='mask' to query fewer"
            )


def _all_complete(queried: BoolArray, n_dropped: IntArray) -> Decision:
    return Decision(queried, n_dropped, np.ones(len(queried), dtype=bool))


class MaskAction(ActionEncoding):
    """``MultiBinary(n)``: one flag per segment.

    More than ``bandwidth`` requests are cut by a rotating pointer. Arrays of any real dtype are
    taken as long as they hold exactly 0 and 1, since learning libraries send flags as floats.
    """

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.MultiBinary(n_mainline), n_mainline, bandwidth)

    def decode(self, episodes: IntArray, actions: Action) -> Decision:
        """See `ActionEncoding.decode`."""
        array = self._checked(episodes, actions)
        wanted = array != 0
        if array.dtype.kind != "b" and not np.array_equal(array, wanted):
            raise ValueError(f"action must hold 0 and 1 only, got {array.tolist()}")
        n_dropped = np.maximum(wanted.sum(axis=1) - self.bandwidth, 0)
        cut = n_dropped > 0
        if cut.any():
            limit = np.full(int(cut.sum()), self.bandwidth)
            wanted[cut] = self._in_turn(episodes[cut], wanted[cut], limit)
        return _all_complete(wanted, n_dropped)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        return queried.astype(np.int8)


class ScoresAction(ActionEncoding):
    """``Box(-1, 1, (n,))``: the ``bandwidth`` segments of highest score; ties go upstream."""

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.Box(-1.0, 1.0, (n_mainline,), np.float32), n_mainline, bandwidth)

    def decode(self, episodes: IntArray, actions: Action) -> Decision:
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
    """``MultiDiscrete([n] * bandwidth)``: a segment per slot; repeats are refilled in rotation."""

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.MultiDiscrete([n_mainline] * bandwidth), n_mainline, bandwidth)

    def decode(self, episodes: IntArray, actions: Action) -> Decision:
        """See `ActionEncoding.decode`."""
        slots = self._checked_indices(episodes, actions)
        queried = np.zeros((len(episodes), self.n_mainline), dtype=bool)
        np.put_along_axis(queried, slots, True, axis=1)
        repeats = self.bandwidth - queried.sum(axis=1)
        short = repeats > 0
        if short.any():
            queried[short] |= self._in_turn(episodes[short], ~queried[short], repeats[short])
        return _all_complete(queried, repeats)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        return np.nonzero(queried)[1].reshape(len(queried), self.bandwidth)


class SequentialAction(ActionEncoding):
    """``Discrete(n)``: one segment per action, ``bandwidth`` actions a step.

    The traffic stands still until the last pick. What `picked` leaves out may be picked next, for
    policies that mask invalid actions; a pick of a taken segment is replaced in rotation.
    """

    def __init__(self, n_mainline: int, bandwidth: int) -> None:
        """Make the encoding for ``n_mainline`` segments and ``bandwidth`` queries a step."""
        super().__init__(spaces.Discrete(n_mainline), n_mainline, bandwidth)
        self.actions_per_step = bandwidth

    def start(self, n_episodes: int) -> None:
        """See `ActionEncoding.start`."""
        super().start(n_episodes)
        self._n_replaced = np.zeros(n_episodes, dtype=np.int64)

    def reset(self, episodes: IntArray) -> None:
        """See `ActionEncoding.reset`."""
        super().reset(episodes)
        self._n_replaced[episodes] = 0

    def decode(self, episodes: IntArray, actions: Action) -> Decision:
        """See `ActionEncoding.decode`."""
        picks = self._checked_indices(episodes, actions)
        taken = self.picked[episodes, picks]
        self.picked[episodes, picks] = True
        if taken.any():
            again = episodes[taken]
            one = np.ones(len(again), dtype=np.int64)
            self.picked[again] |= self._in_turn(again, ~self.picked[again], one)
            self._n_replaced[again] += 1
        queried = self.picked[episodes]
        complete = queried.sum(axis=1) == self.bandwidth
        n_dropped = np.where(complete, self._n_replaced[episodes], 0)
        self.picked[episodes[complete]] = False
        self._n_replaced[episodes[complete]] = 0
        return Decision(queried, n_dropped, complete)

    def encode(self, queried: BoolArray, picked: BoolArray) -> Action:
        """See `ActionEncoding.encode`."""
        self._require_full(queried)
        choice: Action = np.argmax(queried & ~picked, axis=1)
        return choice


ACTION_ENCODINGS: dict[str, Callable[[int, int], ActionEncoding]] = {
    "mask": MaskAction,
    "scores": ScoresAction,
    "slots": SlotsAction,
    "sequential": SequentialAction,
}
"""Action encodings by name, each made of (n_mainline, bandwidth)."""
