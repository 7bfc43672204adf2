"""The configuration of an environment: one frozen dataclass, presets, and how keywords change them.

Everything is reachable from plain JSON, so the keywords of ``gym.make`` survive a spec.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from dptse_env.actions import ACTION_ENCODINGS
from dptse_env.estimators import EstimatorSettings, check_estimator
from dptse_env.estimators.tuning import available_settings, load_settings, settings_name
from dptse_env.mapping import from_mapping
from dptse_env.model import ARZModel, ARZParameters, load_parameters
from dptse_env.privacy import (
    VOID_REASONS,
    Accountant,
    PrivacySettings,
    Sensitivity,
    contribution_sensitivity,
    paper_sensitivity,
)
from dptse_env.rewards import REWARD_TERMS
from dptse_env.traffic import CORRIDORS, Corridor, randomised

TRAINING_SEEDS = range(1_000)
"""Traffic seeds meant for training and calibration."""
VALIDATION_SEEDS = range(1_000, 2_000)
"""Traffic seeds meant for choosing among trained policies."""
TEST_SEEDS = range(2_000, 3_000)
"""Traffic seeds meant for the numbers that are reported."""


def _require_name(path: str, name: object, known: Iterable[str]) -> None:
    known = list(known)
    if name not in known:
        raise ValueError(f"{path} must be one of {', '.join(known)}, got {name!r}")


@dataclass(frozen=True)
class EnvConfig:
    """What an environment is made of.

    Attributes:
        corridor: The road, its demand, incident and fixed sensors.
        estimator: Name of the estimator: ``ekf``, ``ukf``, ``enkf``, ``mhe``, ``random_walk`` or
            ``open_loop``.
        backend: ``compiled`` or ``reference``.
        parameters: ARZ parameters, or the name of a set.
        estimator_settings: Tuning of the estimator, or the name of a shipped set
            (`dptse_env.estimators.tuning`), whichever estimator it was tuned for. None for the
            set ``<estimator>-<ARZ parameters>-<privacy preset>`` if one ships, else the defaults.
        bandwidth: Most mainline segments to query a step.
        action: Name of the action encoding: ``mask``, ``scores``, ``slots`` or ``sequential``.
        privacy: Preset of the mechanism, epsilon and delta, and what they protect.
        reward: Term of the reward: ``joint``, ``density`` or ``speed``.
        horizon: Length of an episode [s]; None for the whole record.
        random_start: Whether an episode starts at a random second of the record.
        traffic_seeds: Traffic seeds to draw episodes from.
        truth_in_info: Whether ``info`` shows the true traffic.

    Raises:
        ValueError: A value is out of range, or the parameters violate the CFL condition.
    """

    corridor: Corridor
    estimator: str = "ekf"
    backend: str = "compiled"
    parameters: str | ARZParameters = "paper"
    estimator_settings: str | EstimatorSettings | None = None
    bandwidth: int = 5
    action: str = "mask"
    privacy: PrivacySettings = field(default_factory=PrivacySettings)
    reward: str = "joint"
    horizon: int | None = None
    random_start: bool = False
    traffic_seeds: tuple[int, ...] = tuple(TRAINING_SEEDS[:64])
    truth_in_info: bool = False

    def __post_init__(self) -> None:
        """Check everything that needs no traffic."""
        _require_name("action", self.action, ACTION_ENCODINGS)
        _require_name("reward", self.reward, REWARD_TERMS)
        check_estimator(self.estimator, self.backend)
        n, duration = self.corridor.n_mainline, self.corridor.duration
        if not 1 <= self.bandwidth <= n:
            raise ValueError(f"bandwidth must be in 1..{n}, got {self.bandwidth}")
        if not 1 <= self.horizon_steps <= duration:
            raise ValueError(f"horizon must be in 1..{duration}, got {self.horizon}")
        if self.random_start and self.horizon_steps == duration:
            raise ValueError(
                f"random_start needs a horizon below the record's {duration} s, got {self.horizon}"
            )
        if not self.traffic_seeds:
            raise ValueError("traffic_seeds must not be empty")
        if min(self.traffic_seeds) < 0 or len(set(self.traffic_seeds)) < len(self.traffic_seeds):
            raise ValueError(f"traffic_seeds must be >= 0 and distinct, got {self.traffic_seeds}")
        self.model()
        self.settings()

    @property
    def horizon_steps(self) -> int:
        """Length of an episode [s]."""
        return self.corridor.duration if self.horizon is None else self.horizon

    @property
    def last_start(self) -> int:
        """Latest second of the record at which an episode may start."""
        return self.corridor.duration - self.horizon_steps

    def model(self) -> ARZModel:
        """Return the traffic model of the estimator, with a time step of one second."""
        parameters = self.parameters
        if isinstance(parameters, str):
            parameters = load_parameters(parameters)
        # The centre of the speeds that a flow is clipped to.
        centre = 0.5 * self.corridor.speed_limit if self.privacy.speed == "flow" else None
        return ARZModel(self.corridor, parameters, reference_speed=centre)

    def settings(self) -> EstimatorSettings:
        """Return the settings of the estimator."""
        if isinstance(self.estimator_settings, EstimatorSettings):
            return self.estimator_settings
        if self.estimator_settings is not None:
            return load_settings(self.estimator_settings)
        parameters = self.parameters if isinstance(self.parameters, str) else self.parameters.name
        name = settings_name(self.estimator, parameters, self.privacy.preset)
        return load_settings(name) if name in available_settings() else EstimatorSettings()

    def sensitivity(self) -> Sensitivity:
        """Return how far one vehicle can move the releases, by the rule of the privacy preset."""
        corridor, privacy = self.corridor, self.privacy
        if privacy.is_bounded:
            slope = corridor.speed_scale / corridor.density_scale
            return contribution_sensitivity(
                contributions=privacy.contributions(self.horizon_steps),
                adjacency=privacy.adjacency,
                segment_length=corridor.segment_length,
                largest_speed=corridor.speed_limit,
                protects=privacy.protected(),
                mean_speed_slope=slope if privacy.speed == "mean" else None,
            )
        n_always = len(corridor.fixed_sensors)
        if privacy.boundary == "private":
            n_always += corridor.n_boundaries
        return paper_sensitivity(
            n_sensors=self.bandwidth + n_always,
            average_dwell=corridor.average_dwell,
            segment_length=corridor.segment_length,
            # Constants of the corridor, so that the noise does not depend on the estimator.
            free_flow_speed=corridor.speed_scale,
            jam_density=corridor.density_scale,
        )

    def accountant(self) -> Accountant:
        """Return the account of what an episode releases."""
        return Accountant(self.privacy, self.sensitivity())

    def warn_where_void(self) -> None:
        """Warn where the preset that guarantees privacy was asked for, and other fields void it.

        The warning names the line that called the caller, the constructor of an environment.
        """
        if not self.privacy.is_bounded:
            return
        reasons = self.accountant().report.void_reasons
        if reasons:
            listed = "; ".join(f"{reason}: {VOID_REASONS[reason]}" for reason in reasons)
            asked = f"privacy.preset is {self.privacy.preset!r}"
            warnings.warn(
                f"{asked}, yet no privacy is guaranteed. {listed}", UserWarning, stacklevel=3
            )


PRESETS = {
    "paper-highway": EnvConfig(corridor=CORRIDORS["paper-highway"]),
    "private-highway": EnvConfig(
        corridor=randomised(CORRIDORS["paper-highway"]),
        parameters="w99-3lane",
        privacy=PrivacySettings("guaranteed", epsilon=5.0, cap=64),
    ),
    "short-highway": EnvConfig(corridor=CORRIDORS["short-highway"], bandwidth=2),
}
"""Configurations by name."""


def resolve(preset: str, overrides: Mapping[str, Any]) -> EnvConfig:
    """Return a preset with some of its fields replaced.

    Args:
        preset: A name in `PRESETS`.
        overrides: Fields of `EnvConfig`. A mapping replaces the named fields of a nested
            dataclass and keeps the others. Names stand for known values: a corridor, a privacy
            preset. Shortcuts: ``epsilon`` and ``delta`` of ``privacy``, ``incident`` of
            ``corridor`` (``"preset"``, ``"none"``, ``"random"`` or a mapping) and ``demand`` of
            ``corridor`` (the same without ``"none"``); random means drawn anew for every traffic
            seed. ``traffic_seeds`` may be a string ``"first:stop"``. In a mapping
            ``estimator_settings``, fields left out keep what None would have given: the tuned set
            of the resolved estimator, parameters and privacy preset, or else the defaults.

    Raises:
        ValueError: A key is unknown or a value out of range; the message starts with its path.
    """
    _require_name("preset", preset, PRESETS)
    base, values = PRESETS[preset], dict(overrides)
    base = replace(base, corridor=_corridor(base.corridor, values))
    base = replace(base, privacy=_privacy(base.privacy, values))
    if isinstance(values.get("traffic_seeds"), str):
        values["traffic_seeds"] = parse_seeds(values["traffic_seeds"], "traffic_seeds")
    settings = values.get("estimator_settings")
    if not isinstance(settings, Mapping):
        return from_mapping(EnvConfig, values, "", base)
    del values["estimator_settings"]
    config = from_mapping(EnvConfig, values, "", base)
    settings = from_mapping(EstimatorSettings, settings, "estimator_settings", config.settings())
    return replace(config, estimator_settings=settings)


def parse_seeds(text: str, path: str = "seeds") -> tuple[int, ...]:
    """Return the seeds that ``"first:stop"`` or ``"one"`` stands for, ``stop`` left out.

    Raises:
        ValueError: The text is neither, or the range is empty.
    """
    first, colon, stop = text.partition(":")
    if not (first.isdecimal() and (stop.isdecimal() or not colon)):
        raise ValueError(f"{path} must be 'first:stop' or one seed, got {text!r}")
    seeds = tuple(range(int(first), int(stop) if colon else int(first) + 1))
    if not seeds:
        raise ValueError(f"{path} must not be empty, got {text!r}")
    return seeds


def _corridor(base: Corridor, values: dict[str, Any]) -> Corridor:
    """Take the keywords about the corridor out of ``values`` and apply them."""
    corridor = values.pop("corridor", {})
    if isinstance(corridor, str):
        _require_name("corridor", corridor, CORRIDORS)
        base, corridor = CORRIDORS[corridor], {}
    base = from_mapping(Corridor, corridor, "corridor", base)
    named: dict[str, dict[str, Any]] = {
        "demand": {"preset": base.demand, "random": randomised(base).demand},
        "incident": {
            "preset": base.incident,
            "random": randomised(base).incident,
            "none": None,
        },
    }
    for key, known in named.items():
        value = values.pop(key, "preset")
        if isinstance(value, str):
            _require_name(key, value, known)
            value = known[value]
        base = from_mapping(Corridor, {key: value}, "corridor", base)
    return base


def _privacy(base: PrivacySettings, values: dict[str, Any]) -> PrivacySettings:
    """Take the keywords about privacy out of ``values`` and apply them."""
    privacy = values.pop("privacy", {})
    if isinstance(privacy, str):
        privacy = {"preset": privacy}
    base = from_mapping(PrivacySettings, privacy, "privacy", base)
    shortcuts = {key: values.pop(key) for key in ("epsilon", "delta") if key in values}
    return from_mapping(PrivacySettings, shortcuts, "privacy", base)
