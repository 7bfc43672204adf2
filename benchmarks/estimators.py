"""Time of an estimator's step: compiled, alone and in a batch, beside filterpy and qpsolvers.

A step is `predict`, `update` and `estimate` of one episode on one core, given what the estimator
of an environment was given. The reference filters run on filterpy's classes, the moving horizon
estimator on qpsolvers with piqp, the EnKF in numpy; all of them call the compiled model, which
favours them.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

from agents.figures import LABELS
from benchmarks.turns import Line, compare, make_batch, random_queries, take_turns
from dptse_env.estimators import EstimatorSettings, make_estimator
from dptse_env.vector_env import SensorQueryVectorEnv

ENV = 'dptse_env:dptse/PaperHighway-v0 {"parameters": "w99-3lane", "bandwidth": 11}'
REFERENCES = {"ekf": "filterpy", "ukf": "filterpy", "enkf": "numpy", "mhe": "qpsolvers"}


class Tap:
    """Passes the calls of an estimator on and keeps those that change it.

    Attributes:
        calls: Name and arguments of each call.
    """

    def __init__(self, estimator: Any) -> None:
        """Tap an estimator."""
        self._estimator = estimator
        self.calls: list[tuple[str, tuple[Any, ...]]] = []

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the estimator, a method that changes it with a record of calls."""
        method = getattr(self._estimator, name)
        if name not in ("reset", "predict", "update"):
            return method

        def call(*arguments: Any) -> None:
            # The estimator draws from the generators of a reset.
            kept = copy.deepcopy(arguments) if name == "reset" else arguments
            self.calls.append((name, kept))
            method(*arguments)

        return call


def tapped_calls(env: SensorQueryVectorEnv, n_steps: int) -> list[tuple[str, tuple[Any, ...]]]:
    """Return the calls of an episode's first steps, with sampled queries, reset first."""
    tap: Any = Tap(env.process.estimator)
    env.process.estimator = tap
    env.reset(seed=0)
    for action in random_queries(env, n_steps):
        env.step(action)
    calls: list[tuple[str, tuple[Any, ...]]] = tap.calls
    return calls


class Replay:
    """Another estimator that repeats calls, some steps in each turn, from the reset on."""

    def __init__(
        self,
        name: str,
        backend: str,
        env: SensorQueryVectorEnv,
        calls: list[Any],
        settings: EstimatorSettings,
    ) -> None:
        """Make the estimator for the model and the number of episodes of ``env``."""
        model, n = env.process.model, env.num_envs
        self.estimator: Any = make_estimator(name, backend, model, n, settings)
        self._calls, self._episodes, self._next = calls, env.num_envs, 0

    def turn(self, n_steps: int) -> int:
        """Repeat the calls of some steps; return their number, over all episodes."""
        done = 0
        while done < n_steps:
            if self._next == len(self._calls):
                self._next = 0
            name, arguments = self._calls[self._next]
            self._next += 1
            if name == "reset":
                arguments = copy.deepcopy(arguments)
            getattr(self.estimator, name)(*arguments)
            if name == "update":
                self.estimator.estimate()
                done += 1
        return done * self._episodes


def measure(*, quick: bool = False) -> list[Line]:
    """Return the lines of all estimators; the ratios are to one episode, compiled."""
    n_batch, n_steps, block, rounds = (2, 8, 4, 2) if quick else (64, 240, 20, 12)
    alone, batch = (make_batch(ENV, n, traffic_seeds="0:4") for n in (1, n_batch))
    config = alone.config
    calls = {env.num_envs: tapped_calls(env, n_steps) for env in (alone, batch)}
    work, bases = {}, {}

    def add(what: str, base: str, name: str, backend: str, env: SensorQueryVectorEnv) -> None:
        settings = replace(config, estimator=name).settings()
        replay = Replay(name, backend, env, calls[env.num_envs], settings)
        work[what] = lambda: replay.turn(block)
        if base:
            bases[what] = base

    for name in (*REFERENCES, "recurrent", "asm"):
        label = LABELS[name]
        add(label, "", name, "compiled", alone)
        add(f"{label}, batch of {n_batch}", label, name, "compiled", batch)
        if name in REFERENCES:
            add(f"{label}, {REFERENCES[name]}", label, name, "reference", alone)
    return compare(take_turns(work, rounds), bases)
