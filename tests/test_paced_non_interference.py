"""Nothing of the true traffic may reach prices or centres except through what was released before.

No error would show it if it did: the proof of the paced ledger would be void. With a release model
that publishes the same values whatever the traffic, two episodes over different traffic must look
the same, bit by bit, in prices, centres and deviations as in observations, estimates and ``info``.
"""

import itertools

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.estimators import ESTIMATORS
from dptse_env.release import Fusion, Paced, Pacing
from tests.helpers import fast_and_slow

from .test_non_interference import (
    EVERY_PAIR,
    EVERY_SCHEDULE,
    PAIRS,
    SCHEDULES,
    SEEDS,
    STEPS,
    same,
    transcript,
    unlike,
)


class Blind:
    """Publishes values that depend on the second and the column alone.

    Ledgers and everything else are as in the class that it is mixed into.

    Attributes:
        centre: The last centres, shape (k, places).
        sigmas: The last deviations, shape (k, C, 2).
    """

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self._seconds, self.centre, self.sigmas = 0, np.empty(0), np.empty(0)

    def reset(self, episodes, generators):
        super().reset(episodes, generators)
        self._seconds, self.centre, self.sigmas = 0, np.empty(0), np.empty(0)

    def release(self, request):
        released = super().release(request)
        self._seconds, self.sigmas = self._seconds + 1, released.sigma
        self.centre = released.centre
        answer = np.random.default_rng(self._seconds).uniform(-0.2, 1.0, released.values.shape)
        return released._replace(values=answer * [60.0, 2000.0])


def make(kind=Paced, **keywords):
    """An environment whose release model is a blind one of this kind."""
    blind = type(f"Blind{kind.__name__}", (Blind, kind), {})
    privacy = {"preset": blind, **keywords.pop("privacy", {})}
    keywords = {"horizon": STEPS, "random_start": True, **keywords}
    return gym.make(
        "dptse_env:dptse/PrivateHighway-v1", traffic_seeds=SEEDS, privacy=privacy, **keywords
    )


WAYS = [
    ("ekf", "trip", "nominal"), ("ukf", "event", "private"), ("enkf", "trip", "private"),
    ("mhe", "trip", "private"), ("blend", "event", "nominal"), ("recurrent", "trip", "nominal"),
]  # fmt: skip
EVERY_WAY = itertools.product(ESTIMATORS, ["trip", "event"], ["nominal", "private"])


@pytest.mark.parametrize(("estimator", "unit", "boundary"), fast_and_slow(EVERY_WAY, WAYS))
def test_traffic_does_not_show(estimator, unit, boundary):
    env = make(estimator=estimator, privacy={"unit": unit, "boundary_inputs": boundary})
    first, second = transcript(env, 0), transcript(env, 1)
    assert same(first, second)
    # What is held equal is alive.
    for name in ("observation", "centre", "prices", "queried"):
        moving = unit == "trip" or name != "prices"
        assert np.array_equal(first[1][name], first[-1][name]) != moving
    assert first[-1]["sigmas"].shape == (1, *first[-1]["prices"].shape[1:], 2)


@pytest.mark.parametrize(("action", "estimator"), fast_and_slow(EVERY_PAIR, PAIRS[:4]))
def test_traffic_does_not_show_through_an_action(action, estimator):
    env = make(estimator=estimator, action=action)
    assert same(transcript(env, 0), transcript(env, 1))


@pytest.mark.parametrize(("schedule", "boundary"), fast_and_slow(EVERY_SCHEDULE, SCHEDULES))
def test_traffic_does_not_show_through_a_schedule(schedule, boundary):
    env = make(privacy={"boundary_inputs": boundary, "clip": 25.0})
    assert same(transcript(env, 0, schedule), transcript(env, 1, schedule))


def test_vehicles_do_pay_and_run_out_meanwhile():
    """The ledgers of both traffics differ, and that is what must not show."""
    env = make(truth_in_info=True, privacy={"epsilon": 0.5})
    told = []
    for seed in SEEDS:
        transcript(env, seed)
        process = env.unwrapped.process
        told.append(process.infos(np.array([0]))["truth"])
    ledgers = [np.array(truth["ledgers"][0]) for truth in told]
    assert max(ledger.max() for ledger in ledgers) > 0.8
    assert len(ledgers[0]) != len(ledgers[1]) or not np.array_equal(*ledgers)


PARTLY = {
    "penetration": [0.05, 0.4],
    "detectors": {"dropout": 0.2, "absolute": 0.5},
}


@pytest.mark.parametrize(
    ("estimator", "boundary"),
    fast_and_slow(
        itertools.product(ESTIMATORS, ["nominal", "private"]),
        [("ekf", "private"), ("ukf", "nominal"), ("mhe", "private"), ("random_walk", "nominal")],
    ),
)
def test_neither_traffic_nor_who_is_connected_shows(estimator, boundary):
    env = make(estimator=estimator, privacy={"boundary_inputs": boundary}, **PARTLY)
    first, second = transcript(env, 0), transcript(env, 1)
    assert same(first, second)
    assert not np.array_equal(first[1]["observation"], first[-1]["observation"])


def test_a_share_that_only_the_truth_shows_would_be_noticed(monkeypatch):
    env = make(**PARTLY)
    process = env.unwrapped.process
    read = Fusion.read

    def knowing(self, measured, prediction):
        share = process.config.penetration.share_of(SEEDS[process.traffic_index[0]])
        return read(self, measured._replace(values=measured.values / share), prediction)

    monkeypatch.setattr(Fusion, "read", knowing)
    assert unlike(env)


# --- mutations that must be caught --------------------------------------------------------------


def truth_of(release, request):
    """True density and speed of this second, shape (k, S) each."""
    traffic = release.traffic.aggregates(request.traffic, request.times)
    return {"density": traffic[..., 0], "speed": traffic[..., 1]}


class CentreOfTheTruth(Paced):
    def release(self, request):
        seen = request.prediction()._replace(speed=truth_of(self, request)["speed"])
        return super().release(request._replace(prediction=lambda: seen))


class PriceOfTrueCounts(Paced):
    def release(self, request):
        seen = request.prediction()._replace(density=truth_of(self, request)["density"])
        return super().release(request._replace(prediction=lambda: seen))


class CentreOfTheSameSecond(Paced):
    """Centred on speeds that this second's own noisy sums have corrected."""

    def release(self, request):
        first, prediction = super().release(request), request.prediction()
        values = first.values[:, : prediction.speed.shape[1]]
        told = prediction.speed + values[..., 1] / np.maximum(values[..., 0], 10.0)
        seen = request.observed[:, : prediction.speed.shape[1]]
        updated = prediction._replace(speed=np.where(seen, told, prediction.speed))
        return super().release(request._replace(prediction=lambda: updated))


class PriceOfTrueLedgers(Paced):
    """Prices by what the vehicles have really left."""

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        ledgers = self.ledgers

        class FromLedgers(Pacing):
            def prices(self, episodes, observed, density, speed):
                left = ledgers.budget - ledgers.paid[episodes].max(axis=2, initial=0.0)
                return np.broadcast_to(np.maximum(0.05 * left, 1e-3), observed.shape).copy()

        self.pacing = FromLedgers(task, self.pacing.budget)


class AccountOfTrueLedgers(Paced):
    def spent(self, episodes, steps):
        most = self.ledgers.paid[episodes, 0].max(axis=1, initial=0.0)
        return np.sqrt(2.0 * most), np.sqrt(2.0 * most)


class RefusalsInPublic(Paced):
    def public(self, episodes):
        refused = self.private(episodes, np.zeros_like(episodes))["n_refused"]
        return super().public(episodes) | {"n_refused": refused}


class FallsBackWhereNobodyIs(Paced):
    """Takes a segment that is empty for one without a prediction."""

    def release(self, request):
        empty = truth_of(self, request)["density"] == 0.0
        prediction = request.prediction()
        holed = prediction._replace(speed=np.where(empty, np.nan, prediction.speed))
        return super().release(request._replace(prediction=lambda: holed))


# Little privacy is left, so that some vehicles run out within the episode.
LITTLE = {"epsilon": 0.5, "pace": 1.0}


@pytest.mark.parametrize(
    "kind",
    [CentreOfTheTruth, PriceOfTrueCounts, CentreOfTheSameSecond, FallsBackWhereNobodyIs],
)
def test_a_prediction_that_looks_at_the_truth_would_show(kind):
    assert unlike(make(kind, privacy=LITTLE))


@pytest.mark.parametrize("kind", [PriceOfTrueLedgers, AccountOfTrueLedgers, RefusalsInPublic])
def test_ledgers_that_are_used_in_public_would_show(kind):
    assert unlike(make(kind, privacy=LITTLE))


@pytest.mark.parametrize("estimator", fast_and_slow(ESTIMATORS, ["ekf", "mhe", "random_walk"]))
def test_true_boundary_inputs_would_show(estimator):
    with pytest.warns(UserWarning, match="boundary_inputs"):
        env = make(estimator=estimator, privacy={"boundary_inputs": "true"})
    assert unlike(env) == (estimator != "random_walk")
