"""`SensorQueryEnv`: the decision process as a Gymnasium environment, one episode at a time."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dptse_env.config import resolve
from dptse_env.estimators import check_settings
from dptse_env.parts import make_interface, make_model, make_parts, warn_where_void
from dptse_env.process import QueryProcess
from dptse_env.rendering import History, Picture, Window
from dptse_env.traffic import Records, open_library
from dptse_env.utils.arrays import Observation
from dptse_env.utils.fields import integer, require

_ONLY = np.zeros(1, dtype=np.int64)


class SensorQueryEnv(gym.Env[Observation, Any]):
    """Choose which segments' connected vehicles to query, second by second.

    One step is one second of traffic. A policy picks at most ``bandwidth`` of the n mainline
    segments, a private mechanism answers for them and for the fixed sensors, an estimator updates
    its estimate of all S segments (mainline, on-ramps, off-ramps), and the reward is minus the
    error of that estimate. Queries never change the traffic: an episode replays a record of SUMO,
    made once for each traffic seed and cached on disk.

    **Queries**: by default an option is a mainline segment, and there are G = n of them. With
    ``query_spans`` an option is the average over one or several neighbouring segments, with
    ``price_levels`` one of several prices for it; ``interface.queries`` is the table of all G. An
    option costs as much of the ``bandwidth`` as it has segments, or one
    (``bandwidth_unit="sums"``). Options that overlap may be queried together; each answer has noise
    of its own.

    **Observation**: a flat float32 ``Box`` of named blocks, in this order; ``interface.observations
    .slices`` has the place of each. F is the number of fixed sensors, and the density and speed
    scales are constants of the corridor.

    | block                    | size | value                                       | bounds    |
    | :--                      | :--  | :--                                         | :--       |
    | density                  | S    | estimated density / density scale           | [0, 4]    |
    | speed                    | S    | estimated speed / speed scale               | [0, 4]    |
    | density_log_std          | S    | log of (standard deviation / scale)         | [-10, 5]  |
    | speed_log_std            | S    | the same for the speed                      | [-10, 5]  |
    | released_density         | G    | last released density / scale               | [-5, 5]   |
    | released_speed           | G    | last released speed / scale (or flow)       | [-5, 5]   |
    | density_innovation       | G    | normalised innovation, 0 if not observed    | [-10, 10] |
    | speed_innovation         | G    | the same for the second released quantity   | [-10, 10] |
    | age                      | n    | seconds since last observed / 60, at most 1 | [0, 1]    |
    | queried                  | G    | the last query                              | {0, 1}    |
    | fixed_density_innovation | F    | normalised innovation of the fixed sensors  | [-10, 10] |
    | fixed_speed_innovation   | F    | the same for the second released quantity   | [-10, 10] |
    | bandwidth                | 1    | queries a step / n                          | [0, 1]    |
    | epsilon                  | 1    | log10 of the privacy parameter              | [-6, 6]   |
    | picked                   | G    | picks so far (``sequential`` only)          | {0, 1}    |
    | last_price               | G    | log10 of last price / 2; 0 before the first | [-5, 5]   |
    | tracer                   | n    | mean charge of a vehicle over its budget    | [0, 1]    |

    ``released_flow`` takes the place of ``released_speed`` where flows are released; ``last_price``
    and ``tracer`` are there under release models with prices. Values beyond the bounds are clipped.
    ``observation`` chooses other blocks.

    **Action**: ``action`` chooses the encoding; a sampled action never raises. B is the largest
    number of queries that the bandwidth pays for; under ``sequential`` an action picks one option,
    until the bandwidth pays for no other.

    | ``action``     | space                      | meaning                                   |
    | :--            | :--                        | :--                                       |
    | ``mask``       | ``MultiBinary(G)``         | one flag per option (default)             |
    | ``scores``     | ``Box(-1, 1, (G,))``       | the options of highest score              |
    | ``slots``      | ``MultiDiscrete([G] * B)`` | one option for each of the B queries      |
    | ``sequential`` | ``Discrete(G)``            | one option per action, see `action_masks` |

    **Reward**: minus the root mean squared error over the mainline, density and speed each in
    units of its scale; ``reward`` chooses one of the two or another reward.

    **Episode**: is truncated after ``horizon`` seconds and never terminates.

    **Info**: numbers are floats and have the same keys at the reset and at every step.

    | key              | value                                                                     |
    | :--              | :--                                                                       |
    | ``rmse_density`` | error of the estimated mainline densities [veh/km]; true traffic          |
    | ``rmse_speed``   | error of the speeds of occupied segments [km/h]; true traffic             |
    | ``n_occupied``   | mainline segments with a vehicle; true traffic                            |
    | ``n_dropped``    | requested options that were cut, repeated or replaced                     |
    | ``queried``      | the options that were queried, flags of shape (G,)                        |
    | ``diverged``     | 1 if the estimator diverged in this second and was started anew           |
    | ``fallback``     | 1 if its update had no solution in this second, so that it only predicted |
    | ``mu``           | privacy loss of a vehicle so far, at most: Gaussian DP parameter          |
    | ``epsilon``      | the same as epsilon at the configured delta                               |
    | ``truth``        | true traffic, with ``truth_in_info=True`` only                            |
    | ``privacy``      | at the reset only: the guarantee and its account (`privacy`)              |
    | ``inherited``    | at the reset only: keywords whose values belong to another road           |

    Values marked "true traffic" serve training and evaluation, as the reward does. They are not
    covered by the guarantee, and no policy may act on them. The others are public.

    **Reset options**: ``traffic_seed`` (one of ``traffic_seeds``) and ``start`` (first second of
    the record).

    **Rendering**: ``render_mode="rgb_array"`` draws true density, estimate, queries and error over
    space and time; ``"human"`` shows the same in a window at every reset and step (extra
    ``video``). The picture shows true traffic.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}  # noqa: RUF012 (Gymnasium's own)

    def __init__(
        self,
        preset: str = "paper-highway",
        *,
        render_mode: str | None = None,
        render_every: int = 1,
        records: Records = None,
        **overrides: Any,
    ) -> None:
        """Describe the environment; nothing is recorded or compiled before `reset`.

        Args:
            preset: Name of a preset in `dptse_env.config.PRESETS`.
            render_mode: None, ``"rgb_array"`` or ``"human"``.
            render_every: Simulated time between two drawings [s]; in between, `render` returns the
                last one.
            records: Folder of the record cache, or a library of records; None for the user's
                cache.
            **overrides: Fields of `dptse_env.config.EnvConfig`, or the shortcuts ``epsilon``,
                ``delta``, ``incident`` and ``demand``. Values may be plain JSON.

        Raises:
            ValueError: A key is unknown or a value out of range; the message names it.
            MissingExtraError: ``render_mode`` is ``"human"`` and pygame is not installed.

        Warns:
            UserWarning: A release model with a guarantee is configured, and other keywords void
                it, or values of another road are used on this one.
        """
        modes = (None, *self.metadata["render_modes"])
        require(render_mode in modes, "render_mode", "None, 'rgb_array' or 'human'", render_mode)
        self.render_mode = render_mode
        self._window: Window | None = None
        if render_mode == "human":
            self._window = Window("dptse-env", self.metadata["render_fps"])
        self.render_every = integer("render_every", render_every, 1)
        self.config = config = resolve(preset, overrides)
        warn_where_void(config)
        self.interface = make_interface(config)
        self._model = make_model(config)
        check_settings(config.estimator, self._model, config.settings())
        self.action_space = self.interface.actions.space
        self.observation_space = self.interface.observations.space
        self._library = open_library(records)
        self._process: QueryProcess | None = None
        self.history: History | None = None
        self._picture: Picture | None = None
        self._frame: tuple[int, NDArray[np.uint8]] | None = None

    @property
    def process(self) -> QueryProcess:
        """The process behind the environment, assembled at the first use."""
        if self._process is None:
            parts = make_parts(
                self.config, 1, self._library, interface=self.interface, model=self._model
            )
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
            gymnasium.error.Error: ``render_mode`` is ``"human"``, and there is no display.
        """
        super().reset(seed=seed)
        outcome = self.process.reset(_ONLY, [self.np_random], options)
        if self.render_mode is not None:
            self.history, self._frame = History.from_process(self.process), None
        if self._window is not None:
            self._window.reopen()
            self._window.show(self._drawn())
        info = self.process.info(0)
        info |= self.process.reset_info()
        return outcome.observation[0], info

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Query, estimate and score one second.

        Raises:
            ValueError: The action has a wrong shape, dtype or value.
            gymnasium.error.ResetNeeded: The episode is over, or none was begun.
        """
        process = self.process
        if process.over[0]:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        outcome = process.step(_ONLY, np.asarray(action)[None])
        if self.history is not None:
            self.history.append(process)
        if self._window is not None:
            self._window.show(self._drawn())
        return (
            outcome.observation[0],
            float(outcome.reward[0]),
            False,
            bool(outcome.truncated[0]),
            process.info(0),
        )

    def action_masks(self) -> NDArray[np.bool_]:
        """Return flags (G,) of the options that may be picked next, for ``action="sequential"``.

        Raises:
            ValueError: A step takes one action only.
            gymnasium.error.ResetNeeded: No episode is running.
        """
        self.interface.require_sequential()
        if self.process.over[0]:
            raise gym.error.ResetNeeded("no episode is running: call reset() first")
        picked = self.process.pending.picked[:1]
        free: NDArray[np.bool_] = self.interface.actions.available(picked)[0]
        return free

    def privacy(self) -> dict[str, Any]:
        """Return the guarantee of an episode, or what voids it, and the account behind it."""
        return self.process.privacy()

    def render(self) -> NDArray[np.uint8] | None:
        """Return the episode so far as a picture over space and time, shape (height, width, 3).

        With ``render_mode="human"`` the window shows it already, and nothing is returned.

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
        return None if self._window is not None else self._drawn().copy()

    def _drawn(self) -> NDArray[np.uint8]:
        """Return the picture of the present second, drawn anew if it is due."""
        assert self.history is not None
        second = int(self.process.elapsed[0])
        if self._frame is None or self._is_due(second - self._frame[0]):
            if self._picture is None:
                self._picture = Picture(self.history)
            self._frame = second, self._picture.draw(self.history)
        return self._frame[1]

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
        super().close()

    def _is_due(self, since: int) -> bool:
        """Return whether a picture that is ``since`` seconds old is to be drawn again."""
        return since >= self.render_every or (since > 0 and bool(self.process.over[0]))
