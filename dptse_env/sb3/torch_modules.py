"""Torch modules of a `PlackettLucePolicy`: convolutions along the road, shared by all segments.

The names of parameters are those of the weights in saved policies.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from dptse_env.sb3.channels import RoadChannels

KERNEL_SIZE = 5
"""Segments in a convolution's receptive field: the segment and two neighbours on either side."""


class RoadFeatures(nn.Module):
    """Arranges observations (k, size) as scaled channels along the road (k, n_channels, n)."""

    source: Tensor
    centre: Tensor
    factor: Tensor
    marks: Tensor

    def __init__(self, road: RoadChannels) -> None:
        """Store the position of each value in an observation; nothing here is learned or saved."""
        super().__init__()
        padding = road.size  # index of the zero that is appended to observations
        source = [[padding if at is None else at for at in c.source] for c in road.channels]
        present = [[at is not None for at in channel.source] for channel in road.channels]
        scales = torch.tensor([[channel.scale] for channel in road.channels])
        centres = torch.tensor([[channel.centre] for channel in road.channels])
        self.shape = (len(road.channels), road.n_mainline)
        self.register_buffer("source", torch.tensor(source).flatten(), persistent=False)
        self.register_buffer("centre", centres, persistent=False)
        self.register_buffer("factor", torch.tensor(present) / scales, persistent=False)
        self.register_buffer("marks", torch.tensor(road.marks), persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the channels (k, n_channels, n) of observations (k, size)."""
        k = len(observation)
        padded = nn.functional.pad(observation, (0, 1))
        values = padded.index_select(1, self.source).view(k, *self.shape)
        values = (values - self.centre) * self.factor
        return torch.cat([values, self.marks.expand(k, -1, -1)], dim=1)


class Trunk(nn.Module):
    """Two convolutions along the road; the second also sees the first's mean over the road."""

    def __init__(self, n_channels: int, width: int) -> None:
        """Make a trunk of ``width`` features per segment."""
        super().__init__()
        self.near = nn.Conv1d(n_channels, width, KERNEL_SIZE, padding=KERNEL_SIZE // 2)
        self.far = nn.Conv1d(width, width, KERNEL_SIZE, padding=KERNEL_SIZE // 2)
        self.whole = nn.Linear(width, width, bias=False)

    def forward(self, channels: Tensor) -> Tensor:
        """Return features (k, width, n) of channels (k, n_channels, n)."""
        near = torch.relu(self.near(channels))
        mean = self.whole(near.mean(dim=2))
        return torch.relu(self.far(near) + mean[:, :, None])


class Scorer(nn.Module):
    """Scores each segment by a linear rule plus a correction that starts small.

    The rule is linear in some mainline channels, with learned weights, so an untrained scorer is
    close to the rule.
    """

    rule_channels: Tensor

    def __init__(self, road: RoadChannels, width: int, rule: Mapping[str, float]) -> None:
        """Make a scorer of ``width`` features per segment with the initial weights of a rule.

        Raises:
            ValueError: A block of the rule is no mainline channel of the road.
        """
        super().__init__()
        indices = torch.tensor([road.index(name) for name in rule])
        self.register_buffer("rule_channels", indices, persistent=False)
        self.rule = nn.Parameter(torch.tensor(list(rule.values()), dtype=torch.float32))
        self.trunk = Trunk(road.n_channels, width)
        self.correction = nn.Conv1d(width, 1, 1, bias=False)
        # Small rather than zero, which would keep the trunk's gradient at zero at first.
        with torch.no_grad():
            self.correction.weight *= 0.1

    def forward(self, channels: Tensor) -> Tensor:
        """Return scores (k, n) of channels (k, n_channels, n)."""
        scores = torch.einsum("c,kcn->kn", self.rule, channels[:, self.rule_channels])
        corrections: Tensor = self.correction(self.trunk(channels))
        return scores + corrections[:, 0]
