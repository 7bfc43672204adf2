"""Settings of release models, and what is asked of a model of another package."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest

from dptse_env.release import CappedSettings, PacedSettings, PrivacySettings, check_released
from tests.helpers import PricedRelease

from .worlds import COLUMNS, ONE, Worlds, request, stays

BAD_SETTINGS = [
    (CappedSettings, {"epsilon": 0.0}, r"epsilon must be .*, got 0\.0$"),
    (CappedSettings, {"delta": True}, r"delta must be .*, got True$"),
    (CappedSettings, {"cap": 0}, r"cap must be .*, got 0$"),
    (CappedSettings, {"share": 0.0}, r"share must be .*, got 0\.0$"),
    (
        CappedSettings,
        {"unit": np.zeros(2)},
        r"unit must be .*, got \[0\.0, 0\.0\]$",
    ),
    (PacedSettings, {"clip": math.inf}, r"clip must be .*, got inf$"),
    (PacedSettings, {"ratio": 1.0001}, r"ratio must be at most 1 for .*, got 1\.0001$"),
    (PacedSettings, {"unit": "horizon"}, r"unit must be one of trip, event, got 'horizon'$"),
]


@pytest.mark.parametrize(("kind", "fields", "message"), BAD_SETTINGS)
def test_bad_settings_are_named_with_their_path(kind, fields, message):
    for make in (kind, partial(dataclasses.replace, kind())):
        with pytest.raises(ValueError, match=rf"^privacy\.{message}"):
            make(**fields)


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
