"""Cells, the units that every table of results is made of, and the one place that plays them."""

from __future__ import annotations

import json
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock

from agents.environments import make_config, make_vector, quietly
from agents.policies import find_policy
from agents.watchers import WATCHERS
from dptse_env.config import EnvConfig
from dptse_env.estimators.recurrent import member_for, read_weights, shipped_weights
from dptse_env.evaluation import WARM_UP, Row, WatcherFactory, evaluate
from dptse_env.policies import TRANSFERABLE
from dptse_env.traffic import Corridor, RecordLibrary, Records, open_library
from dptse_env.utils.files import file_digest
from dptse_env.utils.validation import require

POLICY_SEED = 0
"""Seeds the draws of a schedule, and torch for the draws of a learned policy."""


class PlayError(Exception):
    """A cell could not be played; the message names its policy and where that raised what."""


@dataclass(frozen=True)
class Cell:
    """A query policy in an environment, to be played on some traffic seeds.

    Attributes:
        env: Environment id.
        policy: What `agents.policies.find_policy` takes: the name of a schedule or of a policy that
            comes with the package, the file of a saved policy, or a class.
        keywords: Keywords of ``gym.make`` as plain JSON, without traffic seeds and records.
        labels: Columns that tell the cell apart in tables: strings and numbers.
        noise_seed: Noise is seeded with this plus the traffic seed.
        deterministic: Whether the policy takes its likeliest action; None for what its card says.
        transferred: Whether the policy may act in an environment that it was not trained for.
        watchers: Names in `agents.watchers.WATCHERS`, which add columns to the rows.
        seeds: Traffic seeds in place of the study's.
    """

    env: str
    policy: str = "shift-ahead"
    keywords: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, Any] = field(default_factory=dict)
    noise_seed: int = 0
    deterministic: bool | None = None
    transferred: bool = False
    watchers: tuple[str, ...] = ()
    seeds: tuple[int, ...] | None = None

    @property
    def id(self) -> str:
        """Everything that the rows depend on but the seeds, as JSON.

        Digests stand for the files that it names, so a policy that was trained again is another
        cell.

        Raises:
            FileNotFoundError: There is no such policy.
            ValueError: The file of the policy is not a saved one.
        """
        source = find_policy(self.policy)
        identity = source.identity
        acts = source.deterministic if self.deterministic is None else self.deterministic
        content = {
            "env": self.env,
            "policy": identity if source.is_schedule else f"sha256:{identity}",
            "keywords": _with_digests(self.keywords),
            "noise_seed": self.noise_seed,
            "deterministic": acts,
            "watchers": list(self.watchers),
        }
        return json.dumps(content, sort_keys=True)

    @property
    def all_keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make``; those of the policy where they do not name others."""
        return {**find_policy(self.policy).keywords, **self.keywords}

    @property
    def config(self) -> EnvConfig:
        """Configuration of its environment.

        Raises:
            ValueError: A keyword is unknown or out of range.
        """
        with quietly():
            return make_config(self.env, self.all_keywords)

    def check(self) -> None:
        """Check keywords, policy and watchers without playing, recording or compiling.

        Raises:
            FileNotFoundError: There is no such policy.
            ValueError: A keyword is unknown or out of range, an episode is too short, or the policy
                is unknown or does not suit the environment.
        """
        unknown = [name for name in self.watchers if name not in WATCHERS]
        if unknown:
            raise ValueError(f"watchers must be of {', '.join(WATCHERS)}, got {unknown[0]!r}")
        with quietly():
            env = make_vector(self.env, 1, self.all_keywords)
            seconds, allowed = env.config.horizon_steps, f"above the {WARM_UP} s that do not count"
            require(seconds > WARM_UP, "horizon or the road's duration", allowed, seconds)
            env.process  # noqa: B018 (an estimator refuses a road when it is made)
        self.load_policy(env)

    def misfit(self) -> str | None:
        """Return why the cell cannot be played, or None if it can.

        Raises:
            FileNotFoundError: There is no such policy.
        """
        try:
            self.check()
        except ValueError as problem:
            return str(problem)
        return None

    def load_policy(self, env: Any) -> Any:
        """Bind the policy to an environment.

        Raises:
            ValueError: It is unknown or does not suit.
        """
        allow = TRANSFERABLE if self.transferred else ()
        return find_policy(self.policy).load(env, allow=allow, seed=POLICY_SEED)


def _with_digests(value: Any) -> Any:
    """Return plain JSON with digests in place of files' names, and beside those of weights.

    That are weights of the package by their own name. A pair's name stands alone, as it stands in
    rows from before.
    """
    if isinstance(value, Mapping):
        return {key: _with_digests(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_with_digests(each) for each in value]
    if isinstance(value, str):
        if value in shipped_weights():
            return f"{value} sha256:{read_weights(value).card['sha256']}"
        members = dict.fromkeys(member_for(value, flows) for flows in (True, False))
        files = [member for member in members if Path(member).is_file()]
        return "+".join(f"sha256:{file_digest(file)}" for file in files) or value
    return value


def play(
    cell: Cell,
    seeds: Sequence[int],
    records: Records = None,
    threads: int | None = 1,
    watchers: Sequence[WatcherFactory] = (),
) -> list[Row]:
    """Play a cell on some traffic seeds, all at once, and return a row for each.

    Traffic that was never recorded is recorded first.

    Args:
        cell: The cell.
        seeds: Traffic seeds.
        records: Folder of the record cache or a library; None for the user's cache.
        threads: Threads of the estimator; None for one per core.
        watchers: Those that watch beside the cell's.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: A keyword is out of range, or the policy does not suit.
        RecordingError: SUMO could not make a record.
        PlayError: The policy raised an error, or took an action that there is not.
    """
    more = {"traffic_seeds": list(seeds), "records": records, "threads": threads}
    with quietly():
        env = make_vector(cell.env, len(seeds), {**cell.all_keywords, **more})
    record(env.config.corridor, seeds, records)
    policy = cell.load_policy(env)
    if not find_policy(cell.policy).is_schedule:
        import torch  # noqa: PLC0415 (schedules alone do without)

        torch.manual_seed(POLICY_SEED)
    try:
        return evaluate(
            env,
            policy,
            seeds,
            cell.noise_seed,
            deterministic=cell.deterministic,
            watchers=[*(WATCHERS[name] for name in cell.watchers), *watchers],
        )
    except Exception as problem:
        raise PlayError(_blame(cell, problem)) from problem


def _blame(cell: Cell, problem: Exception) -> str:
    """Return an error in one line, with the cell and the innermost place in the code."""
    labels = ", ".join(f"{name} {value}" for name, value in cell.labels.items())
    place = traceback.extract_tb(problem.__traceback__)[-1]
    said = " ".join(f"{type(problem).__name__}: {problem}".split())
    return f"{cell.policy!r} in {labels or cell.env}: {said} ({place.filename}:{place.lineno})"


def record(
    corridor: Corridor,
    seeds: Sequence[int],
    records: Records = None,
    *,
    progress: bool = False,
    workers: int | None = None,
) -> None:
    """Record the traffic that is missing on this machine.

    Of several processes that lack the same records, one makes them and the others wait.

    Args:
        corridor: The road.
        seeds: Traffic seeds.
        records: Folder of the record cache or a library; None for the user's cache.
        progress: Whether to show a progress bar.
        workers: Processes that record; None for one per core.

    Raises:
        ValueError: A seed is out of range or was not recorded.
        RecordingError: A recording fails, or the folder cannot be written.
        NetconvertError: The corridor has to be compiled and cannot be.
        SumoVersionError: libsumo is missing, broken or too old.
    """
    library: RecordLibrary = open_library(records)
    missing = library.missing(corridor, seeds)
    if not missing or corridor.recordings is not None:
        return
    with FileLock(library.prepare(corridor, missing[0]) / ".lock"):
        library.ensure(corridor, seeds, workers, progress)
