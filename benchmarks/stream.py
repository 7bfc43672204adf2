"""Time of a second of a stream of one's own beside a second of an environment.

The road has 60 segments, and stations at every fifth border that report each minute, or each
ten seconds. An environment of the same estimator queries a third of the segments.
"""

from __future__ import annotations

from collections.abc import Callable

from agents.environments import quietly
from agents.figures import LABELS
from benchmarks.long_roads import long_road
from benchmarks.turns import Row, Work, compare, make_batch, repeating, sample, take_turns
from dptse_env import RoadEstimator, station
from dptse_env.traffic import Corridor

ESTIMATORS = ("recurrent", "asm", "ekf")


def measure(*, quick: bool = False) -> list[Row]:
    """Return the rows of all estimators; the ratios are to an environment's."""
    n, seconds, rounds = (16, 120, 2) if quick else (60, 600, 10)
    road = long_road(n).replaced(**({"duration": 60, "incident": None} if quick else {}))
    work: dict[str, Work] = {}
    bases = {}
    for name in ESTIMATORS:
        base = f"{LABELS[name]}, a second of an environment"
        env = make_batch(
            "dptse_env:dptse/PaperHighway-v0", 1, corridor=road, privacy="corrected",
            parameters="w99-3lane", bandwidth=n // 3, traffic_seeds=[0], estimator=name,
        )  # fmt: skip
        work[base] = repeating(env, sample(env.action_space, 50), 1)
        for interval in (60, 10):
            what = f"{LABELS[name]}, a second of a stream, readings of {interval} s"
            work[what] = streaming(road, name, interval, seconds), seconds
            bases[what] = base
    return compare(take_turns(work, rounds), bases)


def streaming(road: Corridor, estimator: str, interval: int, seconds: int) -> Callable[[], None]:
    """Return work that takes readings of stations as they come in, and estimates each second."""
    with quietly():
        followed = RoadEstimator(road, estimator)
    borders = range(0, road.geometry.n_mainline + 1, 5)
    said = [station(0.1 * face, flow=4500, speed=90, seconds=interval) for face in borders]

    def turn() -> None:
        for second in range(1, seconds + 1):
            followed.step(said if second % interval == 0 else ())
            followed.estimate()

    return turn
