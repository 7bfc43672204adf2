"""The limit of a fast test's CPU time holds for what is the test's own."""

import pytest

pytest_plugins = ["pytester"]

BURN = """
import subprocess, sys, time
import pytest
from numba.core import event

def burn(seconds=0.3):
    begun = time.process_time()
    while time.process_time() - begun < seconds:
        pass

@pytest.fixture
def own():
    burn()

def in_a_child():
    command = "for i in range(10_000_000): pass"
    subprocess.run([sys.executable, "-c", command], check=True)

@pytest.fixture(scope="module")
def shared():
    burn()
    in_a_child()
"""

TOO_LONG = {
    "a test": "def test(): burn()",
    "its fixture": "def test(own): pass",
    "a child process": "def test(): in_a_child()",
}

LEFT_OUT = {
    "a sleeper": "def test(): time.sleep(0.3)",
    "a slow test": "@pytest.mark.slow\ndef test(): burn()",
    "a shared fixture": "def test(shared): pass",
    "compiling": """
def test():
    with event.trigger_event("numba:compile"), event.trigger_event("numba:compile"):
        burn()
""",
}


@pytest.fixture
def run(pytester):
    def run(text):
        pytester.makeini("[pytest]\nmarkers = slow")
        pytester.makepyfile(f"{BURN}\n{text}")
        return pytester.runpytest("-p", "tests.cpu_limit", "--cpu-limit", "0.2")

    return run


@pytest.mark.parametrize("text", TOO_LONG.values(), ids=TOO_LONG)
def test_a_test_above_the_limit_fails_the_run(run, text):
    result = run(text)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines("*::test took 0.* CPU seconds, more than the 0.2 of a fast test*")


@pytest.mark.parametrize("text", LEFT_OUT.values(), ids=LEFT_OUT)
def test_what_is_not_a_fast_tests_own_is_left_out(run, text):
    run(text).assert_outcomes(passed=1)
