"""Tasks: columns and places, lengths and limits."""

import numpy as np

from dptse_env.config import resolve
from dptse_env.parts import make_model, make_task
from dptse_env.release import Corrected, PrivacySettings, Queries
from tests.helpers import UNEVEN, MeanRelease, SumRelease

from .worlds import task_of


def task(boundary="nominal", preset=SumRelease, **keywords):
    privacy = {"preset": preset, "boundary_inputs": boundary}
    road = {"fixed_sensors": [5, 7, 2]}
    return make_task(resolve("short-plain", {"privacy": privacy, "corridor": road, **keywords}))


def test_channels_are_those_of_the_road_and_then_boundary_cells():
    plain, sums, private = task(), task(query_spans=(2,)), task("private", query_spans=(2,))
    assert [each.n_channels for each in (plain, sums, private)] == [8, 5 + 2 + 2, 5 + 2 + 2 + 4]
    assert [each.n_cells for each in (plain, sums, private)] == [8, 8, 12]
    assert plain.always.tolist() == [5, 7, 2]
    assert private.always.tolist() == [7, 6, 8, *range(9, 13)]
    np.testing.assert_allclose(private.channels.length, [0.2] * 5 + [0.1] * 8)
    observed = private.observed(np.isin(np.arange(5), [0, 2])[None])
    assert np.flatnonzero(observed).tolist() == [0, 2, *range(6, 13)]
    assert np.flatnonzero(private.covered(observed)).tolist() == [0, 1, 2, 3, 5]
    np.testing.assert_array_equal(private.covers.sum(axis=1), private.channels.span)
    assert np.flatnonzero(private.covers[2]).tolist() == [2, 3]


def test_a_channel_is_as_long_as_what_it_covers():
    settings = PrivacySettings("corrected", boundary_inputs="private")
    options = Queries.make(UNEVEN.geometry.n_mainline, 2)
    uneven = task_of(Corrected, settings, UNEVEN, options)
    np.testing.assert_array_equal(uneven.channels.length, UNEVEN.road.lengths)


def test_a_model_has_the_channels_and_the_centre_of_the_task():
    config = resolve("short-plain", {"privacy": SumRelease, "query_spans": (1, 2)})
    model, expected, road = make_model(config), make_task(config), config.corridor.geometry
    np.testing.assert_array_equal(model.channels.first, expected.channels.first)
    np.testing.assert_array_equal(model.channels.span, expected.channels.span)
    assert model.centre == expected.centre == 0.5 * road.speed_limit
    assert not task(preset=MeanRelease).releases_flow
