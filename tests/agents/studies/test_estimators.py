from pathlib import Path

import gymnasium as gym
import numpy as np
import polars as pl
import pytest

from agents.studies import estimators as study
from agents.studies.estimators import sensed
from agents.study import read_rows
from dptse_env.privacy import mu_of

RECORDED = Path(__file__).parents[3] / "results" / "estimators"


@pytest.fixture(scope="module")
def recorded():
    return read_rows("estimators", RECORDED)


@pytest.fixture(scope="module")
def some(recorded):
    """Return the rows of two estimators of the first part, as if the second was not played."""
    rows = recorded.filter(pl.col("estimator").is_in(["ekf", "recurrent"]), part="estimators")
    return rows.drop(name for name in rows.columns if rows[name].null_count() == len(rows))


def test_tables_have_the_numbers_of_the_rows_and_dashes_for_the_rest(some):
    lines = "\n".join([*study.world_tables(some), *study.sensed_tables(some)]).splitlines()
    world = some.filter(world="PrivateHighway-v1", policy="round-robin", network=0)
    ekf, network = (world.filter(estimator=name) for name in ("ekf", "recurrent"))
    reward = network["reward"].mean()
    error, gain = -1000.0 * reward, 100.0 * (1.0 - reward / ekf["reward"].mean())
    start = f"| PrivateHighway-v1, recurrent | ε = 5, δ = 0.05 | {error:.1f} ["
    (line,) = [x for x in lines if x.startswith(start) and x.count("|") == 9]
    assert f"] | {gain:.2f} [" in line
    assert f" | {network['chi2_density'].mean():.2f}, {network['chi2_speed'].mean():.2f} |" in line
    assert "| PrivateHighway-v1, UKF | ε = 5, δ = 0.05 | - | - | - | - | - | - |" in lines
    assert "| PaperHighway-v0, corrected, UKF | none | - | - | - | - | - | - |" in lines
    assert "| paced, EKF | ε = 5, δ = 0.05 | - | - | - | - | - |" in lines


def test_figures_are_there_where_all_that_they_show_was_played(some, tmp_path):
    for name in study.FIGURES:
        (tmp_path / name).write_bytes(b"old")
    study.report(some, tmp_path)
    assert [path.name for path in tmp_path.glob("*.png")] == ["fig_elsewhere.png"]
    assert (tmp_path / "fig_elsewhere.png").stat().st_size > 10_000


def test_sensors_alone_have_the_budget_that_they_are_said_to_have():
    def mu_by_group(labels):
        cell = study.sensed_cell(labels)
        report = gym.make(cell.env, **cell.keywords).unwrapped.privacy()
        return {group["group"]: group["mu"] for group in report["groups"]}

    whole = mu_of(study.EPSILON, 0.05)
    part = whole / np.sqrt(1.0 + 3.0 * np.sqrt(study.BASE_SHARE))
    assert mu_by_group(study.alone("paced", "ekf"))["sensors"] == pytest.approx(whole)
    assert mu_by_group(study.alone("paced", "ekf", study.PART))["sensors"] == pytest.approx(part)
    queries = sensed("paced", "ekf", sensors=study.QUERIES)
    assert mu_by_group(queries) == {"queries": pytest.approx(whole)}
    assert study.alone("printed", "ekf") == study.alone("printed", "ekf", study.PART)


def test_loops_stand_beside_queries_and_alone():
    cells = study.LOOPED_CELLS
    assert len({cell.id for cell in cells}) == len(cells)
    for cell in cells:
        assert ("loops" in cell.keywords) == (cell.labels["interval"] > 0)
        assert cell.keywords["corridor"] == {"fixed_sensors": []}


def test_straight_lines_join_the_last_readings():
    road = {"estimator": "agents.studies.straight_lines:StraightLines", "traffic_seeds": [0]}
    loops = {"positions": [0.0, 0.4], "interval": 10}
    keywords = {**road, "privacy": "paced", "epsilon": 5.0, "loops": loops}
    keywords["corridor"] = {"fixed_sensors": []}
    env = gym.make("dptse_env:dptse/ShortHighway-v0", **keywords).unwrapped
    env.reset(seed=0)
    process, nothing = env.process, np.zeros((1, 6), dtype=np.int8)
    for _ in range(40):
        process.step(np.arange(1), nothing)
    said = process.loops.said(process.traffic.readings[:1, 40 // 10 - 1])
    first, last = said.density[0, 0], said.density[0, -1]
    line = [first, *np.linspace(first, last, 5)[1:], last]
    np.testing.assert_allclose(process.estimate.density[0, :6], line)
    assert process.estimate.speed[0, :6].min() > 0.0
