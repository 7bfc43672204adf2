"""`PlackettLuce`: a distribution over ordered sets of distinct items."""

import torch
from torch import Tensor


class PlackettLuce:
    """Draws B distinct items of n in turn, each by softmax over the remaining ones.

    With scores s the probability of the ordered set a_1, .., a_B is

        prod_j  exp(s[a_j]) / sum_{i not in a_1 .. a_{j-1}} exp(s[i])

    (Plackett, 1975). Sampling needs no loop: the order of the B largest scores after adding
    independent Gumbel noise to each has this distribution (Yellott, 1977; Kool et al., 2019).

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
        # Only differences matter. Centred scores are at most 0, so no exponential overflows, and
        # neither do sums of a few of the lowest scores.
        centred = scores - scores.max(dim=-1, keepdim=True).values.detach()
        self.scores = centred.clamp_min(torch.finfo(scores.dtype).min / (4 * n))
        self.size = size

    def sample(self) -> Tensor:
        """Return ordered sets drawn at random, shape (k, B)."""
        # Minus the logarithm of a standard exponential is a standard Gumbel variable.
        exponential = torch.empty_like(self.scores).exponential_()
        noise = -exponential.clamp_min(torch.finfo(exponential.dtype).tiny).log()
        return self._largest(self.scores.detach() + noise)

    def mode(self) -> Tensor:
        """Return the most probable ordered sets, shape (k, B); ties go upstream."""
        return self._largest(self.scores.detach())

    def log_prob(self, chosen: Tensor) -> Tensor:
        """Return the log-probabilities of ordered sets (k, B), shape (k,).

        Raises:
            ValueError: The shape is not (k, B), an index is out of range, or an item appears twice.
        """
        chosen = self._checked(chosen)
        n = self.scores.shape[1]
        current = torch.nn.functional.one_hot(chosen, n)
        taken = current.cumsum(dim=1) - current > 0  # (k, B, n), by the draws before
        logits = self.scores[:, None, :].masked_fill(taken, -torch.inf)
        logs = torch.log_softmax(logits, dim=2)
        return logs.gather(2, chosen[:, :, None]).squeeze(2).sum(dim=1)

    def _checked(self, chosen: Tensor) -> Tensor:
        k, n = self.scores.shape
        if chosen.shape != (k, self.size):
            raise ValueError(f"chosen must have shape {(k, self.size)}, got {tuple(chosen.shape)}")
        chosen = chosen.long()
        if chosen.numel() and (int(chosen.min()) < 0 or int(chosen.max()) >= n):
            raise ValueError(f"chosen must lie in [0, {n - 1}], got {chosen.tolist()}")
        ordered = chosen.sort(dim=1).values
        if bool((ordered[:, 1:] == ordered[:, :-1]).any()):
            raise ValueError("chosen must hold distinct items, an item appears twice")
        return chosen

    def _largest(self, keys: Tensor) -> Tensor:
        return keys.argsort(dim=1, descending=True, stable=True)[:, : self.size]
