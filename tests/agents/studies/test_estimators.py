import gymnasium as gym
import numpy as np
import polars as pl

from agents.studies import estimators as study
from agents.study import read_rows


def test_what_was_not_played_is_a_dash_and_no_figure(results, tmp_path):
    """As if two estimators of the first part were played alone."""
    rows = read_rows("estimators", results / "estimators")
    some = rows.filter(pl.col("estimator").is_in(["ekf", "recurrent"]), part="estimators")
    some = some.drop(name for name in some.columns if some[name].null_count() == len(some))
    for name in study.FIGURES:
        (tmp_path / name).write_bytes(b"old")
    lines = study.report(some, tmp_path).splitlines()
    assert "| PrivateHighway-v1, UKF | ε = 5, δ = 0.05 | - | - | - | - | - | - |" in lines
    assert "| PaperHighway-v0, corrected, UKF | none | - | - | - | - | - | - |" in lines
    assert "| paced, EKF | ε = 5, δ = 0.05 | - | - | - | - | - |" in lines
    assert [path.name for path in tmp_path.glob("*.png")] == ["fig_elsewhere.png"]
    assert (tmp_path / "fig_elsewhere.png").stat().st_size > 10_000


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
