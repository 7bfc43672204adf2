"""`PlackettLuce`: the distribution over ordered sets of distinct items, by their scores."""

from __future__ import annotations

import torch
from stable_baselines3.common.distributions import Distribution
from torch import Tensor, nn


class PlackettLuce(Distribution):
    """Draws B distinct items of n in turn, each by softmax over the remaining ones.

    With scores s the probability of the ordered set a_1, .., a_B is

        prod_j  exp(s[a_j]) / sum_{i not in a_1 .. a_{j-1}} exp(s[i])

    (Plackett, 1975); for B = 1 it is a categorical distribution. Sampling needs no loop: the order
    of the B largest scores after adding independent Gumbel noise to each has this distribution
    (Yellott, 1977; Kool et al., 2019).

    Attributes:
        size: B, items to draw.
        scores: Shape (k, n), the largest of each row at 0.
    """

    scores: Tensor

    def __init__(self, size: int) -> None:
        """Draw ``size`` items, by the scores that `proba_distribution` is given."""
        super().__init__()  # type: ignore[no-untyped-call]
        self.size = size

    def proba_distribution_net(self) -> nn.Module:
        """Return the module from scores to parameters of the distribution, which are the same."""
        return nn.Identity()

    def proba_distribution(self, scores: Tensor) -> PlackettLuce:
        """Take the scores, shape (k, n), and return the distribution.

        Raises:
            ValueError: B is not in 1..n, or a score is not finite.
        """
        n = scores.shape[-1]
        if not 1 <= self.size <= n:
            raise ValueError(f"size must be in 1..{n}, got {self.size}")
        if not bool(torch.isfinite(scores).all()):
            raise ValueError("scores must be finite; a diverged training makes them NaN")
        # Only differences matter. Centred scores are at most 0, so no exponential overflows, and
        # neither do sums of a few of the lowest scores.
        centred = scores - scores.amax(dim=-1, keepdim=True).detach()
        self.scores = centred.clamp_min(torch.finfo(scores.dtype).min / (4 * n))
        return self

    def sample(self) -> Tensor:
        """Return ordered sets drawn at random, shape (k, B)."""
        # Minus the logarithm of a standard exponential is a standard Gumbel variable.
        exponential = torch.empty_like(self.scores).exponential_()
        noise = -exponential.clamp_min(torch.finfo(exponential.dtype).tiny).log()
        return self._largest(self.scores.detach() + noise)

    def mode(self) -> Tensor:
        """Return the most probable ordered sets, shape (k, B); ties go upstream."""
        return self._largest(self.scores.detach())

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return the log-probabilities of ordered sets (k, B), shape (k,).

        That of a set in which an item appears twice is minus infinity.

        Raises:
            ValueError: The shape is not (k, B).
            RuntimeError: An index is out of range.
        """
        expected = (len(self.scores), self.size)
        if actions.shape != expected:
            raise ValueError(f"actions must have shape {expected}, got {tuple(actions.shape)}")
        item, *others = torch.split(actions.long(), 1, dim=1)
        logs = self._first
        total = logs.gather(1, item)
        for other in others:
            logs = logs.scatter(1, item, -torch.inf).log_softmax(dim=1)
            total, item = total + logs.gather(1, other), other
        return total[:, 0]

    def entropy(self) -> Tensor:
        """Return B times the entropy of the first draw, shape (k,): the entropy for B = 1."""
        logs = self._first
        return -self.size * (logs.exp() * logs).sum(dim=1)

    def actions_from_params(self, scores: Tensor, deterministic: bool = False) -> Tensor:
        """Return the most probable ordered sets of scores (k, n), or drawn ones, shape (k, B)."""
        return self.proba_distribution(scores).get_actions(deterministic)

    def log_prob_from_params(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        """Return ordered sets drawn by scores (k, n), and their log-probabilities (k,)."""
        actions = self.actions_from_params(scores)
        return actions, self.log_prob(actions)

    @property
    def _first(self) -> Tensor:
        """Log-probabilities of the first draw, (k, n)."""
        return self.scores.log_softmax(dim=1)

    def _largest(self, keys: Tensor) -> Tensor:
        if self.size == 1:
            return keys.argmax(dim=1, keepdim=True)
        return keys.argsort(dim=1, descending=True, stable=True)[:, : self.size]
