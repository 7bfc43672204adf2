"""SUMO in worker processes: what they record, and workers and parents that die."""

import logging
import multiprocessing
import os
import signal
import subprocess
import sys

import pytest

from dptse_env.traffic import (
    SHORT_HIGHWAY,
    Record,
    RecordingError,
    RecordLibrary,
    simulate,
)
from dptse_env.traffic.recording import record_seeds
from tests.helpers import ROOT, wait_for
from tests.traffic.test_record import assert_same

UNGUARDED = """
from dptse_env.traffic import SHORT_HIGHWAY, simulate_in_worker
print(simulate_in_worker(SHORT_HIGHWAY, 0).n_rows)
"""
ENSURE = """
import signal, sys
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary
signal.signal(signal.SIGINT, signal.default_int_handler)
RecordLibrary(sys.argv[1]).ensure(SHORT_HIGHWAY, range(int(sys.argv[2])), workers=2)
"""


class Code:
    """Runs as soon as a worker takes it."""

    def __init__(self, text):
        self.text = text

    def __reduce__(self):
        return exec, (self.text,)


DIES = Code("import os; os._exit(9)")


def record(folder, sources, workers=1):
    """Record seeds with what is saved with each, and return their files."""
    paths = {seed: folder / f"{seed}" for seed in sources}
    record_seeds(SHORT_HIGHWAY, paths, sources, workers)
    return paths


def test_a_seed_whose_worker_dies_is_recorded_by_another(
    tmp_path, short_record, monkeypatch, caplog
):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    dies_once = Code(
        f"import os\nif not os.path.exists(p := {str(tmp_path / 'died')!r}):\n"
        "    open(p, 'w').close()\n"
        "    open(os.environ['TMPDIR'] + '/left', 'w').close()\n"
        "    os.kill(os.getpid(), 9)"
    )
    with caplog.at_level(logging.WARNING, logger="dptse_env"):
        paths = record(tmp_path, {1: {}, 0: {"value": dies_once}})
    (warning,) = caplog.messages
    assert warning.endswith("recording again: traffic seeds 0")
    loaded = Record.load(paths[0], {"value": None}, SHORT_HIGHWAY.record_shape)
    assert_same(loaded, short_record)
    assert paths[1].is_file()
    assert (tmp_path / "died").is_file()
    assert list((tmp_path / "temporary").iterdir()) == []


def test_a_seed_that_kills_three_workers_is_named(tmp_path, caplog):
    message = r"traffic seed 5 failed: a recording process died \(.*\)\n\(tried 3 times"
    with caplog.at_level(logging.WARNING), pytest.raises(RecordingError, match=message):
        record(tmp_path, {4: {}, 5: {"value": DIES}}, workers=2)
    assert len(caplog.messages) == 2


def test_what_a_worker_reports_is_not_tried_again(tmp_path, caplog):
    (tmp_path / "1").mkdir()
    with pytest.raises(RecordingError, match=r"seed 1 failed: (IsADirectory|Permission)Error"):
        record(tmp_path, {0: {}, 1: {}, 2: {}})
    assert (tmp_path / "0").is_file()  # kept
    assert not (tmp_path / "2").exists()  # not begun
    assert caplog.messages == []


def in_daemon(folder):
    record(folder, {0: {}})


@pytest.mark.slow
def test_a_daemonic_process_records_and_stays_daemonic(tmp_path):
    process = multiprocessing.get_context("spawn").Process(
        target=in_daemon, args=(tmp_path,), daemon=True
    )
    process.start()
    process.join()
    assert (process.exitcode, process.daemon) == (0, True)
    assert (tmp_path / "0").is_file()


def start_ensure(path, n_seeds, temporary):
    environment = {"PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)}
    return subprocess.Popen(
        [sys.executable, "-c", ENSURE, str(path), str(n_seeds)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
        start_new_session=True,
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows kills otherwise")
@pytest.mark.parametrize(("send", "how"), [("kill", "KILL"), ("kill", "INT"), ("killpg", "INT")])
def test_a_killed_parent_leaves_no_orphans_no_files_and_a_valid_library(send, how, tmp_path):
    how, temporary = signal.Signals[f"SIG{how}"], tmp_path / "temporary"
    temporary.mkdir()
    process = start_ensure(tmp_path / "library", 400, temporary)
    wait_for(lambda: len(list((tmp_path / "library").rglob("*.safetensors"))) >= 4)
    getattr(os, send)(process.pid, how)  # to the parent, or as a terminal does
    # Workers have its pipes as well: both end with the last of them.
    _, said = process.communicate(timeout=600)
    assert list(temporary.iterdir()) == []
    records = RecordLibrary(tmp_path / "library")
    made = set(range(400)) - set(records.missing(SHORT_HIGHWAY, range(400)))
    assert 0 < len(made) < 400
    assert all(records.get(SHORT_HIGHWAY, seed).n_rows > 0 for seed in made)
    assert process.returncode == -how
    if how == signal.SIGINT:
        assert said.strip().endswith("KeyboardInterrupt")
        assert "recording again" not in said


@pytest.mark.slow
def test_processes_recording_the_same_seeds_agree(tmp_path, short_record):
    processes = [start_ensure(tmp_path / "library", 3, tmp_path) for _ in range(2)]
    for process in processes:
        _, errors = process.communicate()
        assert process.returncode == 0, errors
    assert_same(RecordLibrary(tmp_path / "library").get(SHORT_HIGHWAY, 0), short_record)
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 3


@pytest.mark.slow
def test_a_simulation_of_the_user_survives(short_record, tmp_path):
    """libsumo holds one simulation per process; the user's own must not be replaced."""
    import libsumo

    from dptse_env.traffic.sumo_input import packaged_net

    net = tmp_path / "users.net.xml"
    net.write_text(packaged_net("paper-highway"))
    libsumo.start(["sumo", "-n", str(net), "--no-step-log", "--xml-validation.net", "never"])
    try:
        libsumo.simulationStep()
        with pytest.raises(RecordingError, match="another simulation in this process"):
            simulate(SHORT_HIGHWAY, 0)
        assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
        assert libsumo.simulation.getTime() == 1.0
        assert "main_14" in libsumo.edge.getIDList()
    finally:
        libsumo.close()


@pytest.mark.slow
def test_a_script_without_a_main_guard_and_one_from_a_pipe_work(tmp_path, short_record):
    script = tmp_path / "unguarded.py"
    script.write_text(UNGUARDED)
    for arguments, text in (([str(script)], ""), (["-"], UNGUARDED)):
        result = subprocess.run(
            [sys.executable, *arguments],
            input=text,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert result.stdout.strip() == str(short_record.n_rows), result.stderr
