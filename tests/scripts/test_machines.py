"""Executors on the command line."""

import socket
import sys

import pytest

pytest.importorskip("tyro")

from scripts import evaluate
from scripts.cli import run


def refused(monkeypatch, capsys, tmp_path, *arguments, status=2):
    fixed = ["--env", "dptse_env:dptse/ShortHighway-v0", "--output", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", ["evaluate.py", *fixed, *arguments])
    with pytest.raises(SystemExit) as ended:
        run(evaluate.main, evaluate.Args, None)
    assert ended.value.code == status
    assert not (tmp_path / "out").exists()
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_cluster_that_does_not_answer_is_one_line(monkeypatch, capsys, tmp_path):
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    words = "--executor", "ray", "--address", address
    line = refused(monkeypatch, capsys, tmp_path, *words, status=1)
    assert line.startswith(f"error: no cluster answers at {address}")
    assert "ray start --head" in line


def test_the_missing_extra_is_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    line = refused(monkeypatch, capsys, tmp_path, "--executor", "ray", status=1)
    assert "pip install 'dptse-env[ray]'" in line


def test_an_address_is_for_a_cluster(monkeypatch, capsys, tmp_path):
    line = refused(monkeypatch, capsys, tmp_path, "--address", "auto")
    assert line == "error: address must be given with the executor ray, got 'auto'"
