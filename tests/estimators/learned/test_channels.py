"""What the network is told of a second's releases: Kalman updates with independent errors."""

import numpy as np
import pytest

from dptse_env.estimators.learned.cells import make_cells
from dptse_env.estimators.learned.channels import (
    CHANNELS,
    LARGEST_CORRECTION,
    LARGEST_INNOVATION,
    Released,
    make_rows,
    read_rows,
)

from ..episodes import simulate
from ..rows import averaged

AT = {name: k for k, name in enumerate(CHANNELS)}


def read(episodes, observed, values, sigma, prior, centre=None, age=None):
    """The channels and innovations of one episode; `values` and `sigma` by row."""
    model = episodes.model
    M, S = model.rows.n_rows, model.n_segments
    table = np.zeros((3, 1, M, 2))
    for row, value, deviation in zip(observed, values, sigma, strict=True):
        table[0, 0, row], table[1, 0, row], table[2, 0, row] = 1.0, value, deviation
    centre = np.zeros((1, S)) if centre is None else np.full((1, S), centre)
    released = Released(table[0, ..., 0], table[1], table[2], centre)
    cells = make_cells(model)
    age = np.full((1, S), 7.0) if age is None else age
    x, innovations = read_rows(np, cells, make_rows(model.rows), released, prior, age)
    return x[0], innovations[0], cells


def prior(episodes, density=40.0, speed=80.0, density_std=10.0, speed_std=6.0):
    numbers = np.array([density, speed, density_std, speed_std])
    return np.broadcast_to(numbers, (1, episodes.model.n_segments, 4)).copy()


def kalman(mean, variances, H, value, noise):
    """The scalar update of independent states: gain and correction of each."""
    total = float(H**2 @ variances + noise**2)
    gain = variances * H / total
    return gain * (value - float(H @ mean)), gain * H


def test_a_speed_is_corrected_as_a_kalman_filter_would():
    episodes = simulate(n_steps=1)
    x, innovations, cells = read(
        episodes, [4], [(60.0, 95.0)], [(8.0, 3.0)], prior(episodes)
    )  # fmt: skip
    change, gain = kalman(np.array([40.0]), np.array([100.0]), np.ones(1), 60.0, 8.0)
    assert x[4, AT["density_correction"]] == pytest.approx(4.0 * change[0] / cells.unit[4])
    assert x[4, AT["density_gain"]] == pytest.approx(gain[0])
    change, gain = kalman(np.array([80.0]), np.array([36.0]), np.ones(1), 95.0, 3.0)
    assert x[4, AT["speed_correction"]] == pytest.approx(4.0 * change[0] / cells.limit)
    assert x[4, AT["speed_gain"]] == pytest.approx(gain[0])
    assert x[4, AT["density_correction_by_flow"]] == 0.0
    expected = [20.0 / np.hypot(10.0, 8.0), 15.0 / np.hypot(6.0, 3.0)]
    np.testing.assert_allclose(innovations[4], expected)
    np.testing.assert_allclose(
        x[4, [AT["density_innovation"], AT["second_innovation"]]], 0.5 * np.array(expected)
    )
    others = np.delete(x, 4, axis=0)
    assert not others[:, [AT["queried"], AT["density_gain"], AT["speed_correction"]]].any()
    assert x[4, AT["queried"]] == 1.0


def test_a_flow_over_two_cells_is_corrected_as_a_kalman_filter_would():
    episodes = averaged(1)
    rows = episodes.model.rows
    m = int(np.flatnonzero(rows.span == 2)[0])
    cover = np.arange(rows.first[m], rows.first[m] + 2)
    before = prior(episodes)
    before[0, cover[1]] = 70.0, 50.0, 12.0, 9.0
    centre = 60.0
    value = 1500.0
    x, _, cells = read(
        episodes, [m], [(60.0, value)], [(8.0, 200.0)], before, centre=centre
    )  # fmt: skip
    rho, v = before[0, cover, 0], before[0, cover, 1]
    share = np.full(2, 0.5)
    change, _ = kalman(rho, before[0, cover, 2] ** 2, share, 60.0, 8.0)
    np.testing.assert_allclose(x[cover, AT["density_correction"]], 4 * change / cells.unit[cover])
    # The row as a function of both densities and both speeds, linear at the prediction.
    H = 0.5 * np.concatenate([v - centre, rho])
    variances = np.concatenate([before[0, cover, 2] ** 2, before[0, cover, 3] ** 2])
    total = float(H**2 @ variances + 200.0**2)
    error = value - 0.5 * float(rho @ (v - centre))
    change = variances * H / total * error
    np.testing.assert_allclose(
        x[cover, AT["density_correction_by_flow"]], 4 * change[:2] / cells.unit[cover]
    )
    np.testing.assert_allclose(x[cover, AT["speed_correction"]], 4 * change[2:] / cells.limit)
    assert x[cover, AT["share"]].tolist() == [0.5, 0.5]


def test_what_is_far_off_is_held_to_a_range():
    episodes = simulate(n_steps=1)
    certain = prior(episodes, density_std=1e-3, speed_std=50.0)
    x, innovations, _ = read(episodes, [2], [(900.0, 9e5)], [(1e-3, 1e-3)], certain)
    assert x[2, AT["density_innovation"]] == 0.5 * LARGEST_INNOVATION
    assert x[2, AT["speed_correction"]] == 4.0 * LARGEST_CORRECTION
    assert innovations[2, 0] > 1e3
    assert np.isfinite(x).all()


def test_noise_and_age_are_told():
    episodes = simulate(n_steps=1)
    some = [(60.0, 95.0)]
    quiet, _, cells = read(episodes, [2], some, [(5.0, 5.0)], prior(episodes))
    loud, _, _ = read(episodes, [2], some, [(50.0, 50.0)], prior(episodes))
    for name in ("log_density_sigma", "log_second_sigma"):
        assert loud[2, AT[name]] - quiet[2, AT[name]] == pytest.approx(0.2 * np.log(10.0))
    assert quiet[2, AT["log_density_sigma"]] == pytest.approx(0.2 * np.log(5.0 / cells.unit[2]))
    assert quiet[5, AT["log_age"]] == pytest.approx(0.25 * np.log(8.0))
    assert loud[2, AT["density_gain"]] < quiet[2, AT["density_gain"]]
