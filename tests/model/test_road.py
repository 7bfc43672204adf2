"""A road as arrays, and the channels that are measured on it."""

import numpy as np
import pytest

from dptse_env.model import ARZModel
from tests.helpers import make_channels

from .oracle import CHANNELS, HIGHWAY, PUBLISHED


def test_a_channel_is_the_average_of_its_segments():
    values = np.random.default_rng(0).normal(size=(4, 19, 2))
    averages = ARZModel(HIGHWAY.road, PUBLISHED, 1.0, 51.0, CHANNELS).averages(values)
    for m, (first, span) in enumerate(zip(CHANNELS.first, CHANNELS.span, strict=True)):
        np.testing.assert_allclose(averages[:, m], values[:, first : first + span].mean(axis=1))
    single = ARZModel(HIGHWAY.road, PUBLISHED, 1.0, 51.0)
    np.testing.assert_array_equal(single.averages(values), values)


@pytest.mark.parametrize(("first", "span"), [(-1, 1), (18, 2), (3, 0), (19, 1)])
def test_a_channel_off_the_road_is_refused(first, span):
    channels = make_channels((0, first), (1, span))
    with pytest.raises(ValueError, match=r"model\.channels must cover segments in 0\.\.18"):
        ARZModel(HIGHWAY.road, PUBLISHED, 1.0, 51.0, channels)
