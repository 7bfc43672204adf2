import json

import gymnasium as gym

from tests.helpers import SHORT
from tests.scripts.commands import ROAD, refused, run_command

TUNE = ("fit", "--tune", "--trials", "3", "--estimators", "random_walk")


def of(privacy):
    return f'{SHORT} {{"privacy": "{privacy}"}}'


def test_it_leaves_a_set_for_each_estimator(tmp_path):
    words = *TUNE, "blend", "--train-seeds", "0:2", "--output", tmp_path, "--env"
    done = run_command(*words, of("corrected"))
    assert done.returncode == 0, done.stderr
    for estimator, line in zip(
        ("random_walk", "blend"), done.stdout.splitlines()[-2:], strict=True
    ):
        name = f"{estimator}-published-corrected"
        content = json.loads((tmp_path / f"{name}.json").read_text())[name]
        provenance = content["provenance"]
        assert (provenance["n_trials"], provenance["seeds"]) == (3, "0:2")
        keywords = json.loads(line)
        env = gym.make(SHORT, privacy="corrected", **keywords).unwrapped
        assert list(env.config.settings().walk_noise) == content["settings"]["walk_noise"]
        keywords["estimator_settings"] = str(tmp_path / f"{name}.json")
        assert env.config == gym.make(SHORT, privacy="corrected", **keywords).unwrapped.config
    found = json.loads(run_command(*words, of("corrected"), "--json").stdout)
    assert found[name] == json.loads(line)
    (tmp_path / "random_walk-published-printed.json").write_text("mine")
    assert "random_walk-published-printed.json" in refused(*words, of("printed"))
    done = run_command(*words, of("printed"), "--force", "--quiet")
    assert done == (0, "", "")


def test_settings_are_tuned_on_a_road_of_ones_own(tmp_path):
    path = tmp_path / "my-road.toml"
    path.write_text(ROAD)
    words = *TUNE, "--env", f'{SHORT} {{"bandwidth": 1}}', "--train-seeds", "0:1", path
    done = run_command(*words, "--policies", "round-robin")
    assert done.returncode == 0, done.stderr
    (written,) = (tmp_path / "my-road-fit" / "tuned").glob("*.json")
    (content,) = json.loads(written.read_text()).values()
    provenance = content["provenance"]
    assert (provenance["corridor"], provenance["schedule"]) == ("my-road", "round-robin")
    assert path.read_text() == ROAD


def test_a_search_goes_on_after_ctrl_c_with_force_too(monkeypatch):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("scripts.fit.main", interrupt)
    said = run_command(*TUNE, "--env", SHORT, "--force").stderr
    assert "the same command goes on from what is done" in said
