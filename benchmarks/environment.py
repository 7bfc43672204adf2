"""Time of an environment's step beside SUMO's second, Gymnasium's vectorisation and sumo-rl.

A step is a second of one episode with the EKF; sumo-rl's takes five seconds, so its time of a
second is a fifth of it. Beside loops the estimator is rewound every 20 s.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections import deque
from functools import partial
from itertools import count
from pathlib import Path

import gymnasium as gym

from agents.environments import PAPER, PRIVATE
from benchmarks.turns import Row, Work, compare, make_batch, repeating, sample, stepping, take_turns
from dptse_env.config import resolve
from dptse_env.traffic import Corridor, RecordLibrary, draw_scenario
from dptse_env.traffic.sumo import running
from dptse_env.traffic.sumo import seconds as seconds_of
from dptse_env.utils.threads import n_cores

LOOPS = {"loops": {"positions": [0.0, 0.5, 1.0, 1.5], "interval": 20}}


def measure(*, quick: bool = False) -> list[Row]:
    """Return the rows of all environments; the ratios are to the largest batch on one thread.

    Those beside loops are to the same without.
    """
    n, steps, rounds = (2, 2, 2) if quick else (1024, 16, 10)
    keywords = {"traffic_seeds": "0:2" if quick else "0:64", "horizon": 600, "random_start": True}
    keywords["estimator_settings"] = None
    base = f"batch of {n:,}"
    with tempfile.TemporaryDirectory() as folder:
        corridor = resolve("paper-highway", {}).corridor
        duration, libraries = corridor.conditions.duration, (Path(folder, str(k)) for k in count())
        work: dict[str, Work] = {
            "libsumo alone": (partial(simulate, corridor), duration),
            "recording": (lambda: RecordLibrary(next(libraries)).get(corridor, 0), duration),
        }
        if importlib.util.find_spec("sumo_rl"):
            work["sumo-rl, one intersection"] = intersection(60 if quick else 600)
        for name, more in (("one episode", {}), ("one episode, loops", LOOPS)):
            env = gym.make(PAPER, **keywords, **more)
            env.reset(seed=0)
            actions = sample(env.action_space, 8 if quick else 400)
            work[name] = repeating(env, actions, 1, env.reset)
        for mode in ("sync", "async"):
            envs = gym.make_vec(PAPER, num_envs=8, vectorization_mode=mode, **keywords)
            envs.reset(seed=0)
            actions = sample(envs.action_space, 4 if quick else 100)
            work[f"{mode} vectorisation, 8 episodes"] = repeating(envs, actions, 8)
        for name, more in (("batch of 64", {}), ("batch of 64, loops", LOOPS)):
            work[name] = stepping(make_batch(PAPER, 64, **keywords, **more), 4 * steps)
        work[base] = stepping(make_batch(PAPER, n, **keywords), steps)
        if n_cores() > 1:
            batch = make_batch(PAPER, n, threads=None, **keywords)
            work[f"{base}, {n_cores()} threads"] = stepping(batch, steps)
        keywords |= {"estimator": "ekf", "bandwidth": 5}
        work[f"{base}, PrivateHighway"] = stepping(make_batch(PRIVATE, n, **keywords), steps)
        times = take_turns(work, rounds)
        bases = {f"{name}, loops": name for name in ("one episode", "batch of 64")}
    return compare(times, {name: bases.get(name, base) for name in times if name != base})


def simulate(corridor: Corridor) -> None:
    """Simulate the scenario that is recorded, incident and all, and read nothing."""
    scenario = draw_scenario(corridor, 0)
    with running(corridor, scenario) as libsumo:
        deque(seconds_of(libsumo, corridor, scenario), maxlen=0)


def intersection(duration: int) -> Work:
    """Return work that plays an episode of sumo-rl's single intersection, on libsumo."""
    import sumo  # noqa: PLC0415  not always there

    # sumo-rl and traci read both when they are imported.
    os.environ.update(SUMO_HOME=sumo.SUMO_HOME, LIBSUMO_AS_TRACI="1")
    import sumo_rl  # noqa: PLC0415

    nets = Path(sumo_rl.__file__).parent / "nets" / "single-intersection"
    env = gym.make(
        "sumo-rl-v0",
        net_file=str(nets / "single-intersection.net.xml"),
        route_file=str(nets / "single-intersection.rou.xml"),
        delta_time=5,
        num_seconds=duration,
        sumo_warnings=False,
    )
    env.action_space.seed(0)

    def turn() -> None:
        env.reset(seed=0)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
        env.close()  # one simulation at a time

    return turn, duration
