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

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from dptse_env.spaces.encoding import ActionEncoding, Decision, check_decision
from dptse_env.spaces.picks import PendingPicks, affordable, most_affordable
from dptse_env.utils.arrays import Action, BoolArray, IntArray
from dptse_env.utils.registry import Registry, missing_methods

__all__ = [
    "ACTION_ENCODINGS",
    "ActionEncoding",
    "Decision",
    "MaskAction",
    "PendingPicks",
    "ScoresAction",
    "SequentialAction",
    "SlotsAction",
    "check_decision",
]


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
