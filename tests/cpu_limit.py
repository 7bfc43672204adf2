"""pytest plugin: a fast test that takes more CPU time than the limit fails.

Counted is what a test and its own fixtures use, in this process and in children that have ended.
Left out is what several tests share: their fixtures, machine code that is compiled or loaded, and
records of traffic. Children do not count where machine code was written while the test ran.
"""

import os
from unittest import mock

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

from dptse_env.traffic import library
from dptse_env.utils.kernels import default_folder

LIMIT = 3.0
"""CPU seconds of a test that is marked neither slow nor ray."""


def pytest_addoption(parser):
    """Add the limit as an option."""
    parser.addoption(
        "--cpu-limit", type=float, default=LIMIT, metavar="SECONDS",
        help="CPU seconds that a fast test may take (default: %(default)s)",
    )  # fmt: skip


def pytest_configure(config):
    """Measure from now on."""
    config.pluginmanager.register(CpuLimit(config.getoption("cpu_limit")))


class CpuLimit:
    """Adds up the CPU seconds of a test, without what is left out."""

    def __init__(self, limit):
        self._limit = limit
        self._seconds = 0.0
        self._left_out = self._left_out_since = np.zeros(2)
        self._depth = 0
        self._patches = [
            mock.patch.object(owner, name, self._outside(getattr(owner, name)))
            for owner, name in ((CPUDispatcher, "compile"), (library, "record_seeds"))
        ]
        for patch in self._patches:
            patch.start()

    def pytest_unconfigure(self):
        """Measure no longer."""
        for patch in self._patches:
            patch.stop()

    def _outside(self, method):
        """Return a method whose time is left out."""

        def wrapper(*args, **keywords):
            self._pause()
            try:
                return method(*args, **keywords)
            finally:
                self._resume()

        return wrapper

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self):
        """Begin with a test."""
        self._seconds = 0.0
        return (yield from self._count())

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self):
        """Count the test."""
        return (yield from self._count())

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        """Leave fixtures out that several tests share."""
        if fixturedef.scope == "function":
            return (yield)
        self._pause()
        try:
            return (yield)
        finally:
            self._resume()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        """Fail a test that has passed and took too long."""
        report = yield
        fast = not any(item.get_closest_marker(name) for name in ("slow", "ray"))
        if call.when == "call" and report.passed and fast and self._seconds > self._limit:
            report.outcome = "failed"
            report.longrepr = (
                f"{item.nodeid} took {self._seconds:.1f} CPU seconds, more than the "
                f"{self._limit:g} of a fast test: make it smaller, or mark it slow"
            )
        return report

    def _pause(self):
        """Leave out what follows."""
        if self._depth == 0:
            self._left_out_since = _used()
        self._depth += 1

    def _resume(self):
        """Go on counting."""
        self._depth -= 1
        if self._depth == 0:
            self._left_out = self._left_out + _used() - self._left_out_since

    def _count(self):
        self._left_out = np.zeros(2)
        before, kernels = _used(), _last_compiled()
        try:
            return (yield)
        finally:
            own, children = _used() - before - self._left_out
            self._seconds += own + (children if _last_compiled() == kernels else 0.0)


def _used():
    """Return the CPU seconds of this process and of its children that have ended."""
    times = os.times()
    return np.array([times.user + times.system, times.children_user + times.children_system])


def _last_compiled():
    folder = default_folder()
    return folder.stat().st_mtime_ns if folder.exists() else 0
