"""`RoadChannels`: a flat observation as channels along the road."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dptse_env.config import EnvConfig
from dptse_env.parts import make_interface

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
