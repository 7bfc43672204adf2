"""The power that compiles to vector instructions, against numpy's."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

from dptse_env.model.power import LARGEST_BASE, LEAST_BASE, power

EXPONENTS = st.floats(0.05, 10.0)


@njit
def powers(bases, exponent, out):
    for i in range(bases.size):
        out[i] = power(bases[i], exponent)


def computed(bases, exponent):
    out = np.empty(len(bases))
    powers(np.asarray(bases, dtype=float), exponent, out)
    return out


@given(st.lists(st.floats(-30.0, 30.0, exclude_min=True, exclude_max=True), min_size=1), EXPONENTS)
def test_equals_numpys_over_its_domain(logs, exponent):
    """But for the rounding of the base-2 logarithm, and a few units in the last place."""
    bases = 10.0 ** np.array(logs)
    tolerance = (8.0 + np.abs(exponent * np.log2(bases))) * np.finfo(float).eps
    expected = bases**exponent
    assert (np.abs(computed(bases, exponent) - expected) <= tolerance * expected).all()


@given(EXPONENTS)
def test_what_lies_outside_comes_back_as_it_is(exponent):
    outside = np.array([0.0, -0.0, -2.0, LEAST_BASE, LARGEST_BASE, np.inf, -np.inf, np.nan])
    np.testing.assert_array_equal(computed(outside, exponent), outside)
    # And leaves its neighbours in a vector alone.
    mixed = np.array([0.5, np.nan, 0.25, 0.0, 2.0, np.inf, 1.0, 3.0])
    inside = [0, 2, 4, 6, 7]
    alone = [computed(mixed[[i]], exponent)[0] for i in inside]
    np.testing.assert_allclose(computed(mixed, exponent)[inside], alone, rtol=1e-14)
