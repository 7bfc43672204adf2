"""Replay of a measured field by the command."""

import json

from tests.agents.test_measured_field import source
from tests.scripts.commands import refused, run_command


def test_a_row_for_each_estimator(tmp_path):
    field = source(tmp_path, columns=60)
    words = [
        "replay-field", "--density", field.density, "--speed", field.speed,
        "--cell", "0.05", "--interval", "5",
        "--density-unit", "veh/ft", "--speed-unit", "ft/s", "--segments", "3", "--window", "100",
        "--repeats", "1", "--speed-limit", "50",
    ]  # fmt: skip
    done = run_command(*words, "--estimators", "ekf", "recurrent")
    assert done.returncode == 0, done.stderr
    assert "EKF" in done.stdout
    assert "recurrent" in done.stdout

    def error(keywords):
        env = f"dptse_env:dptse/PaperHighway-v0 {json.dumps(keywords)}"
        printed = run_command(*words, "--estimators", "ekf", "--env", env, "--json").stdout
        return json.loads(printed)["ekf"]["error"]

    given = {"privacy": "corrected", "bandwidth": 2}
    assert error({**given, "epsilon": 50.0}) < error(given) != error({**given, "bandwidth": 1})
    env = "dptse_env:dptse/PaperHighway-v0"
    assert "bandwidth must be" in refused(*words, "--env", f'{env} {{"privacy": "corrected"}}')
    assert "privacy must be" in refused(*words, "--env", env)
