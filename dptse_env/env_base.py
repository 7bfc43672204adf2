"""The base of the scalar and the vectorised environment, which play episodes of a process."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from dptse_env.config import resolve
from dptse_env.estimators import check_settings, require_time_step
from dptse_env.parts import make_interface, make_model, warn_where_void
from dptse_env.process import QueryProcess
from dptse_env.rendering import Drawing
from dptse_env.traffic import Records, open_library
from dptse_env.utils.arrays import BoolArray
from dptse_env.utils.registry import is_foreign
from dptse_env.utils.validation import require, within


class QueryEnvBase:
    """Configuration, process, masks, privacy and pictures of an environment of n episodes.

    Attributes:
        config: The configuration.
        interface: Action encoding, observation and reward.
        drawing: The episode that `render` draws; None without a render mode.
    """

    metadata: dict[str, Any]
    render_mode: str | None

    def __init__(
        self,
        preset: str,
        overrides: Mapping[str, Any],
        n_episodes: int,
        records: Records,
        render_mode: str | None,
        *,
        threads: int | None = 1,
    ) -> None:
        """Describe the environment; nothing is recorded or compiled before the first reset.

        Raises:
            ValueError: A keyword, a part of another package, a setting of the estimator on this
                road, the render mode or ``records`` is not what is expected.

        Warns:
            UserWarning: As `resolve`; and a release model with a guarantee is configured, and other
                keywords void it.
        """
        config = resolve(preset, overrides)
        modes = self.metadata["render_modes"]
        allowed = " or ".join(["None", *map(repr, modes)])
        require(render_mode in (None, *modes), "render_mode", allowed, render_mode)
        self.config, self.render_mode = config, render_mode
        self.interface = make_interface(config)
        self._model = make_model(config)
        with within(config.origins.get("corridor", "")):
            require_time_step(config.estimator, self._model)
        with within(config.origins.get("estimator_settings", "")):
            check_settings(config.estimator, self._model, config.settings())
        self._library, self._threads = open_library(records), threads
        self._spec: EnvSpec | None = None
        self._n_episodes = n_episodes
        self._process: QueryProcess | None = None
        self.drawing: Drawing | None = None
        warn_where_void(config)

    @property
    def spec(self) -> EnvSpec | None:
        """Its registration with Gymnasium, with its keywords.

        ``max_episode_steps`` is `n_steps`. Ids are registered without it: keywords change it, and
        a time limit of Gymnasium would cut longer episodes.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec and replace(spec, max_episode_steps=self.n_steps)

    @property
    def id(self) -> str:
        """Its id, empty where it was made without one."""
        return self.spec.id if self.spec is not None else ""

    @property
    def n_steps(self) -> int | None:
        """Steps of an episode; None where they depend on the actions."""
        actions = self.interface.actions
        varies = actions.picks_one_by_one and self.interface.queries.costs_differ
        if varies or is_foreign(actions):
            return None
        decisions = math.ceil(self.config.horizon_steps / self.config.query_every)
        return decisions * actions.actions_per_step

    @property
    def process(self) -> QueryProcess:
        """The process behind the environment, assembled at the first use."""
        if self._process is None:
            self._process = QueryProcess(
                self.config, self._n_episodes, self._library,
                interface=self.interface, model=self._model, threads=self._threads,
            )  # fmt: skip
        return self._process

    def guarantee(self) -> str:
        """Return the guarantee of an episode in one line.

        Its numbers are rounded up; `privacy` has all digits. Where there is none, it is "none" with
        the names of what voids it, which `dptse_env.release.VOID_REASONS` explains.
        """
        report = self.privacy()
        reasons = ", ".join(report["void_reasons"])
        return f"none: {reasons}" if reasons else str(report["guarantee"])

    def privacy(self) -> dict[str, Any]:
        """Return the guarantee of an episode, or what voids it, and the account behind it."""
        return self.process.privacy()

    def _masks(self) -> BoolArray:
        """Return flags of the valid choices of the n episodes, shape (n, m)."""
        return self.interface.actions.masks(self.process.pending.picked)

    def _drawn(self) -> NDArray[np.uint8] | None:
        """Return the picture of the episode so far; None, with a warning, without a render mode."""
        if self.render_mode is None:
            gym.logger.warn("render() needs render_mode='rgb_array'; nothing was drawn")
            return None
        assert self.drawing is not None
        return self.drawing.draw()
