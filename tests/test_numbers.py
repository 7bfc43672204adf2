"""The package gives the numbers that are kept in ``numbers.npz``; see `tests.numbers`."""

import numpy as np
import pytest

from dptse_env import versions
from tests import numbers

pytestmark = pytest.mark.slow

# Shares by which numbers may differ: a chaotic filter or an iterative solver magnifies rounding,
# and the network computes in single precision, in an order that depends on the processor.
CHAOTIC = {"ukf": 1e-6, "enkf": 1e-6, "mhe": 1e-6, "recurrent": 1e-6}
MEANS = {"ukf": 0.01, "enkf": 0.01, "mhe": 0.01}


@pytest.fixture(scope="module")
def kept():
    with np.load(numbers.FILE) as file:
        return dict(file)


def compare(case, found, kept, share):
    """Compare arrays of a case, with shares of the largest number of each array."""
    for key, value in found.items():
        before = kept[f"{case}/{key}"]
        if value.dtype in (np.uint8, bool):
            np.testing.assert_array_equal(value, before, err_msg=f"{case}/{key}")
        else:
            allowed = max(share, 1e-6 if value.dtype == np.float32 else share)
            largest = max(1.0, float(np.abs(before).max(initial=0.0)))
            np.testing.assert_allclose(
                value, before, rtol=0.0, atol=allowed * largest, err_msg=f"{case}/{key}"
            )


def given_steps(road, kept):
    names = "state", "inputs", "observed", "values", "sigma", "centre"
    return {name: kept[f"steps {road}/{name}"] for name in names}


@pytest.mark.parametrize("estimator", numbers.ESTIMATORS)
@pytest.mark.parametrize("road", numbers.ROADS)
def test_steps_from_recorded_states(road, estimator, kept):
    found = numbers.estimator_steps(road, estimator, given_steps(road, kept))
    compare(f"steps {road} {estimator}", found, kept, CHAOTIC.get(estimator, 1e-9))


@pytest.mark.parametrize("case", [case for case, _, _ in numbers.cases()])
def test_episodes(case, kept):
    function, arguments = {name: call for name, *call in numbers.cases()}[case]
    estimator = case.split()[-1] if case.startswith("errors") else ""
    compare(case, function(*arguments), kept, MEANS.get(estimator, 1e-6))


def test_the_digest_of_this_code_is_declared_to_have_these_numbers():
    *_, last = versions.EQUAL.read_text(encoding="utf-8").splitlines()
    assert versions.digest() in last.split(), f"where the others pass, add it in {versions.EQUAL}"
