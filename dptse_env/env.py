"""`SensorQueryEnv`: the decision process as a Gymnasium environment, one episode at a time."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dptse_env.config import resolve
from dptse_env.parts import make_interface, make_parts, warn_where_void
from dptse_env.process import QueryProcess
from dptse_env.rendering import History, render_rgb
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.arrays import Observation
from dptse_env.utils.validation import path_or_none

_ONLY = np.zeros(1, dtype=np.int64)


class SensorQueryEnv(gym.Env[Observation, Any]):
    """Choose which segments' connected vehicles to query, second by second.

    One step is one second of traffic. A policy picks at most ``bandwidth`` mainline segments, a
    private mechanism answers for them and for the fixed sensors, an estimator updates, and the
    reward is minus the error of its estimate. Queries never change the traffic: an episode
    replays a SUMO record, made once per traffic seed and cached on disk.

    **Observation**: a flat float32 ``Box``; its named blocks are listed at
    `dptse_env.spaces.observations.ObservationEncoding`.

    **Action**: set by ``action``, see `dptse_env.spaces.actions`. ``mask`` is ``MultiBinary(n)``
    (default), ``scores`` a ``Box``, ``slots`` a ``MultiDiscrete``, ``sequential`` a ``Discrete``
    with `action_masks`. A sampled action never raises.

    **Reward**: minus the root mean squared error over the mainline, density and speed each in
    units of its scale (``reward`` picks one of them).

    **Episode**: ends by ``truncated`` after ``horizon`` seconds; it never terminates.

    **Info**: the same keys at reset and at every step: ``rmse_density`` [veh/km], ``rmse_speed``
    [km/h], ``n_occupied``, ``n_dropped``, ``diverged``, ``mu``, ``epsilon`` (floats) and
    ``queried`` (flags, shape (n,)); with ``truth_in_info`` also ``truth``. At reset ``privacy``
    names the guarantee, or what voids it, and the account behind it. ``mu`` and ``epsilon`` are
    what a vehicle has spent at most so far. ``rmse_*``, ``n_occupied`` and ``truth`` come from the
    true traffic: use them to train and evaluate, never to act.

    **Reset options**: ``traffic_seed`` (one of ``traffic_seeds``) and ``start`` (first second).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own)

    def __init__(
        self,
        preset: str = "paper-highway",
        *,
        render_mode: str | None = None,
        records: str | None = None,
        **overrides: Any,
    ) -> None:
        """Describe the environment; nothing is recorded or compiled before `reset`.

        Args:
            preset: Name of a preset in `dptse_env.config.PRESETS`.
            render_mode: None or ``"rgb_array"``.
            records: Folder of the record cache; None for the user's cache.
            **overrides: Fields of `dptse_env.config.EnvConfig`, or the shortcuts ``incident``,
                ``epsilon`` and ``delta``. Values may be plain JSON.

        Raises:
            ValueError: A key is unknown or a value out of range; the message names it.

        Warns:
            UserWarning: Privacy preset ``guaranteed`` was asked for, and other keywords void it.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None or 'rgb_array', got {render_mode!r}; wrap the "
                "environment in gymnasium.wrappers.HumanRendering to see it in a window"
            )
        self.render_mode = render_mode
        self.config = resolve(preset, overrides)
        warn_where_void(self.config)
        self.interface = make_interface(self.config)
        self.action_space = self.interface.actions.space
        self.observation_space = self.interface.observations.space
        self._records = path_or_none("records", records)
        self._process: QueryProcess | None = None
        self.history: History | None = None

    @property
    def process(self) -> QueryProcess:
        """The process behind the environment, assembled at the first use."""
        if self._process is None:
            library = RecordLibrary(self._records)
            parts = make_parts(self.config, 1, library, interface=self.interface)
            self._process = QueryProcess(parts)
        return self._process

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Starts ``np_random`` anew; without it, the sequence of episodes goes on.
            options: ``traffic_seed`` and ``start``, both optional.

        Raises:
            ValueError: An option is unknown or out of range.
        """
        super().reset(seed=seed)
        outcome = self.process.reset(_ONLY, [self.np_random], options)
        if self.render_mode is not None:
            self.history = History.begin(self.process)
        info = self.process.info(0)
        info |= self.process.reset_info()
        return outcome.observation[0], info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Query, estimate and score one second.

        Raises:
            ValueError: The action has a wrong shape, dtype or value.
            gymnasium.error.ResetNeeded: The episode is over or was never begun.
        """
        process = self.process
        if process.over[0]:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        outcome = process.step(_ONLY, np.asarray(action)[None])
        if self.history is not None:
            self.history.append(process)
        return (
            outcome.observation[0],
            float(outcome.reward[0]),
            False,
            bool(outcome.truncated[0]),
            process.info(0),
        )

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which segments may be picked next, shape (n,), for ``action="sequential"``.

        Raises:
            ValueError: The actions are not sequential.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        if self.config.action != "sequential":
            raise ValueError(
                f"action_masks() needs action='sequential', this is {self.config.action!r}"
            )
        if self.process.over[0]:
            raise gym.error.ResetNeeded("no episode is running: call reset() first")
        free: NDArray[np.bool_] = ~self.process.pending.picked[0]
        return free

    def render(self) -> NDArray[np.uint8] | None:
        """Return the episode so far as a picture over space and time, shape (h, w, 3).

        Raises:
            gymnasium.error.ResetNeeded: No episode has begun.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "render() needs gym.make(..., render_mode='rgb_array'); nothing was drawn"
            )
            return None
        if self.history is None:
            raise gym.error.ResetNeeded("nothing to render: call reset() first")
        return render_rgb(self.history)
