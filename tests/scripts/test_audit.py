import json
from dataclasses import replace
from pathlib import Path

import pytest

from dptse_env.privacy import mu_of
from dptse_env.traffic import SHORT_HIGHWAY, write_corridor
from scripts.audit import Args, attacked_config, main
from tests.helpers import fast_and_slow

SHORT = "dptse_env:dptse/ShortHighway-v0"


def run(folder, **changes):
    """Return the only file that an audit leaves, and its content."""
    arguments = {
        "env": SHORT,
        "privacy": "capped",
        "epsilon": 5.0,
        "cap": 16,
        "runs": 150,
        "workers": 1,
    }
    main(Args(**{**arguments, "output": Path(folder) / "out", **changes}))
    (path,) = (Path(folder) / "out").iterdir()
    return path.name, json.loads(path.read_text())


def test_a_guarantee_is_not_rejected(tmp_path, capsys):
    name, found = run(tmp_path)
    assert name == "capped-worst-case-hunter.json"
    mu = mu_of(5.0, 0.05)
    assert found["verdict"] == "not rejected"
    assert found["distance"] == pytest.approx(mu)
    assert found["result"]["claim"] == {"mu": pytest.approx(mu), "epsilon": 5.0, "delta": 0.05}
    assert 0.0 < found["result"]["mu"]["value"] <= mu
    assert found["privacy"]["void_reasons"] == []
    printed = capsys.readouterr().out
    for number in (f"{mu:.3f}", f"{found['result']['mu']['value']:.3f}", f"{found['power']:.4f}"):
        assert number in printed
    assert "not rejected" in printed.splitlines()[-2]


def test_too_little_noise_is_rejected(tmp_path, capsys):
    name, found = run(tmp_path, noise_factor=0.4)
    assert name == "capped-worst-case-hunter-noise-0.4.json"
    assert found["verdict"] == "rejected"
    assert found["distance"] == pytest.approx(2.5 * mu_of(5.0, 0.05))
    assert found["result"]["mu"]["value"] > mu_of(5.0, 0.05)
    assert "rejected" in capsys.readouterr().out.splitlines()[-2]


@pytest.mark.parametrize("preset", fast_and_slow(["paper", "corrected"], ["paper"]))
def test_what_the_paper_promises_is_rejected_with_vehicles_of_the_record(preset, tmp_path):
    _, found = run(
        tmp_path,
        privacy=preset,
        cap=None,
        epsilon=1.0,
        target="replaced",
        runs=700 if preset == "corrected" else 100,
    )
    assert found["verdict"] == "rejected"
    # The claim to users, not the account.
    assert found["result"]["claim"]["mu"] == pytest.approx(mu_of(1.0, 0.05))
    assert "boundary_inputs" in found["privacy"]["void_reasons"]


def test_every_argument_arrives(tmp_path):
    name, found = run(
        tmp_path, runs=10, adjacency="add_remove", unit="event", target="deleted",
        policy="adaptive", delta=0.01, boundary_inputs="private", bandwidth=1, confidence=0.9,
        traffic_seed=3, seed=5, cap=9,
    )  # fmt: skip
    assert name == "capped-deleted-adaptive.json"
    privacy = found["privacy"]
    assert "one second of one vehicle's trip, added or removed" in privacy["protects"]
    assert privacy["boundary_inputs"] == "private"
    assert found["result"]["claim"]["delta"] == 0.01
    assert found["result"]["confidence"] == 0.9
    assert found["n_runs"] == 10
    # 10 runs prove nothing, and that is said.
    assert found["detectable_mu"] is None
    assert found["arguments"]["traffic_seed"] == "3"


def test_the_paced_ledger_is_attacked_with_the_estimator_of_the_environment(tmp_path):
    name, found = run(tmp_path, privacy="paced", cap=None)
    assert name == "paced-worst-case-hunter.json"
    mu = mu_of(5.0, 0.05)
    assert found["verdict"] == "not rejected"
    assert 0.95 * mu < found["distance"] <= mu
    assert found["privacy"]["void_reasons"] == []


@pytest.mark.slow
def test_a_paced_ledger_with_too_little_noise_is_rejected(tmp_path):
    _, weak = run(tmp_path, privacy="paced", cap=None, noise_factor=0.4)
    assert weak["verdict"] == "rejected"


def test_settings_of_the_paced_ledger_arrive(tmp_path):
    name, found = run(
        tmp_path, runs=5, privacy="paced", cap=None, pace=0.5, clip=25.0, ratio=0.7, target="late",
        estimator="open_loop",
    )  # fmt: skip
    assert name == "paced-late-hunter.json"
    privacy = found["privacy"]
    assert (privacy["pace"], privacy["clip"], privacy["ratio"]) == (0.5, 25.0, 0.7)
    assert attacked_config(Args(env=SHORT, estimator="open_loop")).estimator == "open_loop"
    assert attacked_config(Args(env=SHORT)).estimator == "ekf"


def test_the_bandwidth_arrives():
    assert attacked_config(Args(env=SHORT, bandwidth=1)).bandwidth == 1
    assert attacked_config(Args(env=SHORT)).bandwidth == 2


def test_a_road_file_is_attacked(tmp_path):
    road = tmp_path / "mine.toml"
    write_corridor(road, replace(SHORT_HIGHWAY, name="mine", lanes=3), {"bandwidth": 3})
    with pytest.warns(UserWarning, match="parameters"):
        config = attacked_config(Args(env=SHORT, corridor=str(road)))
    assert (config.corridor.name, config.corridor.lanes, config.bandwidth) == ("mine", 3, 3)
    assert config.privacy == attacked_config(Args(env=SHORT)).privacy


def test_settings_of_the_release_are_given_once():
    keywords = '{"privacy": {"epsilon": 2.0}}'
    assert attacked_config(Args(env=SHORT, keywords=keywords)).privacy.epsilon == 2.0
    with pytest.raises(ValueError, match=r"^privacy must be given once, .* got \{'cap': 3\}"):
        attacked_config(Args(env=SHORT, keywords=keywords, cap=3))


def test_two_audits_agree(tmp_path):
    first, second = (
        run(tmp_path / name, runs=20, seed=1)[1]["result"] for name in ("first", "second")
    )
    other = run(tmp_path / "three", runs=20, seed=2)[1]["result"]
    assert first == second != other


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": "everyone"}, "target must be one of"),
        ({"policy": "random"}, "policy must be one of"),
        ({"runs": 1}, "runs must be an integer >= 2, got 1"),
        ({"target": "jam"}, r"target must be one of \[.*\] for preset 'capped', got 'jam'"),
        ({"cap": 9, "privacy": "paced"}, r"privacy\.cap is unknown"),
        ({"estimator": "none"}, "estimator must be one of"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_recorded_or_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        run(tmp_path, records=tmp_path / "cache", **changes)
    assert list(tmp_path.iterdir()) == []
