"""Rows, tables and targets of the throughput benchmark; no test depends on speed."""

import csv
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.throughput.children import RowError, measure, measure_all
from benchmarks.throughput.environments import Driver, Kernel, make_batch
from benchmarks.throughput.measure import Measured, Samples, queries, resident, take_turns
from benchmarks.throughput.results import Result
from benchmarks.throughput.rows import QUICK, Row, Sizes, catalogue, chosen

ROOT = Path(__file__).parents[2]


def result(name, peak=None, libraries=None, notes=None, **arms):
    arms = {arm.replace("_", " "): Samples(rates) for arm, rates in arms.items()}
    return Result(Row(name, "m:f"), [Measured(arms, peak, libraries, notes or {})])


def results(*found):
    return {each.row.name: each for each in found}


def test_rates_are_medians_over_all_turns_of_all_repeats():
    row = result("a", environment=[1.0, 2.0, 30.0])
    row.repeats += result("a", environment=[4.0, 5.0]).repeats
    assert row.rate("environment") == 4.0
    assert math.isnan(row.rate("kernel"))
    low, high = np.percentile([1.0, 2.0, 4.0, 5.0, 30.0], [10, 90])
    assert row.spread("environment") == pytest.approx((high - low) / 8.0)


def test_a_share_pairs_the_turns_of_one_round():
    # The machine slows down by ten in the second round: the share stays.
    row = result("a", one_thread=[50.0, 5.0, 60.0], kernel=[100.0, 10.0, 60.0])
    assert row.share("one thread", "kernel") == pytest.approx(0.5)


def test_turns_alternate_and_set_up_is_off_the_clock():
    log = []
    work = {"a": lambda: log.append("a") or 1, "b": lambda: log.append("b") or 2}

    def prepare():
        log.append("-")
        time.sleep(0.05)

    arms = take_turns(work, 0.0, prepare)
    assert log == ["-", "a", "b"] * 3
    assert len(arms["a"].rates) == 3
    assert min(arms["a"].rates) > 1 / 0.05


def test_a_module_that_is_absent_is_reported_and_the_rest_is_measured():
    absent = Row("peer", "m:f", needs=("no_such_module",))
    broken = Row("broken", "rows:best")
    found = measure_all([absent, broken], 0.0, 1, lambda line: None)
    assert found["peer"].problem == (
        "no_such_module not installed: pip install 'dptse-env[benchmark]'"
    )
    assert "AttributeError" in found["broken"].problem


def test_a_row_that_hangs_is_ended():
    with pytest.raises(RowError, match="took longer than 0 s"):
        measure(Row("slow", "environments:scalar"), 60.0, limit=0.1)


def test_rows_are_chosen_by_pattern():
    rows = list(catalogue(Sizes()))
    assert len({row.name for row in rows}) == len(rows)
    assert len(chosen(rows, ["vector-ekf-*"])) == 6
    assert chosen(rows, []) == rows
    assert len(list(catalogue(QUICK))) < len(rows)
    with pytest.raises(ValueError, match=r"rows must be among libsumo, .*; got 'sumo'"):
        chosen(rows, ["sumo"])


def test_queries_are_masks_of_the_given_size():
    masks = queries(4, 3, 15, 5)
    assert masks.shape == (4, 3, 15)
    assert (masks.sum(axis=-1) == 5).all()
    assert not (masks[0] == masks[1]).all()


@pytest.mark.parametrize("estimator", ["ekf", "enkf"])
def test_the_bare_estimator_does_the_work_of_the_environments(estimator):
    env = make_batch("ShortHighway", 2, 1, estimator=estimator, traffic_seeds="0:1", horizon=200)
    driver = Driver(env, 2, queries(4, 2, 6, 2))
    kernel = Kernel(env)
    driver.restart(0)
    assert kernel.follow() == 0
    assert driver.step(6) == kernel.follow() == 12
    kernel.check()
    driver.restart()
    kernel.follow()
    driver.step(1)
    with pytest.raises(AssertionError):
        kernel.check()
    kernel.follow()
    kernel.check()


def test_memory_is_read():
    assert 10.0 < resident() <= resident("VmHWM")


@pytest.mark.slow
def test_the_command_writes_its_tables(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.bench_throughput", "--quick", "--rows", "sync-8",
         "plain-ekf", "--output", tmp_path],
        cwd=ROOT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert (tmp_path / "tables.md").read_text() == done.stdout.removesuffix("\n")
    with (tmp_path / "throughput.csv").open() as file:
        assert {line["row"] for line in csv.DictReader(file)} == {"sync-8", "plain-ekf"}
    assert len(json.loads((tmp_path / "throughput.json").read_text())) == 2
    refused = subprocess.run(
        [sys.executable, "-m", "benchmarks.bench_throughput", "--rows", "nothing"],
        cwd=ROOT, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: rows must be among")
