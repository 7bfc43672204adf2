"""Draw two worlds and one ledger from an episode of PrivateHighway: docs/images/two_worlds.png.

python docs/_site/two_worlds.py
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agents.audit.attack import overheard
from agents.audit.planner import public_plan
from agents.audit.worlds import Trajectory, Worlds
from agents.environments import make_config
from agents.figures import COLOURS, WIDTH, add_frame, make_figure, save_figure
from dptse_env.config import EnvConfig
from dptse_env.parts import privacy_report
from dptse_env.traffic import Record, RecordLibrary
from dptse_env.utils.arrays import FloatArray

PICTURE = Path(__file__).parents[1] / "images" / "two_worlds.png"
VEHICLES = 180, 252  # of the record of traffic seed 0: both meet the queue behind the incident
SHOWN = 185, 450  # seconds
SEGMENT = 8  # where both wait
LINES = [{"color": c, "ls": s, "lw": 1.8} for c, s in zip(COLOURS, ("-", "--"), strict=False)]


class Transcript(NamedTuple):
    """An episode of T seconds, played in world 0, and the ledger of the trip of either world.

    Attributes:
        paid: What each trip has paid, over the budget, shape (2, T).
        counted: Segment on which each is counted in a second, nan where it is not, shape (2, T).
        square: Squared distance of the true sums of both worlds over mu^2, shape (T,).
        released: Released counts of `SEGMENT`, nan where it is not queried, shape (T,).
    """

    paid: FloatArray
    counted: FloatArray
    square: FloatArray
    released: FloatArray


def play(config: EnvConfig, worlds: Worlds) -> Transcript:
    """Play world 0 under a round robin; keep ledgers as `Paced` does, but for its rounding."""
    T, clip, ratio = config.horizon_steps, config.privacy.clip, config.privacy.ratio
    mu = privacy_report(config).mu
    found = Transcript(*(np.full(shape, np.nan) for shape in ((2, T), (2, T), T, T)))
    trips = [
        {t: (s, v) for t, s, v in zip(trip.step, trip.segment, trip.speed, strict=True)}
        for trip in worlds.pair
    ]
    plan, paid = public_plan(config, "round-robin"), np.zeros(2)
    world_0, streams = np.zeros(1, dtype=np.int64), [np.random.default_rng(0)]
    for t, release in enumerate(overheard(config, worlds, world_0, plan, streams)):
        observed, values, sigma, centre = (part[0] for part in release.last)
        length = release.task.channels.length
        for world, trip in enumerate(trips):
            segment, speed = trip.get(t + 1, (0, np.nan))
            for c in np.flatnonzero(observed & (release.task.channels.first == segment)):
                price = (sigma[c, 0] * length[c]) ** -2
                d = np.clip(speed - centre[segment], -clip, clip)
                payment = price * (1.0 + ratio * (d / clip) ** 2)
                if paid[world] + payment <= mu**2 / 2.0:  # nan is not
                    paid[world] += payment
                    found.counted[world, t] = segment
        found.paid[:, t], found.square[t] = paid / (mu**2 / 2.0), release.square[0] / mu**2
        if observed[SEGMENT]:
            found.released[t] = values[SEGMENT, 0] * length[SEGMENT]
    return found


def draw(config: EnvConfig, worlds: Worlds, found: Transcript) -> Figure:
    """Draw both worlds above, and what is published and paid below."""
    figure = make_figure(WIDTH, 5.4)
    (first, second), (published, ledger) = figure.subplots(2, 2, sharex=True)
    seconds = np.arange(1, found.square.size + 1)
    for world, axis in enumerate((first, second)):
        line = LINES[world]
        trip = worlds.pair[world]
        on_road = trip.only(trip.segment < config.corridor.geometry.n_mainline)
        draw_others(axis, worlds.rest, config.corridor.geometry.n_mainline)
        axis.plot(on_road.step, on_road.segment, **line)
        axis.plot(seconds, found.counted[world], "o", color=line["color"], ms=3.5)
        counts = worlds.get(config.corridor, world).counts[1:, SEGMENT]
        published.step(seconds, counts, **line | {"lw": 1.2})
        ledger.plot(seconds, 100.0 * found.paid[world], **line)
        axis.set_ylabel("segment", fontsize=9)
    add_title(first, "World 0: the trip", COLOURS[0])
    add_title(second, "World 1: another trip", COLOURS[1])
    say(first, (320, 3.2), "dots: counted", "black")
    published.plot(seconds, found.released, ".", color="black", ms=4)
    published.set_ylim(0, 45)
    published.set_ylabel("count [veh]", fontsize=9)
    add_title(published, f"Noisy counts, segment {SEGMENT}")
    say(published, (192, 1.5), "lines: true counts", "black")
    ledger.plot(seconds, 100.0 * found.square, ":", color="black", lw=1.8)
    ledger.axhline(100.0, color="black", lw=0.8)
    ledger.set_ylim(0, 112)
    ledger.set_ylabel("paid [%]", fontsize=9)
    add_title(ledger, "Budget that is paid")
    say(ledger, (190, 90), "trip of world 0", COLOURS[0])
    say(ledger, (357, 45), "trip of\nworld 1", COLOURS[1])
    say(ledger, (300, 8), "dotted: distance²\nof the sums / μ²", "black")
    for axis in figure.axes:
        add_frame(axis)
    for axis in (published, ledger):
        axis.set_xlabel("time [s]", fontsize=9)
        axis.set_xlim(*SHOWN)
    return figure


def draw_others(axis: Axes, rest: Record, n_mainline: int) -> None:
    """Draw every fifth of the other vehicles, which are the same in both worlds."""
    for vehicle in range(0, rest.n_vehicles, 5):
        trip = Trajectory.from_record(rest, vehicle)
        trip = trip.only(trip.segment < n_mainline)
        axis.plot(trip.step, trip.segment, color=COLOURS[-1], lw=0.5, alpha=0.3)


def add_title(axis: Axes, text: str, colour: str = "black") -> None:
    """Name a panel."""
    axis.set_title(text, fontsize=9, loc="left", color=colour)


def say(axis: Axes, at: tuple[float, float], text: str, colour: str) -> None:
    """Write into a panel."""
    axis.text(*at, text, fontsize=7.5, color=colour)


def main() -> None:
    """Draw the picture."""
    config = make_config("dptse_env:dptse/PrivateHighway-v1", {"estimator": "ekf", "bandwidth": 5})
    record = RecordLibrary().get(config.corridor, 0)
    trips = tuple(Trajectory.from_record(record, vehicle) for vehicle in VEHICLES)
    rest = record.without(VEHICLES[1]).without(VEHICLES[0])
    worlds = Worlds.adjacent(rest, trips)
    save_figure(draw(config, worlds, play(config, worlds)), PICTURE, "")


if __name__ == "__main__":
    main()
