"""The ensemble Kalman filter beside its reference, and its options."""

import numpy as np
import pytest

from dptse_env.estimators import (
    BACKENDS,
    EnsembleSettings,
    EstimatorSettings,
)
from dptse_env.estimators.enkf import gaspari_cohn, make_tapers
from dptse_env.model import ARZModel
from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY
from tests.helpers import UNEVEN, make_channels, pairwise
from tests.model.oracle import W99

from .helpers import RICH, simulate, started, step

OPTIONS = {
    "rich": {name: getattr(RICH, name) for name in ("demand", "vehicle_noise", "flicker")},
    "taper": {"enkf": EnsembleSettings(inflation=1.02, taper=0.35, n_members=31)},
    "inflation": {"enkf": EnsembleSettings(inflation=1.1)},
    "plain": {},
}


@pytest.mark.parametrize(
    ("release", "bounds", "options"),
    pairwise(["rows", "uneven", "flow", "speed"], ["cone", "box"], OPTIONS, rest=False),
)
def test_it_takes_the_steps_of_its_reference(release, bounds, options):
    """Both draw the same numbers."""
    parameters = "published" if release == "speed" else "w99-3lane"
    road = {"road": UNEVEN} if release == "uneven" else {"release": release}
    episodes = simulate(parameters, n=2, n_steps=25, **road)
    settings = EstimatorSettings(bounds=bounds, **OPTIONS[options])
    compiled, reference = (started("enkf", each, episodes, settings) for each in BACKENDS)
    unit = compiled.model.state_scale
    for k in range(25):
        for filters in (compiled, reference):
            step(filters, episodes, k)
        np.testing.assert_allclose(compiled.members / unit, reference.members / unit, atol=1e-9)
        np.testing.assert_allclose(compiled.innovations, reference.innovations, atol=1e-6)
        np.testing.assert_allclose(compiled.covariances, reference.covariances, atol=1e-9)
        for a, b in zip(compiled.estimate(), reference.estimate(), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
        assert not np.any(compiled.diverged | reference.diverged)
        if bounds == "box":  # leaves psi / rho without a bound, and there rounding grows
            for each, members in zip(reference.filters, compiled.members, strict=True):
                each.members = members / unit
    assert (compiled.innovations[episodes.observed[24]] != 0.0).all()
    np.testing.assert_array_equal(compiled.innovations[~episodes.observed[24]], 0.0)


# Options ------------------------------------------------------------------------------------------


def test_a_taper_leaves_a_definite_s_where_a_few_members_do_not():
    """Known exactly, 22 outputs of 4 members have no definite S: flagged, not solved."""
    episodes = simulate(n_steps=1, release="rows")
    only = (np.arange(episodes.model.channels.size) % 4 == 0)[None]
    for taper, diverges in ((None, True), (0.2, False)):
        enkf = EnsembleSettings(n_members=4, taper=taper)
        for backend in BACKENDS:
            filters = started("enkf", backend, episodes, EstimatorSettings(enkf=enkf))
            step(filters, episodes, 0, observed=only, sigma=np.zeros(2))
            np.testing.assert_array_equal(filters.diverged, diverges)
            assert np.isfinite(filters.members).all()


def test_gaspari_cohn_is_a_convolution_of_tents():
    """Eq. 4.10 is the self-convolution over space of a tent of half the reach, normalised."""
    # In three dimensions, along an axis: integrate tent(|r|) tent(|r - d|) over cylinders.
    half, width = 0.5, 0.01
    z = np.arange(-0.5 + width / 2, 1.5, width)
    z, radius = np.meshgrid(z, np.arange(width / 2, 0.5, width))

    def overlap(distance):
        tent = np.maximum(0.0, 1.0 - np.hypot(z, radius) / half)
        other = np.maximum(0.0, 1.0 - np.hypot(z - distance, radius) / half)
        return np.sum(tent * other * radius)

    distances = np.linspace(0.0, 1.5, 16)
    expected = [overlap(d) / overlap(0.0) for d in distances]
    np.testing.assert_allclose(gaspari_cohn(distances, 1.0), expected, atol=2e-3)
    np.testing.assert_array_equal(gaspari_cohn(distances[distances >= 1.0], 1.0), 0.0)


@pytest.mark.parametrize("reach", [0.05, 0.3, 2.0])
def test_weights_of_channels_and_states_are_averages_and_positive_semidefinite(reach):
    """Jointly with those among the components, at the segments and the factors' entries."""
    # On-ramp at face 2, off-ramp at face 4, segments of 0.1 km.
    places = [0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.2, 0.4]
    np.testing.assert_allclose(SHORT_HIGHWAY.road.position, places)
    channels = make_channels((0, 0, 1, 4, 8, 9, 12), (1, 2, 3, 5, 2, 3, 3))
    model = ARZModel(PAPER_HIGHWAY.road, W99, 1.0, 51.0, channels, True)
    x, weights = model.road.position, make_tapers(model, reach)
    cells = np.concatenate([np.repeat(np.arange(19), 2), model.road.entries])
    among = gaspari_cohn(np.abs(x[:, None] - x), reach)
    states = among[np.ix_(cells, cells)]
    np.testing.assert_allclose(weights.with_states[2], states[2:8:2].mean(axis=0), atol=1e-14)
    np.testing.assert_allclose(weights.among_channels[2, 3], among[1:4, 4:9].mean(), atol=1e-14)
    joint = np.block(
        [[states, weights.with_states.T], [weights.with_states, weights.among_channels]]
    )
    np.testing.assert_allclose(joint, joint.T, atol=1e-15)
    assert np.linalg.eigvalsh(joint).min() > -1e-12
