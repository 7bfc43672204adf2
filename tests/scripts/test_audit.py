import json

import pytest

from dptse_env.privacy import mu_of
from dptse_env.release import ReleaseModel
from dptse_env.release.gaussian import Printed
from scripts.audit import Args, main
from tests.helpers import SHORT

CAPPED = {"preset": "capped", "epsilon": 5.0, "cap": 16}


def run(folder, privacy=CAPPED, **changes):
    """Return the content of the only file that an audit leaves, after a look at its status."""
    env, status = f"{SHORT} {json.dumps({'privacy': privacy})}", 0
    try:
        main(Args(**{"env": env, "trials": 150, "workers": 1, "output": folder / "out", **changes}))
    except SystemExit as end:
        status = end.code
    (path,) = (folder / "out").iterdir()
    assert path.name == "audit.json"
    found = json.loads(path.read_text())
    assert status == (3 if found["verdict"] == "rejected" else 0)
    return found


def test_a_guarantee_is_not_rejected_and_too_little_noise_is(tmp_path, capsys):
    found = run(tmp_path / "sound")
    mu = mu_of(5.0, 0.05)
    assert found["verdict"] == "not rejected"
    assert found["distance"] == pytest.approx(mu)
    assert found["result"]["claim"] == {"mu": pytest.approx(mu), "epsilon": 5.0, "delta": 0.05}
    assert 0.0 < found["result"]["mu"]["value"] <= mu
    assert found["privacy"]["void_reasons"] == []
    noise = found["noise"]
    assert noise["p_value"] > 1e-3
    printed = capsys.readouterr().out
    assert ", estimator ekf" in " ".join(printed.split())
    for number in (f"{mu:.3f}", f"{found['result']['mu']['value']:.3f}",
                   f"without any error, so many show a mu of {found['most']:.3f}\n", "cap 16",
                   f"noise: not rejected by {noise['n']} residuals", noise["suspect"]):  # fmt: skip
        assert number in printed
    weak = run(tmp_path / "weak", noise_factor=0.4)
    assert weak["verdict"] == "rejected"
    assert weak["distance"] == pytest.approx(2.5 * mu)
    assert weak["result"]["mu"]["value"] > mu
    assert weak["noise"]["p_value"] < 1e-10


def test_what_the_noise_alone_betrays_is_rejected(tmp_path, capsys):
    privacy = {"preset": "tests.agents.audit.mechanisms:SharedNoise", "epsilon": 5.0}
    found = run(tmp_path, privacy, trials=20)
    assert found["result"]["mu"]["value"] < found["result"]["claim"]["mu"]
    assert found["verdict"] == "rejected"
    printed = capsys.readouterr().out
    assert "noise: rejected by " in printed
    assert "verdict: rejected" in printed


class Unstated(Printed):
    """Releases as in the paper, of which nothing is stated."""

    report = ReleaseModel.report


def test_a_model_that_states_nothing_is_held_to_what_was_asked_of_it(tmp_path):
    privacy = {"preset": f"{__name__}:Unstated", "epsilon": 1.0}
    found = run(tmp_path, privacy, target="replaced", trials=100)
    assert found["verdict"] == "rejected"
    assert found["result"]["claim"]["mu"] == pytest.approx(mu_of(1.0, 0.05))
    assert found["privacy"]["mu"] is None


@pytest.mark.parametrize(
    ("factor", "verdict"),
    [(1.0, "not rejected"), pytest.param(0.4, "rejected", marks=pytest.mark.slow)],
)
def test_one_run_says_the_same(factor, verdict, tmp_path, capsys):
    found = run(tmp_path, one_run=True, trials=5000, noise_factor=factor)
    assert found["verdict"] == verdict
    assert found["result"]["epsilon"] is None
    assert (found["result"]["mu"]["value"] > found["result"]["claim"]["mu"]) == (
        verdict == "rejected"
    )
    assert f"{found['result']['n']} canaries" in capsys.readouterr().out


def test_every_argument_arrives(tmp_path, capsys):
    privacy = {**CAPPED, "delta": 0.01, "adjacency": "add_remove"}
    arguments = {"trials": 10, "target": "deleted"}
    found = run(tmp_path / "first", privacy, seed=5, traffic_seed=1, **arguments)
    assert found["result"]["claim"]["delta"] == 0.01
    assert found["result"]["n"] == 10
    # 10 runs prove nothing, and that is said.
    assert found["most"] < found["result"]["claim"]["mu"]
    assert "too few to reject this claim" in capsys.readouterr().out
    assert found["arguments"]["traffic_seed"] == "1"
    again = run(tmp_path / "again", privacy, seed=5, traffic_seed=1, **arguments)
    assert again["result"] == found["result"]
    for changes in ({"seed": 6}, {"traffic_seed": 0}):
        given = {"seed": 5, "traffic_seed": 1, **changes, **arguments}
        assert run(tmp_path / str(changes), privacy, **given)["result"] != found["result"]
