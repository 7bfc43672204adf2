"""Rewind: an estimator that goes through intervals again, in every use of the process."""

import copy
import pickle
from functools import partial

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.estimators import ESTIMATORS, Estimator, Measurement
from dptse_env.measurement.loops import seconds_told
from dptse_env.process import QueryProcess
from tests.helpers import COUNTED, PAID, SHORT, fast_and_slow, lock_step, make_batch

T = 10
LOOPS = {"positions": [0.0, 0.2, 0.6], "ramps": [2], "interval": T, "least_count": 1}
SEEDS = (11, 12, 13, 14)
ALL = np.arange(4)
STARTS = {"traffic_seed": [0, 1, 2, 1], "start": [0, 13, 39, 41]}
"""Episodes that begin at an interval's beginning and within one, and in its last second."""


def begun(**keywords):
    given = {"traffic_seeds": "0:3", "horizon": 60, "random_start": True, "loops": LOOPS}
    process = QueryProcess(resolve("short-plain", {**given, **keywords}), 4)
    process.reset(ALL, [np.random.default_rng(seed) for seed in SEEDS], STARTS)
    return process


def sampled(process, n_steps):
    space = process.interface.actions.space
    space.seed(5)
    return [np.array([space.sample() for _ in ALL]) for _ in range(n_steps)]


def assert_alike(one, two, episodes=ALL):
    for mine, other in zip(one.memory, two.memory, strict=True):
        np.testing.assert_array_equal(mine[episodes], other[episodes])


# --- the truth of it ------------------------------------------------------------------------------

WAYS = [("ekf", PAID), ("recurrent", COUNTED), ("enkf", "printed"), ("mhe", PAID)]


@pytest.mark.parametrize(
    ("estimator", "privacy"),
    fast_and_slow([(e, p) for e in ESTIMATORS for p in ("printed", COUNTED, PAID)], WAYS),
)
def test_the_estimator_is_as_if_it_had_had_the_readings_in_time(estimator, privacy):
    """At each interval's end, bit for bit, but for what it says of the releases of this second."""
    interval = 2 * T if privacy == "printed" else T  # which is told of in two seconds or in one
    seconds, loops = seconds_told(interval), LOOPS | {"interval": interval}
    process = begun(estimator=estimator, privacy=privacy, loops=loops)
    by_hand, given = copy.deepcopy(process.estimator), {e: [] for e in ALL.tolist()}
    kept, beside = process.rewind.follow, process.loops.segments
    # Of the seconds that are told, without the interval's readings; NaN where they were not lived.
    estimated = np.full((len(seconds), len(ALL), len(beside), 2), np.nan)

    def spy(episodes, traffic, times, inputs, measured):
        for k, episode in enumerate(episodes.tolist()):
            own = measured.at(slice(k, k + 1))
            seen = own.observed[..., None]  # the rest may be anything, and is not kept
            own = own._replace(values=own.values * seen, sigma=own.sigma * seen)
            given[episode].append((inputs[k : k + 1].copy(), own))
        second, row = np.nonzero((times - 1) % interval == seconds[:, None])
        found = process.estimator.estimate()
        own = np.stack([found.density[:, beside], found.speed[:, beside]], axis=-1)
        estimated[second, episodes[row]] = own[episodes[row]]
        kept(episodes, traffic, times, inputs, measured)

    process.rewind.follow = spy
    n_ends = 0
    for action in sampled(process, 30):
        process.step(ALL, action)
        for episode in ALL[process.time % interval == 0]:
            own = np.array([episode])
            loops = process.loops
            said = loops.said_until(process.traffic_index[own], process.time[own])
            told = loops.told(said, estimated[:, own])
            n = len(given[episode])  # fewer than an interval where the episode began within
            for second, (inputs, measured) in enumerate(given[episode], interval - n):
                by_hand.predict(own, inputs)
                by_hand.update(own, loops.added(measured, told, np.array([second])))
            given[episode].clear()
            for name in ("innovations", "diverged", "fallback"):
                getattr(by_hand, name)[own] = getattr(process.estimator, name)[own]
            assert_alike(by_hand, process.estimator, own)
            for mine, other in zip(by_hand.estimate(), process.estimate, strict=True):
                np.testing.assert_array_equal(mine[own], other[own])
            n_ends += 1
    assert n_ends == {T: 3 + 3 + 3 + 3, 2 * T: 1 + 2 + 2 + 1}[interval]


@pytest.mark.parametrize("privacy", ["printed", COUNTED])
def test_what_is_known_of_a_segment_in_a_second_is_weighed_by_its_variance(privacy):
    process = begun(privacy=privacy, loops=LOOPS | {"least_count": 0})
    task, loops, generator = process.release.task, process.loops, np.random.default_rng(0)
    shape = len(ALL) * 2, task.n_channels
    measured = Measurement(
        generator.random(shape) < 0.5, *generator.uniform(1.0, 90.0, (2, *shape, 2)),
        generator.uniform(20.0, 90.0, (shape[0], task.n_cells)),
    )  # fmt: skip
    said = loops.said_until(process.traffic_index, np.array([2, 5, 9, 20]) * T)
    told = loops.told(said, np.full((1, *said.shape[:2], 2), np.nan))
    given = loops.added(measured, told, np.array([5, 5]))
    untold = loops.added(measured, told, np.array([4, 6]))
    for own, other in zip(untold, measured, strict=True):
        np.testing.assert_array_equal(own, other)
    beside = np.unique(task.corridor.stations.beside)
    rest = np.setdiff1d(np.arange(task.n_channels), beside)
    for own, other in zip(given[:3], measured[:3], strict=True):
        np.testing.assert_array_equal(own[:, rest], other[:, rest])
    assert np.isfinite(said[..., 0]).all()
    assert given.observed[:, beside].all()
    density, speed, density_std, speed_std = np.moveaxis(np.tile(told[0], (2, 1, 1)), -1, 0)
    if task.releases_flow:
        slip = speed - measured.centre[:, beside]
        least = np.maximum(density, 1.0 / process.config.corridor.road.lengths[beside])
        speed_std = np.hypot(least * speed_std, slip * density_std)
        speed = density * slip
    own, weight = np.stack([density, speed], -1), np.stack([density_std, speed_std], -1) ** -2.0
    other = measured.sigma[:, beside] ** -2.0 * measured.observed[:, beside, None]
    mean = (weight * own + other * measured.values[:, beside]) / (weight + other)
    np.testing.assert_allclose(given.values[:, beside], mean)
    np.testing.assert_allclose(given.sigma[:, beside], (weight + other) ** -0.5)


def test_a_reading_is_of_the_mean_and_leaves_an_estimate_its_course():
    """Of three seconds of 30 in which an estimate rises, and of one episode that begins late."""
    loops = begun(loops=LOOPS | {"interval": 30}).loops
    n = loops.segments.size
    said = np.tile([60.0, 40.0, 5.0, 3.0, 2.0, 1.0], (2, n, 1))
    estimated = np.stack([[30.0, 80.0], [40.0, 60.0], [80.0, 40.0]])[:, None, None]
    estimated = np.tile(estimated, (1, 2, n, 1))
    estimated[:2, 1] = np.nan
    told = loops.told(said, estimated)
    std = np.hypot([5.0, 3.0], 2.0**0.5 * np.array([2.0, 1.0]))
    np.testing.assert_allclose(told[..., 2:], np.broadcast_to(std, (3, 2, n, 2)))
    # Densities 10 below the reading in the mean are moved, speeds 20 above it scaled down.
    np.testing.assert_allclose(told[:, 0, 0, :2], [[40, 160 / 3], [50, 40], [90, 80 / 3]])
    np.testing.assert_allclose(told[2, 1, :, :2], said[1, :, :2])
    empty = loops.told(said, np.zeros_like(estimated))
    np.testing.assert_allclose(empty[..., :2], np.tile(said[..., :2], (3, 1, 1, 1)))


# --- what rules and reports see -------------------------------------------------------------------


@pytest.mark.parametrize("estimator", ["ekf", "recurrent"])
def test_a_reading_is_no_query(estimator):
    """Ages, queries and releases are those without loops; innovations those of releases alone."""
    given = {"estimator": estimator, "privacy": COUNTED}
    with_loops, without = begun(**given), begun(**given, loops=None)
    for second, action in enumerate(sampled(with_loops, 20)):
        for process in (with_loops, without):
            process.step(ALL, action)
        for name in ("age", "queried", "released"):
            np.testing.assert_array_equal(getattr(with_loops, name), getattr(without, name))
        innovations = with_loops.estimator.innovations
        observed = with_loops.release.task.observed(with_loops.queried)[:, : innovations.shape[1]]
        assert (innovations[~observed] == 0.0).all()
        assert (innovations[observed] != 0.0).all()
        early = second < T - 1 - np.array(STARTS["start"]) % T
        np.testing.assert_array_equal(innovations[early], without.estimator.innovations[early])


def test_a_filter_that_starts_over_in_a_rewind_says_so():
    process = begun(privacy="printed")
    actions, added = sampled(process, T), process.loops.added

    def spoilt(measured, told, seconds):
        values = added(measured, told, seconds).values.copy()
        values[5] = np.nan  # in the second that is told of
        return added(measured, told, seconds)._replace(values=values)

    process.loops.added = spoilt
    for action in actions[:-1]:
        process.step(ALL[:1], action[:1])
        assert process.info(0)["diverged"] == 0.0
    process.step(ALL[:1], actions[-1][:1])
    assert process.info(0)["diverged"] == 1.0
    assert np.isfinite(process.estimate.density).all()


def test_an_observation_has_the_last_readings_also_those_before_the_episode():
    process = begun()
    encoding, corridor = process.interface.observations, process.config.corridor
    unit = corridor.scales.density_scale * corridor.scales.speed_scale * T / 3600.0
    outcome = process.observe(ALL)
    for action in sampled(process, 15):
        for e, time in enumerate(process.time.tolist()):
            shown = {
                name: encoding.block(outcome[e], name)
                for name in ("loop_flow", "loop_speed", "loop_age")
            }
            np.testing.assert_allclose(shown["loop_age"], [time % T / T])
            flow, speed = np.full((2, 4), -1.0)
            if time >= T:
                record = process.traffic_index[e]
                count, mean = process.traffic.readings[record, time // T - 1].T
                flow = np.where(np.isfinite(count), count / unit, -1.0)
                speed = np.where(count > 0, mean / corridor.scales.speed_scale, -1.0)
            np.testing.assert_allclose(shown["loop_flow"], flow, rtol=1e-6)
            np.testing.assert_allclose(shown["loop_speed"], speed, rtol=1e-6)
        outcome = process.step(ALL, action).observation


# --- batches --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "estimator", "action", "privacy"),
    [
        ("NextStep", "ekf", "sequential", PAID),
        ("SameStep", "enkf", "mask", COUNTED),
        ("Disabled", "recurrent", "slots", "printed"),
    ],
)
def test_episodes_of_a_batch_begin_again_within_intervals(mode, estimator, action, privacy):
    """Of six seconds, where an interval has ten, and with resets of some in between."""
    given = {"estimator": estimator, "action": action, "privacy": privacy, "loops": LOOPS}
    lock_step({**given, "truth_in_info": True}, 20, autoreset_mode=mode)


def test_nothing_is_left_of_an_episode_that_began_anew():
    """Of the interval that a reset ends, and of the one that it begins in, told of twice."""
    used, fresh = (begun(privacy=PAID, loops=LOOPS | {"interval": 2 * T}) for _ in range(2))
    actions = sampled(used, 40)
    for action in actions[:17]:
        used.step(ALL, action)
    generators = [np.random.default_rng(seed) for seed in SEEDS]
    used.reset(ALL, generators, STARTS)
    for action in actions[17:]:
        here, there = used.step(ALL, action), fresh.step(ALL, action)
        np.testing.assert_array_equal(here.observation, there.observation)


# --- copies ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("copied", "estimator"),
    [
        (QueryProcess.fork, "ekf"),
        (copy.deepcopy, "enkf"),
        (lambda process: pickle.loads(pickle.dumps(process)), "enkf"),
    ],
)
def test_a_copy_that_is_stepped_like_its_origin_gives_the_same_bits(copied, estimator):
    """From within an interval past the ends of two, and its origin is left alone."""
    origin, expected = begun(estimator=estimator), begun(estimator=estimator)
    actions = sampled(origin, 25)
    for action in actions[:5]:
        origin.step(ALL, action)
        expected.step(ALL, action)
    ahead, other = copied(origin), copied(origin)
    for action in actions[5:]:
        other.step(ALL, action[::-1])
    for action in actions[5:]:
        there = ahead.step(ALL, action)
        here, undisturbed = origin.step(ALL, action), expected.step(ALL, action)
        for name in ("observation", "reward", "truncated"):
            np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
            np.testing.assert_array_equal(getattr(here, name), getattr(undisturbed, name))
    assert_alike(origin.estimator, ahead.estimator)
    assert not np.array_equal(other.estimate.density, origin.estimate.density)


# --- estimators that cannot go back ---------------------------------------------------------------


class Forgetful(ESTIMATORS.find("random_walk")):
    """One that does not say what it remembers."""

    _memory = Estimator._memory


class Copying(ESTIMATORS.find("random_walk")):
    """One that hands out what nothing can be written back to."""

    @property
    def _memory(self):
        return tuple(each.copy() for each in super()._memory)


@pytest.mark.parametrize("make", [partial(gym.make, SHORT), make_batch])
def test_an_estimator_that_cannot_go_back_is_refused_before_anything_is_recorded(make):
    with pytest.raises(ValueError, match=r"^estimator must be .* got .*Forgetful"):
        make(estimator=Forgetful, loops=LOOPS)
    make(estimator=Forgetful)
    with pytest.raises(ValueError, match=r"^estimator must return .* got .*Copying"):
        make(estimator=Copying, loops=LOOPS).reset(seed=0)
    with pytest.raises(ValueError, match=r"^backend must be 'compiled' .* got 'reference'"):
        make(estimator="ekf", backend="reference", loops=LOOPS)
