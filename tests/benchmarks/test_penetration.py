"""The benchmark of penetration: that it runs; never how fast anything is."""

import pytest

from benchmarks.bench_penetration import ARMS, BASE, Args, measure


@pytest.mark.slow
def test_every_arm_is_measured_against_the_base():
    found = measure(Args(episodes=2, block=2, turns=2), "paced")
    assert found.keys() == ARMS.keys()
    assert found[BASE].mean == 1.0
    assert all(ratio.mean > 0.0 for ratio in found.values())
