"""Loop detectors: readings, what they say of segments, and their place in the process."""

import numpy as np

from dptse_env.config import resolve
from dptse_env.process import QueryProcess

SEEDS = range(2000, 2004)


def error(**keywords):
    """Mean error of densities over some minutes without a query [veh/km]."""
    given = {"traffic_seeds": list(SEEDS), "horizon": 240, **keywords}
    process, every = QueryProcess(resolve("private-highway", given), 4), np.arange(4)
    streams = [np.random.default_rng(seed) for seed in SEEDS]
    process.reset(every, streams, {"traffic_seed": list(SEEDS), "start": 300})
    nothing, errors = np.zeros((4, 15), dtype=np.int8), []
    for _ in range(240):
        process.step(every, nothing)
        errors.append(process.error.density.mean())
    return float(np.mean(errors))


def test_readings_tell_the_estimator_of_the_traffic():
    loops = {"positions": [0.0, 0.5, 1.0, 1.5], "interval": 20}
    road = {"corridor": {"fixed_sensors": []}, "estimator": "recurrent"}
    assert error(**road, loops=loops) < 0.8 * error(**road)


def test_processes_that_share_loaded_traffic_read_the_same():
    loops, privacy = {"positions": [0.3], "interval": 20}, {"boundary_inputs": "nominal"}
    given = {"traffic_seeds": [0], "horizon": 60, "loops": loops, "privacy": privacy}
    first = QueryProcess(resolve("short-highway", given))
    second = QueryProcess(first.config, traffic=first.traffic)
    assert first.traffic.load([0]) == [0]
    for process in (first, second):
        process.reset(np.arange(1), [np.random.default_rng(0)])
    passed = first.traffic.readings[0, :, 0, 0]
    assert passed.min() >= 0 < passed.max()
    for _ in range(60):
        for process in (first, second):
            process.step(np.arange(1), np.ones((1, 6), dtype=np.int8))
        np.testing.assert_array_equal(first.estimate.density, second.estimate.density)
