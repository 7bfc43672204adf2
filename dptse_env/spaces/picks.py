"""State of action encodings between actions, and choice within a bandwidth."""

import numpy as np

from dptse_env.utils.arrays import BoolArray, IntArray


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
