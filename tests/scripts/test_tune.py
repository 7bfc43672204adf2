import json
import sys

import gymnasium as gym
import pytest

from agents.search.tuning import FINISHED
from scripts.tune import Args, main
from tests.helpers import SHORT, run_killed


def test_it_leaves_a_set_per_configuration(tmp_path, capsys):
    envs = tuple(f'{SHORT} {{"privacy": "{privacy}"}}' for privacy in ("printed", "corrected"))
    args = Args(env=envs, estimators=("random_walk",), seeds="0:2", trials=3, output=tmp_path)
    main(args)
    printed = capsys.readouterr().out.splitlines()
    for privacy, line in zip(("printed", "corrected"), printed[-2:], strict=True):
        name = f"random_walk-published-{privacy}"
        content = json.loads((tmp_path / f"{name}.json").read_text())[name]
        assert set(content["settings"]) == {"walk_noise"}
        assert content["provenance"]["n_trials"] == 3
        keywords = json.loads(line)
        env = gym.make(SHORT, privacy=privacy, **keywords).unwrapped
        assert list(env.config.settings().walk_noise) == content["settings"]["walk_noise"]
        keywords["estimator_settings"] = str(tmp_path / f"{name}.json")
        assert env.config == gym.make(SHORT, privacy=privacy, **keywords).unwrapped.config
    (tmp_path / "random_walk-published-printed.journal").unlink()
    with pytest.raises(ValueError, match=r"random_walk-published-printed\.json"):
        main(args)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows kills otherwise")
def test_a_killed_run_leaves_nobody_behind_and_goes_on(tmp_path):
    words = (
        "scripts.dptse", "tune", "--env", SHORT, "--estimators", "ekf", "--seeds", "0:2",
        "--trials", "16", "--workers", "2", "--output", tmp_path,
    )  # fmt: skip
    journal = tmp_path / "ekf-published-printed.journal"
    assert run_killed("dptse_env.utils.progress:tqdm", "update", 4, *words).returncode == -9
    n = finished(journal)
    assert 4 <= n < 16
    assert not (tmp_path / "ekf-published-printed.json").exists()
    assert run_killed("dptse_env.utils.progress:tqdm", "update", 17 - n, *words).returncode == 0
    (content,) = json.loads((tmp_path / "ekf-published-printed.json").read_text()).values()
    assert content["provenance"]["n_trials"] == finished(journal) == 16


def finished(journal):
    """Count trials that were completed or stopped early."""
    records = [json.loads(line) for line in journal.read_text().splitlines() if line.endswith("}")]
    return sum(each["op_code"] == 6 and each["state"] in FINISHED for each in records)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"workers": 0}, "workers must be an integer >= 1, got 0"),
        ({"trials": 0}, "trials must be an integer >= 1, got 0"),
        ({"estimators": ("ekf", "ekf")}, "ekf-published-printed must be tuned once"),
        ({"estimators": ()}, "must not be empty"),
        ({"seeds": "2000:2008"}, "seeds must be traffic seeds"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{"env": (SHORT,), "output": tmp_path / "out", **changes}))
    assert not (tmp_path / "out").exists()
