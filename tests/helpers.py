"""Helpers of tests in several folders: chosen cases, environments, roads, records and policies."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import combinations, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.config import PRESETS, EnvConfig, resolve
from dptse_env.model import Channels
from dptse_env.parts import make_interface
from dptse_env.release import ReleaseModel
from dptse_env.road import make_road
from dptse_env.traffic import SHORT_HIGHWAY, Conditions, Corridor, Demand, Geometry, Record, Scales
from dptse_env.utils.kernels import kernel

SHORT = "tests.helpers:tests/ShortHighway-v0"
"""Id of the smallest environment: six segments, two queries, records of 240 s.

It has the EKF with the published parameters, whatever the id of the package has.
"""

PRIVATE = "tests.helpers:tests/PrivateHighway-v1"
"""Id of the road with a guarantee, likewise with the EKF and five queries."""

PRESETS["short-plain"] = EnvConfig(corridor="short-highway", bandwidth=2)
PRESETS["private-plain"] = resolve("private-highway", {"estimator": "ekf", "bandwidth": 5})
for env_id, preset in ((SHORT, "short-plain"), (PRIVATE, "private-plain")):
    gym.register(
        env_id.rpartition(":")[2],
        entry_point="dptse_env.env:SensorQueryEnv",
        vector_entry_point="dptse_env.vector_env:SensorQueryVectorEnv",
        kwargs={"preset": preset},
    )

# --- cases: a few for every run, the rest among the slow ones -------------------------------------


def fast_and_slow(cases: Iterable[Any], fast: Collection[Any]) -> list[Any]:
    """Return cases as parameters, marked slow where they are not among the fast ones.

    A case is one value, or a tuple of one for each argument.
    """
    return [_parameter(case, slow=case not in fast) for case in cases]


def pairwise(*axes: Iterable[Any], n: int = 6, rest: bool = True) -> list[Any]:
    """Return the product of axes as parameters: `n` fast ones, and the others (if kept) slow.

    Among the fast ones every value occurs, and as many pairs of values of two axes as possible.
    """
    values = [list(axis) for axis in axes]
    waiting = list(product(*(range(len(axis)) for axis in values)))
    chosen: list[tuple[int, ...]] = []
    covered: set[Any] = set()

    def gain(indices: tuple[int, ...]) -> tuple[int, int]:
        single = list(enumerate(indices))
        return len({*single} - covered), len({*combinations(single, 2)} - covered)

    while waiting and len(chosen) < n:
        best = max(waiting, key=gain)
        waiting.remove(best)
        chosen.append(best)
        covered |= {*enumerate(best), *combinations(enumerate(best), 2)}
    return [
        _parameter(tuple(axis[i] for axis, i in zip(values, indices, strict=True)), slow=slow)
        for slow, group in ((False, sorted(chosen)), (True, waiting if rest else []))
        for indices in group
    ]


def _parameter(case: Any, slow: bool) -> Any:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=[pytest.mark.slow] if slow else [])


# --- other processes ------------------------------------------------------------------------------


def wait_for(condition: Callable[[], Any]) -> None:
    """Wait until a condition holds; five minutes or more pass before that is given up."""
    for _ in range(30_000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("waited in vain")


ROOT = Path(__file__).parents[1]
KILLED = """
import os, pkgutil, runpy, signal, sys
owner, name, calls, how, *sys.argv = sys.argv[1:]
owner, left = pkgutil.resolve_name(owner), [int(calls)]
function = getattr(owner, name)
def counted(*args, **keywords):
    result = function(*args, **keywords)
    left[0] -= 1
    if not left[0]:
        os.kill(os.getpid(), int(how))
    return result
setattr(owner, name, counted)
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module(sys.argv[0], run_name="__main__")
"""


def run_killed(
    owner: str, function: str, calls: int, *words: object, how: int = 9
) -> subprocess.CompletedProcess[str]:
    """Run a module as a program that sends itself a signal after some calls of a function.

    Returns:
        The program, when it and the processes that it has begun are gone.
    """
    command = [sys.executable, "-c", KILLED, owner, function, str(calls), str(int(how))]
    return subprocess.run(
        [*command, *map(str, words)], cwd=ROOT, capture_output=True, text=True, check=False
    )


# --- environments on the short road ---------------------------------------------------------------

EPISODES = {"traffic_seeds": "0:3", "horizon": 6, "random_start": True}
COUNTED = {"preset": "capped", "cap": 5, "boundary_inputs": "private"}
PAID = {"preset": "paced", "boundary_inputs": "private"}


def make_env(**keywords):
    """Return a scalar environment with three seeds of traffic."""
    return gym.make(SHORT, **{"traffic_seeds": "0:3", **keywords})


def make_batch(num_envs: int = 3, **keywords: Any) -> Any:
    """Return a batch of episodes of six steps."""
    return gym.make_vec(SHORT, num_envs=num_envs, **{**EPISODES, **keywords})


def briefly(env_id: str) -> dict[str, Any]:
    """Keywords with which an id's records take a second, whatever the length of its road."""
    is_short = env_id.endswith("ShortHighway-v0")
    return {} if is_short else {"corridor": {"duration": 60, "incident": None}}


def play(env: Any, n_steps: int, seed: int = 0) -> list[Any]:
    """Reset and act at random; return everything that came back."""
    env.action_space.seed(seed)
    seen = [env.reset(seed=seed)]
    seen += [env.step(env.action_space.sample()) for _ in range(n_steps)]
    return seen


def assert_same(first: Any, second: Any, tolerance: float = 0.0) -> None:
    """Compare everything that came back, dtypes and the keys of dicts too."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key], tolerance)
    elif isinstance(first, tuple | list):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other, tolerance)
    elif isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape)
        if first.dtype == object:
            assert_same(first.tolist(), second.tolist(), tolerance)
        elif first.dtype.kind == "f":
            np.testing.assert_allclose(first, second, rtol=0, atol=tolerance)
        else:
            np.testing.assert_array_equal(first, second)
    else:
        assert type(first) is type(second)
        assert first == (pytest.approx(second, abs=tolerance) if type(first) is float else second)


def lock_step(
    keywords: dict[str, Any], n_steps: int, env_id: str = SHORT, autoreset_mode: str = "NextStep"
) -> None:
    """Compare a batch with three scalar environments of the same seeds, at every step.

    Two of the three episodes begin again after two steps, so that ends are not all at one step.
    """
    keywords, mode = {**EPISODES, **keywords}, {"autoreset_mode": autoreset_mode}
    batch = gym.make_vec(env_id, num_envs=3, **mode, **keywords)
    singles = gym.make_vec(
        env_id, num_envs=3, vectorization_mode="sync", vector_kwargs=mode, **keywords
    )
    assert batch.action_space == singles.action_space
    assert batch.observation_space == singles.observation_space

    def reset(seed: int | None, mask: Any) -> None:
        came_back = [
            env.reset(seed=seed, options=None if mask is None else {"reset_mask": np.array(mask)})
            for env in (batch, singles)
        ]
        assert_same(*came_back, 1e-10)

    reset(7, None)
    batch.action_space.seed(1)
    for step in range(n_steps):
        actions = batch.action_space.sample()
        came_back = batch.step(actions)
        assert came_back[0] in batch.observation_space
        assert_same(came_back, singles.step(actions), 1e-10)
        if step == 1:
            reset(40, [True, False, True])
        if autoreset_mode == "Disabled" and came_back[3].any():
            reset(None, came_back[3])
    assert_same(batch.np_random_seed, singles.np_random_seed)
    draws = [[g.integers(2**63) for g in env.np_random] for env in (batch, singles)]
    assert draws[0] == draws[1]


# --- roads and records ----------------------------------------------------------------------------

SHORT_COLUMNS = SHORT_HIGHWAY.geometry.n_cells
AWAY = -1
"""Place of a vehicle that is not on the road."""

UNEVEN = Corridor(
    name="uneven",
    geometry=Geometry(
        n_mainline=8,
        on_ramps=(2, 3),
        off_ramps=(4, 6),
        exit_shares=(0.2, 0.1),
        lanes=(3, 3, 4, 4, 4, 3, 2, 2),
        ramp_lanes=(1, 2, 2, 1),
        segment_length=(0.1, 0.12, 0.2, 0.1, 0.35, 0.09, 0.1, 0.15),
        speed_limit=(102.0, 102.0, 102.0, 120.0, 120.0, 80.0, 80.0, 80.0),
        ramp_segments=(1, 3, 2, 1),
        ramp_length=(0.1, 0.08, 0.2, 0.15),
    ),
    conditions=Conditions(Demand(mainline=((0.0, 2000.0),), on_ramps=(300.0, 200.0)), duration=200),
    scales=Scales(density_scale=333.0, speed_scale=102.0, average_dwell=8.0),
    fixed_sensors=(7,),
)
"""A road with segments and ramps of many kinds."""


def short_road(duration: int) -> Corridor:
    """Return the short highway for records of `duration` seconds, without its incident."""
    demand = Demand(((0.0, 1000.0),), (100.0,))
    return SHORT_HIGHWAY.replaced(duration=duration, demand=demand, incident=None)


def record(places: Any, speeds: Any, n_columns: int = SHORT_COLUMNS) -> Record:
    """A record of places (V, T + 1) of V vehicles, `AWAY` where there is none, and their speeds."""
    step, vehicle = np.nonzero(np.asarray(places).T != AWAY)
    place, speed = (np.asarray(table)[vehicle, step] for table in (places, speeds))
    return Record(
        step=step, vehicle=vehicle, segment=place, speed=speed,
        n_steps=np.shape(places)[1], n_columns=n_columns,
    )  # fmt: skip


def stretch(
    n_mainline: int = 15, on_ramps: tuple[int, ...] = (), off_ramps: tuple[int, ...] = (),
    segment_length: float = 0.1, lanes: int = 3, ramp_lanes: int = 1, more_outside: int = 0,
    **others: Any,
) -> Any:  # fmt: skip
    """A road of segments alike, within wider limits than those of a corridor."""
    n_on, n_ramps = len(on_ramps), len(on_ramps) + len(off_ramps)
    ramps = tuple((n_mainline + i,) for i in range(n_ramps))
    n_segments = n_mainline + n_ramps
    geometry = SimpleNamespace(
        n_mainline=n_mainline, n_segments=n_segments, on_ramps=on_ramps, off_ramps=off_ramps,
        on_ramp_segments=ramps[:n_on], off_ramp_segments=ramps[n_on:],
        segment_lengths=(segment_length,) * n_segments, speed_limits=(102.0,) * n_segments,
        segment_lanes=(lanes,) * n_mainline + (ramp_lanes,) * n_ramps,
        **{"exit_shares": (), **others},
    )  # fmt: skip
    road = make_road(geometry)
    outside = np.arange(road.lanes.size) >= road.n_segments
    road = road._replace(lanes=road.lanes + more_outside * outside)
    return SimpleNamespace(geometry=geometry, road=road)


def make_channels(first: Sequence[int], span: Sequence[int]) -> Channels:
    """Channels of one group on segments of 100 m."""
    spans = np.array(span, dtype=np.int64)
    return Channels(np.array(first, dtype=np.int64), spans, np.zeros_like(spans), 0.1 * spans)


def compiled(part: Any) -> Any:
    """Return a kernel that does nothing but call a part; its machine code is kept as any other."""
    # The part is a global name and not one of a closure, which the fingerprint does not look into.
    names: dict[str, Any] = {"part": part, "__name__": part.__module__}
    exec("def call(*args): return part(*args)", names)
    call = names["call"]
    call.__qualname__ = f"call_{part.__name__}"
    return kernel(call)


# --- release models of sums, for queries that cover several segments ------------------------------


class SumRelease(ReleaseModel):
    """Averages of true density and centred flow, with noise of the same size for every row."""

    releases_sums = True
    sigma = np.array([4.0, 150.0])  # [veh/km, veh/h]

    @classmethod
    def centre(cls, corridor, settings):
        return 0.5 * corridor.geometry.speed_limit

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.streams = {}

    def reset(self, episodes, generators):
        self.streams.update(zip(episodes.tolist(), generators, strict=True))

    def true_values(self, request):
        """Return what is released before noise is added, shape (k, n_columns, 2)."""
        task, corridor = self.task, self.task.corridor
        every = corridor.geometry.n_cells
        values = self.traffic.aggregates(request.traffic, request.times, every)
        values[..., 1] = values[..., 0] * (values[..., 1] - 0.5 * corridor.geometry.speed_limit)
        weights = task.channels.averaging(task.n_cells)
        return np.einsum("cs,nsk->nck", weights, values[:, : task.n_cells])

    def release(self, request):
        values = self.true_values(request).copy()
        for k, episode in enumerate(request.episodes.tolist()):
            values[k] += self.sigma * self.streams[episode].standard_normal(values[k].shape)
        return self.measurement(request, values, self.sigma)


class PricedRelease(SumRelease):
    """The same with a price of 0.01 for each query, and spent shares that grow."""

    has_prices = True

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.prices = np.zeros((task.n_episodes, task.queries.n_queries))
        self.spent_share = np.zeros((task.n_episodes, task.corridor.geometry.n_mainline))

    def reset(self, episodes, generators):
        super().reset(episodes, generators)
        self.prices[episodes], self.spent_share[episodes] = 0.0, 0.0

    def release(self, request):
        queries = self.task.queries
        asked = request.observed[:, : queries.n_queries]
        before = self.prices[request.episodes]
        self.prices[request.episodes] = np.where(asked, 0.01, before)
        self.spent_share[request.episodes] += 0.25 * self.task.covered(request.observed)
        return super().release(request)

    def public(self, episodes):
        return {"prices": self.prices[episodes], "spent_share": self.spent_share[episodes]}


class MeanRelease(SumRelease):
    """One that says that it releases sums, and releases mean speeds."""

    @classmethod
    def centre(cls, corridor, settings):
        return None


# --- policies -------------------------------------------------------------------------------------

ABOUT = {
    "env": SHORT,
    "keywords": {"estimator": "ekf"},
    "training": {"learner": "plackett-luce", "seed": 0, "steps": 100},
    "figures": {"error": 0.1234567890123},
}
"""Training as the card of a saved policy tells of it."""


def untrained(action="slots", preset="short-plain", net_arch=None, seed=0, **keywords):
    """An untrained policy of the class that goes with an action encoding, and its configuration."""
    import torch
    from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
    from stable_baselines3.common.policies import ActorCriticPolicy

    from dptse_env.sb3 import RoadPolicy

    config = resolve(preset, {**keywords, "action": action})
    torch.manual_seed(seed)
    if action == "slots":
        policy = RoadPolicy.from_config(config, width=8)
        with torch.no_grad():
            for weights in policy.parameters():  # fresh ones leave the rule as it is
                weights.add_(0.05 * torch.randn_like(weights))
        return policy, config
    interface = make_interface(config)
    spaces = interface.observations.space, interface.actions.space
    kind = MaskableActorCriticPolicy if action == "sequential" else ActorCriticPolicy
    return kind(*spaces, lambda _: 1.0, net_arch=net_arch or [16]), config


def save_untrained(path, action="slots", seed=0, **keywords):
    """Save an untrained policy as a trained one is; return its file."""
    from dptse_env.sb3 import save_policy

    path.parent.mkdir(parents=True, exist_ok=True)
    training = {**ABOUT["training"], "seed": seed}
    policy, config = untrained(action, seed=seed, **keywords)
    save_policy(path, policy, config, **{**ABOUT, "training": training})
    return path
