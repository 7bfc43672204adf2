"""The networks of a `PlackettLucePolicy`: convolutions along the road, shared by all segments."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from dptse_env.sb3.channels import RoadChannels

WIDTH = 5
"""Segments that a convolution sees: itself and two neighbours on either side."""


class Road(nn.Module):
    """Turns observations (k, size) into channels along the road (k, n_channels, n)."""

    source: Tensor
    centre: Tensor
    factor: Tensor
    marks: Tensor

    def __init__(self, road: RoadChannels) -> None:
        """Keep where each value stands; nothing here is learned or saved."""
        super().__init__()
        nothing = road.size  # a zero is appended to the observation there
        source = [[nothing if at is None else at for at in c.source] for c in road.channels]
        here = [[at is not None for at in channel.source] for channel in road.channels]
        scales = torch.tensor([[channel.scale] for channel in road.channels])
        centres = torch.tensor([[channel.centre] for channel in road.channels])
        self.size = road.size
        self.shape = (len(road.channels), road.n_mainline)
        self.register_buffer("source", torch.tensor(source).flatten(), persistent=False)
        self.register_buffer("centre", centres, persistent=False)
        self.register_buffer("factor", torch.tensor(here) / scales, persistent=False)
        self.register_buffer("marks", torch.tensor(road.marks), persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the channels of observations, shape (k, n_channels, n).

        Args:
            observation: Shape (k, size); what follows in longer rows is not read.
        """
        k = len(observation)
        observation = observation[:, : self.size]
        padded = nn.functional.pad(observation, (0, 1))
        values = padded.index_select(1, self.source).view(k, *self.shape)
        values = (values - self.centre) * self.factor
        return torch.cat([values, self.marks.expand(k, -1, -1)], dim=1)


class Trunk(nn.Module):
    """Two convolutions along the road; the second also sees the first's mean over the road."""

    def __init__(self, n_channels: int, width: int) -> None:
        """Make a trunk of ``width`` features per segment."""
        super().__init__()
        self.near = nn.Conv1d(n_channels, width, WIDTH, padding=WIDTH // 2)
        self.far = nn.Conv1d(width, width, WIDTH, padding=WIDTH // 2)
        self.whole = nn.Linear(width, width, bias=False)

    def forward(self, channels: Tensor) -> Tensor:
        """Return features (k, width, n) of channels (k, n_channels, n)."""
        near = torch.relu(self.near(channels))
        whole = self.whole(near.mean(dim=2))
        return torch.relu(self.far(near) + whole[:, :, None])


class Scorer(nn.Module):
    """Scores each segment: a rule plus a correction that starts small.

    The rule is linear in the log standard deviations and the age (both scaled as channels), with
    weights that are learned on from where they start. An untrained scorer is nearly the rule.
    """

    rule_channels: Tensor

    def __init__(self, road: RoadChannels, width: int, rule: dict[str, float]) -> None:
        """Make a scorer.

        Args:
            road: How observations are laid out.
            width: Features per segment.
            rule: First weight of each block that the rule uses.
        """
        super().__init__()
        places = torch.tensor([road.index(name) for name in rule])
        self.register_buffer("rule_channels", places, persistent=False)
        self.rule = nn.Parameter(torch.tensor(list(rule.values())))
        self.trunk = Trunk(road.n_channels, width)
        self.correction = nn.Conv1d(width, 1, 1, bias=False)
        # Small rather than zero: behind a zero the trunk would not learn at first.
        with torch.no_grad():
            self.correction.weight *= 0.1

    def forward(self, channels: Tensor) -> Tensor:
        """Return scores (k, n) of channels (k, n_channels, n)."""
        ruled = torch.einsum("c,kcn->kn", self.rule, channels[:, self.rule_channels])
        corrections: Tensor = self.correction(self.trunk(channels))
        return ruled + corrections[:, 0]


class Critic(nn.Module):
    """Values a state: the mean over the road of what each segment contributes."""

    def __init__(self, n_channels: int, width: int) -> None:
        """Make a critic of ``width`` features per segment."""
        super().__init__()
        self.trunk = Trunk(n_channels, width)
        self.share = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, channels: Tensor) -> Tensor:
        """Return values (k, 1) of channels (k, n_channels, n)."""
        values: Tensor = self.share(self.trunk(channels).mean(dim=2))
        return values


class RatedAdam(torch.optim.Adam):
    """Adam whose groups of parameters have factors on the common learning rate.

    A group's ``factor`` is for what stable-baselines3 cannot say: it sets one rate for all.
    """

    def step(self, closure: Any = None) -> Any:
        """Take a step, each group at its own rate."""
        common = [group["lr"] for group in self.param_groups]
        for group in self.param_groups:
            group["lr"] = group["lr"] * group["factor"]
        try:
            return super().step(closure)
        finally:
            for group, rate in zip(self.param_groups, common, strict=True):
                group["lr"] = rate
