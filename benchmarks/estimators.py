"""Time of an estimator's step: compiled, alone and in a batch, beside filterpy and qpsolvers.

A step is `predict`, `update` and `estimate` of one episode on one core, given what the estimator
of an environment was given. The reference filters run on filterpy's classes, the moving horizon
estimator on qpsolvers with piqp, the EnKF in numpy; all of them call the compiled model, which
favours them.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import cycle
from typing import Any

from agents.figures import LABELS
from benchmarks.turns import Row, Work, compare, make_batch, sample, take_turns
from dptse_env.estimators import make_estimator
from dptse_env.vector_env import SensorQueryVectorEnv

ENV = 'dptse_env:dptse/PaperHighway-v0 {"parameters": "w99-3lane", "bandwidth": 11}'
REFERENCES = {"ekf": "filterpy", "ukf": "filterpy", "enkf": "numpy", "mhe": "qpsolvers"}

Call = tuple[str, tuple[Any, ...]]
"""A method of an estimator that changes it, and its arguments."""


def tapped_calls(env: SensorQueryVectorEnv, n_steps: int) -> list[Call]:
    """Return the estimator's calls in an episode's first steps of sampled queries, reset first."""
    estimator, calls = env.process.estimator, list[Call]()

    def tapped(name: str) -> Any:
        method = getattr(estimator, name)

        def call(*arguments: Any) -> None:
            calls.append((name, copy.deepcopy(arguments)))  # it draws from the reset's generators
            method(*arguments)

        return call

    for name in ("reset", "predict", "update"):
        setattr(estimator, name, tapped(name))
    env.reset(seed=0)
    for action in sample(env.action_space, n_steps):
        env.step(action)
    return calls


def repeating(
    name: str, backend: str, env: SensorQueryVectorEnv, calls: list[Call], n_steps: int
) -> Work:
    """Return work in which another estimator repeats calls, some steps in each turn."""
    settings, n = replace(env.config, estimator=name).settings(), env.num_envs
    estimator: Any = make_estimator(name, backend, env.process.model, n, settings)
    following = cycle(calls)

    def turn() -> None:
        done = 0
        while done < n_steps:
            method, arguments = next(following)
            getattr(estimator, method)(
                *copy.deepcopy(arguments) if method == "reset" else arguments
            )
            if method == "update":
                estimator.estimate()
                done += 1

    return turn, n * n_steps


def measure(*, quick: bool = False) -> list[Row]:
    """Return the rows of all estimators; the ratios are to one episode, compiled."""
    n_batch, n_steps, block, rounds = (2, 8, 4, 2) if quick else (64, 240, 20, 12)
    alone, batch = (make_batch(ENV, n, traffic_seeds="0:4") for n in (1, n_batch))
    calls, calls_of_batch = (tapped_calls(env, n_steps) for env in (alone, batch))
    work, bases = {}, {}
    for name in (*REFERENCES, "recurrent", "asm"):
        label, own = LABELS[name], {}
        work[label] = repeating(name, "compiled", alone, calls, block)
        own[f"{label}, batch of {n_batch}"] = repeating(
            name, "compiled", batch, calls_of_batch, block
        )
        if name in REFERENCES:
            own[f"{label}, {REFERENCES[name]}"] = repeating(name, "reference", alone, calls, block)
        work |= own
        bases |= dict.fromkeys(own, label)
    return compare(take_turns(work, rounds), bases)
