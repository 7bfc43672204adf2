"""Tasks, and what is asked of release models."""

import dataclasses
import json

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.parts import make_model, make_task
from dptse_env.release import Corrected, PrivacySettings, QueryOptions, Task, check_released
from tests.helpers import UNEVEN, MeanRelease, PricedRelease, SumRelease

from .worlds import COLUMNS, ONE, Worlds, request, stays


def task(boundary="nominal", preset=SumRelease, **keywords):
    privacy = {"preset": preset, "boundary_inputs": boundary}
    road = {"fixed_sensors": [5, 7, 2]}
    return make_task(resolve("short-highway", {"privacy": privacy, "corridor": road, **keywords}))


def test_settings_default_to_the_paper_and_survive_json():
    settings = PrivacySettings()
    assert settings == PrivacySettings("paper", 1, 0.05)
    assert PrivacySettings(**json.loads(json.dumps(dataclasses.asdict(settings)))) == settings
    assert hash(settings) == hash(PrivacySettings())
    for two in (2, np.float64(2.0)):
        assert type(PrivacySettings(epsilon=two).epsilon) is float


def test_columns_are_rows_of_the_road_and_then_boundary_segments():
    plain, sums, private = task(), task(query_spans=(2,)), task("private", query_spans=(2,))
    assert [each.n_columns for each in (plain, sums, private)] == [8, 5 + 2 + 2, 5 + 2 + 2 + 4]
    assert [each.n_places for each in (plain, sums, private)] == [8, 8, 12]
    assert plain.always.tolist() == [5, 7, 2]
    assert private.always.tolist() == [7, 6, 8, *range(9, 13)]
    np.testing.assert_allclose(private.length, [0.2] * 5 + [0.1] * 8)
    observed = private.observed(np.isin(np.arange(5), [0, 2])[None])
    assert np.flatnonzero(observed).tolist() == [0, 2, *range(6, 13)]
    assert np.flatnonzero(private.covered(observed)).tolist() == [0, 1, 2, 3, 5]
    np.testing.assert_array_equal(private.covers.sum(axis=1), private.span)
    assert np.flatnonzero(private.covers[2]).tolist() == [2, 3]


def test_lengths_and_limits_are_those_of_what_a_column_covers():
    settings = PrivacySettings("corrected", boundary_inputs="private")
    options = QueryOptions.make(UNEVEN.n_mainline, 2)
    uneven = Task("corrected", Corrected, settings, UNEVEN, options, 60)
    every = UNEVEN.with_boundaries
    np.testing.assert_array_equal(uneven.length, every(UNEVEN.segment_lengths))
    np.testing.assert_array_equal(uneven.limit, every(UNEVEN.speed_limits))


def test_a_model_has_the_rows_and_the_centre_of_the_task():
    config = resolve("short-highway", {"privacy": SumRelease, "query_spans": (1, 2)})
    model, expected = make_model(config), make_task(config)
    np.testing.assert_array_equal(model.rows.first, expected.rows.first)
    np.testing.assert_array_equal(model.rows.span, expected.rows.span)
    assert model.reference_speed == expected.flow_centre == 0.5 * config.corridor.speed_limit
    assert not task(preset=MeanRelease).releases_flow


# --- release models of other packages --------------------------------------------------------


def released(**changes):
    """A model of another package, a good release of its, changed, and what was asked for."""
    release = Worlds(stays(0, 10.0)).started(PrivacySettings(preset="sums"), kind=PricedRelease)
    asked = request(1, np.arange(COLUMNS) > 0)
    return release, release.release(asked)._replace(**changes), asked


SHAPE = 1, COLUMNS
BAD = {
    "values of one quantity": ({"values": np.zeros((*SHAPE, 1))}, r"values of shape \(1, 12, 2\)"),
    "whole numbers": ({"values": np.zeros((*SHAPE, 2), dtype=int)}, "values of shape"),
    "one deviation": ({"sigma": np.ones(2)}, r"sigma of shape .*, got float64 of shape \(2,\)"),
    "a negative deviation": ({"sigma": np.full((*SHAPE, 2), -1.0)}, "standard deviations"),
    "an observed value that is none": ({"values": np.full((*SHAPE, 2), np.nan)}, "finite values"),
    "an answer not asked for": ({"observed": np.ones(SHAPE, dtype=bool)}, "not asked for"),
    "a flow without a centre": ({"centre": np.full(SHAPE, np.nan)}, "centres of flows"),
}


@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
def test_bad_releases_are_refused_by_path(changes, message):
    with pytest.raises(ValueError, match=rf"^privacy\.preset .*PricedRelease\.release.*{message}"):
        check_released(*released(**changes))


def test_a_good_release_passes_whatever_was_not_observed():
    release, found, asked = released()
    found.values[0, 0] = np.nan
    check_released(release, found, asked)
    with pytest.raises(ValueError, match="got tuple"):
        check_released(release, tuple(found), asked)


def test_a_model_claims_no_guarantee_and_no_knowledge_by_default():
    release, *_ = released()
    found = release.report()
    assert (found.guarantee, found.void_reasons) == ("none", ("not_stated",))
    assert (found.speed_release, found.boundary_inputs) == ("flow", "private")
    assert found.to_dict()["mu"] is None  # plain JSON has no infinity
    assert np.concatenate(release.spent(ONE, ONE)).tolist() == [np.inf, np.inf]
    assert release.private(ONE, ONE) == {}
    assert release.budgets_spent(ONE).tolist() == [0.0]
    with pytest.raises(ValueError, match="'sums' cannot be set"):
        release.give_noise(np.zeros((*SHAPE, 2)))
