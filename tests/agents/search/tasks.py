"""The tuning task of the tests of searches."""

from agents.search.tuning_task import TuningTask

TASK = TuningTask(
    env="dptse_env:dptse/ShortHighway-v0",
    estimator="ekf",
    parameters="w99-3lane",
    privacy="paper",
    seeds="0:3",
    keywords={"epsilon": 1.0, "delta": 0.05, "bandwidth": 2},
)
