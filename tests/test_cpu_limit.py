"""The limit of a fast test's CPU time holds for what is the test's own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

TESTS = """
import subprocess, sys, time
import numba
import numpy as np
import pytest

def burn(seconds=0.4):
    begun = time.process_time()
    while time.process_time() - begun < seconds:
        pass

def in_a_child():
    command = "for i in range(20_000_000): pass"
    subprocess.run([sys.executable, "-c", command], check=True)

@pytest.fixture
def own():
    burn()

@pytest.fixture(scope="module")
def shared():
    burn()
    in_a_child()

def test_body(): burn()
def test_own_fixture(own): pass
def test_child(): in_a_child()

def test_sleep(): time.sleep(0.4)
@pytest.mark.slow
def test_slow(): burn()
def test_shared_fixture(shared): pass
def test_compiling(): assert numba.njit(lambda a: a[:] * 2)(np.ones(3)).sum() == 6.0
"""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Outcomes of the tests above under a limit of 0.3 s, in a process of their own."""
    folder = tmp_path_factory.mktemp("limited")
    (folder / "test_limited.py").write_text(TESTS)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = slow")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-rA", "-p", "tests.cpu_limit", "--cpu-limit", "0.3"],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    found = re.findall(r"^(PASSED|FAILED) test_limited\.py::test_(\w+)", done.stdout, re.MULTILINE)
    assert re.search(r"::test_body took 0\.\d CPU seconds, more than the 0\.3", done.stdout)
    return {name: outcome for outcome, name in found}


@pytest.mark.parametrize("name", ["body", "own_fixture", "child"])
def test_a_test_above_the_limit_fails_the_run(outcomes, name):
    assert outcomes[name] == "FAILED"


@pytest.mark.parametrize("name", ["sleep", "slow", "shared_fixture", "compiling"])
def test_what_is_not_a_fast_tests_own_is_left_out(outcomes, name):
    assert outcomes[name] == "PASSED"
