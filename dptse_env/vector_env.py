"""`SensorQueryVectorEnv`: the decision process as a Gymnasium environment of n episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import index
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from dptse_env.env_base import QueryEnvBase
from dptse_env.process import per_episode
from dptse_env.rendering import Drawing
from dptse_env.traffic import Records
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.validation import integer, require, require_name
from dptse_env.utils.vector_info import Infos, in_vector_form, object_array

_MODES = {mode.value: mode for mode in AutoresetMode}


@dataclass(frozen=True)
class FinalStates:
    """Final observations and infos of k episodes that were reset in the same step.

    Attributes:
        episodes: Their indices, shape (k,).
        observation: Their last observations, shape (k, size).
        infos: Their last infos, see `dptse_env.utils.vector_info`.
    """

    episodes: IntArray
    observation: Observation
    infos: Infos


@dataclass(frozen=True)
class Transition:
    """Result of a step of all n episodes, but for the infos.

    Attributes:
        observation: Shape (n, size).
        reward: Shape (n,); zero where an episode was reset instead of stepped.
        truncated: Whether the horizon is reached, shape (n,).
        final: In same-step mode, the final states of the episodes that ended; None if none did.
    """

    observation: Observation
    reward: FloatArray
    truncated: BoolArray
    final: FinalStates | None


class SensorQueryVectorEnv(QueryEnvBase, VectorEnv[Observation, Action, Any]):
    """A batch of n episodes in one process, sharing the records in memory.

    Spaces, keywords, rewards and infos are those of `dptse_env.env.SensorQueryEnv`. Every array has
    a leading axis over the n episodes, and ``infos`` has Gymnasium's vector form. After
    ``reset(seed=s)``, episode i gives the numbers of the scalar environment after
    ``reset(seed=s + i)``.

    **Autoreset** (``metadata["autoreset_mode"]``) of an episode that has ended:

    - ``NextStep`` (default): the next step resets it, ignores its action and gives a reward of 0.
    - ``SameStep``: the same step resets it; ``infos`` has ``final_obs`` and ``final_info``.
    - ``Disabled``: the caller resets it with ``reset_mask`` before the next step.

    **Reset options**: ``traffic_seed`` and ``start`` as in the scalar environment, each one value
    for all episodes or a list of n. ``reset_mask``, flags of shape (n,), resets the flagged
    episodes only, and ``infos`` has values for those alone. Options do not outlive the call.

    The episodes of a batch end together unless ``reset_mask`` staggers them. ``random_start``
    spreads them over the records, so that the episodes of a batch differ in their time of day.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        preset: str = "paper-highway",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        render_episode: int = 0,
        records: Records = None,
        threads: int | None = None,
        max_episode_steps: int | None = None,
        **overrides: Any,
    ) -> None:
        """Describe the environment; nothing is recorded or compiled before `reset`.

        Args:
            num_envs: Number n of episodes.
            preset: Name of a preset in `dptse_env.config.PRESETS`.
            autoreset_mode: A mode or its value, see above.
            render_mode: None or ``"rgb_array"``.
            render_episode: Number of the episode that `render` draws.
            records: Folder of the record cache, or a library of records; None for the user's
                cache.
            threads: Threads of the estimator, each for a block of episodes; None for one per core.
                Their number changes the time only.
            max_episode_steps: Steps of an episode, as a ``spec`` names them, or None. They follow
                from ``horizon``, ``query_every`` and ``action``.
            **overrides: As in `dptse_env.env.SensorQueryEnv`.

        Raises:
            ValueError: A key is unknown or a value out of range; the message names it.
            MissingExtraError: matplotlib is not installed for a ``render_mode``, or the filters of
                ``backend="reference"`` are not.

        Warns:
            UserWarning: A release model with a guarantee is configured, and other keywords void
                it, or values of another road are used on this one.
        """
        self.num_envs = integer("num_envs", num_envs, 1, 1_000_000)
        threads = None if threads is None else integer("threads", threads, 1, 1024)
        super().__init__(preset, overrides, self.num_envs, records, render_mode, threads=threads)
        known = (None, self.n_steps)
        allowed = f"{self.n_steps}, as keywords have it: horizon shortens episodes"
        require(max_episode_steps in known, "max_episode_steps", allowed, max_episode_steps)
        self.render_episode = integer("render_episode", render_episode, 0, self.num_envs - 1)
        if render_mode is not None:
            self.drawing = Drawing(self.render_episode)
            self.process.watchers.append(self.drawing.follow)
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = self.interface.actions.space
        self.single_observation_space = self.interface.observations.space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._generators: list[tuple[np.random.Generator, int] | None] = [None] * self.num_envs
        self._all = np.arange(self.num_envs)
        size = self.single_observation_space.shape
        self._observation = np.zeros((self.num_envs, *size), dtype=np.float32)

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of each episode, n of them."""
        return tuple(self._generator(e)[0] for e in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """The seed of each episode's generator, n of them."""
        return tuple(self._generator(e)[1] for e in range(self.num_envs))

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset all episodes, or those of ``options["reset_mask"]``.

        Args:
            seed: A seed s stands for s + i in episode i; a sequence has a seed for each episode,
                or None for one whose generator continues.
            options: ``traffic_seed``, ``start`` and ``reset_mask``, all optional.

        Returns:
            Observations, shape (n, size), unchanged for episodes that are not reset; and infos.

        Raises:
            ValueError: A seed or an option is unknown, out of range or of a wrong shape.
        """
        choices = dict(options or {})
        episodes = self._all
        if "reset_mask" in choices:
            episodes = np.flatnonzero(self._checked_mask(choices.pop("reset_mask")))
            for key, value in choices.items():
                values = per_episode(key, value, self.num_envs)
                choices[key] = [values[episode] for episode in episodes]
        self._seed(episodes, seed)
        self._reset(episodes, choices)
        return self._observation.copy(), self._infos(episodes)

    def step(
        self, actions: Action
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Query, estimate and score a step in every episode.

        Raises:
            ValueError: The actions have a wrong shape, dtype or value; nothing is changed then.
            gymnasium.error.ResetNeeded: An episode was never reset, or is over and autoreset is
                disabled.
        """
        transition = self.advance(actions)
        infos = self._infos(self._all)
        final = transition.final
        if final is not None:
            ended: Infos = {"final_obs": object_array(list(final.observation))}
            ended["final_info"] = final.infos
            infos |= in_vector_form(ended, final.episodes, self.num_envs)
        return (
            transition.observation,
            transition.reward,
            np.zeros(self.num_envs, dtype=bool),
            transition.truncated,
            infos,
        )

    def advance(self, actions: Action) -> Transition:
        """Step as `step` does, without collecting the infos of episodes that continue.

        Raises:
            ValueError: As in `step`.
            gymnasium.error.ResetNeeded: As in `step`.
        """
        actions = np.asarray(actions)
        if actions.shape[:1] != (self.num_envs,):
            raise ValueError(
                f"actions must have shape {self.action_space.shape}, got {actions.shape}"
            )
        over = self._checked_over()
        live = np.flatnonzero(~over)
        reward, truncated = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        if live.size:
            outcome = self.process.step(live, actions[live])
            self._observation[live] = outcome.observation
            reward[live], truncated[live] = outcome.reward, outcome.truncated
        to_reset, final = over, None
        if self.autoreset_mode is AutoresetMode.SAME_STEP and truncated.any():
            to_reset, done = truncated, np.flatnonzero(truncated)
            final = FinalStates(done, self._observation[done], self.process.infos(done))
        if to_reset.any():
            self._reset(np.flatnonzero(to_reset))
        return Transition(self._observation.copy(), reward, truncated, final)

    def action_masks(self) -> BoolArray:
        """Return flags of the valid choices, shape (n, m), as in the scalar environment.

        Raises:
            gymnasium.error.ResetNeeded: An episode was never reset.
        """
        self._require_reset()
        return self._masks()

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return the episode ``render_episode`` so far as the one picture of a tuple.

        It is that of `dptse_env.env.SensorQueryEnv.render`, shape (height, width, 3). Where an
        episode is reset in the step in which it ends, the picture is that of the new one.

        Raises:
            gymnasium.error.ResetNeeded: No episode has begun.
        """
        picture = self._drawn()
        return None if picture is None else (picture,)

    def _reset(self, episodes: IntArray, options: Mapping[str, Any] | None = None) -> None:
        generators = [self._generator(e)[0] for e in episodes]
        self._observation[episodes] = self.process.reset(episodes, generators, options).observation
        if self.drawing is not None and self.render_episode in episodes:
            self.drawing.begin(self.process, self.id)

    def _infos(self, episodes: IntArray) -> dict[str, Any]:
        return in_vector_form(self.process.infos(episodes), episodes, self.num_envs)

    def _generator(self, episode: int) -> tuple[np.random.Generator, int]:
        """Return the generator of an episode and its seed, drawn by the system if none is set."""
        known = self._generators[episode]
        if known is None:
            known = self._generators[episode] = seeding.np_random()
        return known

    def _seed(self, episodes: IntArray, seed: int | Sequence[int | None] | None) -> None:
        if seed is None:
            return
        if isinstance(seed, int | np.integer):
            seeds: list[int | None] = [int(seed) + e for e in range(self.num_envs)]
        else:
            seeds = [None if value is None else index(value) for value in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed must be an integer or a list of {self.num_envs}, got {len(seeds)}"
            )
        fresh = {e: seeding.np_random(s) for e in episodes if (s := seeds[e]) is not None}
        for episode, generator in fresh.items():
            self._generators[episode] = generator

    def _checked_mask(self, mask: Any) -> BoolArray:
        expected = f"options.reset_mask must be a bool array of shape ({self.num_envs},)"
        if not isinstance(mask, np.ndarray):
            raise ValueError(f"{expected}, got {type(mask).__name__}")
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(f"{expected}, got {mask.dtype} of shape {mask.shape}")
        if not mask.any():
            raise ValueError("options.reset_mask must name at least one episode, all are False")
        return mask

    def _require_reset(self) -> None:
        n_idle = np.count_nonzero(~self.process.was_reset)
        if n_idle > 0:
            raise gym.error.ResetNeeded(
                f"{n_idle} of {self.num_envs} episodes were never reset: call reset() first"
            )

    def _checked_over(self) -> BoolArray:
        """Return the flags of episodes to reset instead of to step, shape (n,)."""
        self._require_reset()
        over = self.process.over
        if self.autoreset_mode is AutoresetMode.DISABLED and over.any():
            raise gym.error.ResetNeeded(
                f"{over.sum()} of {self.num_envs} episodes are over and autoreset is disabled: "
                "call reset(options={'reset_mask': truncated}) first"
            )
        return over


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    require_name("autoreset_mode", mode, _MODES)
    return _MODES[mode]
