"""Records by the command."""

import json
from pathlib import Path

from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary, randomised
from tests.helpers import SHORT
from tests.scripts.commands import run_command


def test_what_an_environment_replays_is_recorded(tmp_path):
    calm = SHORT_HIGHWAY.replaced(duration=60, incident=None)
    library = RecordLibrary(tmp_path)
    for keywords, corridor, seeds in (
        ("", SHORT_HIGHWAY, (3, 4)),
        (' {"demand": "random", "incident": "random"}', randomised(SHORT_HIGHWAY), (0,)),
        (' {"corridor": {"duration": 60, "incident": null}}', calm, (1,)),
    ):
        words = "--env", SHORT + keywords, "--train-seeds", f"{seeds[0]}:{seeds[-1] + 1}"
        done = run_command("record", *words, "--workers", "1", "--records", tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"short-highway: {len(seeds)} record(s) in {tmp_path}" in done.stdout
        there = [n for n in range(9) if library.record_path(corridor, n).is_file()]
        assert there == list(seeds)


def test_records_for_programs(tmp_path):
    seeds = "--train-seeds", "0:4", "--test-seeds", "2000"
    words = "--env", SHORT, "--records", tmp_path, *seeds, "--workers", "1"
    done = run_command("record", *words, "--json")
    assert done.stderr.splitlines()[:1] == ["recorded 4 of 5"]
    found = json.loads(done.stdout)
    assert found["seeds"] == [0, 1, 2, 3, 2000]
    names = sorted(path.name for path in Path(found["folder"]).glob("0*"))
    assert names == [f"0000{seed}.safetensors" for seed in ("0000", "0001", "0002", "0003", "2000")]
    assert found["dwell"] > 0.0
