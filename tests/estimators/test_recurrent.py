"""The recurrent network beside the one that is trained; what it is told, and what it gives."""

import hashlib

import numpy as np
import pytest

from dptse_env.estimators import Measurement
from dptse_env.estimators.recurrent import (
    member_for,
    read_network,
    shipped_networks,
    write_network,
)
from dptse_env.estimators.recurrent_kernels import (
    CHANNELS,
    LARGEST_CORRECTION,
    LARGEST_INNOVATION,
    LOWEST_SPREAD,
    make_cells,
    read,
)
from tests.hostile import check_hostile, edited

from .helpers import card, network_settings, random_network, run, simulate, started, step

torch = pytest.importorskip("torch")

from agents.filters import collecting, torch_network  # noqa: E402

AT = {name: k for k, name in enumerate(CHANNELS)}


def of_network(episodes, folder, network=None, **ranges):
    """The estimator of a network that is written into a folder."""
    settings = network_settings(folder, network, **ranges)
    return started("recurrent", "compiled", episodes, settings)


# Beside the network that is trained ---------------------------------------------------------------


class Twin:
    """The network that is trained, in double precision, on the episodes of an estimator."""

    def __init__(self, estimator):
        self.model, self.cells, n = estimator.model, estimator.cells, estimator.n_episodes
        self.network = torch_network.RecurrentNetwork(estimator.saved.network.width)
        self.network.take(estimator.saved.network)
        upstream = torch.zeros(2 * (self.model.n_segments,))
        upstream[self.cells.edges[:, 1], self.cells.edges[:, 0]] = 1.0
        rows = collecting.make_rows(self.model.rows)
        self.road = torch_network.Road(
            unit=torch.from_numpy(self.cells.unit),
            limit=self.cells.limit,
            flows=torch.full((n, 1), float(self.cells.flows)),
            fixed=torch.from_numpy(self.cells.fixed).expand(n, -1, -1),
            rows=collecting.Rows(*(torch.from_numpy(part).expand(n, *part.shape) for part in rows)),
            upstream=upstream,
            scales=(1.0, 1.0),
            n_mainline=self.model.network.n_mainline,
        )
        said = estimator.estimate()
        start = [said.density, said.speed, said.density_std, said.speed_std]
        self.state = self.network.begin(torch.from_numpy(np.stack(start, -1)))

    def step(self, inputs, given):
        """Return the estimates and deviations after a step, and before the next `(n, S, 4)`."""
        tensors = (torch.from_numpy(part) for part in collecting.make_released(given))
        outside = torch.from_numpy(collecting.input_channels(self.cells, inputs))
        released = collecting.Released(*tensors)
        with torch.no_grad():
            self.state = self.network(self.road, released, outside, self.state)
            tables = self.network.read(self.road, self.state.hidden)
        return [table.numpy() for table in tables]


@pytest.fixture
def _double():
    before, n_threads = torch.get_default_dtype(), torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    yield
    torch.set_default_dtype(before)
    torch.set_num_threads(n_threads)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize(("release", "width"), [("speed", 8), ("flow", 20), ("rows", 8)])
def test_it_is_the_network_that_is_trained(release, width, tmp_path):
    """Messages are all of the hidden state, or a part of it, in single precision."""
    episodes = simulate(n=3, n_steps=40, release=release)
    estimator = of_network(episodes, tmp_path, random_network(width))
    twin = Twin(estimator)
    for k in range(40):
        step(estimator, episodes, k)
        given = Measurement.of(episodes.model, **episodes.released(k, episodes.everyone))
        present, ahead = twin.step(episodes.inputs[k], given)
        np.testing.assert_allclose(estimator.hidden, twin.state.hidden, atol=1e-5)
        np.testing.assert_allclose(estimator.means, present[..., :2], rtol=1e-5, atol=1e-3)
        said = estimator.estimate()
        np.testing.assert_allclose(said.density_std, present[..., 2], rtol=1e-4)
        np.testing.assert_allclose(said.speed_std, present[..., 3], rtol=1e-4)
    estimator.predict(episodes.everyone, episodes.inputs[0])
    np.testing.assert_allclose(estimator.means, ahead[..., :2], rtol=1e-5, atol=1e-3)
    assert np.abs(estimator.hidden).max() > 0.5
    assert not estimator.diverged.any()


# What it is told ----------------------------------------------------------------------------------


def told(episodes, row, values, sigma, prior, centre=0.0, age=7.0):
    """Return the channels of each cell, the row's innovations, and the cells."""
    model, S = episodes.model, episodes.model.n_segments
    cells, shape = make_cells(model), (1, model.rows.n_rows, 2)
    observed, innovations = np.zeros(shape[:2], bool), np.zeros(shape)
    observed[0, row] = True
    x = np.zeros((1, S, len(CHANNELS)), dtype=np.float32)
    read(
        cells, np.arange(1), observed, np.broadcast_to(values, shape).astype(float),
        np.broadcast_to(sigma, shape).astype(float), np.full((1, S), centre),
        np.ones((1, model.n_inputs)), prior, np.full((1, S), age), innovations, x,
    )  # fmt: skip
    return x[0], innovations[0, row], cells


def prior_of(episodes, density=40.0, speed=80.0, density_std=10.0, speed_std=6.0):
    numbers = np.array([density, speed, density_std, speed_std])
    return np.broadcast_to(numbers, (1, episodes.model.n_segments, 4)).copy()


def test_a_flow_over_two_cells_is_corrected_as_a_kalman_filter_would():
    episodes = simulate(n_steps=1, release="rows")
    rows, prior, value = episodes.model.rows, prior_of(episodes), 1500.0
    m = int(np.flatnonzero(rows.span == 2)[0])
    cover = np.arange(rows.first[m], rows.first[m] + 2)
    prior[0, cover[1]] = 70.0, 50.0, 12.0, 9.0
    x, innovations, cells = told(episodes, m, (60.0, value), (8.0, 200.0), prior, centre=60.0)
    rho, v = prior[0, cover, 0], prior[0, cover, 1]
    variances = prior[0, cover, 2] ** 2, prior[0, cover, 3] ** 2
    close = {"rtol": 1e-6}
    total = 0.25 * variances[0].sum() + 8.0**2
    gain = 0.5 * variances[0] / total
    expected = 4 * gain * (60.0 - rho.mean()) / cells.unit[cover]
    np.testing.assert_allclose(x[cover, AT["density_correction"]], expected, **close)
    np.testing.assert_allclose(x[cover, AT["density_gain"]], 0.5 * gain, **close)
    assert innovations[0] == pytest.approx((60.0 - rho.mean()) / np.sqrt(total))
    # The row as a function of both densities and both speeds, linear at the prediction.
    H, joint = 0.5 * np.concatenate([v - 60.0, rho]), np.concatenate(variances)
    total = float(H**2 @ joint + 200.0**2)
    error = value - 0.5 * float(rho @ (v - 60.0))
    change = joint * H / total * error
    by_flow = 4 * change[:2] / cells.unit[cover]
    np.testing.assert_allclose(x[cover, AT["density_correction_by_flow"]], by_flow, **close)
    by_speed = 4 * change[2:] / cells.limit
    np.testing.assert_allclose(x[cover, AT["speed_correction"]], by_speed, **close)
    assert innovations[1] == pytest.approx(error / np.sqrt(total))
    assert x[cover, AT["share"]].tolist() == [0.5, 0.5]


def test_what_is_far_off_is_held_to_a_range():
    episodes = simulate(n_steps=1)
    certain = prior_of(episodes, density_std=1e-3, speed_std=50.0)
    x, innovations, _ = told(episodes, 2, (900.0, 9e5), (1e-3, 1e-3), certain)
    assert x[2, AT["density_innovation"]] == 0.5 * LARGEST_INNOVATION
    assert x[2, AT["speed_correction"]] == 4.0 * LARGEST_CORRECTION
    assert innovations[0] > 1e3
    assert np.isfinite(x).all()


# What it gives ------------------------------------------------------------------------------------


def test_news_travel_from_cell_to_cell(tmp_path):
    """One cell a second, in both directions and along ramps."""
    episodes = simulate(n_steps=1)
    pair = [of_network(episodes, tmp_path) for _ in range(2)]
    n = episodes.model.n_segments
    sparsity = np.eye(n, dtype=bool)
    for start, end in episodes.model.layout.edges:
        sparsity[start, end] = sparsity[end, start] = True
    observed = np.zeros_like(episodes.observed[0])
    reached = np.arange(n) == 8
    for second in range(4):
        observed[0, 8] = second == 0
        for estimator, shift in zip(pair, (0.0, 30.0), strict=True):
            step(estimator, episodes, 0, observed=observed, values=episodes.values[0] + shift)
        a, b = (estimator.estimate().density[0] for estimator in pair)
        np.testing.assert_array_equal(np.abs(a - b) > 1e-9, reached)
        reached = sparsity @ reached


def test_deviations_and_estimates_stay_in_their_range(tmp_path):
    episodes = simulate(n_steps=30)
    network = random_network()
    network = network._replace(heads_bias=np.array([90, 90, -90, 90] * 2, dtype=np.float32))
    estimator = of_network(episodes, tmp_path, network)
    run(estimator, episodes, range(30))
    estimate, unit = estimator.estimate(), estimator.cells.unit
    np.testing.assert_allclose(estimate.density[0], 4.0 * unit)
    np.testing.assert_allclose(estimate.speed, 1.1 * episodes.model.network.speed_limit)
    np.testing.assert_allclose(estimate.density_std[0], unit * np.exp(LOWEST_SPREAD))


def test_a_road_outside_of_the_card_is_refused_unless_asked(tmp_path):
    episodes, rows = simulate(n_steps=1), simulate(n_steps=1, release="rows")
    for given, ranges, message in (
        (episodes, {"n_mainline": [3, 9]}, r"trained on n_mainline in \[3, 9\].* has \[15, 15\]"),
        (rows, {"span": [1, 2]}, r"trained on span in \[1, 2\], .* has \[1, 3\]"),
        (episodes, {"flows": [1, 1]}, r"trained on flows in \[1, 1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            of_network(given, tmp_path, **ranges)
        of_network(given, tmp_path, outside=True, **ranges)


# Files of networks --------------------------------------------------------------------------------

DIGESTS = {
    "highway-flows": ("a7cd6a7d0da0", "463df28b4d90"),
    "highway-speeds": ("98c08e7ad753", "2bb2c4ca118a"),
    "long-highway-flows": ("0718f2eebe91", "af13a07e0dc6"),
}
"""The first digits of the digests of the files before they were converted, and of their weights."""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "network.safetensors"
    write_network(path, random_network(), card())
    return path


def test_what_is_written_is_read(path, tmp_path):
    saved = read_network(str(path))
    for name, array in random_network()._asdict().items():
        np.testing.assert_array_equal(getattr(saved.network, name), array)
    assert {key: value for key, value in saved.card.items() if key != "sha256"} == card()
    write_network(tmp_path / "again.safetensors", random_network(), card())
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()


def test_the_weights_that_ship_are_those_that_were_recorded():
    digests = {}
    for name in shipped_networks():
        saved, content = read_network(name), hashlib.sha256()
        for array in saved.network:
            content.update(array.tobytes())
        digests[name] = saved.card["converted_from"][:12], content.hexdigest()[:12]
    assert digests == DIGESTS


def test_a_pair_is_found_by_the_name_it_shares(tmp_path):
    source = str(tmp_path / "pair")
    single = f"{source}-flows.safetensors"
    write_network(single, random_network(), card())
    assert member_for(source, flows=True) == single
    assert member_for(source, flows=False) == source  # refused by the one who reads it
    assert member_for(single, flows=True) == single
    assert member_for("highway", flows=True) == "highway-flows"
    assert member_for("highway", flows=False) == "highway-speeds"
    with pytest.raises(ValueError, match=r"must be a file or one of highway, highway-flows, .*, g"):
        read_network("nowhere")


def test_damaged_files_are_refused(path, tmp_path):
    check_hostile(lambda path: read_network(str(path)), path, tmp_path / "bad.safetensors")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, a: a.update(heads=a["heads"][:, :7].copy()), "heads must be float32 of shape"),
        (lambda c, a: a.update(hidden=np.zeros((0, 0), "f4")), r"width must be in 1\.\.512, got 0"),
        (lambda c, a: a.update(hidden=np.array(1.0)), r"width must be in 1\.\.512, got 0"),
        (lambda c, a: c.update(format="recurrent-9"), "'recurrent-9', this version reads"),
        (lambda c, a: c.update(channels=["queried"]), "channels of format"),
        (lambda c, a: c.update(ranges={"lanes": [1, "2"]}), "'lanes' must be two numbers"),
    ],
)
def test_other_content_is_refused(change, message, path):
    path.write_bytes(edited(path, change))
    with pytest.raises(ValueError, match=rf"\.safetensors is not a saved network: .*{message}"):
        read_network(str(path))


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    network, path = random_network(), tmp_path / "x.safetensors"
    for bad, about in (
        (network._replace(heads=network.heads * np.float32(np.inf)), card()),
        (network._replace(heads=network.heads[:1]), card()),
        (network, {**card(), "format": "mine"}),
    ):
        with pytest.raises(ValueError, match=r"heads|format"):
            write_network(path, bad, about)
    assert not path.exists()
