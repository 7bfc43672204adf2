"""Numbers of the package in a file, to show that a change of code leaves them alone.

``python -m tests.numbers`` writes ``tests/numbers.npz`` anew, where a change is meant to move
them, and with words only the parts whose names have one of them; the slow test
``tests/test_numbers.py`` compares with it. A step of every estimator is taken from recorded states
with recorded releases, so that the drift of a chaotic filter does not count; means of errors are
those of whole episodes.
"""

from __future__ import annotations

import functools
import io
import json
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents.policies import find_policy
from dptse_env import evaluate
from dptse_env.estimators import Measurement, make_estimator
from dptse_env.policies import TRANSFERABLE
from dptse_env.schedules import make_schedule
from dptse_env.traffic import write_corridor
from dptse_env.utils.arrays import FloatArray
from tests.helpers import UNEVEN

FILE = Path(__file__).with_suffix(".npz")
ID = "dptse_env:dptse/{}"
ESTIMATORS = (
    "ekf", "ukf", "enkf", "mhe", "random_walk", "blend", "open_loop", "recurrent",
    "asm",
)  # fmt: skip

FROM_SECOND, STEPS = 240, 3  # a queue stands on the paper's road from second 200 on
ROADS: dict[str, tuple[str, dict[str, Any]]] = {
    "printed": ("PaperHighway-v0", {}),
    "printed-w99": ("PaperHighway-v0", {"parameters": "w99-3lane"}),
    "corrected": ("PrivateHighway-v1", {"privacy": "corrected"}),
    "capped": ("PrivateHighway-v1", {"privacy": "capped"}),
    "paced": ("PrivateHighway-v1", {}),
    "paced-spans": ("PrivateHighway-v1", {"query_spans": [1, 2]}),
    "paced-uneven": ("PrivateHighway-v1", {"corridor": "uneven", "horizon": 300}),
    "paced-connected": ("PrivateHighway-v1", {"penetration": 0.3}),
}
"""Environments whose estimators take steps from recorded states."""

PLAIN: dict[str, dict[str, Any]] = {
    "PaperHighway-v0": {"estimator_settings": None},
    "PrivateHighway-v1": {"estimator": "ekf", "bandwidth": 5},
    "LongHighway-v0": {"estimator": "ekf", "bandwidth": 8},
}
"""Keywords of all parts but those of the ids, which are then those of the ids as they were."""

IDS = ("PaperHighway-v0", "PrivateHighway-v1", "ShortHighway-v0", "LongHighway-v0")
SCHEDULES = (
    "static", "shift-ahead", "round-robin", "random", "oldest-first", "largest-variance",
    "largest-density-variance", "stale-variance", "largest-deviation", "speed-front", "none",
    "expected-reduction", "greedy-trace", "oracle-error", "oracle-gain",
)  # fmt: skip
POLICIES = {
    "short-highway": "printed",
    "short-highway-corrected": "corrected",
    "short-highway-capped": "capped",
}
"""Some policies of the package, and the release models that they were trained for."""
RELEASES: dict[str, dict[str, Any]] = {
    "printed": {"privacy": "printed"},
    "corrected": {"privacy": "corrected"},
    "capped": {"privacy": "capped"},
    "capped-event": {"privacy": {"preset": "capped", "unit": "event"}},
    "capped-boundary": {"privacy": {"preset": "capped", "boundary_inputs": "private"}},
    "paced": {"privacy": "paced"},
    "paced-spans": {"privacy": "paced", "query_spans": [1, 2]},
    "paced-connected": {"privacy": "paced", "penetration": 0.3},
    "capped-connected": {"privacy": "capped", "penetration": 0.3},
    "paced-detectors": {"privacy": "paced", "sensor_settings": {"absolute": 1.0}},
}
SENTENCES = ("guarantee", "protects")
"""Entries of a privacy report that are words."""
SECONDS = 60
SEEDS = range(8)

Numbers = dict[str, Any]


@functools.cache
def _uneven_road() -> str:
    path = Path(tempfile.mkdtemp()) / "uneven.toml"
    write_corridor(path, UNEVEN.replaced(duration=300), {"parameters": "w99-3lane"})
    return str(path)


def _make(name: str, **keywords: Any) -> Any:
    if keywords.get("corridor") == "uneven":
        keywords["corridor"] = _uneven_road()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gym.make(ID.format(name), disable_env_checker=True, **{**PLAIN[name], **keywords})


class _Witness:
    """An estimator that keeps the arguments which it is given from a second on."""

    def __init__(self, estimator: Any) -> None:
        self._estimator, self.inputs, self.measured = estimator, [], []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._estimator, name)

    def predict(self, episodes: Any, inputs: FloatArray) -> None:
        self.inputs.append(inputs[0].copy())
        self._estimator.predict(episodes, inputs)

    def update(self, episodes: Any, measured: Measurement) -> None:
        self.measured.append(measured.at(0))
        self._estimator.update(episodes, measured)


def recorded_steps(road: str) -> Numbers:
    """Return a state, and the inputs and releases of the `STEPS` seconds that follow it."""
    name, keywords = ROADS[road]
    env = _make(name, **keywords)
    schedule, process = make_schedule("shift-ahead", env), env.unwrapped.process
    observation, _ = env.reset(seed=0, options={"traffic_seed": 0})
    state = None
    witness = _Witness(process.estimator)
    only, model, start = np.array([0]), process.model, np.array([])
    for second in range(FROM_SECOND + STEPS):
        if second == FROM_SECOND:
            truth = process.truth(only)
            speed = np.nan_to_num(truth[..., 1], nan=model.parameters.free_flow_speed)
            start = model.project(model.states(truth[..., 0], speed))[0]
            process.estimator = witness
        action, state = schedule.predict(observation, state, np.array([state is None]), True)
        observation, *_ = env.step(action)
    found: Numbers = {"state": start, "inputs": np.array(witness.inputs)}
    for part in Measurement._fields:
        found[part] = np.array([getattr(measured, part) for measured in witness.measured])
    found["values"] = np.where(found["observed"][..., None], found["values"], 0.0)
    return {k: v if v.dtype == bool else v.astype(np.float32) for k, v in found.items()}


def estimator_steps(road: str, estimator: str, given: Numbers) -> Numbers:
    """Return an estimator's output after the first and the last recorded step, and innovations."""
    name, keywords = ROADS[road]
    env = _make(name, **keywords, estimator=estimator)
    config, model = env.unwrapped.config, env.unwrapped.process.model
    made = make_estimator(estimator, "compiled", model, 1, config.settings())
    only, given = np.array([0]), {k: v.astype(np.float64) for k, v in given.items()}
    made.reset(only, given["state"][None, : 2 * model.n_segments], [np.random.default_rng(3)])
    estimates, others = [], []
    for step in range(STEPS):
        made.predict(only, given["inputs"][step][None])
        parts = [given[part][step][None] for part in Measurement._fields]
        made.update(only, Measurement(parts[0] > 0, *parts[1:]))
        if step in (0, STEPS - 1):
            shown = made.estimate()
            estimates += [shown.density, shown.speed]
            others += [shown.density_std, shown.speed_std]
    others.append(made.innovations.reshape(1, -1))
    return {
        "estimates": np.concatenate(estimates, axis=None),
        "deviations": np.concatenate(others, axis=None).astype(np.float32),
    }


def _projected(rows: list[FloatArray]) -> FloatArray:
    """Return each row's products with six fixed directions, in which any change shows."""
    table = np.array(rows)
    directions = np.random.default_rng(5).normal(size=(table.shape[1], 6))
    return table @ directions / np.sqrt(table.shape[1])


def observations(name: str) -> Numbers:
    """Return what an id gives over `SECONDS` with the paper's schedule."""
    env = gym.make(ID.format(name), disable_env_checker=True)
    schedule = make_schedule("shift-ahead", env)
    observation, info = env.reset(seed=11)
    rows, rewards, spent, state = [observation], [], [info["spent_mu"]], None
    for _ in range(SECONDS):
        action, state = schedule.predict(observation, state, np.array([state is None]), True)
        observation, reward, _, _, info = env.step(action)
        rows.append(observation)
        rewards.append(reward)
        spent.append(info["spent_mu"])
    kept = {"observations": _projected(rows), "rewards": rewards, "mu": spent}
    return {key: np.array(value, dtype=np.float32) for key, value in kept.items()}


def choices(policy: str) -> Numbers:
    """Return the queries of a schedule or a shipped policy over `SECONDS`, packed as bits."""
    make = functools.partial(_make, "PrivateHighway-v1", horizon=SECONDS)
    if policy in POLICIES:
        saved = find_policy(policy)
        env = make(**{"privacy": POLICIES[policy], **saved.keywords})
        player = saved.load(env, allow=TRANSFERABLE)
    else:
        env = make()
        player = make_schedule(policy, env, 3)
    observation, info = env.reset(seed=4)
    state, queried = None, []
    for _ in range(SECONDS):
        action, state = player.predict(observation, state, np.array([state is None]), True)
        observation, _, _, _, info = env.step(action)
        queried.append(info["queried"])
    return {"queried": np.packbits(np.array(queried), axis=1)}


def releases(case: str) -> Numbers:
    """Return released numbers, their deviations, the privacy spent, and the report's numbers."""
    env = _make("PrivateHighway-v1", **RELEASES[case])
    process, rng = env.unwrapped.process, np.random.default_rng(2)
    values, sigma, spent = [], [], []
    measure = process.measure

    def watched(request: Any) -> Measurement:
        measured: Measurement = measure(request)
        own = measured.on_road(process.model.channels.size, process.model.n_segments)
        seen = own.observed[0][:, None]
        values.append(np.where(seen, own.values[0], 0.0).ravel())
        sigma.append(np.where(seen, own.sigma[0], 0.0).ravel())
        return measured

    process.measure = watched
    env.reset(seed=7)
    report = {k: v for k, v in env.unwrapped.privacy().items() if k not in SENTENCES}
    queries = process.interface.queries
    n_chosen = min(2, queries.bandwidth)
    for _ in range(SECONDS):
        action = np.zeros(queries.n_queries, dtype=np.int8)
        action[rng.choice(queries.n_queries, n_chosen, replace=False)] = 1
        *_, info = env.step(action)
        spent.append(info["spent_mu"])
    return {
        "values": _projected(values),
        "sigma": _projected(sigma),
        "mu": np.array(spent, dtype=np.float32),
        "report": np.frombuffer(json.dumps(report, sort_keys=True).encode(), dtype=np.uint8),
    }


def mean_errors(name: str, estimator: str) -> Numbers:
    """Return the errors of density and speed over `SEEDS` with the paper's schedule."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        keywords = {**PLAIN[name], "estimator": estimator, "traffic_seeds": list(SEEDS)}
        env = gym.make_vec(ID.format(name), num_envs=len(SEEDS), **keywords)
    rows = evaluate(env, "shift-ahead", list(SEEDS))
    errors = [[row["rmse_density"], row["rmse_speed"]] for row in rows]
    return {"errors": np.array(errors).mean(axis=0)}


def cases() -> Iterator[tuple[str, Any, tuple[Any, ...]]]:
    """Yield the name of each part of the file, the function that gives it, and its arguments."""
    for name in IDS:
        yield f"id {name}", observations, (name,)
    for schedule in SCHEDULES:
        yield f"schedule {schedule}", choices, (schedule,)
    for policy in POLICIES:
        yield f"policy {policy}", choices, (policy,)
    for case in RELEASES:
        yield f"release {case}", releases, (case,)
    for name in ("PaperHighway-v0", "PrivateHighway-v1"):
        for estimator in ESTIMATORS:
            yield f"errors {name} {estimator}", mean_errors, (name, estimator)
    yield "errors LongHighway-v0 ekf", mean_errors, ("LongHighway-v0", "ekf")


def main(words: list[str]) -> None:
    """Write the file, or the parts whose names have one of some words."""
    found: Numbers = {}
    if words:
        with np.load(FILE) as file_before:
            found = dict(file_before)

    def is_due(name: str) -> bool:
        return not words or any(word in name for word in words)

    for road in filter(is_due, ROADS):
        given = recorded_steps(road)
        found |= {f"steps {road}/{key}": value for key, value in given.items()}
        for estimator in ESTIMATORS:
            made = estimator_steps(road, estimator, given)
            found |= {f"steps {road} {estimator}/{key}": value for key, value in made.items()}
            print(road, estimator, flush=True)
    for case, function, arguments in cases():
        if is_due(case):
            found |= {f"{case}/{key}": value for key, value in function(*arguments).items()}
            print(case, flush=True)
    file = io.BytesIO()
    np.savez_compressed(file, **found)
    FILE.write_bytes(file.getvalue())
    print(f"{FILE}: {len(file.getvalue()) / 1e3:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
