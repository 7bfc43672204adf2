"""The attack: releases as the adversary hears them, his scores, and his findings."""

import dataclasses
import math

import numpy as np
import pytest

from agents.audit.attack import attacked_form, make_overheard
from agents.audit.planner import Planner, public_plan
from agents.audit.statistics import Claim, audit
from agents.audit.worlds import Worlds
from dptse_env.parts import privacy_report
from dptse_env.privacy import ROUNDING, epsilon_of
from dptse_env.release import Capped, ReleaseModel
from dptse_env.release.noise import grid_of
from tests.agents.elsewhere import elsewhere

from .mechanisms import MECHANISMS
from .small import HORIZON, ROAD, config, paced, runs_of, staying

# --- scores ---------------------------------------------------------------------------------------


def sums_in(record, setting, observed, terms):
    """Return what a record's releases would be without noise, (T, C, 2), vehicle by vehicle.

    ``terms`` are the transcript's deviations of noise and centres; columns are places.
    """
    privacy = setting.privacy
    sigma, centre = terms
    mu = privacy_report(setting).mu
    is_paced = privacy.preset == "paced"
    # A part of a payment is kept back for rounding.
    budget = mu**2 / 2.0 * (1.0 - ROUNDING) if is_paced else getattr(privacy, "cap", math.inf)
    clip, ratio = (privacy.clip, privacy.ratio) if is_paced else (math.inf, 0.0)
    paid, sums = {}, np.zeros_like(sigma)
    for step, segment, vehicle, speed in zip(
        *(getattr(record, name).tolist() for name in ("step", "segment", "vehicle", "speed")),
        strict=True,
    ):
        if not 1 <= step <= HORIZON or not observed[step - 1, segment]:
            continue
        if privacy.preset == "printed":
            sums[step - 1, segment] += 1.0, speed
            continue
        price = (
            (sigma[step - 1, segment, 0] * ROAD.geometry.segment_length) ** -2 if is_paced else 1.0
        )
        grid = grid_of(float(sigma[step - 1, segment, 1] * ROAD.geometry.segment_length))
        d = (
            np.rint((min(speed, ROAD.geometry.speed_limit) - centre[step - 1, segment]) / grid)
            * grid
        )
        d = min(max(d, -np.floor(clip / grid) * grid), np.floor(clip / grid) * grid)
        cost = price * (1.0 + ratio * (d / clip) ** 2)
        if paid.get(vehicle, 0.0) + cost <= budget:
            paid[vehicle] = paid.get(vehicle, 0.0) + cost
            sums[step - 1, segment] += 1.0, d
    if privacy.preset == "printed":
        counts = sums[..., 0]
        means = np.where(
            counts > 0, sums[..., 1] / np.maximum(counts, 1.0), ROAD.geometry.speed_limit
        )
        return np.stack([counts / ROAD.geometry.segment_length, means], axis=-1)
    return sums / ROAD.geometry.segment_length


@pytest.mark.parametrize(
    "setting",
    [
        config(preset="printed"),
        config(epsilon=5.0, cap=7),
        paced("ekf", boundary_inputs="private"),
        paced("random_walk", clip=20.0),
    ],
    ids=lambda setting: setting.privacy.preset,
)
@pytest.mark.parametrize("factor", [1.0, 0.5])
def test_the_score_is_the_log_likelihood_ratio_of_the_transcript(setting, factor, record):
    """Against ledgers in plain Python, on a schedule that mostly looks elsewhere."""
    setting = attacked_form(setting)
    worlds = Planner(setting).choose(record, "replaced")
    process, release = make_overheard(setting, worlds, 2, factor)
    plan, heard = public_plan(setting, "shift-ahead"), []
    # What is left of runs before must not matter.
    for steps in (plan[:7], plan):
        heard.clear()
        for world in (0, 1):
            stream = [np.random.default_rng(world)]
            process.reset(np.array([world]), stream, {"traffic_seed": world, "start": 0})
        for queried in steps:
            process.step(np.arange(2), np.tile(queried, (2, 1)).astype(np.int8))
            heard.append(tuple(np.array(each) for each in release.last))
    observed, values, sigma, centre = (
        np.stack(column, axis=1) for column in zip(*heard, strict=True)
    )
    for run in (0, 1):
        seen, noise = observed[run], factor * sigma[run][observed[run]]
        told = values[run][seen]
        means = [
            sums_in(worlds.get(ROAD, world), setting, seen, (sigma[run], centre[run]))[seen]
            for world in (0, 1)
        ]
        logs = [-0.5 * np.sum(((told - mean) / noise) ** 2) for mean in means]
        assert release.score[run] == pytest.approx(logs[1] - logs[0], rel=1e-6, abs=1e-9)
        distance = np.sum(((means[1] - means[0]) / noise) ** 2)
        assert release.square[run] == pytest.approx(distance, rel=1e-9)
        assert distance > 0.1


@pytest.mark.parametrize("setting", [config(epsilon=5.0), paced("ekf"), paced()])
@pytest.mark.parametrize("factor", [1.0, 0.6])
def test_scores_have_the_law_of_their_distance(setting, factor, record):
    worlds = Planner(setting).choose(record, "worst-case")
    runs = runs_of(setting, worlds, 400, noise_factor=factor)
    mu = privacy_report(setting).mu
    assert runs.distances.min() > 0.95 * mu / factor
    assert runs.distances.max() <= mu / factor * (1.0 + 1e-9)
    assert (np.ptp(runs.distances) > 1e-9) == (setting.estimator == "ekf")
    middle = np.array([[-0.5], [0.5]]) * runs.distances**2
    normal = (runs.scores - middle) / runs.distances
    assert np.abs(normal.mean(axis=1)).max() < 4.0 / np.sqrt(400)
    assert np.abs(normal.var(axis=1) - 1.0).max() < 4.0 * np.sqrt(2.0 / 400)
    assert len(np.unique(runs.scores)) == runs.scores.size
    assert abs(np.corrcoef(runs.scores)[0, 1]) < 4.0 / np.sqrt(400)


@pytest.mark.parametrize(
    "setting", [config(preset="printed"), paced("ekf", boundary_inputs="private", unit="event")]
)
def test_runs_depend_on_their_seed_alone(setting, record):
    """Not on how many are played at once, nor where."""
    worlds = Planner(setting).choose(record, "replaced")
    together = runs_of(setting, worlds, 5, seed=3)
    for options in ({"batch": 2}, {"batch": 3, "executor": elsewhere}):
        parts = runs_of(setting, worlds, 5, seed=3, **options)
        np.testing.assert_array_equal(together.scores, parts.scores)
        np.testing.assert_array_equal(together.distances, parts.distances)
    other = runs_of(setting, worlds, 5, seed=4)
    assert not np.isin(other.scores, together.scores).any()


def test_only_prices_and_centres_need_the_estimator_of_the_environment():
    assert attacked_form(paced("random_walk")).estimator == "random_walk"
    assert attacked_form(config(estimator="ekf")).estimator == "open_loop"


# --- what is found --------------------------------------------------------------------------------


def verdict(setting, worlds, n_runs=400, plan=None, **options):
    mu = privacy_report(setting).mu
    claim = Claim(mu, epsilon_of(mu, 0.05), 0.05)
    return audit(*runs_of(setting, worlds, n_runs, plan, **options).scores, claim).verdict


@pytest.mark.parametrize("setting", [config(epsilon=5.0), paced("ekf")])
def test_a_guarantee_is_not_rejected_and_half_the_noise_is(setting, record):
    worlds = Planner(setting).choose(record, "worst-case")
    assert verdict(setting, worlds) == "not rejected"
    assert verdict(setting, worlds, noise_factor=0.5) == "rejected"


@pytest.mark.slow
@pytest.mark.parametrize("setting", [config(epsilon=5.0), paced("ekf")])
def test_noise_times_0709_is_rejected_after_five_thousand_runs(setting, record):
    worlds = Planner(setting).choose(record, "worst-case")
    assert verdict(setting, worlds, 5000) == "not rejected"
    assert verdict(setting, worlds, 5000, noise_factor=0.709) == "rejected"


class AskedTooOften(Capped):
    """A vehicle counts once more whenever the estimator predicts a free road."""

    def release(self, request):
        if request.prediction().density.max() < 1e9:
            self.ledgers.reset(request.episodes)
        return super().release(request)


@pytest.mark.parametrize("mechanism", [MECHANISMS["`capped`, half the noise"], AskedTooOften])
def test_a_mechanism_of_ones_own_is_caught(mechanism, record):
    setting = config(preset=mechanism, epsilon=5.0, cap=2)
    worlds = Worlds.adjacent(record, (staying(1), staying(3)))
    everything = np.ones((HORIZON, ROAD.geometry.n_mainline), dtype=bool)
    setting = dataclasses.replace(setting, bandwidth=ROAD.geometry.n_mainline)
    assert verdict(setting, worlds, plan=everything) == "rejected"
    sound = config(ROAD.geometry.n_mainline, epsilon=5.0, cap=2)
    assert verdict(sound, worlds, plan=everything) == "not rejected"


class Silent(ReleaseModel):
    sigma = np.zeros(2)

    def reset(self, episodes, generators):
        """Nothing to do."""

    def release(self, request):
        raise NotImplementedError


def test_what_cannot_be_audited_is_refused(record):
    worlds = Worlds.adjacent(record, (staying(1), staying(3)))
    with pytest.raises(ValueError, match=r"a release model with Gaussian noise.*Silent"):
        runs_of(config(preset=Silent), worlds, plan=np.ones((HORIZON, 6), dtype=bool))
