"""The environment under presets that guarantee privacy: account, warnings, truth, distances."""

import dataclasses
import json
import math
from fractions import Fraction
from functools import cache

import numpy as np
import pytest

from dptse_env.config import EnvConfig
from dptse_env.estimators import Estimate
from dptse_env.measurement import SensorSettings
from dptse_env.parts import make_release
from dptse_env.privacy import ROUNDING, mu_of
from dptse_env.process import QueryProcess
from dptse_env.release import CappedSettings, Paced, PacedSettings, Pacing, Request
from dptse_env.traffic import (
    SHORT_HIGHWAY,
    Loops,
    Penetration,
    RecordLibrary,
    Stations,
    readings,
)
from tests.helpers import AWAY, assert_same, fast_and_slow, make_env, play, record
from tests.release.worlds import ONE, Worlds, alike_to_loops

CAPPED, PACED = {"preset": "capped", "cap": 5}, {"preset": "paced", "epsilon": 0.5}


@pytest.mark.parametrize(
    ("privacy", "claim", "settings"),
    [
        (CAPPED, ("0.7504", "(1, 0.05)"), {"cap": 5}),
        (PACED, ("0.4919", "(0.5, 0.05)"), {"clip": 25.0}),
    ],
)
def test_what_is_spent_grows_up_to_the_guarantee(privacy, claim, settings):
    env = make_env(privacy=privacy, horizon=80, random_start=True)
    (_, at_reset), *steps = play(env, 80)
    account, infos = env.unwrapped.privacy(), [at_reset, *(step[4] for step in steps)]
    assert json.loads(json.dumps(account, allow_nan=False)) == account
    assert account["guarantee"] == env.unwrapped.guarantee()
    stated = "{}-Gaussian differential privacy (rounded up), which is {}-differential privacy, of "
    assert account["guarantee"].startswith(stated.format(*claim))
    assert account["void_reasons"] == []
    assert account.items() >= {"unit": "trip", "adjacency": "replace", **settings}.items()
    mus, epsilons = ([info[key] for info in infos] for key in ("spent_mu", "spent_epsilon"))
    assert mus == sorted(mus)
    assert epsilons == sorted(epsilons)
    assert (mus[0], epsilons[0]) == (0.0, 0.0)
    assert mus[-1] == pytest.approx(account["mu"])
    assert epsilons[-1] == pytest.approx(account["epsilon"]) == account["claimed_epsilon"]
    if "cap" in settings:
        counted = np.minimum(np.arange(81), 5)
        np.testing.assert_allclose(mus, account["mu"] * np.sqrt(counted / 5), rtol=1e-12)
    private = {"exposures", "ledgers", "individual_epsilon", "n_refused", "time"}
    assert not any(private & set(info) for info in infos)


def test_a_void_guarantee_is_warned_of_when_the_environment_is_made():
    with pytest.warns(UserWarning, match="boundary_inputs") as caught:
        env = make_env(privacy=CAPPED | {"boundary_inputs": "true"})
    assert len(caught) == 1
    assert env.unwrapped.guarantee() == "none: boundary_inputs"
    account = env.unwrapped.privacy()
    assert account["guarantee"] == "none"
    assert account["void_reasons"] == ["boundary_inputs"]


@pytest.mark.parametrize(
    ("privacy", "what", "most"), [(CAPPED, "exposures", 5), (PACED, "ledgers", 1.0)]
)
def test_no_vehicle_has_spent_more_than_info_says(privacy, what, most):
    env = make_env(privacy=privacy, truth_in_info=True)
    env.action_space.seed(0)
    env.reset(seed=0, options={"traffic_seed": 0})
    assert env.unwrapped.privacy()["void_reasons"] == ["truth_in_info"]
    process, refused = env.unwrapped.process, 0
    for _ in range(100):
        *_, info = env.step(env.action_space.sample())
        private = process.release.private(ONE, process.traffic_index)
        spent, epsilons = (np.array(private[key][0]) for key in (what, "individual_epsilon"))
        assert spent.max(initial=0) <= most
        assert epsilons.max(initial=0) <= info["spent_epsilon"] * (1.0 + 1e-9)
        refused += np.sum(private.get("n_refused", 0))
    assert spent.max() > 0.9 * most
    assert (spent == 0).any()
    assert (epsilons[spent == 0] == 0.0).all()
    assert (epsilons[spent > 0.1 * most] > 0.0).all()
    assert (refused > 0) == (what == "ledgers")
    assert len(spent) == len(epsilons) == process.traffic.record(0).n_vehicles
    env.reset(options={"traffic_seed": 0})
    again = process.release.private(ONE, process.traffic_index)
    assert not any(again[what][0])
    assert not any(again["individual_epsilon"][0])


# --- no two worlds are further apart than mu ------------------------------------------------------
#
# A process plays an episode of one world. An eavesdropper has noiseless copies of its release model
# in both, which are told the same queries and predictions: what they would have added noise to are
# the true sums. Their distance, in units of the noise, is a fraction without any rounding.

HORIZON, DURATION = 30, 33
COMMON = 4
"""Traffic seed of a record that both worlds have. Theirs are 0 and 1; in 2 and 3 the vehicle that
differs is alone."""
ROAD = SHORT_HIGHWAY.replaced(duration=DURATION, incident=None)
PLACES = ROAD.geometry.n_cells
ESTIMATORS = ("ekf", "random_walk", "recurrent", "ukf", "enkf", "mhe")


class Reckless(Pacing):
    """Prices from far too low to the whole budget at once, by the second and the column."""

    def reset(self, episodes):
        self.second = 0

    def prices(self, episodes, observed, density, speed):
        self.second += 1
        powers = np.random.default_rng(self.second).choice(
            [0.0, -0.3, -1.0, -2.0, -3.0, -6.0], observed.shape[1]
        )
        return np.tile(self.budget[self.task.channels.group] * 10.0**powers, (len(observed), 1))


class RecklesslyPaced(Paced):
    """`Paced` at prices of `Reckless`."""

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.pacing = Reckless(task, self.pacing.budget)


@dataclasses.dataclass(frozen=True)
class Known(Penetration):
    """Half of the vehicles are connected, in every world the same but for the first of them.

    Attributes:
        worlds: Whether the first is connected in either world.
    """

    worlds: tuple[bool, bool] = (True, True)

    def _uniform(self, traffic_seed, stream, n):
        uniform = super()._uniform(COMMON, stream, n)
        if stream == 0 and traffic_seed != COMMON:
            uniform[:1] = 0.0 if self.worlds[traffic_seed % 2] else 1.0
        return uniform


class Silence:
    """In place of noise: keeps what it would be added to, and its deviations."""

    def reset(self, episodes, generators):
        """Nothing is drawn."""

    def added(self, episodes, values, sigma, unit):
        self.sums, self.sigma = values.copy(), sigma.copy()
        return values


class Eavesdropper:
    """Hears every release of a process of one episode, and adds up how far two worlds are apart.

    Attributes:
        square: Squared distance of the true sums so far, in units of the noise.
    """

    def __init__(self, config, records):
        self.process = QueryProcess(config, library=Worlds(*records))
        self.copies = make_release(config, 4, self.process.traffic)
        self.copies.noise = Silence()
        self.process.traffic.load(np.arange(len(records)))
        self._released = self.process.release.release
        self.process.release.release = self._release

    def begin(self, world, traffic, seed):
        """Begin an episode of one of the two worlds; `traffic` are the records of the copies."""
        self.square, self.traffic = Fraction(), np.array(traffic)
        self.copies.reset(np.arange(4), [np.random.default_rng()] * 4)
        options = {"traffic_seed": int(traffic[world])}
        self.process.reset(ONE, [np.random.default_rng(seed)], options)

    def _release(self, request):
        made = request.prediction()
        four = [np.repeat(each, 4, axis=0) for each in made]
        released = self._released(request._replace(prediction=lambda: made))
        self.copies.release(
            Request(
                np.arange(4),
                self.traffic,
                np.repeat(request.times, 4),
                np.repeat(request.observed, 4, axis=0),
                lambda: Estimate(*four),
            )
        )
        sums, sigma = self.copies.noise.sums, self.copies.noise.sigma
        np.testing.assert_array_equal(sigma, np.broadcast_to(sigma[:1], sigma.shape))
        differences = np.where(released.observed[0][:, None], sums[1::2] - sums[::2], 0.0)
        # Other vehicles cancel, bit for bit.
        np.testing.assert_array_equal(*differences)
        for at in zip(*np.nonzero(differences[0]), strict=True):
            self.square += up((Fraction(differences[0][at]) / Fraction(sigma[0][at])) ** 2)
        return released


def up(number):
    """A fraction, rounded up so little that it does not matter: it keeps sums of them short."""
    return Fraction(math.ceil(number * 2**200), 2**200)


def configuration(one_of):
    """A configuration of a short road, of choices that a function makes."""
    is_paced, adjacency = one_of(True, True, False), one_of("replace", "add_remove")
    sensors, estimator = one_of((), (1,), (5, 7), (0, 1, 6)), one_of(*ESTIMATORS)
    # The weights were trained on a limit of 102 km/h, and on sums over two segments at most.
    limit, span = (102.0, 2) if estimator == "recurrent" else (one_of(102.0, 100.7), 3)
    given = {
        "epsilon": one_of(0.5, 5.0, 20.0),
        "delta": one_of(0.05, 1e-12),
        "adjacency": adjacency,
        "boundary_inputs": one_of("nominal", "private", "true"),
    }
    if is_paced:
        privacy = PacedSettings(
            one_of("paced", RecklesslyPaced),
            **given,
            unit=one_of("trip", "trip", "event"),
            clip=one_of(7.3, 25.0, 150.0),
            ratio=one_of(0.3, 1.0) if adjacency == "replace" else one_of(1.0, 30.0),
        )
        options = {
            "query_spans": one_of((1,), (2,), (1, 2), (1, 2, 3)[:span]),
        }
    else:
        unit, cap = one_of(("trip", 7), ("trip", 1), ("trip", HORIZON), ("event", 1))
        privacy = CappedSettings(**given, unit=unit, cap=cap, share=one_of(0.1, 0.5, 0.8))
        options = {}
    if one_of(True, False):
        # Whether the vehicle is connected may differ, too, as it does between vehicles.
        connected = one_of((True, True), (True, False), (False, sensors == ()))
        worlds = connected if privacy.unit != "event" else connected[:1] * 2
        wrong = one_of({}, {"misreporting": 0.5, "misreport_factor": 0.6})
        options["penetration"] = Known(share=0.5, worlds=worlds, **wrong)
    if sensors and one_of(True, False):
        options["sensor_settings"] = one_of(
            SensorSettings(dropout=0.3), SensorSettings(budget_share=0.6)
        )
    return EnvConfig(
        corridor=ROAD.replaced(fixed_sensors=sensors, speed_limit=limit),
        estimator=estimator,
        privacy=privacy,
        bandwidth=one_of(1, 3, 6),
        bandwidth_unit="sums",
        horizon=HORIZON,
        random_start=one_of(True, False),
        traffic_seeds=tuple(range(COMMON + 1)),
        **options,
    )


def jumps(generator, n_vehicles=1):
    """Vehicles anywhere in every second, at speeds that deviate most, or at any."""
    shape = n_vehicles, DURATION + 1
    speeds = generator.choice([0.0, 51.0, 150.0, *generator.uniform(0.0, 130.0, 2)], shape)
    return generator.integers(AWAY, PLACES, shape), speeds


def stands(generator):
    """A vehicle that stays where it is."""
    place, speed = (
        generator.integers(ROAD.geometry.n_mainline),
        generator.choice([0.0, 51.0, 150.0]),
    )
    return np.full((1, DURATION + 1), place), np.full((1, DURATION + 1), speed)


def nobody(generator, n_vehicles=1):
    """A vehicle that is never there."""
    return np.full((1, DURATION + 1), AWAY), np.zeros((1, DURATION + 1))


@cache
def simulated():
    """The vehicles of a record of SUMO, places and speeds (V, T + 1)."""
    whole = RecordLibrary().get(SHORT_HIGHWAY, 0)
    places = np.full((whole.n_vehicles, whole.n_steps), AWAY)
    speeds = np.zeros(places.shape)
    places[whole.vehicle, whole.step] = whole.segment
    speeds[whole.vehicle, whole.step] = whole.speed
    return places, speeds


def drives(generator, n_vehicles=1):
    """Vehicles of a record of SUMO, at a time when there are some."""
    first = generator.integers(simulated()[0].shape[1] - DURATION)
    places, speeds = (table[:, first : first + DURATION + 1] for table in simulated())
    there = generator.permutation(np.flatnonzero((places != AWAY).any(axis=1)))[:n_vehicles]
    return places[there], speeds[there]


TRIPS, OTHERS = (jumps, stands, drives), (jumps, drives, nobody)


def adjacent_trips(config, kinds, generator):
    """The trip of a vehicle in either world: its places and speeds, (1, T + 1) each."""
    zero, one = (kind(generator) for kind in kinds)
    if config.privacy.adjacency == "add_remove":
        is_shown = getattr(config.penetration, "worlds", (True, True))
        one = zero if is_shown[0] != is_shown[1] else nobody(generator)
    if config.privacy.unit == "event":
        own = np.arange(DURATION + 1) != generator.integers(1, HORIZON + 1)
        one = tuple(np.where(own, *each) for each in zip(zero, one, strict=True))
    return zero, one


def records_of(trips, others, generator):
    """Records by traffic seed: the vehicle and others, the vehicle alone, and a common one."""
    tables = [
        *([np.concatenate(pair) for pair in zip(trip, others, strict=True)] for trip in trips),
        *trips, jumps(generator, 20),
    ]  # fmt: skip
    return [record(*table, PLACES) for table in tables]


def plan(config, trips, likely, generator):
    """Flags of the options that are asked in each second, (T + 1, G): where the vehicle is, or
    some, each as likely."""
    options = config.queries
    asked = generator.random((DURATION + 1, options.n_queries)) < likely
    if likely == 0.0:
        places = np.concatenate([places for places, _ in trips])
        covers = np.pad(options.covers, [(0, 0), (0, PLACES + 1 - options.n_mainline)])
        asked = covers[:, places].any(axis=1).T  # `AWAY` is the last column, which none covers
    return asked.astype(np.int8)


def distances(config, records, wanted, seed):
    """Play episodes of either world, and of a common record; return the squares over mu^2."""
    heard, found = Eavesdropper(config, records), []
    process = heard.process
    account, claimed = process.privacy(), mu_of(config.privacy.epsilon, config.privacy.delta)
    mu = min(Fraction(account["mu"]), Fraction(claimed))
    if getattr(config.penetration, "worlds", None) == (False, False):  # sensors alone see it
        mu = min(mu, Fraction(account["groups"][-1]["mu"]))
    for world, traffic in ((0, [0, 1, 2, 3]), (1, [COMMON] * 4), (1, [0, 1, 2, 3])):
        heard.begin(world, traffic, seed)
        assert process.info(0)["spent_mu"] == 0.0
        for _ in range(HORIZON):
            process.step(ONE, wanted[process.time + 1])
            spent = process.info(0)["spent_mu"]
            assert heard.square <= min(Fraction(spent), mu) ** 2
            assert spent <= account["mu"]
        found.append(heard.square / mu**2)
    assert found[1] == 0
    return found


FAST, SLOW = range(6), range(6, 100)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of filters that diverge, as they may
@pytest.mark.parametrize("number", fast_and_slow([*FAST, *SLOW], FAST))
def test_no_two_worlds_are_further_apart_than_what_is_spent(number):
    """Eight choices of mechanism, queries, sensors, estimator and trips, and so on, each."""
    for each in range(8):
        generator = np.random.default_rng((number, each))

        def one_of(*values, draw=generator.integers):
            return values[draw(len(values))]

        config = configuration(one_of)
        kinds, likely = (one_of(*TRIPS), one_of(*TRIPS, nobody)), one_of(0.0, 0.3, 1.0)
        trips = adjacent_trips(config, kinds, generator)
        records = records_of(trips, one_of(*OTHERS)(generator, 30), generator)
        distances(config, records, plan(config, trips, likely, generator), number)


def alike_trips(config, generator):
    """The trip of a vehicle in either world, as in `adjacent_trips`, with the same readings."""
    zero, one = alike_to_loops(config.corridor, 1, generator)
    face, upstream_end = config.corridor.loops.faces(ROAD.geometry)[0], ROAD.geometry.n_segments
    is_before = [(trip[0] < face) | (trip[0] == upstream_end) for trip in (zero, one)]
    if config.privacy.adjacency == "add_remove":
        is_shown = getattr(config.penetration, "worlds", (True, True))
        if is_shown[0] != is_shown[1]:
            one = zero  # it leaves its reports out
        else:
            zero, one = (np.where(is_before[0], zero[0], AWAY), zero[1]), nobody(generator)
    if config.privacy.unit == "event":
        sides = np.concatenate(is_before)
        calm = [t for t in range(1, HORIZON) if np.unique(sides[:, t - 1 : t + 2]).size == 1]
        own = np.arange(DURATION + 1) != generator.choice(calm)
        one = tuple(np.where(own, *each) for each in zip(zero, one, strict=True))
    return zero, one


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("number", fast_and_slow(range(40), range(2)))
def test_beside_loops_no_two_worlds_of_equal_readings_are_further_apart(number):
    """Centres, prices and the estimator read loops, and loops cost nothing."""
    found = []
    for each in range(6):
        generator = np.random.default_rng((number, each, 1))

        def one_of(*values, draw=generator.integers):
            return values[draw(len(values))]

        config = configuration(one_of)
        loops = Loops(
            (one_of(0.1, 0.3, 0.5),), interval=one_of(10, 12, 15), least_count=one_of(0, 3)
        )
        road, spans = config.corridor.replaced(loops=loops), {1, *config.query_spans}
        config = dataclasses.replace(config, corridor=road, query_spans=tuple(sorted(spans)))
        trips = alike_trips(config, generator)
        records = records_of(trips, one_of(*OTHERS)(generator, 30), generator)
        stations = Stations.of(loops, ROAD.geometry)
        np.testing.assert_array_equal(*(readings(each, stations, loops) for each in records[:2]))
        wanted = plan(config, trips, one_of(0.0, 0.3, 1.0), generator)
        found += distances(config, records, wanted, number)
    assert max(found) > 0.2


@pytest.mark.parametrize(
    ("privacy", "options"),
    [(CAPPED, {}), (PACED, {}), (CAPPED | {"boundary_inputs": "private"}, {"penetration": 0.5})],
)
def test_nobody_pays_for_a_loop_and_no_noise_grows(privacy, options):
    """Releases, ledgers and account are those without loops; until a reading also estimates."""
    loops = {"positions": [0.2, 0.5], "ramps": [2], "interval": 20}
    without, beside = (
        make_env(privacy=privacy, corridor={"fixed_sensors": [3]}, horizon=60, **options, **more)
        for more in ({}, {"loops": loops})
    )
    for env in (without, beside):
        env.reset(seed=0, options={"traffic_seed": 0})
    for second in range(1, 61):
        told, estimates = [], []
        for env in (without, beside):
            process = env.unwrapped.process
            *_, info = env.step(np.eye(6, dtype=np.int8)[second % 6])
            private = process.release.private(ONE, process.traffic_index)
            told.append([process.released, info["spent_mu"], private])
            estimates.append(process.estimate.density)
        if second < 20 or privacy != PACED:  # centres and prices follow what is known
            assert_same(*told)
        assert np.array_equal(*estimates) == (second < 20)


class AtOnce(Pacing):
    """Prices that leave a vehicle that deviates by the clip no more than is kept back for rounding.

    Then they try that, then far more, and in the end so little that a ledger does not notice.
    """

    def reset(self, episodes):
        self.parts = iter([1.0, ROUNDING, ROUNDING, 0.5])

    def prices(self, episodes, observed, density, speed):
        whole = self.budget[self.task.channels.group] / (1.0 + self.task.settings.ratio)
        return np.tile(next(self.parts, 2.0**-54) * whole, (len(observed), 1))


class PacedAtOnce(Paced):
    """`Paced` at prices of `AtOnce`."""

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.pacing = AtOnce(task, self.pacing.budget)


EXIT, FAST_ONE, NOBODY = ROAD.geometry.n_segments + 1, (1, 150.0), (AWAY, 0.0)
BOTH_SEE = {"penetration": Known(share=0.5), "sensor_settings": SensorSettings(budget_share=0.6)}
OVERLAPPING = {"query_spans": (1, 2)}
WORST = {
    "capped": (CappedSettings(cap=7, share=0.2), {}, (1, 0.0), FAST_ONE),
    "capped, a second, by queries and sensors": (
        CappedSettings(unit="event", adjacency="add_remove"), BOTH_SEE, (1, 0.0), NOBODY,
    ),
    "capped, every second, at the boundary": (
        CappedSettings(cap=HORIZON, boundary_inputs="private"), {}, (EXIT, 0.0), (1, 0.0),
    ),
    "paced": (PacedSettings(PacedAtOnce), {}, (1, 0.0), (3, 0.0)),
    "paced, by queries and sensors": (
        PacedSettings(PacedAtOnce, adjacency="add_remove"), BOTH_SEE, NOBODY, (1, 0.0),
    ),
    "paced, a second, by overlapping queries": (
        PacedSettings(unit="event", adjacency="add_remove"), OVERLAPPING, (1, 0.0), NOBODY,
    ),
}  # fmt: skip
"""Settings, keywords, and the place and speed at which the vehicle stands in either world."""


@pytest.mark.parametrize(("privacy", "options", "zero", "one"), WORST.values(), ids=WORST)
def test_the_worst_trips_are_as_far_apart_as_mu_and_no_further(privacy, options, zero, one):
    config = EnvConfig(
        corridor=ROAD.replaced(fixed_sensors=(1,) if options == BOTH_SEE else ()),
        estimator="open_loop",
        privacy=privacy,
        bandwidth=6,
        bandwidth_unit="sums",
        horizon=HORIZON,
        traffic_seeds=tuple(range(COMMON + 1)),
        **options,
    )
    seconds, generator = np.arange(DURATION + 1), np.random.default_rng(0)
    there = (seconds == 5) | (privacy.unit != "event")
    trips = [
        (np.where(there, place, AWAY)[None], np.full((1, seconds.size), speed))
        for place, speed in (zero, one)
    ]
    records = records_of(trips, jumps(generator, 30), generator)
    first, _, again = distances(config, records, plan(config, trips, 0.0, generator), 0)
    assert min(first, again) > 1.0 - 1e-7
