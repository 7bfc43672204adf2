"""Properties of every estimator: any name, either backend, both sets of bounds, every release."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import (
    ESTIMATORS,
    REFERENCES,
    EstimatorSettings,
    HorizonSettings,
    Measurement,
    make_estimator,
)
from dptse_env.model import ARZModel
from tests.helpers import fast_and_slow, stretch
from tests.model.oracle import PUBLISHED

from .helpers import (
    EVERY,
    FIELDS,
    PLAIN,
    RICH,
    Snapshot,
    assert_same,
    model_of,
    random_streams,
    run,
    show,
    simulate,
    started,
    step,
    update,
)

# Each compiled one is compared with its reference in a module of its own: the references, and the
# blend of two others, are among the slow tests.
FAST = [
    ("ekf", "compiled", "flow"),
    ("ukf", "compiled", "speed"),
    ("enkf", "compiled", "flow"),
    ("mhe", "compiled", "rows"),
    ("random_walk", "compiled", "flow"),
    ("recurrent", "compiled", "speed"),
    ("asm", "compiled", "rows"),
]
CASES = [(*each, "speed") for each in EVERY]
CASES += [(name, "compiled", kind) for name in ESTIMATORS for kind in ("flow", "rows")]
MODEL = model_of("published", "speed")


def over(without=(), fast=FAST, cases=CASES):
    """Return the mark that runs a test over cases, one of each kind in every run."""
    cases = [case for case in cases if case[0] not in without]
    return pytest.mark.parametrize(("name", "backend", "release"), fast_and_slow(cases, fast))


def held_to(bounds):
    return replace(PLAIN, bounds=bounds, mhe=HorizonSettings(bounds=bounds))


def bounds_of(release):
    """Each set of bounds with another release."""
    return "cone" if release == "speed" else "box"


def steps_of(name, backend, many):
    """Few steps for what takes milliseconds for each."""
    return 14 if (name, backend) in {("mhe", "reference"), ("enkf", "reference")} else many


# The protocol -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "backend"), EVERY)
def test_every_name_and_backend_follows_the_protocol(name, backend):
    """And measures as its model does."""
    for centre, second in ((None, 80.0), (40.0, 30.0 * (80.0 - 40.0))):
        model = ARZModel(MODEL.road, PUBLISHED, 0.5, centre)
        estimator, everyone = make_estimator(name, backend, model, 3), np.arange(3)
        states = model.states(np.full((3, 19), 30.0), np.full((3, 19), 80.0))
        np.testing.assert_allclose(estimator.model.measure(states)[..., 1], second)
        assert (estimator.n_episodes, estimator.model.time_step) == (3, 0.5)
        estimator.reset(everyone, states, random_streams(3))
        estimator.predict(everyone, np.zeros((3, 9)))
        values, seen = model.measure(states), np.ones((3, 19), bool)
        estimator.update(everyone, Measurement.of(estimator.model, seen, values, np.ones(2)))
        assert estimator.innovations.shape == (3, 19, 2)
        assert estimator.diverged.tolist() == [False] * 3
        for a, b in zip(estimator.estimate(), estimator.estimate(), strict=True):
            assert a.shape == (3, 19)
            assert np.isfinite(a).all()
            assert not np.shares_memory(a, b)
            assert (a >= 0.0).all()
        with pytest.raises(ValueError, match=r"^states must .* got \(1, 37\)"):
            estimator.reset(everyone[:1], np.zeros((1, 37)), random_streams(1))
        with pytest.raises(ValueError, match=r"^inputs must .* got \(9,\)"):
            estimator.predict(everyone[:1], np.zeros(9))


def test_a_reference_is_had_where_there_is_one():
    for name in {*ESTIMATORS} - {*REFERENCES}:
        with pytest.raises(ValueError, match=r"^backend must be .* got 'reference'"):
            make_estimator(name, "reference", MODEL, 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observed": np.zeros((2, 4), bool)}, r"observed .* got \(2, 4\)"),
        ({"values": np.zeros((2, 5))}, r"values .* got \(2, 5\)"),
        ({"sigma": np.ones(3)}, r"sigma .* got \(3,\)"),
        ({"sigma": np.array([[1.0, 1.0]] * 4 + [[1.0, -2.0]])}, "sigma must be finite and >= 0"),
        ({"centre": np.ones((2, 4))}, r"centre .* got \(2, 4\)"),
        ({"centre": np.full(5, np.nan)}, "centre must be finite"),
    ],
)
def test_bad_measurements_are_named(changes, message):
    good = {"observed": np.ones((2, 5), bool), "values": np.zeros((2, 5, 2)), "sigma": np.ones(2)}
    model = ARZModel(stretch(n_mainline=5).road, PUBLISHED, centre=50.0)
    with pytest.raises(ValueError, match=message):
        Measurement.of(model, **{**good, **changes})


def test_what_a_measurement_leaves_out_is_filled_in_and_boundary_columns_are_left_out():
    observed, values, sigma = np.ones((2, 5), bool), np.zeros((2, 5, 2)), np.array([3.0, 4.0])
    flows = ARZModel(stretch(n_mainline=5).road, PUBLISHED, centre=50.0)
    given = Measurement.of(flows, observed, values, sigma)
    np.testing.assert_array_equal(given.sigma, np.broadcast_to(sigma, (2, 5, 2)))
    np.testing.assert_array_equal(given.centre, np.full((2, 5), 50.0))
    speeds = ARZModel(stretch(n_mainline=5).road, PUBLISHED)
    given = Measurement.of(speeds, observed, values, sigma, np.full(5, 7.0))
    assert np.isnan(given.centre).all()  # speeds have no centre
    more = np.ones((2, 7), bool), np.ones((2, 7, 2)), np.ones((2, 7, 2)), np.ones((2, 6))
    own = Measurement(*more).on_road(5, 4)
    assert [array.shape for array in own] == [(2, 5), (2, 5, 2), (2, 5, 2), (2, 4)]


# Memory -------------------------------------------------------------------------------------------


REMEMBERING = [case for case in CASES if case[1] == "compiled"]


@over(cases=REMEMBERING)
def test_an_episode_goes_on_from_what_was_kept_of_it(name, backend, release):
    """Back in the same estimator, and in another one, with the same bits; others do not move."""
    episodes = simulate(n=3, n_steps=40, release=release)
    settings = RICH if ESTIMATORS.find(name).has_demand else PLAIN
    estimator, which = started(name, backend, episodes, settings), [0, 2]
    run(estimator, episodes, range(25))
    kept = [array[which].copy() for array in estimator.memory]
    run(estimator, episodes, range(25, 40))
    once, alone = show(estimator), started(name, backend, episodes, settings)
    for each in (estimator, alone):
        for array, rows in zip(each.memory, kept, strict=True):
            array[which] = rows
        for k in range(25, 40):
            step(each, episodes, k, which)
    assert_same(show(estimator), once)
    assert_same(show(alone), once, which, which)
    assert not np.array_equal(show(alone).density[1], once.density[1])


# Soundness ----------------------------------------------------------------------------------------


@over(
    ("random_walk", "open_loop", "recurrent", "asm"),
    cases=[c for c in CASES if c[2] != "rows"],
)
def test_covariance_stays_one(name, backend, release):
    """And no episode was put back to its prior, which would be a repair."""
    n_steps = steps_of(name, backend, 700)
    episodes = simulate(n_steps=n_steps, release=release)
    estimator = started(name, backend, episodes, held_to(bounds_of(release)))

    def check(_):
        covariance = estimator.covariances[0]
        gap = np.abs(covariance - covariance.T).max()
        assert gap == 0.0 if backend == "compiled" else gap < 1e-6 * covariance.max()
        assert np.linalg.eigvalsh(0.5 * (covariance + covariance.T)).min() >= -1e-10
        assert not estimator.diverged.any()

    run(estimator, episodes, range(n_steps), watch=check)


@over()
@pytest.mark.parametrize("bounds", ["cone", "box"])
def test_poor_starts_and_ten_times_the_noise_stay_finite_and_within_bounds(
    name, backend, release, bounds
):
    """From an empty road, and from a jam that stands."""
    n_steps, parameters = (
        steps_of(name, backend, 50),
        "published" if bounds == "box" else "w99-3lane",
    )
    episodes = simulate(parameters, n=2, n_steps=n_steps, noise=10.0, release=release)
    model = episodes.model
    start = model.states(np.array([[0.0], [1.0]]) * model.jam_density, np.zeros((2, 19)))
    estimator = started(name, backend, episodes, held_to(bounds), start)

    def check(_):
        shown = show(estimator)
        for field in Snapshot._fields:
            assert np.isfinite(getattr(shown, field)).all(), field
        assert (np.minimum(shown.density, shown.speed) >= 0.0).all()
        if name == "recurrent":  # has a range of its own
            return
        assert (shown.density <= model.jam_density * (1.0 + 1e-12)).all()
        assert (shown.speed <= model.largest_speed * (1.0 + 1e-12)).all()
        if name not in ("random_walk", "asm"):
            within = model.project(shown.states, bounds)
            np.testing.assert_allclose(within, shown.states, rtol=1e-9, atol=1e-9)

    run(estimator, episodes, range(n_steps), watch=check)


@over(fast=[*FAST[:4], ("blend", "compiled", "flow"), FAST[5]])
def test_what_is_no_number_diverges_that_episode_only(name, backend, release):
    """Not even an infinite number is projected into bounds."""
    episodes = simulate(n=6, n_steps=12, release=release)
    settings = held_to(bounds_of(release))
    estimator, healthy = (started(name, backend, episodes, settings) for _ in range(2))
    prior = show(estimator)
    for one in (estimator, healthy):
        run(one, episodes, range(8))
    inputs, values = episodes.inputs[8].copy(), episodes.values[8].copy()
    observed = episodes.observed[8].copy()
    observed[:, 14] = True
    values[1, 14, 1], values[2, 14, 0], values[3, 14, 1] = np.nan, np.inf, -np.inf
    # A network's gates hold what is infinite to their range.
    inputs[4] = -np.inf if name == "recurrent" else np.nan
    step(estimator, episodes, 8, inputs=inputs, values=values, observed=observed)
    step(healthy, episodes, 8, observed=observed)
    found = show(estimator)
    # A walk does not look at the inputs, the model alone not at what is measured.
    lost = np.array([name != "open_loop"] * 3 + [name != "random_walk"]).nonzero()[0] + 1
    assert np.flatnonzero(found.diverged).tolist() == lost.tolist()
    assert not found.fallback.any()
    np.testing.assert_array_equal(found.innovations[lost], 0.0)
    if name == "enkf":  # members are drawn anew: their mean is off by 1 / sqrt(M) deviations
        off = (found.states[lost] - prior.states[lost]) / episodes.model.state_scale
        assert np.abs(off).max() < 10.0 * np.sqrt(1e-3 / 100)
    else:
        for field in FIELDS:
            a, b = getattr(found, field)[lost], getattr(prior, field)[lost]
            np.testing.assert_allclose(a, b, rtol=1e-12, err_msg=field)
    kept = np.setdiff1d(episodes.everyone, lost)
    assert_same(found, show(healthy), kept, kept)
    run(estimator, episodes, range(9, 12))
    assert not estimator.diverged.any()
    assert np.isfinite(show(estimator).states).all()


# Measurements -------------------------------------------------------------------------------------


@over(("recurrent",))
def test_an_empty_set_of_measurements_leaves_the_prediction(name, backend, release):
    episodes = simulate(n_steps=14, release=release)
    estimator = started(name, backend, episodes)
    run(estimator, episodes, range(12))
    nothing, unread = np.zeros_like(episodes.observed[0]), np.full_like(episodes.values[0], np.nan)
    for k in (12, 13):
        estimator.predict(episodes.everyone, episodes.inputs[k])
        before = show(estimator)
        kept = estimator.covariances if name in ("ekf", "ukf", "enkf") else None
        update(estimator, episodes, k, observed=nothing, values=unread)
        after = show(estimator)
        np.testing.assert_allclose(after.states, before.states, rtol=1e-12)
        np.testing.assert_array_equal(after.innovations, 0.0)
        assert not np.any(after.diverged | after.fallback)
        if kept is not None:
            np.testing.assert_allclose(estimator.covariances, kept, rtol=1e-9, atol=1e-15)
        if name != "open_loop":
            assert after.density_std.mean() > 0.0


@pytest.mark.parametrize("name", ["random_walk", "blend"])
def test_the_noise_is_as_large_as_the_settings_say(name):
    episodes, scale = simulate(n_steps=12, release="flow"), (2.0, 0.5)
    settings = replace(PLAIN, noise_scale=scale)
    given, scaled = (started(name, "compiled", episodes, each) for each in (PLAIN, settings))
    run(given, replace(episodes, sigma=episodes.sigma * scale), range(12))
    run(scaled, episodes, range(12))
    assert_same(show(given), show(scaled))


# Batches ------------------------------------------------------------------------------------------


@over()
def test_a_batch_equals_single_episodes_to_the_bit_in_any_order(name, backend, release):
    """The values of unobserved rows do not matter."""
    n_steps = steps_of(name, backend, 40)
    episodes = simulate(n=3, n_steps=n_steps, noise=2.0, release=release)
    hidden = np.where(episodes.observed[..., None], episodes.values, np.nan)
    hidden = replace(episodes, values=hidden)
    batch, shuffled = (started(name, backend, episodes) for _ in range(2))
    run(batch, episodes, range(n_steps))
    for k in range(n_steps):
        step(shuffled, hidden, k, [2, 0, 1])
    assert_same(show(batch), show(shuffled))
    np.testing.assert_array_equal(batch.innovations[~episodes.observed[-1]], 0.0)
    for i, stream in enumerate(random_streams(3)):
        one, row = make_estimator(name, backend, episodes.model, 1, PLAIN), slice(i, i + 1)
        one.reset(np.arange(1), episodes.start[row], [stream])
        names = ("inputs", "observed", "values", "sigma", "centre")
        alone = {each: getattr(episodes, each) for each in names}
        alone = {each: array[:, row] for each, array in alone.items() if array is not None}
        run(one, replace(episodes, start=episodes.start[row], **alone), range(n_steps))
        assert_same(show(one), show(batch), [0], [i])


@over()
def test_episodes_that_are_not_named_and_copies_stay_as_they_are(name, backend, release):
    """Copies are made as `QueryProcess.fork` does; kernels write to arrays that objects share."""
    episodes = simulate(n=4, n_steps=16, release=release)
    estimator = started(name, backend, episodes)
    run(estimator, episodes, range(12))
    before, other = (
        show(estimator),
        copy.deepcopy(estimator, {id(estimator.model): estimator.model}),
    )
    some, rest = np.array([3, 1]), np.array([0, 2])
    step(estimator, episodes, 12, some)
    estimator.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    after = show(estimator)
    assert_same(show(other), before)
    assert_same(after, before, rest, rest)
    for i in some:
        assert not np.array_equal(after.states[i], before.states[i])
    # What is hidden of the others, streams and windows, goes on as if nothing had happened.
    for one in (estimator, other):
        step(one, episodes, 13, rest)
    assert_same(show(estimator), show(other), rest, rest)


# Reports ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ekf", "blend"])
def test_a_cap_holds_the_reported_speeds_and_nothing_else(name):
    episodes = simulate(n=2, n_steps=4)
    speeds = np.tile(np.linspace(20.0, 95.0, 19), (2, 1))
    mixed = episodes.model.states(np.full((2, 19), 20.0), speeds)
    plain, held = (
        started(name, "compiled", episodes, settings, mixed)
        for settings in (PLAIN, EstimatorSettings(speed_cap=0.7))
    )
    largest = 0.7 * episodes.model.road.limits[0]
    for k in range(4):
        for one in (plain, held):
            step(one, episodes, k)
        expected, found = show(plain), show(held)
        assert (expected.speed > largest).any()
        assert (found.speed < largest).any()
        speed = np.minimum(expected.speed, largest)
        if name == "blend":  # a mean of speeds that are held already
            assert (found.speed <= speed).all()
            speed = found.speed
        assert_same(expected._replace(speed=speed), found)
