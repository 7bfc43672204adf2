"""Plan of the study of privacy: its curves, and the cells that they share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from agents.experiments.cells import Design
from dptse_env.estimators import check_estimator

GUARANTEED, PRINTED = "capped", ("paper", "corrected")
OPEN_LOOP = "open_loop"
"""The estimator without measurements: run beside the others in every figure."""
BOUNDARY_MODES = ("nominal", "private", "true")
UNBOUNDED = "none"
"""Protected unit of a preset that bounds no contributions."""


class Protection(NamedTuple):
    """A privacy preset with its protected unit and cap.

    Attributes:
        preset: Privacy preset.
        unit: Protected unit; `UNBOUNDED` where the preset bounds no contributions.
        cap: Queried steps in which a vehicle counts; 0 where none is set.
    """

    preset: str
    unit: str = UNBOUNDED
    cap: int = 0

    def __str__(self) -> str:
        """Return the name in a table; names of presets are code."""
        if self.preset != GUARANTEED:
            return f"`{self.preset}` noise"
        return f"{self.unit}, C = {self.cap}" if self.cap else self.unit


@dataclass(frozen=True)
class PrivacyCell:
    """A configuration, run on every traffic seed.

    Attributes:
        unit: Protected unit; `UNBOUNDED` where the preset bounds no contributions.
        cap: Queried steps in which a vehicle counts; 0 where none is set.
        boundary_inputs: ``true``, ``nominal`` or ``private``.
    """

    estimator: str
    preset: str
    unit: str
    cap: int
    boundary_inputs: str
    epsilon: float
    delta: float
    bandwidth: int

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it."""
        privacy: dict[str, Any] = {
            name: getattr(self, name) for name in ("preset", "epsilon", "delta", "boundary_inputs")
        }
        if self.unit != UNBOUNDED:
            privacy["unit"] = self.unit
        if self.unit == "trip":
            privacy["cap"] = self.cap
        return {"estimator": self.estimator, "bandwidth": self.bandwidth, "privacy": privacy}


@dataclass(frozen=True)
class PrivacyDesign(Design[PrivacyCell]):
    """The cells of the study; traffic, ARZ parameters and horizon are the environment's.

    Attributes:
        estimators: Estimators beside the open loop, which is always run.
        epsilons: Values of epsilon; the base value is added.
        caps: Caps of the unit trip; the base value is added.
        bandwidths: Segments queried a second; the base value is added.
        epsilon: Base value of epsilon, at which boundary modes and bandwidths are compared.
        delta: The delta of every cell.
        cap: Base value of the cap.
        bandwidth: Base value of the bandwidth.
    """

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    estimators: tuple[str, ...] = ("ekf", "random_walk")
    epsilons: tuple[float, ...] = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
    caps: tuple[int, ...] = (4, 16, 64)
    bandwidths: tuple[int, ...] = (3, 5, 8, 15)
    epsilon: float = 5.0
    delta: float = 0.05
    cap: int = 64
    bandwidth: int = 5

    def __post_init__(self) -> None:
        """Sort the grids with their base values in them."""
        for name, base in self._grids.items():
            object.__setattr__(self, name, tuple(sorted({*getattr(self, name), base})))

    @property
    def _grids(self) -> dict[str, float]:
        """Base values by the names of their grids."""
        return {"epsilons": self.epsilon, "caps": self.cap, "bandwidths": self.bandwidth}

    def check(self) -> None:
        """See `Design.check`."""
        super().check()
        if not self.estimators or len(set(self.estimators)) < len(self.estimators):
            raise ValueError(f"estimators must be 1 or more and distinct, got {self.estimators}")
        for name in self.estimators:
            check_estimator(name, "compiled")
            if name == OPEN_LOOP:
                raise ValueError(f"estimators must not name {OPEN_LOOP!r}: it is always run")
        for name, base in self._grids.items():
            values = getattr(self, name)
            if len(values) < 2:
                raise ValueError(f"{name} must hold a value beside {base:g}, got {values}")

    @property
    def all_estimators(self) -> tuple[str, ...]:
        """The estimators, then the open loop."""
        return (*self.estimators, OPEN_LOOP)

    @property
    def base(self) -> Protection:
        """The protection at which boundary modes and bandwidths are compared."""
        return Protection(GUARANTEED, "trip", self.cap)

    @property
    def guaranteed(self) -> tuple[Protection, ...]:
        """Protections with a guarantee: by cap, then the units that need none."""
        trips = tuple(Protection(GUARANTEED, "trip", cap) for cap in self.caps)
        return (Protection(GUARANTEED, "event"), *trips, Protection(GUARANTEED, "horizon"))

    @property
    def printed(self) -> tuple[Protection, ...]:
        """The paper's noise, as printed and as its cited theorem needs it."""
        return tuple(Protection(preset) for preset in PRINTED)

    def cell(
        self,
        estimator: str,
        protection: Protection | None = None,
        *,
        epsilon: float | None = None,
        boundary_inputs: str | None = None,
        bandwidth: int | None = None,
    ) -> PrivacyCell:
        """Return a cell; fields left out have base values, the boundary is as in the preset."""
        preset, unit, cap = protection or self.base
        mode = boundary_inputs or ("nominal" if preset == GUARANTEED else "true")
        cell = PrivacyCell(
            estimator=estimator,
            preset=preset,
            unit=unit,
            cap=cap,
            boundary_inputs=mode,
            epsilon=self.epsilon if epsilon is None else epsilon,
            delta=self.delta,
            bandwidth=self.bandwidth if bandwidth is None else bandwidth,
        )
        return self._canonical(cell)

    def _canonical(self, cell: PrivacyCell) -> PrivacyCell:
        """Return the cell that stands for all that give the same episodes.

        The open loop uses the boundary inputs and nothing else; where these are not released,
        neither noise nor queries matter to it.
        """
        if cell.estimator != OPEN_LOOP or cell.boundary_inputs == "private":
            return cell
        mode = cell.boundary_inputs
        base = self.epsilon, self.delta, self.bandwidth
        return PrivacyCell(OPEN_LOOP, *self.base, mode, *base)

    def along_epsilon(self, estimator: str, protection: Protection) -> list[PrivacyCell]:
        """Return the cells of one curve over epsilon."""
        return [self.cell(estimator, protection, epsilon=value) for value in self.epsilons]

    def along_bandwidth(self, estimator: str) -> list[PrivacyCell]:
        """Return the cells of one curve over the bandwidth."""
        return [self.cell(estimator, bandwidth=value) for value in self.bandwidths]

    def all_cells(self) -> Iterator[PrivacyCell]:
        """Yield the cells of every curve and table."""
        for name in self.all_estimators:
            for protection in (*self.guaranteed, *self.printed):
                yield from self.along_epsilon(name, protection)
            for mode in BOUNDARY_MODES:
                yield self.cell(name, boundary_inputs=mode)
            yield from self.along_bandwidth(name)

    def quick(self) -> PrivacyDesign:
        """Return a design of the same results with fewer points and seeds."""

        def ends(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return values[0], values[-1]

        return dataclasses.replace(
            self,
            seeds=self.first_seeds(3),
            epsilons=(*ends(self.epsilons), 1.0),
            caps=ends(self.caps),
            bandwidths=ends(self.bandwidths),
        )
