"""`RoadPolicy`: scores every segment by one network, and queries an ordered set of them.

Its parts come first: the observation as channels along the road, the modules of the network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import Tensor, nn

from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface
from dptse_env.road import DIVERGE, MERGE
from dptse_env.sb3.plackett_luce import PlackettLuce
from dptse_env.sb3.vec_env import config_of

MOST_NEIGHBOURS = 16
"""Largest number of neighbours on either side that a convolution of a saved policy sees."""

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
    "spent_share": (0.5, 0.3),
}
"""Centre and scale of each block's values, chosen so that channels are of order one. They are
constants rather than running statistics, which could be lost between training and use."""

MAINLINE_BLOCKS = (
    "density", "speed", "density_log_std", "speed_log_std", "density_innovation",
    "speed_innovation", "age", "queried",
)  # fmt: skip
PRICE_BLOCKS = ("last_price", "spent_share")
"""Blocks with channels where the observation has them."""

RAMP_BLOCKS = ("density", "speed", "density_log_std", "speed_log_std")
FIXED_SENSOR_BLOCKS = ("fixed_density_innovation", "fixed_speed_innovation")


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
    """Channels of an observation along the road, as plain data that travels with a policy.

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
        """Return the channels of the observations of an environment of ``config``.

        Raises:
            ValueError: Queries are not of single segments.
        """
        if not config.queries.are_segments:
            raise ValueError(
                "a policy whose network is shared by all segments needs query_spans (1,), got "
                f"{config.queries}"
            )
        corridor, n = config.corridor, config.corridor.geometry.n_mainline
        encoding = make_interface(config).observations
        starts = {name: place.start for name, place in encoding.slices.items()}
        released = [name for name in starts if name.startswith("released_")]
        prices = [name for name in PRICE_BLOCKS if name in starts]
        road = corridor.road
        parties = road.parties.tolist()
        joins = {s: parties[s][1] for s in np.flatnonzero(road.kind == MERGE).tolist() if s >= n}
        leaves = {parties[s][2]: s for s in np.flatnonzero(road.kind == DIVERGE).tolist()}
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


# Names of parameters below are those of the weights in saved policies. Arrays inside of the network
# have the segments first and the k observations last: then the neighbours of a segment lie beside
# it in memory, a convolution is a product of matrices without a copy, and what is gathered are rows
# of k numbers. With the observations first, learning takes a seventh longer.


class RoadFeatures(nn.Module):
    """Arranges observations (k, size) as what a convolution sees in each of n segments.

    A segment has the channels of `RoadChannels`, the logarithms of its age, of the difference of
    its neighbours' speeds, which is large at a front of a jam, and of its speed; then the marks. In
    this order come its own values first, those of its neighbours from upstream to downstream, which
    are 0 beyond the ends of the road, and its place p on the road, from -1 to 1, p^2 and 1.
    """

    source: Tensor
    offset: Tensor
    factor: Tensor
    fixed: Tensor
    inside_factor: Tensor
    inside_offset: Tensor

    def __init__(self, road: RoadChannels, reach: int) -> None:
        """Store the position of each value in an observation; nothing here is learned or saved."""
        super().__init__()
        n, size = road.n_mainline, road.size
        place = torch.linspace(-1.0, 1.0, n)
        rows = torch.stack([*torch.tensor(road.marks), place, place**2, torch.ones(n)])
        fixed = torch.cat([rows.flatten(), torch.zeros(1)])
        after = torch.arange(size, size + (3 + len(rows)) * n).reshape(-1, n)
        zero = size + after.numel()  # where there is no value
        source = [[zero if at is None else at for at in c.source] for c in road.channels]
        local = torch.cat([torch.tensor(source), after[: 3 + len(road.marks)]])  # (channels, n)
        padded = nn.functional.pad(local, (reach, reach), value=zero)
        around = [padded[:, i : i + n] for i in range(2 * reach + 1) if i != reach]
        columns = torch.cat([local, *around, after[-3:]])
        self.n_inputs = len(columns)
        first = [source[road.index(name)][0] for name in ("age", "speed")]
        self._age, self._speed = (slice(at, at + n) for at in first)

        centre, factor = torch.zeros(zero + 1), torch.ones(zero + 1)
        for channel in road.channels:
            at = [place for place in channel.source if place is not None]
            centre[at], factor[at] = channel.centre, 1.0 / channel.scale
        centre[after[:3].flatten()] = torch.tensor([1.5, -2.5, 0.0]).repeat_interleave(n)
        for name, value in (
            ("source", columns.T.flatten()),
            ("offset", (-centre * factor)[:, None]),
            ("factor", factor[:, None]),
            ("fixed", fixed[:, None]),
            # Inside of the logarithms.
            ("inside_factor", torch.tensor([60.0, 1.0, 1.0]).repeat_interleave(n)[:, None]),
            ("inside_offset", torch.tensor([1.0, 0.02, 0.3]).repeat_interleave(n)[:, None]),
        ):
            self.register_buffer(name, value, persistent=False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the inputs (n, n_inputs, k) of observations (k, size)."""
        rows = observation.T.contiguous()
        age, speed = rows[self._age], rows[self._speed]
        ends = torch.cat([speed[:1], speed, speed[-1:]])
        front = (ends[2:] - ends[:-2]).abs()
        inside = torch.cat([age, front, speed]).clamp_min(0.0)
        logs = torch.addcmul(self.inside_offset, inside, self.inside_factor).log()
        values = torch.cat([rows, logs, self.fixed.expand(-1, rows.shape[1])])
        scaled = torch.addcmul(self.offset, values, self.factor)
        return scaled.index_select(0, self.source).view(-1, self.n_inputs, rows.shape[1])


class Neighbourhoods(torch.autograd.Function):
    """The features (n, c, k) of each segment and its neighbours, (n, (2 reach + 1) c, k).

    Beyond the ends of the road they are 0. They are views of the padded features. The gradient is
    written out, as torch takes many more passes over the views.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, reach: int) -> Tensor:
        """See `torch.autograd.Function.forward`."""
        ctx.reach = reach
        padded = nn.functional.pad(features, (0, 0, 0, 0, reach, reach))
        return padded.unfold(0, 2 * reach + 1, 1).permute(0, 3, 1, 2).flatten(1, 2)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """See `torch.autograd.Function.backward`."""
        reach, (n, _, k) = ctx.reach, gradient.shape
        slots = gradient.view(n, 2 * reach + 1, -1, k)
        total = slots[:, reach].clone()
        for by in range(1, min(reach + 1, n)):
            total[:-by] += slots[by:, reach - by]
            total[by:] += slots[:-by, reach + by]
        return total, None


def in_each_segment(layer: nn.Linear, x: Tensor) -> Tensor:
    """Return the products (n, rows, k) of weights (rows, c) with what segments have, (n, c, k)."""
    return torch.bmm(layer.weight.expand(len(x), -1, -1), x)


class Trunk(nn.Module):
    """Two convolutions along the road; the second also sees the first's mean over the road.

    They are products of matrices, which are faster than convolutions of so few segments. The
    constant of the first one, ``near``, is the weight of the input that is 1.
    """

    def __init__(self, n_inputs: int, width: int, reach: int) -> None:
        """Make a trunk of ``width`` features per segment, of ``reach`` neighbours either side."""
        super().__init__()
        self.reach = reach
        self.near = nn.Linear(n_inputs, width, bias=False)
        self.far = nn.Linear((2 * reach + 1) * width, width, bias=False)
        self.whole = nn.Linear(width, width)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return features (n, width, k) of inputs (n, n_inputs, k)."""
        near = in_each_segment(self.near, inputs).relu_()
        around = Neighbourhoods.apply(near, self.reach)  # type: ignore[no-untyped-call]
        of_road = torch.addmm(self.whole.bias[:, None], self.whole.weight, near.mean(dim=0))
        return in_each_segment(self.far, around).add_(of_road).relu_()


class Scorer(nn.Module):
    """The actor: scores each segment by a rule linear in its inputs plus features of a trunk."""

    def __init__(self, n_inputs: int, width: int, reach: int) -> None:
        """Make a scorer that begins nearly indifferent."""
        super().__init__()
        self.trunk = Trunk(n_inputs, width, reach)
        self.rule = nn.Linear(n_inputs, 1, bias=False)
        self.correction = nn.Linear(width, 1, bias=False)
        nn.init.zeros_(self.rule.weight)
        # Small rather than zero, which would keep the trunk's gradient at zero at first.
        with torch.no_grad():
            self.correction.weight *= 0.1

    def forward(self, inputs: Tensor) -> Tensor:
        """Return scores (k, n) of inputs (n, n_inputs, k)."""
        correction = in_each_segment(self.correction, self.trunk(inputs))
        return (in_each_segment(self.rule, inputs) + correction)[:, 0].T


class Critic(nn.Module):
    """Values of observations: by the mean and the largest of a trunk's features over the road."""

    def __init__(self, n_inputs: int, width: int, reach: int) -> None:
        """Make a critic of ``width`` features per segment."""
        super().__init__()
        self.trunk = Trunk(n_inputs, width, reach)
        self.head = nn.Sequential(
            nn.Linear(2 * width, 4 * width), nn.ReLU(), nn.Linear(4 * width, 1)
        )

    def forward(self, inputs: Tensor) -> Tensor:
        """Return values (k, 1) of inputs (n, n_inputs, k)."""
        features = self.trunk(inputs)
        value: Tensor = self.head(torch.cat([features.mean(dim=0), features.amax(dim=0)]).T)
        return value


class RoadPolicy(ActorCriticPolicy):
    """Scores every mainline segment by one network and queries by `PlackettLuce`.

    Weights are shared by all segments, so one network acts on roads of any size with any bandwidth.
    Actions are those of the encoding ``slots``; they never repeat a segment. Observations are
    scaled by constants of the channels: leave ``norm_obs`` of ``VecNormalize`` off. ``dptse train``
    trains it by PPO, or its scores by regression and swaps. With stable-baselines3 alone::

        PPO(RoadPolicy, SB3VecEnv(env), policy_kwargs=RoadPolicy.kwargs(env))

    Attributes:
        bandwidth: B, queries a step.
        road: Channels of the observations.
        sizes: Arguments other than ``road``: ``width``, ``critic_width``, ``reach`` and
            ``skips_sensors``, which leaves segments with a fixed sensor to that sensor, since it
            tells every second what a query would, as long as there are others to query.
        features: Module that arranges observations along the road.
        scorer: Module that scores segments; it has all weights that actions depend on.
        critic: Module that estimates values.
    """

    handicap: Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule = BasePolicy._dummy_schedule,
        *,
        road: RoadChannels,
        width: int = 32,
        critic_width: int = 16,
        reach: int = 1,
        skips_sensors: bool = True,
        **more: Any,
    ) -> None:
        """Make the network.

        Args:
            observation_space: Flat observations of ``road.size`` numbers.
            action_space: ``MultiDiscrete([n] * B)``, of the encoding ``slots``.
            lr_schedule: Learning rate of the optimizer; none where another one trains the weights.
            road: Channels of the observations, `RoadChannels.from_config` of the environment's
                configuration.
            width: Features per segment of the actor.
            critic_width: Features per segment of the critic.
            reach: Neighbours on either side that each of two convolutions sees.
            skips_sensors: Whether segments with a fixed sensor come last.
            **more: Further arguments of the base class, such as ``optimizer_class``.

        Raises:
            ValueError: A space does not fit ``road``.
        """
        self.bandwidth = _bandwidth(observation_space, action_space, road)
        self.road = road
        self.sizes = {
            "width": width, "critic_width": critic_width, "reach": reach,
            "skips_sensors": skips_sensors,
        }  # fmt: skip
        super().__init__(observation_space, action_space, lr_schedule, **more)

    def _build(self, lr_schedule: Schedule) -> None:
        """Make the modules and the optimizer; called by the base class."""
        mark = torch.tensor(self.road.sensor_mark)
        last = LAST_PLACE * mark if self.sizes["skips_sensors"] else torch.zeros(())
        self.register_buffer("handicap", last, persistent=False)
        reach = self.sizes["reach"]
        self.features = RoadFeatures(self.road, reach)
        self.scorer = Scorer(self.features.n_inputs, self.sizes["width"], reach)
        self.critic = Critic(self.features.n_inputs, self.sizes["critic_width"], reach)
        self.action_dist = PlackettLuce(self.bandwidth)
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    @classmethod
    def kwargs(cls, env: Any) -> dict[str, Any]:
        """Return the ``policy_kwargs`` of an algorithm for an environment: its road.

        Args:
            env: Of this package, scalar or vector, wrapped or not, or as an `SB3VecEnv`.

        Raises:
            ValueError: Another environment, or queries of more than single segments.
        """
        return {"road": RoadChannels.from_config(config_of(env))}

    @classmethod
    def from_config(cls, config: EnvConfig, **arguments: Any) -> RoadPolicy:
        """Make a policy for the environments of ``config``, whose actions are ``slots``.

        Args:
            config: Configuration of the environment.
            **arguments: As those of the class.

        Raises:
            ValueError: Another encoding of actions, or queries of more than single segments.
        """
        interface = make_interface(config)
        spaces = interface.observations.space, interface.actions.space
        return cls(*spaces, road=RoadChannels.from_config(config), **arguments)

    def sharing(self, config: EnvConfig) -> RoadPolicy:
        """Return a policy for another environment that has the very same weights.

        A training that moves them moves both policies.

        Raises:
            ValueError: The environment's actions do not fit, or its channels differ.
        """
        twin = RoadPolicy.from_config(config, **self.sizes)
        names, own = ([channel.name for channel in each.road.channels] for each in (twin, self))
        if names != own:
            missing, more = sorted(set(own) - set(names)), sorted(set(names) - set(own))
            raise ValueError(
                f"environments must have the same channels to share a network; one lacks "
                f"{missing} and has {more} besides"
            )
        twin.scorer, twin.critic = self.scorer, self.critic
        return twin

    def scores(self, observation: PyTorchObs) -> Tensor:
        """Return the scores (k, n) of observations (k, size)."""
        scores: Tensor = self.scorer(self.features(observation))
        return scores

    def forward(self, obs: Tensor, deterministic: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions (k, B), values (k, 1) and log-probabilities (k,)."""
        sets, values = self._both(obs)
        actions = sets.get_actions(deterministic)
        return actions, values, sets.log_prob(actions)

    def evaluate_actions(
        self, obs: PyTorchObs, actions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return values (k, 1), log-probabilities of actions (k, B), and entropies, (k,) each."""
        sets, values = self._both(obs)
        return values, sets.log_prob(actions), sets.entropy()

    def predict_values(self, obs: PyTorchObs) -> Tensor:
        """Return values (k, 1) of observations (k, size)."""
        values: Tensor = self.critic(self.features(obs))
        return values

    def get_distribution(self, obs: PyTorchObs) -> PlackettLuce:
        """Return the distribution over ordered sets for observations (k, size)."""
        return self._sets(self.scores(obs))

    def _both(self, obs: PyTorchObs) -> tuple[PlackettLuce, Tensor]:
        """Return distribution and values (k, 1)."""
        inputs = self.features(obs)
        return self._sets(self.scorer(inputs)), self.critic(inputs)

    def _sets(self, scores: Tensor) -> PlackettLuce:
        return PlackettLuce(self.bandwidth).proba_distribution(scores - self.handicap)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "road": self.road,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            **self.sizes,
        }


def _bandwidth(
    observations: spaces.Space[Any], actions: spaces.Space[Any], road: RoadChannels
) -> int:
    """Return B of an action space, or refuse spaces that do not fit the road."""
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
