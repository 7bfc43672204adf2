"""`PlackettLuce`: a distribution over ordered sets of distinct items."""

from __future__ import annotations

import torch
from torch import Tensor


class PlackettLuce:
    """Draws B distinct items of n, one after the other, each by softmax over those left.

    With scores s the probability of the ordered set a_1, .., a_B is

        prod_j  exp(s[a_j]) / sum_{i not in a_1 .. a_{j-1}} exp(s[i])

    (Plackett, 1975). Drawing it takes no loop: the order of the B largest scores, each with Gumbel
    noise of its own, has this distribution (Yellott, 1977; Kool et al., 2019).

    An observed set has many orders. The order is drawn with the set, so its log-probability is
    exact and a policy gradient by it is unbiased, whatever is done with the set.

    Attributes:
        scores: Shape (k, n).
        size: B, items to draw.
    """

    def __init__(self, scores: Tensor, size: int) -> None:
        """Take scores, shape (k, n), and the number B of items to draw.

        Raises:
            ValueError: B is not in 1..n, or a score is not finite.
        """
        n = scores.shape[-1]
        if not 1 <= size <= n:
            raise ValueError(f"size must be in 1..{n}, got {size}")
        if not bool(torch.isfinite(scores).all()):
            raise ValueError("scores must be finite; a diverged training makes them NaN")
        # Only differences count. Centred, the largest is 0 and no exponential overflows; sums of
        # a few of the lowest do not, either.
        centred = scores - scores.max(dim=-1, keepdim=True).values.detach()
        self.scores = centred.clamp_min(torch.finfo(scores.dtype).min / (4 * n))
        self.size = size

    def sample(self) -> Tensor:
        """Return ordered sets drawn at random, shape (k, B)."""
        # Minus the logarithm of a standard exponential is a standard Gumbel variable.
        exponential = torch.empty_like(self.scores).exponential_()
        noise = -exponential.clamp_min(torch.finfo(exponential.dtype).tiny).log()
        return self._first(self.scores.detach() + noise)

    def mode(self) -> Tensor:
        """Return the most probable ordered sets, shape (k, B); ties go upstream."""
        return self._first(self.scores.detach())

    def log_prob(self, chosen: Tensor) -> Tensor:
        """Return the logarithms of the probabilities of ordered sets (k, B), shape (k,).

        Raises:
            ValueError: The shape is not (k, B), an index is out of range, or an item stands twice.
        """
        return self._stepwise(self._checked(chosen))[0].sum(dim=1)

    def evaluate(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return `log_prob` and `entropy_along` of ordered sets (k, B), each of shape (k,).

        Raises:
            ValueError: As in `log_prob`.
        """
        log_chosen, entropies = self._stepwise(self._checked(chosen))
        return log_chosen.sum(dim=1), entropies.sum(dim=1)

    def entropy_along(self, chosen: Tensor) -> Tensor:
        """Return the entropies of the B draws, each given those before it, summed, shape (k,).

        Their mean over `sample` is the entropy of the ordered set, by the chain rule. The exact
        one would need all n! / (n - B)! of them.

        Raises:
            ValueError: As in `log_prob`.
        """
        return self.evaluate(chosen)[1]

    def _stepwise(self, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return log-probability and entropy of each draw given those before, (k, B) each."""
        n = self.scores.shape[1]
        own = torch.nn.functional.one_hot(chosen, n)
        taken = own.cumsum(dim=1) - own > 0  # (k, B, n), by the draws before
        logits = self.scores[:, None, :].masked_fill(taken, -torch.inf)
        logs = torch.log_softmax(logits, dim=2)
        # What is taken has probability 0 and adds 0 log 0 = 0; computed, that would be NaN.
        entropies = -(logs.exp() * logs.masked_fill(taken, 0.0)).sum(dim=2)
        return logs.gather(2, chosen[:, :, None]).squeeze(2), entropies

    def _checked(self, chosen: Tensor) -> Tensor:
        k, n = self.scores.shape
        if chosen.shape != (k, self.size):
            raise ValueError(f"chosen must have shape {(k, self.size)}, got {tuple(chosen.shape)}")
        chosen = chosen.long()
        if chosen.numel() and (int(chosen.min()) < 0 or int(chosen.max()) >= n):
            raise ValueError(f"chosen must lie in [0, {n - 1}], got {chosen.tolist()}")
        ordered = chosen.sort(dim=1).values
        if bool((ordered[:, 1:] == ordered[:, :-1]).any()):
            raise ValueError("chosen must hold distinct items, one stands twice")
        return chosen

    def _first(self, keys: Tensor) -> Tensor:
        return keys.argsort(dim=1, descending=True, stable=True)[:, : self.size]
