"""Tasks, and what is asked of release models."""

import dataclasses
import json

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.estimators import Measurement
from dptse_env.parts import make_model, make_release, make_task
from dptse_env.release import (
    Corrected,
    PrivacySettings,
    QueryOptions,
    Request,
    Task,
    check_released,
)
from tests.helpers import UNEVEN, MeanRelease, PricedRelease, SumRelease

from .worlds import ONE, Worlds, stays


def task(**keywords):
    keywords = {"privacy": SumRelease, "corridor": {"fixed_sensors": [5, 7, 2]}, **keywords}
    return make_task(resolve("short-highway", keywords))


def test_settings_default_to_the_paper_and_survive_json():
    settings = PrivacySettings()
    assert settings == PrivacySettings("paper", 1, 0.05)
    assert PrivacySettings(**json.loads(json.dumps(dataclasses.asdict(settings)))) == settings
    assert hash(settings) == hash(PrivacySettings())
    assert type(PrivacySettings(epsilon=np.float64(2.0)).epsilon) is float
    assert type(PrivacySettings(epsilon=2).epsilon) is float


def test_columns_are_rows_of_the_road_and_then_boundary_segments():
    plain, sums = task(), task(query_spans=(2,))
    assert (plain.n_columns, sums.n_columns) == (8, 5 + 2 + 2)
    assert plain.always.tolist() == [5, 7, 2]
    private = task(query_spans=(2,), privacy={"preset": SumRelease, "boundary_inputs": "private"})
    assert private.n_columns == private.n_rows + private.corridor.n_boundaries == 13
    assert private.n_places == 12
    assert private.always.tolist() == [7, 6, 8, *range(9, 13)]
    queried = np.isin(np.arange(5), [0, 2])[None]
    observed = private.observed(queried)
    assert np.flatnonzero(observed).tolist() == [0, 2, *range(6, 13)]
    assert np.flatnonzero(private.covered(observed)).tolist() == [0, 1, 2, 3, 5]
    np.testing.assert_array_equal(private.covers.sum(axis=1), private.span)
    assert np.flatnonzero(private.covers[2]).tolist() == [2, 3]


def test_lengths_and_limits_are_those_of_what_a_column_covers():
    settings = PrivacySettings("corrected", boundary_inputs="private")
    options = QueryOptions.make(UNEVEN.n_mainline, 2)
    uneven, every = (
        Task("corrected", Corrected, settings, UNEVEN, options, 60),
        UNEVEN.with_boundaries,
    )
    np.testing.assert_array_equal(uneven.length, every(UNEVEN.segment_lengths))
    np.testing.assert_array_equal(uneven.limit, every(UNEVEN.speed_limits))
    pairs = task(query_spans=(2,))
    np.testing.assert_allclose(pairs.length, [0.2] * 5 + [0.1] * 4)


def test_predictions_of_boundary_segments_are_those_beside_them():
    private = task(privacy={"preset": SumRelease, "boundary_inputs": "private"})
    values = np.arange(16.0).reshape(2, 8)
    at_places = private.at_places(values)
    np.testing.assert_array_equal(at_places[:, :8], values)
    np.testing.assert_array_equal(at_places[:, 8:], values[:, private.corridor.boundary_neighbours])
    assert task().at_places(values) is values


def test_a_task_knows_its_model():
    assert task().flow_centre == 0.5 * task().corridor.speed_limit
    assert not task(privacy=MeanRelease).releases_flow
    config = resolve("short-highway", {"privacy": SumRelease, "query_spans": (1, 2)})
    rows, expected = make_model(config).rows, make_release(config).task.rows
    np.testing.assert_array_equal(rows.first, expected.first)
    np.testing.assert_array_equal(rows.span, expected.span)


# --- release models of other packages --------------------------------------------------------


def released(**changes):
    """A model of another package, a good release of its, changed, and what was asked for."""
    release = Worlds(stays(0, 10.0)).started(PrivacySettings(preset="sums"), kind=PricedRelease)
    observed = np.ones((1, release.task.n_columns), dtype=bool)
    observed[0, 0] = False
    asked = Request(ONE, ONE, ONE + 1, observed)
    return release, release.release(asked)._replace(**changes), asked


SHAPE = 1, 12
BAD = {
    "values of one quantity": ({"values": np.zeros((*SHAPE, 1))}, r"values of shape \(1, 12, 2\)"),
    "whole numbers": ({"values": np.zeros((*SHAPE, 2), dtype=int)}, "values of shape"),
    "one deviation": ({"sigma": np.ones(2)}, r"sigma of shape .*, got float64 of shape \(2,\)"),
    "a negative deviation": ({"sigma": np.full((*SHAPE, 2), -1.0)}, "standard deviations >= 0"),
    "an observed value that is none": ({"values": np.full((*SHAPE, 2), np.nan)}, "finite values"),
    "an answer not asked for": ({"observed": np.ones(SHAPE, dtype=bool)}, "was not asked for"),
    "a flow without a centre": ({"centre": np.full((1, 12), np.nan)}, "finite centres of flows"),
}


@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
def test_bad_releases_are_refused_by_path(changes, message):
    release, found, asked = released(**changes)
    with pytest.raises(
        ValueError, match=rf"^privacy\.preset .*PricedRelease\.release\(\) .*{message}"
    ):
        check_released(release, found, asked)


def test_a_good_release_passes_whatever_was_not_observed():
    release, found, asked = released()
    values = found.values.copy()
    values[0, 0] = np.nan
    check_released(release, found._replace(values=values), asked)
    with pytest.raises(ValueError, match="must return a Measurement, got tuple"):
        check_released(release, tuple(found), asked)
    assert isinstance(found, Measurement)


def test_a_model_claims_no_guarantee_and_no_knowledge_by_default():
    release, *_ = released()
    found = release.report()
    assert (found.guarantee, found.void_reasons) == ("none", ("not_stated",))
    assert found.speed_release == "flow"
    mu, epsilon = release.spent(ONE, ONE)
    assert (mu.tolist(), epsilon.tolist()) == ([np.inf], [np.inf])
    assert release.private(ONE, ONE) == {}
    assert release.budgets_spent(ONE).tolist() == [0.0]
    with pytest.raises(ValueError, match="noise of the release model 'sums' cannot be set"):
        release.give_noise(np.zeros((1, 12, 2)))
