"""Results of the study of choices: gains over the base schedule, and the bandwidth they save."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.experiments.cells import ERROR, Results
from agents.statistics import Interval, bootstrap, percent_below
from agents.studies.choices.cell import ChoiceCell
from agents.studies.choices.plan import ChoiceDesign, World
from dptse_env.utils.arrays import FloatArray


@dataclass(frozen=True)
class ChoiceResults(Results[ChoiceDesign, ChoiceCell]):
    """Scores by cell, in the order of the traffic seeds of its road."""

    def table(self, world: World, bandwidth: int, policies: Sequence[str]) -> FloatArray:
        """Return errors x 1000 of policies, shape (n_policies, n_seeds)."""
        cells = [self.design.cell(world, bandwidth, policy) for policy in policies]
        return np.stack([self.values(cell, ERROR) for cell in cells])

    def gain(self, world: World, bandwidth: int, policies: Sequence[str]) -> Interval:
        """Return by how much the mean of policies lies below the base schedule [%].

        With several policies, those of training seeds, a two-level bootstrap.
        """
        base = self.table(world, bandwidth, [self.design.schedule])
        return bootstrap(percent_below, self.table(world, bandwidth, policies), base)

    def worst_gain(self, world: World, bandwidth: int, policies: Sequence[str]) -> float:
        """Return the smallest gain of any of the policies [%]."""
        base = self.table(world, bandwidth, [self.design.schedule])[None]
        tables = (self.table(world, bandwidth, [each])[None] for each in policies)
        return min(float(percent_below(table, base)[0]) for table in tables)

    def saved(self, world: World, bandwidth: int, policies: Sequence[str]) -> Interval:
        """Return the bandwidth that policies save at the base schedule's error [%].

        With B' the bandwidth at which the base schedule has the error that the policies have with
        B, they save 1 - B / B'. Between the bandwidths that were run, the base schedule's error is
        taken as linear in the logarithm of the bandwidth; outside of them B' is the nearest.
        """
        bandwidths = self.design.bandwidths_of(world)
        bases = [self.table(world, each, [self.design.schedule]) for each in bandwidths]

        def percent(table: FloatArray, *curve: FloatArray) -> FloatArray:
            errors = np.stack([each.mean(axis=(-1, -2)) for each in curve], axis=-1)
            reached = table.mean(axis=(-1, -2))
            matched = _matching(np.log(bandwidths), errors, reached)
            saved: FloatArray = 100.0 * (1.0 - bandwidth / np.exp(matched))
            return saved

        return bootstrap(percent, self.table(world, bandwidth, policies), *bases, n_resamples=2000)


def _matching(places: FloatArray, errors: FloatArray, reached: FloatArray) -> FloatArray:
    """Return where curves of errors (..., n) at places (n,) first fall to the errors reached."""
    curves = np.atleast_2d(errors)
    # Noise may let an error rise with the bandwidth; what counts is the least so far.
    falling = np.minimum.accumulate(curves, axis=-1)
    found = [
        np.interp(-value, -curve, places)
        for curve, value in zip(falling, np.atleast_1d(reached), strict=True)
    ]
    return np.array(found).reshape(np.shape(reached))
