"""A door for a stream of one's own: readings in time or late, gaps, restarts and refusals."""

import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest

from dptse_env import RoadEstimator, Seen, probes, station
from dptse_env.estimators import ESTIMATORS, Estimator
from dptse_env.measurement.loops import interpreted
from dptse_env.measurement.seen import LONGEST
from dptse_env.utils import files
from tests.helpers import fast_and_slow

ROAD = "short-highway"
"""Six segments of .1 km, an on-ramp at face 2, an off-ramp at face 4."""
BORDERS = (0.0, 0.3, 0.6)


def make(estimator="random_walk", **keywords):
    """A road's estimator."""
    return RoadEstimator(ROAD, estimator, **keywords)


def loops(seed, until=None, seconds=60, borders=BORDERS):
    """Readings of loops at borders, drawn by a seed."""
    rng = np.random.default_rng(seed)
    return [
        station(
            km, count=int(rng.integers(5, 30)), speed=float(rng.uniform(20, 100)), seconds=seconds,
            until=until,
        )
        for km in borders
    ]  # fmt: skip


def bits(road, delay=0):
    """The estimates of a road, now or some seconds ago."""
    return np.stack(road.estimate(delay))


def played(road, until, every=60, late=0):
    """Have readings come in at the end of every interval, or late; return the road."""
    while road.time < until:
        ended = road.time + 1 - late
        comes = ended % every == 0 and ended > 0
        road.step(loops(ended, until=ended, seconds=every) if comes else ())
    return road


@pytest.mark.parametrize("seconds", [10, 60])
def test_an_interval_counts_alike_whenever_it_comes_in(seconds):
    at_once, in_time, late, blind = (make() for _ in range(4))
    at_once.step(loops(0, seconds=seconds), seconds=seconds)
    for _ in range(seconds - 1):
        in_time.step()
    in_time.step(loops(0, seconds=seconds))
    late.step(seconds=seconds + 10)
    for road in (at_once, in_time, blind):
        road.step(seconds=seconds + 11 - road.time)
    late.step(loops(0, until=seconds, seconds=seconds))
    assert (bits(at_once) == bits(in_time)).all()
    assert (bits(at_once) == bits(late)).all()
    assert (bits(at_once) != bits(blind)).any()


def test_an_estimate_with_a_delay_is_that_of_then_with_what_came_in_since():
    road = played(make("ekf"), 240)
    then = played(make("ekf"), 180)
    assert (bits(road, 60) == bits(then)).all()
    assert (bits(road, 30) != bits(played(make("ekf"), 210))).any()  # 240 said something of 210
    road.step(seconds=500)
    assert bits(road, LONGEST).shape == (4, 8)


def test_sources_of_a_second_are_put_together_by_their_variances():
    several, one = make(), make()
    several.step(
        [Seen(0.1, 0.2, 40.0, 80.0, 3.0, 5.0), Seen(0.1, 0.2, 70.0, None, 6.0, None)]
    )  # weights 4 : 1
    one.step([Seen(0.1, 0.2, 46.0, 80.0, np.sqrt(7.2), 5.0)])
    np.testing.assert_allclose(bits(several), bits(one), rtol=1e-12)


PLACES = [
    ((0.0, 0.0, None), [0]),
    ((0.1, 0.1, None), [0, 1]),
    ((0.2, 0.2, None), [2]),  # where the on-ramp is
    ((0.1985, 0.1985, None), [1]),
    ((0.4, 0.4, None), [4]),
    ((0.6, 0.6, None), [5]),
    ((0.26, 0.26, None), [2, 3]),
    ((0.16, 0.16, None), [1]),
    ((0.1, 0.3, None), [1, 2]),
    ((0.04, 0.16, None), [0, 1]),
    ((0.12, 0.14, None), [1]),
    ((0.0, 0.6, None), [0, 1, 2, 3, 4, 5]),
    ((0.0, 0.0, 2), [6]),
    ((0.1, 0.1, 4), [7]),
    ((0.02, 0.07, 4), [7]),
]


@pytest.mark.filterwarnings("ignore:.*lies within a segment")
def test_a_source_says_something_of_the_segments_at_its_place():
    blind = make()
    blind.step()
    for (*ends, ramp), segments in PLACES:
        road = make()
        road.step([Seen(*ends, speed=20.0, speed_std=1.0, ramp=ramp)])
        changed = np.flatnonzero(bits(road)[1] < bits(blind)[1])
        assert changed.tolist() == segments, (ends, ramp)


def test_adaptive_smoothing_reaches_over_half_the_distance_of_stations():
    blind, near = make("asm"), {"asm": {"length": 0.1}}
    blind.step()
    for keywords, reached in (
        ({}, 4),
        ({"stations": (0.0, 0.6)}, 6),
        ({"stations": np.array([0.0, 0.6])}, 6),
        ({"stations": (0.0, 0.6), "estimator_settings": near}, 4),
    ):
        road = make("asm", **keywords)
        road.step([Seen(0.0, 0.0, speed=20.0, speed_std=1.0)])
        assert np.count_nonzero(bits(road)[1, :6] < bits(blind)[1, :6] - 0.5) == reached


def test_the_loops_of_a_road_file_are_its_stations(tmp_path):
    path = tmp_path / "road.toml"
    text = ROAD_FILE.replace("[0, 0.1]", "[0, 0.3]").replace("n_mainline = 3", "n_mainline = 6")
    own_settings = "estimator_settings = { asm = { length = 0.2 } }"
    path.write_text(text.replace(own_settings, ""), encoding="utf-8")
    given, found, none = (
        RoadEstimator(str(path), "asm", **keywords).save()
        for keywords in ({"stations": (0.0, 0.3)}, {}, {"stations": ()})
    )
    assert given == found != none


def test_a_point_within_a_segment_is_said_to_count_at_its_border():
    with pytest.warns(UserWarning, match=r"^0\.26 km lies .* counts at its border at 0\.3 km$"):
        make().step(loops(0, borders=[0.26]), seconds=60)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make().step(loops(0, borders=[0.16, 0.3004]), seconds=60)


def test_what_is_said_at_an_end_enters_there_until_it_is_ten_minutes_old():
    said, none = make("open_loop"), make("open_loop")
    for road, seen in ((said, loops(3, borders=[0.0])), (none, [])):
        road.step(seen, seconds=60)
        road.step(seconds=LONGEST)
    assert abs(bits(said)[0, 0] - bits(none)[0, 0]) > 1.0
    for road in (said, none):
        road.step(seconds=LONGEST)
    np.testing.assert_allclose(bits(said)[0], bits(none)[0], atol=0.1)


def test_speeds_alone_say_nothing_of_what_enters():
    road, blind = make("open_loop"), make("open_loop")
    road.step([*loops(0, seconds=10), probes(0.0, 0.6, 20.0, vehicles=9, seconds=1)])
    blind.step(loops(0, seconds=10))
    for each in (road, blind):
        each.step(seconds=60)
    assert (bits(road) == bits(blind)).all()


@pytest.mark.parametrize("estimator", ["random_walk", "ekf"])
def test_an_interval_counts_once(estimator):
    said = Seen(0.0, 0.1, 40.0, 80.0, 2.0, 4.0, seconds=60)
    at_once, by_second = make(estimator), make(estimator)
    at_once.step([said], seconds=60)
    each = replace(said, seconds=1, density_std=2.0 * 60**0.5, speed_std=4.0 * 60**0.5)
    for _ in range(60):
        by_second.step([each])
    np.testing.assert_allclose(bits(at_once), bits(by_second), rtol=1e-9)


@pytest.mark.parametrize("estimator", ["random_walk", "ekf"])
def test_a_station_is_read_by_lanes_length_and_limit_of_the_road(estimator):
    by_flow, by_density, road = make(estimator), make(estimator), make().corridor.road
    by_flow.step([station(0.1, flow=2400.0, speed=45.0, seconds=60)], seconds=60)
    said = interpreted(
        np.array(2400.0), np.array(45.0), 60, road.lanes[0], road.lengths[0], road.limits[0]
    )
    alike = np.array([1.0, 1.0, 6.0**0.5, 6.0**0.5])  # told six times, with alike errors
    each = Seen(0.0, 0.2, *(np.array(said[:4]) * alike).tolist())
    for second in range(1, 61):
        by_density.step([each] if second % 10 == 6 else [])
    np.testing.assert_allclose(bits(by_flow), bits(by_density), rtol=1e-9)


ROAD_FILE = """
n_mainline = 3
exit_shares = []
duration = 60
average_dwell = 5.0
fixed_sensors = [0]
loops = { positions = [0, 0.1] }
demand = { mainline = [[0, 1000]], on_ramps = [] }
[environment]
estimator = "ekf"
estimator_settings = { asm = { length = 0.2 } }
parameters = "published"
privacy = "paced"
bandwidth = 2
query_spans = [1, 2]
penetration = 0.2
sensor_settings = { factor = 1.1 }
traffic_seeds = "0:3"
"""


def test_a_road_file_gives_road_parameters_and_settings_and_no_queries(tmp_path):
    path = tmp_path / "road.toml"
    path.write_text(ROAD_FILE, encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing is taken from another road
        road = RoadEstimator(str(path), "asm")
    assert road.model.parameters.name == "published"
    settings = {"asm": {"length": 0.2}}
    same = RoadEstimator(road.corridor, "asm", parameters="published", estimator_settings=settings)
    same.load(road.save())
    road.step([Seen(0.0, 0.3, 40.0, 80.0, 5.0, 5.0)])
    assert bits(road).shape == (4, 3)


def test_what_comes_in_after_a_long_gap_counts_at_its_end_alone():
    at_once, by_second = (played(make(), 120) for _ in range(2))
    at_once.step(loops(4, seconds=600), seconds=900)
    for _ in range(899):
        by_second.step()
    by_second.step(loops(4, seconds=600))
    assert (bits(at_once) == bits(by_second)).all()


def test_late_data_go_back_only_as_far_as_needed(monkeypatch):
    road, steps, predict = played(make(), 900), [], Estimator.predict
    monkeypatch.setattr(Estimator, "predict", lambda *args: steps.append(1) or predict(*args))
    for age in (0, 7, 100, 540):
        steps.clear()
        road.step(loops(age, until=road.time + 1 - age))
        assert 55 + age <= len(steps) <= 1.15 * (60 + age) + 8  # the first of six is told in 5


def test_memory_is_bounded():
    road = played(make(), 1400)
    size = len(pickle.dumps(road))
    assert 0.7 * size < len(pickle.dumps(played(road, 2100))) < 1.3 * size


# Restarts


@pytest.mark.parametrize("estimator", fast_and_slow(ESTIMATORS, ["enkf", "mhe", "recurrent"]))
def test_a_restart_gives_the_same_bits(estimator):
    road = played(make(estimator, start=1_700_000_003), 1_700_000_700)
    state = road.save()
    again = make(estimator)
    again.load(state)
    assert again.save() == state
    for each in (road, again):
        each.step(loops(5, until=1_700_000_400, seconds=120))
        played(each, 1_700_000_800)
    assert (bits(road) == bits(again)).all()
    assert (bits(road, LONGEST) == bits(again, LONGEST)).all()


def test_a_state_is_saved_ahead_of_the_first_step():
    road, again = make(), make(start=7)
    again.load(road.save())
    assert again.time == 0
    assert (bits(road) == bits(again)).all()


def flipped(state):
    """A state with a bit that fell over."""
    return state[:-5] + bytes([state[-5] ^ 1]) + state[-4:]


UNFIT = [
    (lambda: RoadEstimator("paper-highway", "asm"), bytes, r"^state\.road must be"),
    (lambda: make("ekf"), bytes, r"^state\.estimator must be"),
    (lambda: make("asm", stations=(0.0, 0.6)), bytes, r"^state\.settings must be"),
    (lambda: make("asm", parameters="published"), bytes, r"^state\.settings must be"),
    (lambda: make("asm"), flipped, "^state is damaged, .*digest"),
    (lambda: make("asm"), lambda state: state[:1000], "^state is damaged"),
    (lambda: make("asm"), lambda _: b"", "^state is damaged"),
    (lambda: make("asm"), lambda _: "text", "^state must be the bytes that save"),
]


def test_a_state_that_does_not_fit_is_refused_and_nothing_is_lost():
    road = played(make("asm"), 130)
    before = road.save()
    for other, damage, message in UNFIT:
        state = damage(played(other(), 70).save())
        with pytest.raises(ValueError, match=message) as problem:
            road.load(state)
        assert "\n" not in str(problem.value)
        assert road.save() == before
    assert (bits(played(road, 200)) == bits(played(make("asm"), 200))).all()


def test_a_state_of_another_version_is_refused(monkeypatch):
    state = make().save()
    monkeypatch.setattr("dptse_env.road_estimator.code_version", lambda: "0.0.1+abc")
    with pytest.raises(ValueError, match=r"^state\.version must be 'abc', got"):
        make().load(state)


def forged(state, forge):
    """A state whose bytes of the estimator's memory are others, under a digest of their own."""
    card, arrays = files.parse_tensors(state, "state")
    del card["sha256"]
    memory = {name: forge(array) for name, array in arrays.items() if name.startswith("memory")}
    return files.dump_tensors({**arrays, **memory}, card, "state", 2**30)


@pytest.mark.parametrize(("estimator", "byte"), [("mhe", 63), ("asm", 127), ("recurrent", 255)])
def test_a_forged_state_is_refused_and_nothing_is_lost(estimator, byte):
    road = played(make(estimator), 70)
    before = road.save()
    with pytest.raises(ValueError, match=r"^state: memory\[\d+\] must be .*, got") as problem:
        road.load(forged(before, lambda array: np.full_like(array, byte)))
    assert "\n" not in str(problem.value)
    assert road.save() == before


@pytest.mark.parametrize("field", ["length", "active_set", "solved", "centre"])
def test_an_index_out_of_range_is_no_memory(field):
    estimator = make("mhe")._estimator
    place = [*estimator._windows._fields].index(field) + 3
    estimator.check_memory()
    estimator.memory[place][...] = -9
    with pytest.raises(ValueError, match=rf"^memory\[{place}\] must be in .*, got -9"):
        estimator.check_memory()


@pytest.mark.parametrize("problem", [KeyboardInterrupt, RuntimeError])
def test_a_step_or_a_restart_that_ends_early_changes_nothing(monkeypatch, problem):
    road, same = (played(make("ekf"), 130) for _ in range(2))
    before, other = road.save(), played(make("ekf"), 700).save()
    predict, steps = Estimator.predict, []

    def interrupted(*args):
        steps.append(1)
        if len(steps) % 30 == 0:
            raise problem
        predict(*args)

    for act in (
        lambda: road.step(loops(9)),
        lambda: road.step(loops(9), seconds=2000),
        lambda: road.load(other),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(Estimator, "predict", interrupted)
            with pytest.raises(problem):
                act()
        assert road.save() == before
    for each in (road, same):
        each.step(loops(9))
    assert (bits(road) == bits(same)).all()
    assert (bits(road, 100) == bits(same, 100)).all()


# Bad input


REFUSED = [
    ([Seen(0.1, 0.9, speed=90, speed_std=9)], r"seen\[0\]\.end must be .*, got 0\.9"),
    ([Seen(0.1, 0.1, speed=90, speed_std=9, ramp=3)], r"seen\[0\]\.ramp must be .*, got 3"),
    (loops(0, until=131), r"seen\[0\]\.until must be in 1\.\.130, .*, got 131"),
    (loops(0, until=0), r"seen\[0\]\.until must be in 1\.\.130, .*, got 0"),
    (loops(0) * 2, r"seen\[3\] must be the only reading of its station and interval"),
    ([*loops(0), (0.1, 0.2)], r"seen\[3\] must be .*, got \(0\.1, 0\.2\)"),
    (Seen(0.1, 0.1, speed=90, speed_std=9), "seen must be"),
    ("abc", r"seen\[0\] must be .*, got 'a'"),
    (None, "seen must be"),
]


def test_a_step_that_is_refused_changes_nothing():
    road = played(make(), 129)
    before = road.save()
    for seen, message in REFUSED:
        with pytest.raises(ValueError, match=f"^{message}") as problem:
            road.step(seen)
        assert "\n" not in str(problem.value)
        assert road.save() == before


def test_what_is_too_old_to_count_is_refused():
    road = played(make(), 900)
    before = road.save()
    with pytest.raises(ValueError, match=r"^seen\[0\]\.until must be in 302\.\.901, .*, got 301"):
        road.step(loops(0, until=301))
    with pytest.raises(ValueError, match=r"^seen\[0\]\.until must be in 8501\.\.9100, .* got 900"):
        road.step(loops(0, until=900), seconds=8200)
    assert road.save() == before
    road.step(loops(0, until=302, seconds=600))


def test_a_step_or_a_delay_of_no_seconds_is_refused():
    road = make()
    for seconds in (0, -1, 1.5, "1", None, float("nan"), 10**9):
        with pytest.raises(ValueError, match=r"^seconds must be an integer"):
            road.step(seconds=seconds)
    road.step(seconds=10)
    for delay in (-1, 11, 1.5, None):
        with pytest.raises(ValueError, match=r"^delay must be an integer in 0\.\.10, got"):
            road.estimate(delay)


class Forgetful(ESTIMATORS.find("random_walk")):
    """An estimator that does not say what it remembers, and so cannot go back."""

    _memory = Estimator._memory


KEYWORDS = [
    ({"start": 1.5}, "start must be"),
    ({"stations": 5}, "stations must be"),
    ({"stations": (0.5, 0.2)}, "stations must be"),
    ({"stations": (0.5, 0.7)}, r"stations must be .* 0\.\.0\.6 km, got"),
    ({"stations": (0.5, float("nan"))}, r"stations\[1\] must be .*, got nan"),
    ({"estimator": "no"}, "estimator must be"),
    ({"estimator": dict}, "estimator builtins:dict must be"),
    ({"estimator": Forgetful}, r"estimator must .*Forgetful"),
    ({"parameters": "no"}, "parameters must be"),
    ({"estimator_settings": {"no": 1}}, r"estimator_settings\.no is unknown"),
]


def test_keywords_are_refused_by_name():
    for keywords, message in KEYWORDS:
        with pytest.raises(ValueError, match=f"^{message}"):
            make(**keywords)
    for name in ("bandwidth", "privacy", "penetration", "seed"):
        with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'"):
            make(**{name: 1})
