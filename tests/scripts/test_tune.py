import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dptse_env.estimators.settings import read_settings
from scripts.tune import Args, main

SHORT = "dptse_env:dptse/ShortHighway-v0"
ROOT = Path(__file__).parents[2]


def test_it_leaves_a_set_per_configuration(tmp_path, capsys):
    args = Args(
        env=SHORT, estimators=("random_walk",), parameters=("paper",),
        privacy=("paper", "corrected"), seeds="0:2", trials=4, workers=1,
        output=tmp_path / "out",
    )  # fmt: skip
    main(args)
    printed = capsys.readouterr().out
    for privacy in args.privacy:
        name = f"random_walk-paper-{privacy}"
        content = json.loads((args.output / f"{name}.json").read_text())[name]
        assert name in printed
        assert set(content["settings"]) == {"walk_noise"}
        assert content["provenance"]["n_trials"] == 4
        assert read_settings(args.output / f"{name}.json").walk_noise[0] > 0
    before = {path.name: path.read_text() for path in args.output.glob("*.json*")}
    main(args)  # finished: scored no more
    assert {path.name: path.read_text() for path in args.output.glob("*.json*")} == before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no groups of processes")
def test_a_killed_run_leaves_nobody_behind_and_goes_on(tmp_path):
    command = [
        sys.executable, "scripts/tune.py", "--env", SHORT, "--estimators", "ekf", "--parameters",
        "paper", "--seeds", "0:2", "--trials", "40", "--workers", "2", "--output", str(tmp_path),
    ]  # fmt: skip
    journal = tmp_path / "ekf-paper-paper.journal"
    with subprocess.Popen(
        command, cwd=ROOT, start_new_session=True, stderr=subprocess.DEVNULL
    ) as process:
        try:
            deadline = time.monotonic() + 120
            while not journal.exists() or finished(journal) < 6:
                assert time.monotonic() < deadline
                assert process.poll() is None
                time.sleep(0.02)
        finally:
            process.kill()
    deadline = time.monotonic() + 20
    while group_lives(process.pid):
        assert time.monotonic() < deadline, "workers outlive the run"
        time.sleep(0.05)
    before = finished(journal)
    assert 6 <= before < 40
    assert not (tmp_path / "ekf-paper-paper.json").exists()
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert finished(journal) == 40
    (content,) = json.loads((tmp_path / "ekf-paper-paper.json").read_text()).values()
    assert content["provenance"]["n_trials"] == 40


def finished(journal):
    """Count trials that were completed (1) or stopped early (2)."""
    records = [line for line in journal.read_text().splitlines() if line.endswith("}")]
    states = [json.loads(line) for line in records]
    return sum(each["op_code"] == 6 and each["state"] in (1, 2) for each in states)


def group_lives(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"estimators": ("open_loop",)}, "'open_loop' has nothing to tune"),
        ({"parameters": ("own",)}, "parameters must be one of paper, w99-3lane, got 'own'"),
        ({"seeds": "2000:2008"}, "seeds must be training seeds"),
        ({"workers": 0}, "workers must be an integer >= 1, got 0"),
        ({"estimators": ("ekf", "ekf")}, "ekf-w99-3lane-paper must be given once"),
        ({"estimators": ()}, "must not be empty"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{"env": SHORT, "output": tmp_path / "out", **changes}))
    assert not (tmp_path / "out").exists()
