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

    def scores(*more):
        return json.loads(run_command(*words, "--estimators", "ekf", *more, "--json").stdout)

    usual = scores()
    assert set(usual["ekf"]) == {"error", "density", "speed", "chi2_density", "chi2_speed"}
    assert scores("--settings", "ekf-w99-3lane-corrected") == usual
    assert scores("--parameters", "published")["ekf"]["error"] != usual["ekf"]["error"]
    assert scores("--epsilon", "50")["ekf"]["error"] < usual["ekf"]["error"]
    assert scores("--bandwidth", "1") != usual
    assert scores("--preset", "printed")["ekf"]["error"] < usual["ekf"]["error"]
    wide = scores("--settings", '{"noise_scale": [3.0, 3.0]}')
    assert wide["ekf"]["chi2_density"] != usual["ekf"]["chi2_density"]


def test_what_does_not_suit_a_field_is_refused(tmp_path):
    field = source(tmp_path, columns=60)
    words = [
        "replay-field", "--density", field.density, "--speed", field.speed, "--cell", "0.05",
        "--interval", "5", "--density-unit", "veh/ft", "--speed-unit", "ft/s", "--segments", "3",
    ]  # fmt: skip
    words += ["--speed-limit", "50", "--window", "100"]
    assert "privacy.preset must be" in refused(*words, "--preset", "paced")
    assert "settings must be" in refused(*words, "--settings", "{1")
    assert "bandwidth must be" in refused(*words, "--bandwidth", "5")
    # 50 m: too short for the EKF with these parameters, and what may be done is said.
    short = [*words[: words.index("--segments")], "--segments", "6", *words[-4:]]
    line = refused(*short, "--parameters", "published", "--estimators", "random_walk", "ekf")
    assert "segments must be fewer, got 6: corridor.segment_length must be at least 0.0567" in line
    assert "random_walk" in line.partition(" an estimator that does not step the model: ")[2]
    assert "parameters must be" in refused(*words, "--parameters", "mine")
