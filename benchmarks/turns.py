"""Time of a step in one environment over that in another, both in turns.

python -m benchmarks.turns --envs 'dptse_env:dptse/PrivateHighway-v1' \
    'dptse_env:dptse/PrivateHighway-v1 {"penetration": 0.1}'

Rates drift between machines and moments, ratios of turns that follow one another far less: whatever
is compared takes its turns in one process, and a ratio is the geometric mean over the rounds.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from agents.environments import parse_env, quietly
from agents.statistics import Interval, geometric_mean_interval
from agents.terminal import make_table, print_table
from dptse_env.utils.arrays import FloatArray
from dptse_env.vector_env import SensorQueryVectorEnv
from scripts.cli import run

Work = Callable[[], int]
"""Does a turn of work and returns the number of its steps, over all episodes."""


HEADER = ("", "us a step", "ratio", "95 % interval", "to")


class Line(NamedTuple):
    """A line of the table.

    Attributes:
        what: Work that was measured.
        time: Median time of a step of an episode [us].
        ratio: That time over the one of ``base``, with its 95 % interval; None for a base.
        base: Work that it is compared with.
    """

    what: str
    time: float
    ratio: Interval | None = None
    base: str = ""


def take_turns(
    work: Mapping[str, Work],
    rounds: int,
    prepare: Callable[[], object] = lambda: None,
) -> dict[str, FloatArray]:
    """Let each kind of work have its turn, again and again, so that all meet the same weather.

    Args:
        work: What is measured, by name.
        rounds: Rounds that count, 2 or more; one before them compiles and fills caches.
        prepare: Called ahead of every round, off the clock.

    Returns:
        By name, the time of a step in each round [us], shape (rounds,).
    """
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(1 + rounds):
        prepare()
        for name, turn in work.items():
            start = time.perf_counter()
            steps = turn()
            times[name].append(1e6 * (time.perf_counter() - start) / steps)
    return {name: np.array(found[1:]) for name, found in times.items()}


def compare(times: Mapping[str, FloatArray], bases: Mapping[str, str]) -> list[Line]:
    """Return a line for each kind of work.

    Args:
        times: What `take_turns` returns.
        bases: By name, the work that another one is compared with, where there is one.
    """
    return [
        Line(
            name,
            float(np.median(found)),
            geometric_mean_interval(found / times[bases[name]]) if name in bases else None,
            bases.get(name, ""),
        )
        for name, found in times.items()
    ]


def measure(part: str, quick: bool) -> list[Line]:
    """Return the lines of a part; here, so that a process of its own can be asked for them."""
    lines: list[Line] = importlib.import_module(f"benchmarks.{part}").measure(quick=quick)
    return lines


def as_cells(line: Line) -> list[str]:
    """Return a line as the cells of a row under `HEADER`."""
    ratio, interval = "", ""
    if line.ratio is not None:
        ratio = f"{line.ratio.mean:.3g}"
        interval = f"{line.ratio.low:.3g} to {line.ratio.high:.3g}"
    return [line.what, f"{line.time:,.1f}", ratio, interval, line.base]


def show(title: str, lines: Iterable[Line]) -> None:
    """Print lines as a table."""
    table = make_table(title, *HEADER)
    table.columns[-1].justify = "left"
    for line in lines:
        table.add_row(*as_cells(line))
    print_table(table)


def random_queries(env: SensorQueryVectorEnv, n_steps: int) -> list[Any]:
    """Return sampled actions of a batch for a number of steps, always the same ones."""
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(n_steps)]


def make_batch(text: str, n_episodes: int, **more: Any) -> SensorQueryVectorEnv:
    """Make a batch of an environment that is given as ``'id {json}'``."""
    env_id, keywords = parse_env(text)
    with quietly():
        env = gym.make_vec(env_id, num_envs=n_episodes, **{"threads": 1, **more, **keywords})
    assert isinstance(env, SensorQueryVectorEnv)
    env.reset(seed=0)
    return env


def stepping(env: SensorQueryVectorEnv, n_steps: int) -> Work:
    """Return work that takes a number of steps in all episodes."""
    actions = random_queries(env, n_steps)

    def turn() -> int:
        for action in actions:
            env.step(action)
        return n_steps * env.num_envs

    return turn


@dataclass(frozen=True)
class Args:
    """Compare environments, the others with the first one."""

    envs: tuple[str, ...]
    """Environments, each an id, or an id, a space and keywords as JSON."""
    episodes: int = 256
    """Episodes of a batch."""
    steps: int = 20
    """Steps of a turn."""
    rounds: int = 25
    """Turns of each."""
    quick: bool = False
    """Smallest sizes: whether it runs, not how fast it is."""


def main(args: Args) -> None:
    """Measure and print."""
    if args.quick:
        args = replace(args, episodes=2, steps=2, rounds=2)
    work = {
        text: stepping(make_batch(text, args.episodes, traffic_seeds="0:16"), args.steps)
        for text in args.envs
    }
    first = args.envs[0]
    times = take_turns(work, args.rounds)
    show(
        f"{args.episodes} episodes, one thread", compare(times, dict.fromkeys(args.envs[1:], first))
    )


if __name__ == "__main__":
    run(main, Args, __doc__)
