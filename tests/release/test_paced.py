"""The release model `Paced`: what it releases, what it says of it, and whom it charges."""

import numpy as np
import pytest

from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import PacedSettings, Pacing
from tests.cases import pairwise

from .paced_worlds import (
    COLUMNS,
    LIMIT,
    T,
    drives,
    predicting,
    request,
    standardised,
    stays,
    streams,
)
from .test_mechanism import residual_faults
from .worlds import AWAY, Worlds, record

ONE = np.array([0])
SEGMENTS, LENGTH = 8, 0.1


def started(settings=None, worlds=None, seed=0, **keywords):
    worlds = worlds or Worlds(drives(np.arange(T) % 6, 40.0))
    release = worlds.release(settings or PacedSettings(), **keywords)
    release.reset(np.arange(len(worlds.records)), streams(*range(seed, seed + len(worlds.records))))
    return release


def crowd(n_vehicles=40, seed=0):
    generator = np.random.default_rng(seed)
    places = generator.integers(AWAY, COLUMNS, (n_vehicles, T + 1))
    return record(places, generator.uniform(0.0, LIMIT, places.shape), COLUMNS)


# --- what is released ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wish", "seed"),
    pairwise([{}, {"clip": 10.0, "ratio": 0.25}, {"unit": "event"}], range(3), n=3),
)
def test_residuals_are_white_and_of_the_stated_size(wish, seed):
    worlds = Worlds(crowd(seed=seed))
    assert residual_faults(*standardised(worlds, PacedSettings(**wish), seed=seed), 1.0) == []


def test_noise_of_flows_is_that_of_counts_times_the_clip_over_the_root_of_the_ratio():
    release = started(PacedSettings(clip=20.0, ratio=0.25))
    released = release.release(request(1))
    count = 1.0 / np.sqrt(release.prices) / LENGTH
    np.testing.assert_allclose(released.sigma[..., 0], count, rtol=1e-12)
    np.testing.assert_allclose(released.sigma[..., 1], 40.0 * count, rtol=1e-12)


@pytest.mark.parametrize("epsilon", [1e-3, 5.0, 50.0])
def test_releases_lie_on_a_public_grid_much_finer_than_the_noise(epsilon):
    release = started(PacedSettings(epsilon=epsilon), Worlds(crowd()))
    for second in range(1, T + 1):
        released = release.release(request(second))
        deviations = released.sigma * LENGTH
        grid = np.exp2(np.floor(np.log2(deviations / 1024.0)))
        in_grid = released.values * LENGTH / grid
        np.testing.assert_allclose(in_grid, np.rint(in_grid), rtol=1e-12, atol=0.0)
        assert ((grid > deviations / 2048.0) & (grid <= deviations / 1024.0)).all()
        # Not all are multiples of the next one.
        assert (np.rint(in_grid) % 2.0 == 1.0).any()


def test_policies_meet_the_same_noise():
    """In units of its deviation, but for the rounding: the deviation depends on the policy."""
    worlds = Worlds(crowd())
    everything, few = started(worlds=worlds), started(worlds=worlds)
    twins = started(worlds=worlds), started(worlds=worlds)
    sigmas = []
    for second in range(1, T + 1):
        residuals = []
        asked = np.isin(np.arange(COLUMNS), [second % SEGMENTS, 5, 7])
        for release, twin, flags in ((everything, twins[0], True), (few, twins[1], asked)):
            found = release.release(request(second, flags))
            true = twin.collect(request(second, flags), release.prices, release.centres)
            sums = np.stack([true.counts, true.deviations], axis=-1)
            residuals.append((found.values * LENGTH - sums) / (found.sigma * LENGTH))
            sigmas.append(found.sigma)
        np.testing.assert_allclose(*residuals, rtol=0.0, atol=2.0**-10)
    assert not np.allclose(*sigmas[-2:])


def test_a_copy_of_an_episode_in_a_batch_is_released_alike():
    one, two = crowd(seed=1), crowd(n_vehicles=9, seed=2)
    batch, single = started(worlds=Worlds(one, two), seed=4), started(worlds=Worlds(two), seed=5)
    for second in range(1, T + 1):
        together = batch.release(request(second, second % 2 == 0, episodes=(0, 1)))
        alone = single.release(request(second, second % 2 == 0))
        for name in ("values", "sigma", "centre"):
            np.testing.assert_array_equal(getattr(together, name)[1], getattr(alone, name)[0])


# --- centres and prices ----------------------------------------------------------------------


def test_centres_are_predicted_speeds_within_the_limits():
    release = started()
    speed = np.array([-5.0, 0.0, 30.0, 60.0, 101.0, 140.0, 20.0, 10.0])
    released = release.release(request(1, prediction=predicting(10.0, speed)))
    own = np.clip(speed, 0.0, LIMIT)
    # The ends of the road, the on-ramp and the off-ramp, each as the segment beside it.
    beside = own[[0, 5, 6, 7]]
    np.testing.assert_array_equal(released.centre, [[*own, *beside]])
    np.testing.assert_array_equal(release.centres, released.centre)


def test_the_last_prices_are_those_of_the_noise():
    release = started()
    for second in (1, 2):
        released = release.release(request(second, second == 2))
        np.testing.assert_allclose(
            release.prices, (released.sigma[..., 0] * LENGTH) ** -2.0, rtol=1e-12
        )
    release.reset(ONE, streams(0))
    assert not release.prices.any()
    assert not release.centres.any()


@pytest.mark.parametrize(
    ("bad", "quantity"), [(np.nan, "density"), (np.inf, "speed"), (-np.inf, "density")]
)
def test_without_a_finite_prediction_centres_fall_back_and_releases_go_on(bad, quantity):
    release = started()
    values = {"density": np.full(SEGMENTS, 20.0), "speed": np.full(SEGMENTS, 40.0)}
    values[quantity][3] = bad
    assert release.public_info(ONE) == {"centre_fallback": [0.0]}
    released = release.release(request(1, prediction=predicting(**values)))
    assert release.public_info(ONE) == {"centre_fallback": [1.0]}
    assert released.centre[0, :SEGMENTS].tolist() == [40.0] * 3 + [LIMIT] + [40.0] * 4
    for array in (released.values, released.sigma, release.prices):
        assert np.isfinite(array).all()
    release.release(request(2, prediction=predicting(20.0, 40.0)))
    assert release.public_info(ONE) == {"centre_fallback": [0.0]}
    release.release(request(3, prediction=predicting(**values)))
    release.reset(ONE, streams(0))
    assert release.public_info(ONE) == {"centre_fallback": [0.0]}


class Curious(Pacing):
    def prices(self, step):
        return step.ledgers


def returning(prices):
    return type("Bad", (Pacing,), {"prices": lambda self, step: prices(step.observed.shape)})


BAD_PRICES = {
    "negative": (lambda shape: np.full(shape, -1.0), "positive and finite"),
    "zero": (np.zeros, "positive and finite"),
    "infinite": (lambda shape: np.full(shape, np.inf), "positive and finite"),
    "not a number": (lambda shape: np.full(shape, np.nan), "positive and finite"),
    "one short": (
        lambda shape: np.ones(shape[1] - 1),
        r"floats of shape \(1, 12\), got .* \(11,\)",
    ),
    "integers": (lambda shape: np.ones(shape, dtype=int), "floats of shape"),
    "nothing": (lambda shape: None, "floats of shape"),
}


@pytest.mark.parametrize(("prices", "message"), BAD_PRICES.values(), ids=BAD_PRICES)
def test_bad_prices_of_another_pacing_are_refused_by_path(prices, message):
    release = started(PacedSettings(pacing=returning(prices)))
    with pytest.raises(ValueError, match=rf"^privacy\.pacing must return .*{message}"):
        release.release(request(1))


def test_a_pacing_that_asks_for_what_is_not_public_is_refused_by_path():
    release = started(PacedSettings(pacing=Curious))
    with pytest.raises(AttributeError, match=r"^privacy\.pacing must depend on public .*'ledgers'"):
        release.release(request(1))


def test_another_pacing_sets_the_prices():
    release = started(PacedSettings(pacing=returning(lambda shape: np.full(shape, 0.04))))
    assert release.release(request(1)).sigma[0, 0, 0] == pytest.approx(5.0 / LENGTH)


# --- who pays --------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.3, 0.7, 1.0])
def test_for_an_event_each_second_has_a_budget_and_nobody_is_refused(ratio):
    """Not even who deviates by the clip or more, which costs the whole of the budget."""
    still, passing = stays(1, 0.0), stays(2, LIMIT)
    for traffic, centre in ((still, LIMIT), (passing, 0.0), (crowd(), 0.0), (crowd(), LIMIT)):
        release = started(PacedSettings(unit="event", ratio=ratio), Worlds(traffic))
        for second in range(1, T + 1):
            release.release(request(second, prediction=predicting(10.0, centre)))
            info = release.private_info(ONE, ONE)
            here = traffic.vehicle[traffic.step == second]
            assert np.flatnonzero(info["ledgers"][0]).tolist() == sorted(here.tolist())
            assert max(info["ledgers"][0]) <= 1.0
            assert info["n_refused"] == [0]
        if traffic in (still, passing):
            assert max(info["ledgers"][0]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("place", "is_charged"), [(5, True), (7, True), (8, True), (11, True), (1, False)]
)
def test_fixed_sensors_and_boundaries_charge_without_a_query(place, is_charged):
    """Segments 5 and 7 have sensors, and 8 to 11 are boundary segments, which are released."""
    release = started(worlds=Worlds(stays(place, 10.0)))
    flags = release.setup.observed(np.zeros((1, 6), dtype=bool))[0]
    for second in range(1, T + 1):
        release.release(request(second, flags))
    assert (release.private_info(ONE, ONE)["ledgers"][0][0] > 0.0) == is_charged


def test_refusals_and_ledgers_are_told_as_private_lists():
    release = started(PacedSettings(epsilon=0.5), Worlds(crowd(3)))
    told = []
    for second in np.tile(np.arange(1, T + 1), 6).tolist():
        release.release(request(second))
        told.append(release.private_info(ONE, ONE))
    for info in told:
        assert [type(info[key][0]) for key in ("ledgers", "individual_epsilon")] == [list, list]
        assert len(info["ledgers"][0]) == len(info["individual_epsilon"][0]) == 3
    assert sum(int(info["n_refused"][0]) for info in told) > 0
    ledgers, epsilons = (np.array(told[-1][key][0]) for key in ("ledgers", "individual_epsilon"))
    assert (ledgers <= 1.0).all()
    budget = mu_of(0.5, 0.05) ** 2 / 2.0
    np.testing.assert_array_equal(ledgers * budget, release.ledgers.paid[0])
    exact = [epsilon_of(np.sqrt(2.0 * budget * part), 0.05) for part in ledgers]
    # Rounded up to a level of mu.
    assert (epsilons >= exact).all()
    np.testing.assert_allclose(epsilons, exact, atol=0.01)
