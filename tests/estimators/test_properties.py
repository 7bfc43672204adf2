"""Properties of every estimator: any name, either backend, both sets of bounds and releases."""

from dataclasses import fields, replace

import numpy as np
import pytest

from dptse_env.estimators import (
    ESTIMATORS,
    EstimatorSettings,
    HorizonSettings,
    make_estimator,
)
from dptse_env.model import ARZModel, Bounds
from tests.helpers import Road, fast_and_slow

from .episodes import (
    EVERY,
    Snapshot,
    assert_same,
    random_streams,
    run,
    scale_of,
    show,
    simulate,
    started,
    tell,
)

# Each compiled one is compared with its reference in a module of its own: the references, and the
# blend of two others, are among the slow tests.
FAST = [
    ("ekf", "compiled", "flow"),
    ("ukf", "compiled", "speed"),
    ("enkf", "compiled", "flow"),
    ("mhe", "compiled", "speed"),
    ("random_walk", "compiled", "flow"),
    ("recurrent", "compiled", "speed"),
]
CASES = [(*each, "speed") for each in EVERY]
CASES += [(name, "compiled", "flow") for name in ESTIMATORS if name != "open_loop"]
WITH_COVARIANCE = [
    case for case in CASES if case[0] not in ("random_walk", "open_loop", "recurrent")
]
EXCHANGED = [*range(15), 16, 15, 17, 18]  # segments, the on-ramps exchanged
SLOW = {("mhe", "reference"), ("enkf", "reference")}  # milliseconds a step


def over(cases):
    """Return the mark that runs a test over cases, one of each kind in every run."""
    return pytest.mark.parametrize(("name", "backend", "release"), fast_and_slow(cases, FAST))


every_case, with_covariance = over(CASES), over(WITH_COVARIANCE)


def held_to(bounds: Bounds) -> EstimatorSettings:
    return EstimatorSettings(bounds=bounds, mhe=HorizonSettings(bounds=bounds))


def steps_of(name, backend, compiled, reference, slow):
    if (name, backend) in SLOW:
        return slow
    return compiled if backend == "compiled" else reference


# Streams ------------------------------------------------------------------------------------------


@every_case
def test_the_seed_decides_and_the_global_generator_is_left_alone(name, backend, release):
    n_steps = steps_of(name, backend, 50, 50, 14)
    episodes = simulate(n_steps=n_steps, release=release)
    first, second = (started(name, backend, episodes) for _ in range(2))
    np.random.seed(1)  # noqa: NPY002
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    run(first, episodes, range(n_steps))
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    np.random.seed(2)  # noqa: NPY002
    run(second, episodes, range(n_steps))
    assert_same(show(first), show(second))
    second.reset(episodes.everyone, episodes.start, random_streams(1))
    run(second, episodes, range(n_steps))
    assert_same(show(first), show(second))
    third = started(name, backend, episodes, seed=1)
    run(third, episodes, range(n_steps))
    draws = name == "enkf"
    assert np.array_equal(show(first).density, show(third).density) != draws


# Soundness ----------------------------------------------------------------------------------------


@with_covariance
def test_covariance_is_one_over_recorded_traffic(name, backend, release, recordings):
    """And no episode was put back to its prior, which would be a repair."""
    bounds = "cone" if release == "speed" else "box"
    episodes = recordings[release]
    estimator = started(name, backend, episodes, held_to(bounds))

    def check(_):
        covariance = estimator.covariances[0]
        gap = np.abs(covariance - covariance.T).max()
        assert gap == 0.0 if backend == "compiled" else gap < 1e-6 * covariance.max()
        assert np.linalg.eigvalsh(0.5 * (covariance + covariance.T)).min() >= -1e-10
        assert not estimator.diverged.any()

    n_steps = steps_of(name, backend, 700, 700, 60)
    run(estimator, episodes, range(n_steps), watch=check)


POOR = [
    (*case, bounds, parameters, filling)
    for case in CASES
    for bounds in ("cone", "box")
    for parameters in ("paper", "w99-3lane")
    for filling in (0.0, 1.0)
]
FAST_POOR = [
    ("ekf", "compiled", "flow", "cone", "paper", 1.0),
    ("ekf", "compiled", "flow", "box", "w99-3lane", 0.0),
    ("ukf", "compiled", "speed", "box", "paper", 0.0),
    ("enkf", "compiled", "flow", "box", "w99-3lane", 1.0),
    ("mhe", "compiled", "speed", "cone", "w99-3lane", 0.0),
    ("mhe", "compiled", "flow", "box", "paper", 1.0),
]


@pytest.mark.parametrize(
    ("name", "backend", "release", "bounds", "parameters", "filling"),
    fast_and_slow(POOR, FAST_POOR),
)
def test_poor_starts_and_ten_times_the_noise_stay_finite_and_within_bounds(
    name, backend, release, bounds, parameters, filling
):
    n_steps = steps_of(name, backend, 200, 60, 14)
    episodes = simulate(parameters, n=2, n_steps=n_steps, noise=10.0, release=release)
    model = episodes.model
    density = np.full((2, 19), filling) * model.jam_density
    start = model.states(density, np.zeros((2, 19)))
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
        if name != "random_walk":
            within = model.project(shown.states, bounds)
            np.testing.assert_allclose(within, shown.states, rtol=1e-9, atol=1e-9)

    run(estimator, episodes, range(n_steps), watch=check)


# A walk does not look at the inputs, the model alone not at what is measured.
POISONS = [
    (*case, poison, bad)
    for case in CASES
    for poison, bad in (("values", np.nan), ("values", -np.inf), ("inputs", np.nan))
    if (case[0], poison) not in {("random_walk", "inputs"), ("open_loop", "values")}
]
FAST_POISONS = [
    ("ekf", "compiled", "flow", "values", -np.inf),
    ("ukf", "compiled", "speed", "inputs", np.nan),
    ("enkf", "compiled", "flow", "inputs", np.nan),
    ("mhe", "compiled", "speed", "values", np.nan),
    ("blend", "compiled", "speed", "values", np.nan),
    ("recurrent", "compiled", "speed", "inputs", np.nan),
]


@pytest.mark.parametrize(
    ("name", "backend", "release", "poison", "bad"), fast_and_slow(POISONS, FAST_POISONS)
)
def test_what_is_no_number_diverges_that_episode_only(name, backend, release, poison, bad):
    episodes = simulate(n=3, n_steps=12, release=release)
    estimator, healthy = (started(name, backend, episodes) for _ in range(2))
    prior = show(estimator)
    for one in (estimator, healthy):
        run(one, episodes, range(8))
    inputs, values = episodes.inputs[8].copy(), episodes.values[8].copy()
    if poison == "values":
        values[1, 14, 1] = bad
    else:
        inputs[1] = bad
    estimator.predict(episodes.everyone, inputs)
    tell(estimator, episodes.everyone, episodes.observed[8], values, episodes.sigma)
    run(healthy, episodes, [8])
    found = show(estimator)
    assert found.diverged.tolist() == [False, True, False]
    assert not found.fallback.any()
    np.testing.assert_array_equal(found.innovations[1], 0.0)
    if name == "enkf":  # members are drawn anew: their mean is off by 1 / sqrt(M) deviations
        off = (found.states[1] - episodes.start[1]) / scale_of(episodes.model)
        assert np.abs(off).max() < 5.0 * np.sqrt(1e-3 / 100)
    else:
        for field in ("density", "speed", "density_std", "speed_std"):
            a, b = getattr(found, field)[1], getattr(prior, field)[1]
            np.testing.assert_allclose(a, b, rtol=1e-12, err_msg=field)
    assert_same(found, show(healthy), [0, 2], [0, 2])
    run(estimator, episodes, range(9, 12))
    assert not estimator.diverged.any()
    assert np.isfinite(show(estimator).states).all()


# Measurements -------------------------------------------------------------------------------------

# Settings under which worthless measurements leave nothing but the model. A mean over points is
# the model's own path if they lie close together; a window is if it is linearised along it.
WITHOUT_NOISE = EstimatorSettings(process_noise=(1e-9, 1e-9), initial_variance=1e-18)
ALONG = HorizonSettings(linearisation="trajectory", bounds="cone")
BLIND = {
    "ekf": (EstimatorSettings(), 1e-9),
    "ukf": (WITHOUT_NOISE, 1e-4),
    "enkf": (WITHOUT_NOISE, 1e-4),
    "mhe": (EstimatorSettings(mhe=ALONG), 1e-8),
    "blend": (EstimatorSettings(), 1e-9),
}


@with_covariance
def test_worthless_measurements_leave_the_model_alone(name, backend, release):
    n_steps = steps_of(name, backend, 100, 100, 30)
    episodes = simulate(n_steps=n_steps, release=release)
    settings, tolerance = BLIND[name]
    estimator = started(name, backend, episodes, settings)
    alone = started("open_loop", "compiled", episodes)
    for one in (estimator, alone):
        run(one, episodes, range(n_steps), sigma=np.array([1e12, 1e12]))
    np.testing.assert_allclose(estimator.states, alone.states, rtol=tolerance)


@over([case for case in CASES if case[0] != "recurrent"])
def test_an_empty_set_of_measurements_leaves_the_prediction(name, backend, release):
    episodes = simulate(n_steps=14, release=release)
    estimator = started(name, backend, episodes)
    run(estimator, episodes, range(12))
    nothing, unread = np.zeros((1, 19), bool), np.full((1, 19, 2), np.nan)
    for k in (12, 13):
        estimator.predict(episodes.everyone, episodes.inputs[k])
        before = show(estimator)
        kept = estimator.covariances if name in ("ekf", "ukf", "enkf") else None
        tell(estimator, episodes.everyone, nothing, unread, episodes.sigma)
        after = show(estimator)
        np.testing.assert_allclose(after.states, before.states, rtol=1e-12)
        np.testing.assert_array_equal(after.innovations, 0.0)
        assert not np.any(after.diverged | after.fallback)
        if kept is not None:
            np.testing.assert_allclose(estimator.covariances, kept, rtol=1e-9, atol=1e-15)
        if name != "open_loop":
            assert after.density_std.mean() > 0.0


@every_case
def test_values_of_unobserved_segments_are_not_looked_at(name, backend, release):
    episodes = simulate(n_steps=14, release=release)
    hidden = np.where(episodes.observed[..., None], episodes.values, np.nan)
    a, b = (started(name, backend, episodes) for _ in range(2))
    run(a, episodes, range(14))
    run(b, replace(episodes, values=hidden), range(14))
    assert_same(show(a), show(b))
    np.testing.assert_array_equal(b.innovations[~episodes.observed[13]], 0.0)


def renumbered(episodes):
    """The same road and traffic with its two on-ramps, segments 15 and 16, exchanged."""
    same = episodes.model.network
    names = [field.name for field in fields(Road) if hasattr(same, field.name)]
    road = Road(**{name: getattr(same, name) for name in names})
    model = ARZModel(
        replace(road, on_ramps=road.on_ramps[::-1]),
        episodes.model.parameters,
        reference_speed=episodes.model.reference_speed,
    )
    inputs, start = episodes.inputs.copy(), episodes.start.copy()
    inputs[..., [3, 4, 5, 6]] = inputs[..., [5, 6, 3, 4]]
    start[:, 30:34] = start[:, [32, 33, 30, 31]]
    seen, values = episodes.observed[..., EXCHANGED], episodes.values[..., EXCHANGED, :]
    return replace(episodes, model=model, start=start, inputs=inputs, observed=seen, values=values)


@over([case for case in CASES if case[0] != "enkf"])
def test_the_numbering_of_segments_and_rows_changes_nothing(name, backend, release):
    """The EnKF gives its draws out in this order, so that it is the same in distribution only.

    The root of the UKF's covariance depends on the order, too: not in the first step, as the
    prior has no correlations.
    """
    n_steps = 1 if name == "ukf" else 14
    episodes = simulate("paper", n_steps=n_steps, release=release)
    episodes.observed[..., [15, 16]] = True
    other = renumbered(episodes)
    assert not np.array_equal(other.values[0, 0], episodes.values[0, 0])
    a, b = started(name, backend, episodes), started(name, backend, other)
    run(a, episodes, range(n_steps))
    run(b, other, range(n_steps))
    first, second = show(a), show(b)
    # The network sums in single precision, in another order; densities are of the order of 100.
    atol = 1e-4 if name == "recurrent" else 1e-7
    for field in ("density", "speed", "density_std", "speed_std", "innovations"):
        mine, its = getattr(first, field), getattr(second, field)[:, EXCHANGED]
        np.testing.assert_allclose(mine, its, rtol=1e-6, atol=atol, err_msg=field)


# Batches ------------------------------------------------------------------------------------------


@every_case
def test_a_batch_equals_single_episodes_to_the_bit_in_any_order(name, backend, release):
    n_steps = steps_of(name, backend, 60, 30, 14)
    episodes = simulate(n=3, n_steps=n_steps, noise=2.0, release=release)
    batch, shuffled = (started(name, backend, episodes) for _ in range(2))
    run(batch, episodes, range(n_steps))
    order = np.array([2, 0, 1])
    for k in range(n_steps):
        shuffled.predict(order, episodes.inputs[k, order])
        seen, values = episodes.observed[k, order], episodes.values[k, order]
        tell(shuffled, order, seen, values, episodes.sigma)
    assert_same(show(batch), show(shuffled))
    for i, stream in enumerate(random_streams(3)):
        one, alone, row = make_estimator(name, backend, episodes.model, 1), np.arange(1), [i]
        one.reset(alone, episodes.start[row], [stream])
        for k in range(n_steps):
            one.predict(alone, episodes.inputs[k, row])
            tell(one, alone, episodes.observed[k, row], episodes.values[k, row], episodes.sigma)
        assert_same(show(one), show(batch), [0], [i])


@every_case
def test_episodes_that_are_not_named_stay_as_they_are(name, backend, release):
    episodes = simulate(n=4, n_steps=16, release=release)
    estimator, other = (started(name, backend, episodes) for _ in range(2))
    for one in (estimator, other):
        run(one, episodes, range(12))
    before = show(estimator)
    some, rest = np.array([3, 1]), np.array([0, 2])
    estimator.predict(some, episodes.inputs[12, some])
    tell(estimator, some, episodes.observed[12, some], episodes.values[12, some], episodes.sigma)
    estimator.reset(np.array([1]), episodes.start[[1]], random_streams(1))
    after = show(estimator)
    assert_same(after, before, rest, rest)
    for i in some:
        assert not np.array_equal(after.states[i], before.states[i])
    # What is hidden of the others, streams and windows, goes on as if nothing had happened.
    for one in (estimator, other):
        one.predict(rest, episodes.inputs[13, rest])
        tell(one, rest, episodes.observed[13, rest], episodes.values[13, rest], episodes.sigma)
    assert_same(show(estimator), show(other), rest, rest)
