"""A foreign policy under guard: what it raises, and nonsense and delay, become a reason."""

from __future__ import annotations

import contextlib
import copy
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

import numpy as np

from agents.evaluation.episodes import Policy
from dptse_env.vector_env import SensorQueryVectorEnv

LONGEST_STEP = 1.0
"""Most seconds that a policy may take for the decision of one episode."""
START_TIME = 120.0
"""Further seconds that it may take for its first decision, in which it may compile."""


class PolicyError(Exception):
    """A policy raised, returned no action, or took too long; the message says which."""


class Guarded:
    """A policy whose failures are raised as `PolicyError`.

    Attributes:
        seconds: Time of its decisions, but for the first.
        n_decisions: Decisions in that time, one for each episode and step.
    """

    def __init__(self, policy: Policy, env: SensorQueryVectorEnv) -> None:
        """Guard a policy in an environment."""
        self._policy, self._env = policy, env
        self._is_first = True
        self.seconds, self.n_decisions = 0.0, 0

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return what the policy returns.

        Raises:
            PolicyError: It raised, returned no actions for all episodes, or took too long.
        """
        n = self._env.num_envs
        limit = n * LONGEST_STEP + (START_TIME if self._is_first else 0.0)
        started = time.perf_counter()
        with foreign_code(), _interrupted_after(limit):
            action, next_state = self._policy.predict(
                observation, state, episode_start, deterministic
            )
        seconds = time.perf_counter() - started
        if seconds > limit:
            raise PolicyError(_too_slow(limit))
        if not self._is_first:
            self.seconds += seconds
            self.n_decisions += n
        self._is_first = False
        self._check(action)
        return action, next_state

    def _check(self, action: Any) -> None:
        """Try the actions, without an effect on the environment."""
        process = self._env.process
        try:
            array = np.asarray(action)
            if array.shape[:1] != (self._env.num_envs,):
                raise ValueError(
                    f"actions must be {self._env.num_envs}, one for each episode, got shape "
                    f"{array.shape}"
                )
            every = np.arange(self._env.num_envs)
            self._env.interface.actions.decode(every, array, copy.deepcopy(process.pending))
        except (ValueError, TypeError) as problem:
            raise PolicyError(f"no valid action: {_short(problem)}") from problem


@contextlib.contextmanager
def foreign_code() -> Iterator[None]:
    """Turn whatever the body raises into a `PolicyError`; an interrupt stays one."""
    try:
        yield
    except PolicyError:
        raise
    except Exception as problem:
        raise PolicyError(f"raised {type(problem).__name__}: {_short(problem)}") from problem


@contextlib.contextmanager
def _interrupted_after(seconds: float) -> Iterator[None]:
    """Interrupt the body when its time is up, where the system has timers for that."""
    if (
        not hasattr(signal, "setitimer")
        or threading.current_thread() is not threading.main_thread()
    ):
        yield
        return

    def ring(_signum: int, _frame: FrameType | None) -> None:
        raise PolicyError(_too_slow(seconds))

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _too_slow(limit: float) -> str:
    return f"took longer than {limit:g} s for a step of all episodes"


def _short(problem: BaseException) -> str:
    text = " ".join(str(problem).split())
    return text if len(text) <= 300 else text[:297] + "..."
