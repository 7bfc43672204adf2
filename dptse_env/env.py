"""`SensorQueryEnv`: the decision process as a Gymnasium environment, one episode at a time."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dptse_env.env_base import QueryEnvBase
from dptse_env.rendering import Drawing, Screen
from dptse_env.traffic import Records
from dptse_env.utils.arrays import Observation
from dptse_env.utils.validation import integer

_ONLY = np.zeros(1, dtype=np.int64)


class SensorQueryEnv(QueryEnvBase, gym.Env[Observation, Any]):
    """Choose which segments' connected vehicles to query, step by step.

    Traffic flows along a motorway of n mainline segments with on- and off-ramps, S segments in all.
    A step is one second, or ``query_every`` seconds with queries in the first. A policy picks a few
    mainline segments, whose connected vehicles are queried. A private release model answers for
    them and for the F fixed sensors with noisy numbers. An estimator, a recurrent network or a
    Kalman filter on a macroscopic traffic model, updates its estimate of density and speed on all
    segments. The aim is to keep the error of that estimate small with few queries. Queries never
    change the traffic: an episode replays a record of SUMO, made once for each traffic seed and
    cached on disk.

    **Queries**: by default a query is one mainline segment, so that there are G = n queries, and
    a step may query as many as the ``bandwidth``. With ``query_spans`` a query is the average
    over one or several neighbouring segments; ``interface.queries`` is the table of all G. A
    query costs as much of the ``bandwidth`` as it has segments, or one
    (``bandwidth_unit="sums"``). Queries that overlap may be queried together; each answer has noise
    of its own.

    **Observation**: a flat float32 ``Box`` of named blocks, in this order; ``interface.observations
    .slices`` has the place of each. The scales are constants of the corridor: of densities
    ``corridor.density_scale`` (111 veh/km for each lane on the roads that ship), of speeds
    ``corridor.speed_scale`` (their speed limit, 102 km/h), of flows the product of both. Values
    beyond the bounds are clipped. Nothing in it shows the true traffic or the time, but for what
    loops report and how long ago that was.

    | block                    | size | value                                          | bounds    |
    | :--                      | :--  | :--                                            | :--       |
    | density                  | S    | estimated density [scale]                      | [0, 4]    |
    | speed                    | S    | estimated speed [scale]                        | [0, 4]    |
    | density_log_std          | S    | ln of the density's standard deviation [scale] | [-10, 5]  |
    | speed_log_std            | S    | ln of the speed's standard deviation [scale]   | [-10, 5]  |
    | released_density         | G    | last released density [scale], 0 before        | [-5, 5]   |
    | released_speed           | G    | last released speed [scale], 0 before          | [-5, 5]   |
    | released_flow            | G    | last released centred flow [scale], 0 before   | [-5, 5]   |
    | density_innovation       | G    | innovation of the density [its deviation]      | [-10, 10] |
    | speed_innovation         | G    | innovation of the speed or flow                | [-10, 10] |
    | age                      | n    | time since last observed [min], at most 1      | [0, 1]    |
    | queried                  | G    | whether the last step queried it               | [0, 1]    |
    | fixed_density_innovation | F    | as density_innovation, of the fixed sensors    | [-10, 10] |
    | fixed_speed_innovation   | F    | as speed_innovation, of the fixed sensors      | [-10, 10] |
    | bandwidth                | 1    | ``bandwidth`` / n                              | [0, 1]    |
    | epsilon                  | 1    | log10 of the privacy parameter                 | [-6, 6]   |
    | picked                   | G    | whether it is picked for the step to come      | [0, 1]    |
    | last_price               | G    | log10(price of the last query) / 2, 0 before   | [-5, 5]   |
    | spent_share              | n    | mean charge of a vehicle there [its budget]    | [0, 1]    |
    | loop_flow                | L    | last flow at a loop [scale], -1 unknown        | [-1, 4]   |
    | loop_speed               | L    | last mean speed at a loop [scale], -1 unknown  | [-1, 4]   |
    | loop_age                 | 1    | age of these readings [interval]               | [0, 1]    |
    | loop_position            | L    | place of a loop [length of the mainline]       | [0, 1]    |

    Either ``released_speed`` or ``released_flow`` is there, whichever the release model releases,
    ``picked`` under ``action="sequential"``, ``last_price`` and ``spent_share`` under release
    models with prices, and those of ``loop_`` on a road with L loops. These say -1 before the first
    reading, where fewer vehicles passed than a loop reports, and of the speed where none did.
    Innovations are 0 where nothing was observed. ``observation`` chooses other blocks.

    **Action**: ``action`` chooses the encoding; a sampled action never raises. B is the largest
    number of queries that the bandwidth pays for.

    | ``action``     | space                      | meaning                                      |
    | :--            | :--                        | :--                                          |
    | ``mask``       | ``MultiBinary(G)``         | a flag per query; too many are cut in turn   |
    | ``scores``     | ``Box(-1, 1, (G,))``       | the highest clipped scores; ties in rotation |
    | ``slots``      | ``MultiDiscrete([G] * B)`` | a query in each of B slots                   |
    | ``sequential`` | ``Discrete(G)``            | one query per action, see `action_masks`     |

    Under ``sequential`` the traffic stands still, and the reward is 0, until the bandwidth pays for
    no other query. Every id has a variant of each encoding, as ``ShortHighway-Discrete-v0``
    (`dptse_env.registration.ENCODINGS`).

    **Reward**: minus the root mean squared error over the mainline, at most 0: of densities and
    speeds together, each in units of its scale (``joint``), or of one of them (``density``,
    ``speed``), or a function of your own. A segment without a vehicle has no speed to err in. The
    reward of a step of several seconds is their mean, so that errors compare.

    **Start of an episode**: a traffic seed is drawn from ``traffic_seeds``, and with
    ``random_start`` the first second. The estimator starts from the traffic of the nominal demand.
    The options of `reset` fix ``traffic_seed`` (one of ``traffic_seeds``) and ``start`` [s].

    **End of an episode**: truncated after ``horizon`` seconds, by default with the record; never
    terminated. The last step has the seconds that are left. ``spec.max_episode_steps`` is the
    number of steps, where it does not depend on the actions.

    **Info**: the same keys at the reset and at every step; numbers are floats, but for the seed.

    | key                 | value                                                             |
    | :--                 | :--                                                               |
    | ``rmse_density``    | error of the estimated mainline densities [veh/km]; true traffic  |
    | ``rmse_speed``      | error of the speeds of occupied segments [km/h]; true traffic     |
    | ``n_occupied``      | mainline segments with a vehicle; true traffic                    |
    | ``traffic_seed``    | seed of the record that is replayed, an integer; true traffic     |
    | ``n_dropped``       | requested queries that were cut, repeated or replaced             |
    | ``queried``         | the queries that were made, flags of shape (G,)                   |
    | ``diverged``        | 1 if the estimator diverged in this step and was started anew     |
    | ``fallback``        | 1 if its update had no solution in this step: it only predicted   |
    | ``spent_mu``        | privacy loss of a vehicle so far, at most: Gaussian DP parameter  |
    | ``spent_epsilon``   | the same as epsilon at the configured delta                       |
    | ``prices``          | under ``paced``: last price of each query, 0 before, shape (G,)   |
    | ``spent_share``     | under ``paced``: as in the observation, shape (n,)                |
    | ``centre_fallback`` | under ``paced``: 1 if no prediction was finite to centre flows on |
    | ``true_density``    | with ``truth_in_info``: of each segment [veh/km], shape (S,)      |
    | ``true_speed``      | with ``truth_in_info``: of each segment [km/h], shape (S,)        |
    | ``time``            | with ``truth_in_info``: second of the record; true traffic        |

    Values marked "true traffic" serve training and evaluation, as the reward does. They are not
    covered by the guarantee, and no policy may act on them. The others are public. ``spent_mu`` and
    ``spent_epsilon`` read like an odometer: what is guaranteed is the budget of a complete episode,
    in `guarantee` and `privacy`.

    **Arguments** of ``gym.make``, with the defaults of ``PaperHighway-v0``. All are plain JSON, but
    for parts of your own (a class or ``"package.module:Class"``). `EnvConfig` names the classes of
    those that take a mapping. ``docs/environment`` explains them, a page a noun.

    | argument             | default         | meaning                                             |
    | :--                  | :--             | :--                                                 |
    | `corridor`           | "paper-highway" | the road: a name, a mapping or a road file          |
    | `estimator`          | "ekf"           | or `ukf`, `enkf`, `mhe`, `recurrent`, ...           |
    | `backend`            | "compiled"      | or `reference`: textbook filters, an extra          |
    | `parameters`         | "published"     | of the traffic model: a name, a mapping, a file     |
    | `estimator_settings` | "published"     | tuning of the estimator; None for what ships        |
    | `bandwidth`          | 5               | largest cost of the queries of a step               |
    | `query_spans`        | (1,)            | numbers of neighbouring segments of a query         |
    | `bandwidth_unit`     | "segments"      | or `sums`: what a query costs                       |
    | `action`             | "mask"          | encoding of actions, see above                      |
    | `observation`        | ("default",)    | blocks of the observation, see above                |
    | `privacy`            | "printed"       | or `corrected`, `capped`, `paced`, a mapping        |
    | `penetration`        | 1.0             | share of connected vehicles, or a mapping           |
    | `sensor_settings`    | {}              | errors of the fixed sensors, a mapping              |
    | `fusion`             | {}              | how queries and sensors are put together            |
    | `reward`             | "joint"         | see above                                           |
    | `horizon`            | None            | length of an episode [s]; None for the record's     |
    | `query_every`        | 1               | seconds of a step; its first one has queries        |
    | `random_start`       | False           | whether episodes start anywhere in their record     |
    | `traffic_seeds`      | "0:64"          | traffic to draw from                                |
    | `truth_in_info`      | False           | whether `info` shows the true traffic               |
    | `epsilon`            | 1.0             | short for `privacy`'s                               |
    | `delta`              | 0.05            | short for `privacy`'s                               |
    | `loops`              | None            | short for `corridor`'s: loops, a mapping            |
    | `incident`           | "preset"        | short for `corridor`'s; `random`, `none`, a mapping |
    | `demand`             | "preset"        | short for `corridor`'s; `random`, a mapping         |
    | `render_mode`        | None            | or `rgb_array` (extra `plot`), `human` (`video`)    |
    | `render_every`       | 1               | seconds between two drawings                        |
    | `records`            | None            | folder of the record cache; None for the user's     |

    **Ids**, all in the namespace ``dptse``:

    | id                  | n   | S   | record | release, epsilon | estimator | bandwidth | demand |
    | :--                 | :-- | :-- | :--    | :--              | :--       | :--       | :--    |
    | `PaperHighway-v0`   | 15  | 19  | 700 s  | printed, 1       | ekf       | 5         | fixed  |
    | `PrivateHighway-v1` | 15  | 19  | 700 s  | paced, 5         | recurrent | 1         | random |
    | `LongHighway-v0`    | 120 | 128 | 1200 s | paced, 5         | recurrent | 2         | random |
    | `ShortHighway-v0`   | 6   | 8   | 240 s  | printed, 1       | recurrent | 1         | fixed  |

    ``PaperHighway-v0`` has the paper's filter, parameters and noise. The paper's schedule is
    ``shift-ahead``. The others are to learn on: they have the best estimator, calibrated
    parameters, and so few queries that it pays to choose them.

    **Rendering**: true density, estimate, queries and error over space and time, as a picture
    (``rgb_array``) or in a window (``human``). It shows true traffic.

    Examples:
        >>> import gymnasium as gym
        >>> env = gym.make("dptse_env:dptse/ShortHighway-v0", bandwidth=3, horizon=60)
        >>> observation, info = env.reset(seed=0)
        >>> env.action_space, observation.shape, env.unwrapped.privacy()["guarantee"]
        (MultiBinary(6), (74,), 'none')
        >>> total, truncated = 0.0, False
        >>> while not truncated:
        ...     action = env.action_space.sample()
        ...     observation, reward, terminated, truncated, info = env.step(action)
        ...     total += reward
        >>> terminated, int(info["queried"].sum()) <= 3, total < 0.0
        (False, True, True)
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 30}  # noqa: RUF012 (Gymnasium's own)

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
            MissingExtraError: A package is not installed: matplotlib for a ``render_mode``, pygame
                for ``"human"``, the filters of ``backend="reference"``.

        Warns:
            UserWarning: A release model with a guarantee is configured, and other keywords void
                it, or values of another road are used on this one.
        """
        super().__init__(preset, overrides, 1, records, render_mode)
        self.action_space = self.interface.actions.space
        self.observation_space = self.interface.observations.space
        self.render_every = integer("render_every", render_every, 1)
        if render_mode is not None:
            is_shown = render_mode == "human"
            screen = Screen("dptse-env", self.metadata["render_fps"]) if is_shown else None
            self.drawing = Drawing(every=self.render_every, screen=screen)
            self.process.watchers.append(self.drawing.follow)

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
        gym.Env.reset(self, seed=seed)
        outcome = self.process.reset(_ONLY, [self.np_random], options)
        if self.drawing is not None:
            self.drawing.begin(self.process, self.id)
        return outcome.observation[0], self.process.info(0)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Query, estimate and score a step.

        Raises:
            ValueError: The action has a wrong shape, dtype or value.
            gymnasium.error.ResetNeeded: The episode is over, or none was begun.
        """
        process = self.process
        if process.over[0]:
            raise gym.error.ResetNeeded("the episode is over: call reset() before step()")
        outcome = process.step(_ONLY, np.asarray(action)[None])
        reward, truncated = outcome.reward.item(), outcome.truncated.item()
        return outcome.observation[0], reward, False, truncated, process.info(0)

    def action_masks(self) -> NDArray[np.bool_]:
        """Return flags of the valid choices, shape (m,), as MaskablePPO of sb3-contrib wants them.

        Under ``action="sequential"`` they are those of the queries that may be picked next, (G,);
        else all are set. `dptse_env.spaces.actions.ActionEncoding.masks` has their order.

        Raises:
            gymnasium.error.ResetNeeded: No episode is running.
        """
        if self.process.over[0]:
            raise gym.error.ResetNeeded("no episode is running: call reset() first")
        masks: NDArray[np.bool_] = self._masks()[0]
        return masks

    def render(self) -> NDArray[np.uint8] | None:
        """Return the episode so far as a picture over space and time, shape (height, width, 3).

        With ``render_mode="human"`` the window shows it already, and nothing is returned.

        Raises:
            gymnasium.error.ResetNeeded: No episode has begun.
        """
        picture = self._drawn()
        return None if self.render_mode == "human" else picture

    def close(self) -> None:
        """Close the window, if there is one."""
        if self.drawing is not None and self.drawing.screen is not None:
            self.drawing.screen.close()
