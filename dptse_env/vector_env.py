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

from dptse_env.config import resolve
from dptse_env.parts import make_interface, make_parts, warn_where_void
from dptse_env.process import QueryProcess
from dptse_env.reset_options import per_episode
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.validation import integer, path_or_none
from dptse_env.utils.vector_info import Rows, as_objects, in_vector_form, repeated

_MODES = {mode.value: mode for mode in AutoresetMode}


@dataclass(frozen=True)
class Ended:
    """How k episodes ended that have been begun again since.

    Attributes:
        episodes: Which they are, shape (k,).
        observation: Their last observations, shape (k, size).
        infos: What was said of them at the end, rows as in `dptse_env.utils.vector_info`.
    """

    episodes: IntArray
    observation: Observation
    infos: Rows


@dataclass(frozen=True)
class Transition:
    """What a step gives back for all n episodes, ahead of its infos.

    Attributes:
        observation: Shape (n, size).
        reward: Shape (n,); zero where an episode was begun instead of stepped.
        truncated: Whether the horizon is reached, shape (n,).
        begun: Which episodes were begun again, shape (n,).
        ended: How they ended, in same-step mode; None where none did.
    """

    observation: Observation
    reward: FloatArray
    truncated: BoolArray
    begun: BoolArray
    ended: Ended | None


class SensorQueryVectorEnv(VectorEnv[Observation, Action, Any]):
    """Choose whom to query in n episodes at once; see `dptse_env.env.SensorQueryEnv` for what.

    All episodes live in one process and share the records in memory. Episode i gives the numbers
    of the scalar environment of seed s + i. Every array leads with an axis over the n episodes;
    ``infos`` has Gymnasium's vector form, with the keys of the scalar environment.

    **Autoreset** (``metadata["autoreset_mode"]``), for an episode that has ended:

    - ``NextStep`` (default): the next step begins it again; its action is ignored, its reward is 0.
    - ``SameStep``: the same step begins it again; ``infos`` holds ``final_obs`` and ``final_info``.
    - ``Disabled``: the caller resets it with ``reset_mask`` before the next step.

    **Reset options**: ``traffic_seed`` and ``start`` as in the scalar environment, each one value
    or one per episode, n of them, and ``reset_mask``, flags of shape (n,): only these episodes are
    begun, and ``infos`` speaks of no others. Options do not outlive the call.

    The episodes of a batch end together unless ``reset_mask`` staggers them. ``random_start``
    spreads them over the records, so that a batch does not see one time of day.
    """

    def __init__(
        self,
        num_envs: int = 1,
        preset: str = "paper-highway",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        records: str | None = None,
        threads: int | None = None,
        **overrides: Any,
    ) -> None:
        """Describe the environment; nothing is recorded or compiled before `reset`.

        Args:
            num_envs: How many episodes run at once, n.
            preset: Name of a preset in `dptse_env.config.PRESETS`.
            autoreset_mode: When an episode that has ended begins again: a mode or its value.
            render_mode: None; a batch is not drawn.
            records: Folder of the record cache; None for the user's cache.
            threads: Threads that estimate, each for a block of episodes; None for one per core.
                Their number changes the time only.
            **overrides: As in `dptse_env.env.SensorQueryEnv`.

        Raises:
            ValueError: A key is unknown or a value out of range; the message names it.

        Warns:
            UserWarning: Privacy preset ``guaranteed`` was asked for, and other keywords void it.
        """
        if render_mode is not None:
            raise ValueError(
                f"render_mode must be None, got {render_mode!r}: a batch of episodes is not drawn; "
                "make one with gymnasium.make to see it"
            )
        self.num_envs = integer("num_envs", num_envs, 1, 1_000_000)
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.config = resolve(preset, overrides)
        warn_where_void(self.config)
        self.interface = make_interface(self.config)
        self.single_action_space = self.interface.actions.space
        self.single_observation_space = self.interface.observations.space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._records = path_or_none("records", records)
        self._threads = None if threads is None else integer("threads", threads, 1, 1024)
        self._process: QueryProcess | None = None
        self._generators: list[tuple[np.random.Generator, int] | None] = [None] * self.num_envs
        self._begun = np.zeros(self.num_envs, dtype=bool)
        self._all = np.arange(self.num_envs)
        size = self.single_observation_space.shape
        self._observation = np.zeros((self.num_envs, *size), dtype=np.float32)

    @property
    def process(self) -> QueryProcess:
        """The process behind the environment, assembled at the first use."""
        if self._process is None:
            library = RecordLibrary(self._records)
            parts = make_parts(self.config, self.num_envs, library, interface=self.interface)
            self._process = QueryProcess(parts, self._threads)
        return self._process

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
        """Begin all episodes, or those of ``options["reset_mask"]``.

        Args:
            seed: s starts the generator of episode i anew with s + i; a sequence of n gives each
                its own, None lets it go on.
            options: ``traffic_seed`` and ``start``, each one or n of them, and ``reset_mask``, all
                optional.

        Returns:
            Observations, shape (n, size), the last ones for episodes that go on; infos.

        Raises:
            ValueError: A seed or an option is unknown, out of range or of a wrong shape.
        """
        others = dict(options or {})
        episodes = self._all
        if "reset_mask" in others:
            episodes = np.flatnonzero(self._checked_mask(others.pop("reset_mask")))
            for key, value in others.items():
                values = per_episode(key, value, self.num_envs)
                others[key] = [values[episode] for episode in episodes]
        self._seed(episodes, seed)
        self._begin(episodes, others)
        return self._observation.copy(), self._infos(episodes, episodes)

    def step(
        self, actions: Action
    ) -> tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Query, estimate and score one second in every episode.

        Raises:
            ValueError: The actions have a wrong shape, dtype or value; nothing is changed then.
            gymnasium.error.ResetNeeded: An episode was never begun, or is over and autoreset is
                disabled.
        """
        transition = self.advance(actions)
        infos = self._infos(self._all, np.flatnonzero(transition.begun))
        ended = transition.ended
        if ended is not None:
            final: Rows = {"final_obs": as_objects(list(ended.observation))}
            final["final_info"] = ended.infos
            infos |= in_vector_form(final, ended.episodes, self.num_envs)
        return (
            transition.observation,
            transition.reward,
            np.zeros(self.num_envs, dtype=bool),
            transition.truncated,
            infos,
        )

    def advance(self, actions: Action) -> Transition:
        """Do what `step` does, without collecting infos of episodes that go on.

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
        begun, ended = over, None
        if self.autoreset_mode is AutoresetMode.SAME_STEP and truncated.any():
            begun, done = truncated, np.flatnonzero(truncated)
            ended = Ended(done, self._observation[done], self.process.infos(done))
        if begun.any():
            self._begin(np.flatnonzero(begun))
        return Transition(self._observation.copy(), reward, truncated, begun, ended)

    def action_masks(self) -> BoolArray:
        """Return which segments may be picked next, shape (n, n_mainline), for ``sequential``.

        Raises:
            ValueError: The actions are not sequential.
            gymnasium.error.ResetNeeded: An episode was never begun.
        """
        if self.config.action != "sequential":
            raise ValueError(
                f"action_masks() needs action='sequential', this is {self.config.action!r}"
            )
        self._require_begun()
        free: BoolArray = ~self.process.pending.picked
        return free

    def privacy(self) -> dict[str, Any]:
        """Return the guarantee of an episode, or what voids it, and the account behind it."""
        return self.process.privacy()

    def _begin(self, episodes: IntArray, options: Mapping[str, Any] | None = None) -> None:
        generators = [self._generator(e)[0] for e in episodes]
        self._observation[episodes] = self.process.reset(episodes, generators, options).observation
        self._begun[episodes] = True

    def _infos(self, episodes: IntArray, begun: IntArray) -> dict[str, Any]:
        """Return the infos of ``episodes``, with what is said of those just ``begun``."""
        infos = in_vector_form(self.process.infos(episodes), episodes, self.num_envs)
        if begun.size:
            said = repeated(self.process.reset_info(), len(begun))
            infos |= in_vector_form(said, begun, self.num_envs)
        return infos

    def _generator(self, episode: int) -> tuple[np.random.Generator, int]:
        """Return the generator of an episode and its seed; without a seed it draws its own."""
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
            seeds = [None if one is None else index(one) for one in seed]
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must be one or a list of {self.num_envs}, got {len(seeds)}")
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

    def _require_begun(self) -> None:
        if not self._begun.all():
            raise gym.error.ResetNeeded(
                f"{(~self._begun).sum()} of {self.num_envs} episodes were never begun: "
                "call reset() first"
            )

    def _checked_over(self) -> BoolArray:
        """Return which episodes are to be begun instead of stepped, shape (n,)."""
        self._require_begun()
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
    if mode not in _MODES:
        raise ValueError(f"autoreset_mode must be one of {', '.join(_MODES)}, got {mode!r}")
    return _MODES[mode]
