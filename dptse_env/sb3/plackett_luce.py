"""`PlackettLucePolicy`: scores every segment by one network, and queries an ordered set of them.

Its parts come first: the distribution over ordered sets, the observation as channels along the
road, the modules of the network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import Tensor, nn

from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface

KERNEL_SIZE = 5
"""Segments in a convolution's receptive field: the segment and two neighbours on either side."""

RULE = {"density_log_std": 2.8, "speed_log_std": 1.2, "age": 7.2}
"""Initial weights of the scores: an untrained policy queries segments whose estimate is uncertain
or that have not been observed for long."""

LAST_PLACE = 1e4
"""Subtracted from the scores of segments that are queried only when there are no others."""

CENTRES = {
    "density": (0.15, 0.15),
    "speed": (0.6, 0.3),
    "density_log_std": (-3.0, 1.0),
    "speed_log_std": (-3.0, 1.0),
    "released_density": (0.15, 0.3),
    "released_speed": (0.6, 0.5),
    "released_flow": (0.0, 0.1),
    "density_innovation": (0.0, 1.5),
    "speed_innovation": (0.0, 1.5),
    "age": (0.1, 0.1),
    "queried": (0.0, 1.0),
    "fixed_density_innovation": (0.0, 1.5),
    "fixed_speed_innovation": (0.0, 1.5),
    "last_price": (0.0, 1.0),
    "tracer": (0.5, 0.3),
}
"""Centre and scale of each block's values, chosen so that channels are of order one. They are
constants rather than running statistics, which could be lost between training and use."""

MAINLINE_BLOCKS = (
    "density", "speed", "density_log_std", "speed_log_std", "density_innovation",
    "speed_innovation", "age", "queried",
)  # fmt: skip
PRICE_BLOCKS = ("last_price", "tracer")
"""Blocks with channels where the observation has them."""

RAMP_BLOCKS = ("density", "speed", "density_log_std", "speed_log_std")
FIXED_SENSOR_BLOCKS = ("fixed_density_innovation", "fixed_speed_innovation")


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


@dataclass(frozen=True)
class Channel:
    """A channel of the observation, with a value for each mainline segment.

    Attributes:
        name: Kind of segment and observation block, such as ``"off-ramp density"``.
        source: Index into the observation for each of the n segments; None where there is no
            value, and the channel is 0.
        centre: Subtracted from the values.
        scale: Divides the centred values.
    """

    name: str
    source: tuple[int | None, ...]
    centre: float
    scale: float


@dataclass(frozen=True)
class RoadChannels:
    """Layout of an observation along the road, as plain data that travels with a policy.

    A ramp's values are assigned to the segment that it joins or leaves: an on-ramp at face j to
    segment j, downstream of the face, an off-ramp to segment j - 1. The bandwidth and epsilon are
    left out: they are constant during a training, so their weights would remain untrained and
    would harm the policy elsewhere. Their effect shows in the deviations and ages.

    Attributes:
        n_mainline: Segments n along the road.
        size: Length of an observation.
        channels: The channels with values from the observation.
        marks: Constant channels of 0 or 1 per segment, for on-ramps, off-ramps and fixed sensors.
    """

    n_mainline: int
    size: int
    channels: tuple[Channel, ...]
    marks: tuple[tuple[float, ...], ...]

    @classmethod
    def from_config(cls, config: EnvConfig) -> RoadChannels:
        """Return the layout of the observations of an environment of ``config``.

        Raises:
            ValueError: Queries are not of single segments at one price level.
        """
        if not config.queries.are_segments:
            raise ValueError(
                "a policy whose network is shared by all segments needs query_spans (1,) and one "
                f"price level, got {config.queries}"
            )
        corridor, n = config.corridor, config.corridor.n_mainline
        encoding = make_interface(config).observations
        starts = {name: place.start for name, place in encoding.slices.items()}
        released = [name for name in starts if name.startswith("released_")]
        prices = [name for name in PRICE_BLOCKS if name in starts]
        # Of a ramp with several segments, the one that touches the mainline.
        on_ramps = zip(corridor.on_ramp_segments, corridor.on_ramps, strict=True)
        off_ramps = zip(corridor.off_ramp_segments, corridor.off_ramps, strict=True)
        joins = {segments[-1]: face for segments, face in on_ramps}
        leaves = {segments[0]: face - 1 for segments, face in off_ramps}
        channels = [
            _channel(name, starts, {i: i for i in range(n)}, n, "mainline")
            for name in (*MAINLINE_BLOCKS, *released, *prices)
        ]
        fixed = {s: k for k, s in enumerate(corridor.fixed_sensors)}
        for kind, ramps in (("on-ramp", joins), ("off-ramp", leaves)):
            channels += [
                _channel(name, starts, {at: s for s, at in ramps.items()}, n, kind)
                for name in RAMP_BLOCKS
            ]
            watched = {at: fixed[s] for s, at in ramps.items() if s in fixed}
            if watched:
                channels += [
                    _channel(name, starts, watched, n, kind) for name in FIXED_SENSOR_BLOCKS
                ]
        marks = [joins.values(), leaves.values(), [s for s in fixed if s < n]]
        return cls(
            n_mainline=n,
            size=int(encoding.space.shape[0]),
            channels=tuple(channels),
            marks=tuple(tuple(float(i in places) for i in range(n)) for places in marks),
        )

    @property
    def sensor_mark(self) -> tuple[float, ...]:
        """Marks of 0 or 1 per segment: whether it has a fixed sensor."""
        return self.marks[-1]

    @property
    def n_channels(self) -> int:
        """Channels per segment, marks included."""
        return len(self.channels) + len(self.marks)

    def index(self, block: str) -> int:
        """Return the index of the mainline channel of an observation block.

        Raises:
            ValueError: The block has no mainline channel.
        """
        names = [channel.name for channel in self.channels]
        if f"mainline {block}" not in names:
            known = ", ".join(name[9:] for name in names if name.startswith("mainline "))
            raise ValueError(f"observation block must be one of {known}, got {block!r}")
        return names.index(f"mainline {block}")


def _channel(
    block: str, starts: Mapping[str, int], offsets: Mapping[int, int], n: int, kind: str
) -> Channel:
    """Make a channel; ``offsets`` maps a segment to the position of its value in the block."""
    centre, scale = CENTRES[block]
    source = tuple(starts[block] + offsets[i] if i in offsets else None for i in range(n))
    return Channel(f"{kind} {block}", source, centre, scale)


# Names of parameters below are those of the weights in saved policies.


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


class PlackettLucePolicy(BasePolicy):
    """Scores every segment with a shared network and queries an ordered set of B distinct ones.

    Actions are those of the encoding ``slots``. Random ones follow the Plackett-Luce distribution
    over the scores, deterministic ones are the B highest scores, ties upstream. The network
    (`Scorer`) starts as a rule and learns a correction to it.

    One set of weights serves any B, any estimator, any privacy and roads of any length whose
    channels are the same (`RoadChannels`): nothing in it is tied to a segment. It may perform worse
    on another road.

    The policy has no critic and no optimizer: it is trained by regression and rounds of swaps
    (``dptse train``), not by PPO.

    Attributes:
        bandwidth: B, queries a step.
        road: Layout of the observations.
        width: Features per segment.
        rule: Initial weights of the rule by observation block.
        skips_sensors: Whether it leaves segments with a fixed sensor to that sensor, which tells
            every second what a query would, as long as there are others to query.
        features: Module that arranges observations along the road.
        scorer: Module that scores segments; it has all learned weights.
    """

    handicap: Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        road: RoadChannels,
        width: int = 48,
        rule: Mapping[str, float] = RULE,
        skips_sensors: bool = True,
    ) -> None:
        """Make the network.

        Args:
            observation_space: Flat observations of ``road.size`` numbers.
            action_space: ``MultiDiscrete([n] * B)``, of the encoding ``slots``.
            road: Layout of the observations, `RoadChannels.from_config` of the environment's
                configuration.
            width: Features per segment.
            rule: Initial weights of observation blocks in the scores.
            skips_sensors: Whether segments with a fixed sensor come last.

        Raises:
            ValueError: A space does not fit ``road``, or the rule has an unknown block.
        """
        self.bandwidth = _bandwidth(observation_space, action_space, road)
        super().__init__(observation_space, action_space)
        self.road, self.width, self.rule = road, width, dict(rule)
        self.skips_sensors = skips_sensors
        last = LAST_PLACE * torch.tensor(road.sensor_mark) if skips_sensors else torch.zeros(())
        self.register_buffer("handicap", last, persistent=False)
        self.features = RoadFeatures(road)
        self.scorer = Scorer(road, width, rule)

    @classmethod
    def from_config(cls, config: EnvConfig, **arguments: Any) -> PlackettLucePolicy:
        """Make a policy for the environments of ``config``, whose actions are ``slots``.

        Args:
            config: Configuration of the environment.
            **arguments: ``width``, ``rule`` and ``skips_sensors``.

        Raises:
            ValueError: Another encoding of actions, or queries of more than single segments.
        """
        interface = make_interface(config)
        spaces = interface.observations.space, interface.actions.space
        return cls(*spaces, road=RoadChannels.from_config(config), **arguments)

    def sharing(self, config: EnvConfig) -> PlackettLucePolicy:
        """Return a policy for another environment that has the very same weights.

        A training that moves them moves both policies.

        Raises:
            ValueError: The environment's actions do not fit, or its channels differ.
        """
        twin = PlackettLucePolicy.from_config(
            config, width=self.width, rule=self.rule, skips_sensors=self.skips_sensors
        )
        names, own = ([channel.name for channel in each.road.channels] for each in (twin, self))
        if names != own:
            missing, more = sorted(set(own) - set(names)), sorted(set(names) - set(own))
            raise ValueError(
                f"environments must have the same channels to share a network; one lacks "
                f"{missing} and has {more} besides"
            )
        twin.scorer = self.scorer
        return twin

    def scores(self, observation: Tensor) -> Tensor:
        """Return the scores (k, n) of observations (k, size)."""
        scores: Tensor = self.scorer(self.features(observation))
        return scores

    def get_distribution(self, observation: Tensor) -> PlackettLuce:
        """Return the distribution over ordered sets for observations (k, size)."""
        return PlackettLuce(self.scores(observation) - self.handicap, self.bandwidth)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        sets = self.get_distribution(observation)
        return sets.mode() if deterministic else sets.sample()

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "road": self.road,
            "width": self.width,
            "rule": self.rule,
            "skips_sensors": self.skips_sensors,
        }


def _bandwidth(
    observations: spaces.Space[Any], actions: spaces.Space[Any], road: RoadChannels
) -> int:
    """Return B of an action space, or refuse spaces that do not fit the layout."""
    if observations.shape != (road.size,):
        raise ValueError(
            f"observation_space must have shape {(road.size,)}, as in road, got {observations}"
        )
    if (
        not isinstance(actions, spaces.MultiDiscrete)
        or actions.nvec.ndim != 1
        or (actions.nvec != road.n_mainline).any()
        or len(actions.nvec) > road.n_mainline
    ):
        raise ValueError(
            f"action_space must be MultiDiscrete([{road.n_mainline}] * B) with B up to "
            f"{road.n_mainline}, of action='slots'; got {actions}"
        )
    return len(actions.nvec)
