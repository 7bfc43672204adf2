"""Mutants: small changes of the code, each of which must fail a fast test.

Those of `MUTANTS` break each a line of the proof. Those of ``tests/mutants.jsonl`` were drawn.
``python -m tests.mutants`` makes all one by one in a copy of the repository, runs the tests of
their module there, and prints which test has caught each; with words only the mutants whose name,
file or line of the proof has one of them. It ends with status 1 where a mutant lives, which is a
missing test, where one cannot be made any more, or where tests fail without one. It takes half an
hour: run it after a change to what ``docs/privacy/proof.md`` names, and draw mutants anew of lines
that have changed.

``python -m tests.mutants --draw FILE NUMBER TEST...`` prints the first mutants of a seeded order of
a file for that record. One that changes nothing that anyone may rely on does not belong there.
"""

from __future__ import annotations

import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from dptse_env.utils.kernels import default_folder

ROOT = Path(__file__).parents[1]
SPARED = (".*", "__pycache__", "build", "dist", "results")
"""Names that no copy needs, at any depth."""

MOST_SECONDS = 600.0
"""Time for the tests of a mutant, which may compile a kernel."""

UNSOUND = re.compile(
    r"numba\.|(Attribute|Index|Key|Name|Type|UnboundLocal)Error|ValueError: .*broadcast"
)
"""Errors of tests where a mutant is no sound Python, which shows nothing."""


class Mutant(NamedTuple):
    """A one-line change of the code.

    Attributes:
        name: What is wrong with it.
        line: Line of the proof in ``docs/privacy/proof.md`` that it breaks, 0 for none.
        path: File below the folder.
        old: Text that stands there exactly once.
        new: What takes its place.
        tests: Files below ``tests``, a fast test of which must fail.
        folder: Folder below the root.
    """

    name: str
    line: int
    path: str
    old: str
    new: str
    tests: str
    folder: str = "dptse_env"

    @property
    def file(self) -> Path:
        """The file that is changed, below the root."""
        return Path(self.folder, self.path)

    def applied(self, text: str) -> str:
        """Return the text of the file with the change.

        Raises:
            ValueError: The old text is not found, or more than once.
        """
        if text.count(self.old) != 1:
            raise ValueError(
                f"{self.path} has {text.count(self.old)} times what mutant {self.name!r} changes: "
                f"{self.old!r}"
            )
        return text.replace(self.old, self.new)


MUTANTS = (
    # --- two worlds ---------------------------------------------------------------------------
    Mutant(
        "who is connected depends on how many vehicles there are", 1, "traffic/penetration.py",
        "uniform = self._uniform(traffic_seed, 0, record.n_vehicles)",
        "uniform = self._uniform(traffic_seed, 0, record.n_vehicles)[::-1]",
        "traffic/test_penetration.py",
    ),
    Mutant(
        "the mask of answers shows empty segments", 2, "release/paced.py",
        "return Measurement(observed, values, sigma, centre)",
        "return Measurement(observed & (sums[..., 0] > 0.0), values, sigma, centre)",
        "test_non_interference.py",
    ),
    Mutant(
        "the estimator reads no answer of an empty segment", 2, "process.py",
        "measured = self.measure(request)",
        "measured = self.measure(request); "
        "measured.observed[:, :15] &= self.truth(episodes)[:, :15, 0] > 0.0",
        "test_non_interference.py",
    ),
    Mutant(
        "an empty segment has a release of zero", 2, "process.py",
        "measured = self.release.release(request)",
        "measured = self.release.release(request); "
        "measured.values[:, :15] *= self.truth(request.episodes)[:, :15, :1] > 0.0",
        "test_non_interference.py",
    ),
    Mutant(
        "ledgers are in info", 2, "process.py",
        "**self.release.public(episodes),",
        "**self.release.public(episodes), **self.release.private(episodes, 0 * episodes),",
        "test_non_interference.py",
    ),
    Mutant(
        "refusals are in info", 2, "release/paced.py",
        '"centre_fallback": self._fallback[episodes],',
        '"centre_fallback": self._fallback[episodes] + self._refused[episodes, 0],',
        "test_non_interference.py",
    ),
    Mutant(
        "an empty segment has a mean speed of its own", 2, "release/gaussian.py",
        "np.where(counts == 0.0, limit,", "np.where(counts == 0.0, 0.0,",
        "release/test_gaussian.py",
    ),
    Mutant(
        "truth in info voids nothing", 2, "parts.py",
        'shown = ("truth_in_info",) if config.truth_in_info else ()', "shown = ()",
        "release/test_report.py",
    ),
    Mutant(
        "a report that is void still states its guarantee", 2, "release/report.py",
        'replace(self, guarantee="none", ', "replace(self, ",
        "release/test_report.py",
    ),
    Mutant(
        "centres are true speeds", 3, "release/paced.py",
        "predicted, centre = self._predicted(request)",
        "predicted, centre = self._predicted(request); "
        "centre[:, : self._limits.size] = "
        "self.traffic.aggregates(request.traffic, request.times)[..., 1]",
        "test_non_interference.py",
    ),
    Mutant(
        "empty segments count as those without a prediction", 3, "release/paced.py",
        "predicted, centre = self._predicted(request)",
        "predicted, centre = self._predicted(request); self._fallback[request.episodes] = "
        "(self.traffic.aggregates(request.traffic, request.times)[..., 0] == 0.0).sum(axis=1)",
        "test_non_interference.py",
    ),
    Mutant(
        "prices follow true densities", 3, "release/paced.py",
        "prices = self.pacing.prices(episodes, observed, *predicted)",
        "prices = self.pacing.prices(episodes, observed, *np.moveaxis("
        "self.traffic.aggregates(request.traffic, request.times), -1, 0))",
        "test_non_interference.py",
    ),
    Mutant(
        "prices follow true ledgers", 3, "release/paced.py",
        "prices = self.pacing.prices(episodes, observed, *predicted)",
        "prices = self.pacing.prices(episodes, observed, *predicted) "
        "/ (1.0 + self.ledgers.paid[episodes].max())",
        "test_non_interference.py",
    ),
    Mutant(
        "a boundary segment has another centre than the segment beside it", 3, "release/paced.py",
        "centre[k, n_segments + r] = centre[k, neighbours[r]]",
        "centre[k, n_segments + r] = 0.5 * fastest",
        "release/test_paced.py",
    ),
    # --- one vehicle --------------------------------------------------------------------------
    Mutant(
        "two vehicles share a ledger", 4, "release/vehicles.py",
        "s, v = rows.cell[row], rows.vehicle[row]",
        "s, v = rows.cell[row], rows.vehicle[row] // 2",
        "test_guarantee.py",
    ),
    Mutant(
        "a segment answers for three vehicles at most", 4, "release/vehicles.py",
        "if ledgers[g, v] + cost <= terms.budget[g]:",
        "if ledgers[g, v] + cost <= terms.budget[g] and counts[c] < 3:",
        "test_guarantee.py",
    ),
    Mutant(
        "the grid of deviations is coarser than one km/h", 5, "release/noise.py",
        "return min(float(np.int64(bits).view(np.float64)), COARSEST)",
        "return float(np.int64(bits).view(np.float64))",
        "release/test_noise.py",
    ),
    Mutant(
        "deviations are rounded to the grid of another column", 5, "release/vehicles.py",
        "grid[c] = grid_of(sigma[k, c, 1])", "grid[c] = grid_of(sigma[k, 0, 1])",
        "release/test_vehicles.py release/test_paced.py",
    ),
    Mutant(
        "sums that doubles cannot hold are not refused", 5, "release/vehicles.py",
        "steps * MOST_VEHICLES < 2.0**52,", "True,",
        "release/test_vehicles.py",
    ),
    Mutant(
        "a record of too many vehicles is not refused", 5, "traffic/record.py",
        '"vehicle": MOST_VEHICLES}', '"vehicle": 2**31}',
        "traffic/test_record.py",
    ),
    Mutant(
        "a sum is no multiple of the grid", 5, "release/vehicles.py",
        "sums[k, c, 1] = deviations[c] * grid[c]", "sums[k, c, 1] = deviations[c] * 1.01 * grid[c]",
        "release/test_vehicles.py",
    ),
    Mutant(
        "a deviation is charged before it is rounded", 6, "release/vehicles.py",
        "d = steps * grid[c]",
        "d = min(max(min(reported, terms.fastest) - centre[k, s], -clip), clip)",
        "release/test_vehicles.py",
    ),
    Mutant(
        "a deviation at the clip is rounded up", 6, "release/vehicles.py",
        "most[c] = np.floor(clip / grid[c])", "most[c] = np.ceil(clip / grid[c])",
        "release/test_vehicles.py",
    ),
    Mutant(
        "deviations are charged unclipped and released clipped", 6, "release/vehicles.py",
        "d = steps * grid[c]", "d = min(reported, terms.fastest) - centre[k, s]",
        "test_guarantee.py",
    ),
    Mutant(
        "deviations are charged clipped and released unclipped", 6, "release/vehicles.py",
        "deviations[c] += np.int64(steps)",
        "deviations[c] += np.int64((min(reported, terms.fastest) - centre[k, s]) / grid[c])",
        "test_guarantee.py",
    ),
    Mutant(
        "a vehicle is charged for being counted alone", 6, "release/vehicles.py",
        "prices[k, c] * (1.0 + terms.ratio * d * d / (clip * clip))", "prices[k, c]",
        "test_guarantee.py",
    ),
    Mutant(
        "the noise of deviations does not follow the ratio", 6, "release/paced.py",
        "self._flow_noise = settings.clip / math.sqrt(settings.ratio)",
        "self._flow_noise = settings.clip",
        "release/test_paced.py",
    ),
    Mutant(
        "overlaps are charged once", 7, "release/vehicles.py",
        "ledgers[g, v] += cost", "ledgers[g, v] += cost if i == 0 else 0.0",
        "test_guarantee.py",
    ),
    Mutant(
        "a ratio of two is allowed under replace", 8, "release/paced.py",
        "if self.ratio > 1.0 and", "if self.ratio > 2.0 and",
        "release/test_paced.py",
    ),
    Mutant(
        "deviations below the centre are not clipped", 8, "release/vehicles.py",
        "steps = min(max(steps, -most[c]), most[c])", "steps = min(steps, most[c])",
        "test_guarantee.py",
    ),
    Mutant(
        "the budget is not halved under replace", 8, "release/paced.py",
        'self._squares = 2.0 if settings.adjacency == "replace" else 1.0', "self._squares = 1.0",
        "test_guarantee.py",
    ),
    Mutant(
        "budgets of replace and of add_remove are exchanged", 9, "release/paced.py",
        'self._squares = 2.0 if settings.adjacency == "replace" else 1.0',
        'self._squares = 1.0 if settings.adjacency == "replace" else 2.0',
        "test_guarantee.py",
    ),
    Mutant(
        "vehicles that are not connected are counted", 9, "release/vehicles.py",
        "if reported < 0.0:", "if reported < -1.0:",
        "release/test_vehicles.py",
    ),
    Mutant(
        "vehicles that are not connected report", 9, "traffic/penetration.py",
        "return np.where(reports, speeds, np.float32(-1.0))", "return speeds",
        "traffic/test_penetration.py",
    ),
    Mutant(
        "a ledger goes with the segment", 10, "release/vehicles.py",
        "s, v = rows.cell[row], rows.vehicle[row]",
        "s, v = rows.cell[row], (rows.vehicle[row] + rows.cell[row]) % paid.shape[2]",
        "test_guarantee.py",
    ),
    Mutant(
        "ledgers are kept over a reset", 10, "release/vehicles.py",
        "self.paid[episodes] = 0.0", "self.paid = self.paid.copy()",
        "test_guarantee.py",
    ),
    Mutant(
        "a paced reset clears the ledgers of its first episode alone", 10, "release/paced.py",
        "self.ledgers.reset(episodes, self.traffic.n_vehicles)",
        "self.ledgers.reset(episodes[:1], self.traffic.n_vehicles)",
        "release/test_paced.py",
    ),
    Mutant(
        "a capped reset clears the ledgers of its first episode alone", 10, "release/gaussian.py",
        "self.ledgers.reset(episodes, self.traffic.n_vehicles)",
        "self.ledgers.reset(episodes[:1], self.traffic.n_vehicles)",
        "release/test_gaussian.py",
    ),
    Mutant(
        "a wider record clears the ledgers of all episodes", 10, "release/vehicles.py",
        "wider[..., : self.paid.shape[2]] = self.paid", "wider[:] = 0.0",
        "release/test_vehicles.py",
    ),
    Mutant(
        "a trip has a budget for every second", 10, "release/paced.py",
        'if self.task.settings.unit == "event":  # every', "if True:  # every",
        "test_guarantee.py",
    ),
    Mutant(
        "the last payment overdraws the ledger", 11, "release/vehicles.py",
        "if ledgers[g, v] + cost <= terms.budget[g]:", "if ledgers[g, v] <= terms.budget[g]:",
        "test_guarantee.py",
    ),
    Mutant(
        "a refused contribution is added", 11, "release/vehicles.py",
        "refused[k, g] += 1", "refused[k, g] += 1; counts[c] += 1",
        "test_guarantee.py",
    ),
    Mutant(
        "released boundary segments are not charged", 11, "release/vehicles.py",
        "ledgers[g, v] += cost", "ledgers[g, v] += cost if s < n_cells - 4 else 0.0",
        "test_guarantee.py",
    ),
    Mutant(
        "a vehicle counts once more than the cap", 12, "release/gaussian.py",
        "math.inf if cap is None else float(cap)", "math.inf if cap is None else cap + 1.0",
        "test_guarantee.py",
    ),
    Mutant(
        "flows are not centred on the middle of the speeds", 12, "release/model.py",
        "return 0.5 * corridor.geometry.largest_speed_limit",
        "return 0.4 * corridor.geometry.largest_speed_limit",
        "test_guarantee.py",
    ),
    Mutant(
        "two speeds on one segment are taken for speeds on two", 12, "privacy/sensitivity.py",
        "same_segment = 2.0 * flow", "same_segment = math.sqrt(2.0) * flow",
        "test_guarantee.py",
    ),
    Mutant(
        "the noise is that of the longest segment", 12, "release/gaussian.py",
        "segment_length=min(corridor.geometry.segment_lengths),\n            largest_speed",
        "segment_length=max(corridor.geometry.segment_lengths),\n            largest_speed",
        "release/test_gaussian.py",
    ),
    Mutant(
        "the ledger of a second is not cleared", 13, "release/paced.py",
        'if self.task.settings.unit == "event":  # every', "if False:  # every",
        "release/test_paced.py",
    ),
    Mutant(
        "a capped second depends on how often a vehicle counted before", 13, "release/gaussian.py",
        'return self.cap if self.unit == "trip" else None', "return self.cap",
        "release/test_gaussian.py",
    ),
    Mutant(
        "overlapping queries of a second do not divide its budget", 13, "release/pacing.py",
        "most = max(most, total[g, s] + own)", "most = max(most, own)",
        "release/test_pacing.py",
    ),
    Mutant(
        "a second has the noise of a trip", 13, "release/gaussian.py",
        'return min(self.cap, horizon) if self.unit == "trip" else 1',
        "return min(self.cap, horizon)",
        "test_guarantee.py",
    ),
    Mutant(
        "each group of a paced release has the whole budget", 14, "release/paced.py",
        "mu_of(settings.epsilon, settings.delta) * np.sqrt(task.shares)",
        "mu_of(settings.epsilon, settings.delta) * np.ones_like(task.shares)",
        "test_guarantee.py",
    ),
    Mutant(
        "queries have the whole budget beside the sensors' part", 14, "measurement/sensors.py",
        'Group("queries", 1.0 - share, penetration)', 'Group("queries", 1.0, penetration)',
        "test_guarantee.py",
    ),
    Mutant(
        "sensors have the noise of queries", 14, "release/gaussian.py",
        "self.noise_std[task.channels.group]", "self.noise_std[0 * task.channels.group]",
        "test_guarantee.py",
    ),
    Mutant(
        "the report of caps has the mu of one group", 14, "release/gaussian.py",
        "math.hypot(*self.mu), task.settings.delta", "max(self.mu), task.settings.delta",
        "test_guarantee.py",
    ),
    Mutant(
        "the report of ledgers has the mu of one group", 14, "release/paced.py",
        "EpsilonTable(math.hypot(*self.mu), settings.delta)",
        "EpsilonTable(max(self.mu), settings.delta)",
        "test_guarantee.py",
    ),
    # --- noise --------------------------------------------------------------------------------
    Mutant(
        "the grid follows the value", 15, "release/noise.py",
        "grid_of(sigma[k, c, q])\n                ratio",
        "grid_of(sigma[k, c, q] + abs(values[k, c, q]))\n                ratio",
        "release/test_noise.py",
    ),
    Mutant(
        "noise is added unrounded", 15, "release/noise.py",
        "steps = np.rint(ratio * z)", "steps = ratio * z",
        "release/test_noise.py",
    ),
    Mutant(
        "the noise is too small", 15, "release/noise.py",
        "ratio = scale * sigma[k, c, q] / grid", "ratio = 0.95 * scale * sigma[k, c, q] / grid",
        "release/test_noise.py",
    ),
    Mutant(
        "integers in doubt are not settled", 16, "release/noise.py",
        "if n_open > 0 and given is None:", "if False:",
        "release/test_noise.py",
    ),
    Mutant(
        "no integer is ever in doubt", 16, "release/noise.py",
        "margin < ratio * (1.0 + size) * doubt", "margin < 0.0",
        "release/test_noise.py",
    ),
    Mutant(
        "doubt does not grow with the scale", 16, "release/noise.py",
        "margin < ratio * (1.0 + size) * doubt", "margin < (1.0 + size) * doubt",
        "release/test_noise.py",
    ),
    Mutant(
        "far numbers are not in doubt", 16, "release/noise.py",
        "is_open = size > FAR or margin", "is_open = margin",
        "release/test_noise.py",
    ),
    Mutant(
        "what is settled has one sign", 16, "release/noise.py",
        "return -found if bits & 1 else found", "return found",
        "release/test_noise.py",
    ),
    Mutant(
        "the further bits are zeros", 16, "release/noise.py",
        "tail << 64 | more(),", "tail << 64 | 0 * more(),",
        "release/test_noise.py",
    ),
    Mutant(
        "a number is settled by the bits of the next second", 16, "release/noise.py",
        "self._next[row] - 1, c, q", "self._next[row] % BLOCK, c, q",
        "release/test_noise.py",
    ),
    Mutant(
        "counts and deviations have one noise", 17, "release/noise.py",
        "z = normal[episodes[k], step, c, q]", "z = normal[episodes[k], step, c, 0]",
        "release/test_noise.py",
    ),
    Mutant(
        "two columns have one noise", 17, "release/noise.py",
        "z = normal[episodes[k], step, c, q]", "z = normal[episodes[k], step, c // 2 * 2, q]",
        "release/test_noise.py",
    ),
    Mutant(
        "queries and fixed sensors have one noise", 17, "release/noise.py",
        "z = normal[episodes[k], step, c, q]", "z = normal[episodes[k], step, c % 8, q]",
        "release/test_noise.py",
    ),
    Mutant(
        "all episodes of a batch have one noise", 17, "release/noise.py",
        "z = normal[episodes[k], step, c, q]", "z = normal[0, step, c, q]",
        "release/test_noise.py",
    ),
    Mutant(
        "noise comes again after its block", 17, "release/noise.py",
        "                )\n            self._draw(row, generator)",
        "                )\n            self._next[row] = 0",
        "release/test_noise.py",
    ),
    Mutant(
        "noise is drawn by what is queried", 17, "release/gaussian.py",
        "k = len(values)",
        "k = len(values); request.observed[0, 0] or self.noise.added("
        "request.episodes, values, self.added_std[:k], self.unit)",
        "test_streams.py",
    ),
    Mutant(
        "the estimator draws from the stream of the noise", 17, "process.py",
        "self.estimator.reset(episodes, prior, for_estimator)",
        "self.estimator.reset(episodes, prior, for_noise)",
        "test_streams.py",
    ),
    Mutant(
        "noise is drawn from the stream of the traffic", 17, "process.py",
        "self.release.reset(episodes, for_noise)", "self.release.reset(episodes, for_traffic)",
        "test_streams.py",
    ),
    Mutant(
        "errors of fixed sensors are drawn from the stream of the noise", 17, "process.py",
        "self.sensor_errors.reset(episodes, for_sensors)",
        "self.sensor_errors.reset(episodes, for_noise)",
        "measurement/test_sensors.py",
    ),
    Mutant(
        "streams are spawned from 32 bits", 17, "process.py",
        "generator.integers(2**32, size=4,", "generator.integers(2**32, size=1,",
        "test_streams.py",
    ),
    Mutant(
        "secure noise follows the seed", 18, "release/noise.py",
        "np.frombuffer(os.urandom(bits.nbytes), dtype=np.uint64)",
        "np.frombuffer(generator.bytes(bits.nbytes), dtype=np.uint64)",
        "release/test_noise.py",
    ),
    Mutant(
        "the further bits of secure noise follow the seed", 18, "release/noise.py",
        "if self._is_secure:\n            return lambda:",
        "if row < 0:\n            return lambda:",
        "release/test_noise.py",
    ),
    Mutant(
        "paced noise is never secure", 18, "release/paced.py",
        "Noise(n, task.n_channels, settings.noise)", "Noise(n, task.n_channels)",
        "test_streams.py",
    ),
    Mutant(
        "capped noise is never secure", 18, "release/gaussian.py",
        "Noise(n, task.n_channels, task.settings.noise)", "Noise(n, task.n_channels)",
        "test_streams.py",
    ),
    Mutant(
        "a process with secure noise can be forked", 18, "process.py",
        'if self.config.privacy.noise == "secure":', "if False:",
        "test_streams.py",
    ),
    Mutant(
        "a copy has the secure noise of its origin", 18, "release/noise.py",
        "if self._is_secure else self\n", "if False else self\n",
        "release/test_noise.py",
    ),
    Mutant(
        "a forked process has the secure noise of its origin", 18, "release/noise.py",
        "_SECURE.add(self)", "pass",
        "release/test_noise.py",
    ),
    Mutant(
        "a number that is settled moves the stream", 17, "release/noise.py",
        "child = generator.spawn(1)[0]", "child = generator",
        "release/test_noise.py",
    ),
    Mutant(
        "a seeded guarantee does not say so", 18, "release/settings.py",
        'against = "" if self.noise == "secure" else', 'against = "" if self.noise else',
        "release/test_paced.py",
    ),
    Mutant(
        "a model whose noise is its own says that it is secure", 18, "config.py",
        'require(value.noise == "seeded" or model.takes_noise,', "require(True,",
        "test_streams.py",
    ),
    # --- from distances to the guarantee ------------------------------------------------------
    Mutant(
        "the estimator reads a second before the centres are taken", 19, "process.py",
        "measured = self.measure(request)",
        "self.estimator.update(episodes, self.fork().measure(request)); "
        "measured = self.measure(request)",
        "test_process.py",
    ),
    Mutant(
        "the estimator begins at the true state", 20, "process.py",
        "prior = nominal_state(self.config.corridor, self.model, self.time[episodes])",
        "prior = self.model.states(*np.moveaxis(self.truth(episodes), -1, 0))",
        "test_non_interference.py",
    ),
    Mutant(
        "nominal boundary inputs are the true ones", 20, "measurement/boundary.py",
        '"nominal": NominalBoundary,', '"nominal": TrueBoundary,',
        "measurement/test_boundary.py",
    ),
    Mutant(
        "true boundary inputs void nothing", 20, "measurement/boundary.py",
        'void_reasons: ClassVar[tuple[str, ...]] = ("boundary_inputs",)', "pass",
        "release/test_report.py",
    ),
    Mutant(
        "released boundary flows are read around v_0", 20, "measurement/boundary.py",
        "np.maximum(density, self._least_density) + centre",
        "np.maximum(density, self._least_density) + model.centre",
        "measurement/test_boundary.py",
    ),
    Mutant(
        "the noise of an answer is not divided by the share", 20, "measurement/fusion.py",
        "sigma[:, queries, 0] = np.sqrt((sigma[:, queries, 0] / p) ** 2 + sampling)",
        "sigma[:, queries, 0] = np.sqrt(sigma[:, queries, 0] ** 2 + sampling)",
        "measurement/test_fusion.py",
    ),
    Mutant(
        "the noise of a flow is not divided by the share", 20, "measurement/fusion.py",
        "np.sqrt((sigma[:, queries, 1] / p) ** 2 + sampling * square)",
        "np.sqrt(sigma[:, queries, 1] ** 2 + sampling * square)",
        "measurement/test_fusion.py",
    ),
    Mutant(
        "answers are divided by the true share", 20, "process.py",
        "measured = self.fusion.read(measured, request.prediction())",
        "self.fusion.share = self.config.penetration.share_of("
        "self.config.traffic_seeds[request.traffic[0]]); "
        "measured = self.fusion.read(measured, request.prediction())",
        "test_non_interference.py",
    ),
    Mutant(
        "density and flow have the noise that each needs alone", 21, "privacy/gaussian.py",
        "shares = share, 1.0 - share", "shares = 1.0, 1.0",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "the noise of flows forgets two speeds on one segment", 21, "privacy/gaussian.py",
        "max(bound / math.sqrt(part), largest) / mu", "bound / math.sqrt(part) / mu",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "mu is that of a single one-sided bound", 21, "privacy/gaussian.py",
        "return float(log_ndtr(upper)) + math.log1p(-lower_over_upper)",
        "return float(log_ndtr(upper)) + 2.0 * math.log1p(-lower_over_upper)",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "mu is a little too large", 21, "privacy/gaussian.py",
        "return float(brentq(excess, low, high, xtol=1e-16 * low",
        "return (1.0 + 1e-11) * float(brentq(excess, low, high, xtol=1e-16 * low",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "epsilon is given for another delta than is named", 21, "privacy/gaussian.py",
        "{name: epsilon_of(mu, float(name)) for name in DELTAS}",
        "{name: epsilon_of(mu, 0.05) for name in DELTAS}",
        "release/test_gaussian.py",
    ),
    Mutant(
        "a guarantee states mu rounded down", 21, "privacy/gaussian.py",
        "localcontext(rounding=ROUND_CEILING)", "localcontext(rounding='ROUND_FLOOR')",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "the reserve is smaller than the rounding of ledgers", 22, "privacy/gaussian.py",
        "ROUNDING = 2.0**-30", "ROUNDING = 2.0**-36",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "ledgers keep nothing back for rounding", 22, "release/paced.py",
        "(1.0 - ROUNDING) * self.budget", "self.budget",
        "test_guarantee.py",
    ),
    Mutant(
        "capped noise keeps nothing back for rounding", 22, "release/gaussian.py",
        "factor = (1.0 + ROUNDING) / math.sqrt", "factor = 1.0 / math.sqrt",
        "test_guarantee.py",
    ),
    Mutant(
        "an episode may have more payments than the reserve covers", 22, "release/paced.py",
        "require_covered(task.horizon * int(task.covers.sum(axis=0).max()))",
        "require_covered(task.horizon)",
        "release/test_paced.py",
    ),
    Mutant(
        "the reserve covers any number of payments", 22, "privacy/gaussian.py",
        "require(payments <= MOST_PAYMENTS,", "require(True,",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "the next episode of an environment has the noise of the last", 23, "process.py",
        "generator.integers(2**32, size=4,", "copy.deepcopy(generator).integers(2**32, size=4,",
        "test_streams.py",
    ),
    Mutant(
        "an observation begins with the last release of the episode before", 23, "process.py",
        "self.released[episodes] = 0.0", "self.released = self.released.copy()",
        "test_streams.py",
    ),
    Mutant(
        "innovations outlast a reset", 23, "estimators/base.py",
        "self.innovations[episodes] = 0.0", "self.innovations[:0] = 0.0",
        "test_streams.py",
    ),
    Mutant(
        "the boundary remembers the release of the episode before", 23, "measurement/boundary.py",
        "self._has_release[episodes] = False", "self._has_release = self._has_release.copy()",
        "measurement/test_boundary.py",
    ),
    Mutant(
        "what is spent outlasts a reset", 23, "release/pacing.py",
        "self._paces.spent[episodes] = 0.0", "self._paces.spent[:0] = 0.0",
        "release/test_pacing.py release/test_paced.py",
    ),
    Mutant(
        "what is spent leaves out queries that overlap", 24, "release/paced.py",
        "paid[channels.group[c], s] += (1.0 + accounts.ratio) * price",
        "paid[channels.group[c], s] = (1.0 + accounts.ratio) * price",
        "test_guarantee.py",
    ),
    Mutant(
        "what is spent is the largest of a group", 24, "release/paced.py",
        "np.sqrt(squares.sum(axis=1))", "np.sqrt(squares.max(axis=1))",
        "test_guarantee.py",
    ),
    Mutant(
        "what is spent is the largest of a second", 24, "release/paced.py",
        "if accounts.is_event else charged[g] + largest", "",
        "test_guarantee.py",
    ),
    Mutant(
        "what is spent is a vehicle's payment at the predicted speed", 24, "release/paced.py",
        "paid[channels.group[c], s] += (1.0 + accounts.ratio) * price",
        "paid[channels.group[c], s] += price",
        "test_guarantee.py",
    ),
    Mutant(
        "what is spent grows with the number of contributions", 24, "privacy/gaussian.py",
        "self.mu * np.sqrt(np.arange(n + 1) / n)", "self.mu * (np.arange(n + 1) / n)",
        "privacy/test_gaussian.py",
    ),
    Mutant(
        "what is spent is what a vehicle has truly paid", 24, "release/paced.py",
        "return self._losses(self._charged[episodes])",
        "return self._losses(self.ledgers.paid[episodes].max(axis=2, initial=0.0))",
        "test_non_interference.py",
    ),
    Mutant(
        "what is spent is not rounded up", 24, "release/paced.py",
        "np.minimum((1.0 + ROUNDING) * self._squares * paid,", "np.minimum(self._squares * paid,",
        "test_guarantee.py",
    ),
    Mutant(
        "epsilon is rounded down to a level of mu", 24, "privacy/gaussian.py",
        "level = np.ceil(", "level = np.floor(",
        "privacy/test_gaussian.py",
    ),
    # --- loops ----------------------------------------------------------------------------------
    Mutant(
        "loops leave out a vehicle that is not connected", 25, "release/vehicles.py",
        "readings(record, self.corridor.stations",
        "readings(record.without(int(np.argmin(self.populations[0].connected(self.seeds[index], "
        "record)))) if self.populations and self.populations[0] else record, "
        "self.corridor.stations",
        "test_non_interference.py",
    ),
    Mutant(
        "a reading counts a part of its interval", 25, "traffic/readings.py",
        "whole = interval < K", "whole = (interval < K) & (second % loops.interval > 2)",
        "test_non_interference.py",
    ),
    Mutant(
        "who passes in the last second counts in the next interval", 25, "traffic/readings.py",
        "interval = (second - 1) // loops.interval", "interval = second // loops.interval",
        "test_non_interference.py",
    ),
    Mutant(
        "a reading comes before its interval", 25, "measurement/rewind.py",
        "self._loops.said_until(traffic, times)",
        "self._loops.said_until(traffic, np.minimum(times + self._loops.interval, 42))",
        "test_non_interference.py",
    ),
    Mutant(
        "an observation has the reading of an interval that has not ended", 25,
        "measurement/loops.py",
        "self._traffic.readings.shape[2], interval >= 0",
        "self._traffic.readings.shape[2], interval > -2; interval = np.minimum(interval + 1, 5)",
        "test_non_interference.py",
    ),
    Mutant(
        "a reading holds true densities", 25, "measurement/loops.py",
        "self._traffic.readings[traffic[some], interval[some]]",
        "self._traffic.readings[traffic[some], interval[some]] "
        "+ self._traffic.aggregates(traffic[some], interval[some])[:, :1]",
        "test_non_interference.py",
    ),
    Mutant(
        "the least count is ignored", 25, "traffic/readings.py",
        "table[table[..., 0] < loops.least_count] = np.nan", "table[table[..., 0] < 0] = np.nan",
        "test_non_interference.py",
    ),
    Mutant(
        "an interval without a vehicle is reported below the least count", 25,
        "traffic/readings.py",
        "table[table[..., 0] < loops.least_count] = np.nan",
        "table[(table[..., 0] < loops.least_count) & (table[..., 0] > 0)] = np.nan",
        "test_non_interference.py",
    ),
    Mutant(
        "the least count hides speeds alone", 25, "traffic/readings.py",
        "table[table[..., 0] < loops.least_count] = np.nan",
        "table[table[..., 0] < loops.least_count, 1] = np.nan",
        "test_non_interference.py",
    ),
    Mutant(
        "a loop is a channel of the release", 25, "release/task.py",
        "np.concatenate([self.sensors, np.arange(self.n_on_road, self.n_channels)])",
        "np.concatenate([self.sensors, np.arange(self.corridor.loops is not None), "
        "np.arange(self.n_on_road, self.n_channels)])",
        "test_guarantee.py",
    ),
    Mutant(
        "vehicles pay for loops", 25, "process.py",
        "if self.rewind is not None:\n            self.rewind.follow(",
        "if self.rewind is not None:\n            self.release.ledgers.paid[episodes] += 1.0; "
        "self.rewind.follow(",
        "test_guarantee.py",
    ),
    Mutant(
        "a report does not say that it is conditional on loops", 25, "parts.py",
        "report = report.beside(loops)", "pass",
        "release/test_report.py",
    ),
    Mutant(
        "a guarantee is stated without its condition", 25, "release/report.py",
        'f"{self.guarantee}, {GIVEN_LOOPS}"', "self.guarantee",
        "release/test_report.py",
    ),
    Mutant(
        "beside loops a report protects presence", 25, "release/task.py",
        "change.reports if has_loops else change.rows", "change.rows",
        "release/test_report.py",
    ),
    Mutant(
        "a report does not warn that a vehicle alone shows its speed", 25, "release/report.py",
        'if loops.least_count < 2 else ""', 'if loops.least_count < 0 else ""',
        "release/test_report.py",
    ),
)  # fmt: skip


def recorded() -> list[Mutant]:
    """Return the mutants that were drawn."""
    lines = (ROOT / "tests" / "mutants.jsonl").read_text(encoding="utf-8").splitlines()
    return [
        Mutant(f"`{each['new'].strip()}`", 0, **each, folder=".") for each in map(json.loads, lines)
    ]


# --- drawing --------------------------------------------------------------------------------------

EXCHANGED = {
    "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "in": "not in",
    "not in": "in", "is": "is not", "is not": "is", "+": "-", "-": "+", "*": "/", "/": "*",
    "//": "*", "%": "//", "**": "*", "&": "|", "|": "&", "and": "or", "or": "and",
    "min": "max", "max": "min", "minimum": "maximum",
    "maximum": "minimum", "any": "all", "all": "any", "floor": "ceil", "ceil": "floor",
    "argmin": "argmax", "argmax": "argmin", "zeros": "ones", "ones": "zeros", "sorted": "list",
}  # fmt: skip
OPERATOR = re.compile(r"not in|is not|\b(?:in|is|and|or)\b|\*\*|//|[<>=!]=|[-+*/%<>&|]")


def drawn(path: str) -> Iterator[tuple[str, str]]:
    """Yield text that stands in a file once and what takes its place, in a seeded order.

    Operators, numbers and functions are exchanged, conditions turned round, and statements left
    out, at most one in a line.
    """
    text = (ROOT / path).read_text(encoding="utf-8")
    lines, done = text.splitlines(), set[int]()
    found = sorted({each for node in ast.parse(text).body for each in changes(node, lines)})
    random.Random(path).shuffle(found)
    for row, start, end, new in found:
        changed, first = lines[row][:start] + new + lines[row][end:], row
        while text.count("\n".join(lines[first : row + 1])) > 1:
            first -= 1
        if row not in done and "# fmt" not in changed:
            done.add(row)
            yield "\n".join(lines[first : row + 1]), "\n".join([*lines[first:row], changed])


def changes(node: ast.AST, lines: list[str]) -> Iterator[tuple[int, int, int, str]]:
    """Yield changes of a syntax tree: row, first column, column after the last, new text."""
    inside = [*ast.iter_child_nodes(node)]
    match node:
        case ast.FunctionDef(args=args, body=body):
            inside = [*args.defaults, *filter(None, args.kw_defaults), *body]
        case ast.ClassDef(body=inside):
            pass
        case ast.AnnAssign(value=value):
            inside = [value] if value else []
        case ast.Expr(value=ast.Constant()) | ast.JoinedStr() | ast.Import() | ast.ImportFrom():
            return
        case ast.Raise():
            inside = []
    for each in inside:
        if hasattr(each, "lineno"):
            yield from changes(each, lines)
    test = getattr(node, "test", None)
    for part, new in ((node, exchanged), (test, "not ({})".format)):
        if part and part.lineno == part.end_lineno and lines[part.lineno - 1].isascii():
            row, start, end = part.lineno - 1, part.col_offset, part.end_col_offset
            told = new(part if part is node else lines[row][start:end])
            if isinstance(part, ast.Compare | ast.BinOp | ast.BoolOp) and part is node:
                left, right = operands(node)
                sign = OPERATOR.search(lines[row], left.end_col_offset, right.col_offset)
                start, end, told = (*sign.span(), EXCHANGED[sign[0]]) if sign else (0, 0, None)
            elif isinstance(part, ast.Attribute) and part is node:
                start = end - len(part.attr)
            if told is not None:
                yield row, start, end, told


def operands(node: ast.Compare | ast.BinOp | ast.BoolOp) -> tuple[ast.AST, ast.AST]:
    """Return what stands on the two sides of the first operator."""
    match node:
        case ast.Compare(left=left, comparators=[right, *_]) | ast.BinOp(left=left, right=right):
            return left, right
    return node.values[0], node.values[1]


def exchanged(node: ast.AST) -> str | None:
    """Return what takes the place of a constant, a name or a statement, if anything does."""
    match node:
        case ast.Expr() | ast.AugAssign() | ast.Raise():
            return "pass"
        case ast.Constant(value=bool()):
            return str(not node.value)
        case ast.Constant(value=int() | float()):
            return repr(node.value + 1)
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return EXCHANGED.get(name)
    return None


# --- running --------------------------------------------------------------------------------------


def lines_of_the_proof() -> dict[int, str]:
    """Return the titles of the lines of the proof by their numbers."""
    page = (ROOT / "docs" / "privacy" / "proof.md").read_text(encoding="utf-8")
    return {int(n): title for n, title in re.findall(r"^### (\d+)\. (.+)$", page, re.MULTILINE)}


def unsound(mutants: list[Mutant]) -> Iterator[str]:
    """Yield what is wrong with mutants: one that cannot be made, two of a kind, a line without."""
    for mutant in mutants:
        try:
            ast.parse(mutant.applied((ROOT / mutant.file).read_text(encoding="utf-8")))
        except (OSError, SyntaxError, ValueError) as problem:
            yield str(problem)
        yield from (
            f"{mutant.name}: there is no {test}"
            for test in mutant.tests.split()
            if not (ROOT / "tests" / test).is_file()
        )
    if len({(m.file, m.old, m.new) for m in mutants}) < len(mutants):
        yield "two mutants are the same"
    for line in {*lines_of_the_proof()} ^ {mutant.line for mutant in MUTANTS}:
        yield f"line {line} of the proof has no mutant, or a mutant no line of the proof"


def chosen(words: list[str]) -> list[Mutant]:
    """Return the mutants whose name, file or line of the proof has one of some words."""
    return [
        mutant
        for mutant in (*MUTANTS, *recorded())
        if not words or {str(mutant.line)} & {*words}
        or any(word in f"{mutant.name} {mutant.file}" for word in words if not word.isdigit())
    ]  # fmt: skip


def failed(copy: Path, tests: list[str], **environment: str) -> str:
    """Run the fast tests of files of a copy; return the first that fails, empty if all pass.

    Raises:
        RuntimeError: They could not be run, or one failed since the code is no sound Python.
    """
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", "-m", "not slow", "-x", "-q", "-p", "no:cacheprovider",
         *(f"tests/{test}" for test in tests)],
        cwd=copy, capture_output=True, text=True, timeout=MOST_SECONDS, check=False,
        # Without CI pytest would cut lines short.
        env={**os.environ, "PYTHONPATH": str(copy), "CI": "true", **environment},
    )  # fmt: skip
    if ended.returncode == 0:
        return ""
    found = re.search(r"^FAILED tests/(.+?) - (.*)$", ended.stdout, re.MULTILINE)
    if ended.returncode != 1 or found is None or UNSOUND.match(found[2]):
        raise RuntimeError(f"pytest ended with {ended.returncode}:\n{ended.stdout}{ended.stderr}")
    return found[1]


def main(words: list[str]) -> int:
    """Make some mutants, print how each fared, and return the exit status."""
    if words[:1] == ["--draw"]:
        _, path, number, *tests = words
        for old, new in islice(drawn(path), int(number)):
            print(json.dumps({"path": path, "old": old, "new": new, "tests": " ".join(tests)}))
        return 0
    if problems := [*unsound([*MUTANTS, *recorded()])]:
        print(*problems, sep="\n")
        return 1
    mutants = chosen(words)
    if not mutants:
        print(f"no mutant has any of {words} in its name, file or line of the proof")
        return 1
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy, kernels = Path(folder, "repository"), Path(folder, "kernels")
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*SPARED))
        # Kernels are found by their code: those of the user serve, and a mutant's are not kept.
        if default_folder().is_dir():
            shutil.copytree(default_folder(), kernels)
        environment = {"NUMBA_CACHE_DIR": str(kernels)}
        if found := failed(
            copy, sorted({t for m in mutants for t in m.tests.split()}), **environment
        ):
            print(f"without a mutant, {found} fails")
            return 1
        # Bytecode of a mutant could be taken for that of the file, which has the same size.
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        n_lived = 0
        print("| mutant | line of the proof | killed by | seconds |\n| :-- | :-- | :-- | --: |")
        for mutant in mutants:
            file, start = copy / mutant.file, time.monotonic()
            kept = shutil.copy2(file, Path(folder, "kept"))
            file.write_text(mutant.applied(file.read_text(encoding="utf-8")), encoding="utf-8")
            killer = failed(copy, mutant.tests.split(), **environment)
            shutil.copy2(kept, file)
            n_lived += not killer
            seconds = time.monotonic() - start
            print(
                f"| {mutant.name} | {mutant.line} | {killer or '**lives**'} | {seconds:.0f} |",
                flush=True,
            )
    print(f"\n{len(mutants) - n_lived} of {len(mutants)} mutants die")
    return int(n_lived > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
