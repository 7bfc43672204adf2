import os
import threading

import pytest

from agents.engines.served_library import LocalServer, ServedLibrary
from dptse_env.config import resolve
from dptse_env.traffic import RecordLibrary, library, simulate
from dptse_env.traffic.stored_arrays import pack, unpack

CORRIDOR = resolve("short-highway", {}).corridor


class Counting(LocalServer):
    """A server that counts what it is asked for."""

    def __init__(self, of):
        super().__init__(of)
        self.asked = []

    def record(self, corridor, seed):
        self.asked.append(seed)
        return super().record(corridor, seed)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    made = RecordLibrary(tmp_path_factory.mktemp("home"))
    made.ensure(CORRIDOR, [0, 1], workers=1)
    return made


@pytest.fixture
def no_recording(monkeypatch):
    def refuse(*_):
        raise AssertionError("a record was made")

    monkeypatch.setattr(library, "simulate", refuse)


def files(path):
    return {each.name: each.read_bytes() for each in path.iterdir()}


def test_a_record_is_brought_when_it_is_needed_and_once(home, tmp_path, no_recording):
    server = Counting(home)
    away = ServedLibrary(tmp_path, server)
    assert server.asked == []
    record = away.get(CORRIDOR, 1)
    assert record.n_steps == home.get(CORRIDOR, 1).n_steps
    assert files(away.record_path(CORRIDOR, 1)) == files(home.record_path(CORRIDOR, 1))
    ServedLibrary(tmp_path, server).get(CORRIDOR, 1)
    assert server.asked == [1]
    assert not away.record_path(CORRIDOR, 0).exists()


def test_several_readers_of_a_machine_bring_a_record_once(home, tmp_path, no_recording):
    server = Counting(home)
    readers = [
        threading.Thread(target=ServedLibrary(tmp_path, server).get, args=(CORRIDOR, 0))
        for _ in range(6)
    ]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    assert server.asked == [0]


def test_what_the_server_lacks_is_recorded(home, tmp_path):
    away = ServedLibrary(tmp_path, LocalServer(home))
    record = away.get(CORRIDOR, 7)
    assert record.n_steps == simulate(CORRIDOR, 7).n_steps
    assert not home.record_path(CORRIDOR, 7).exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_an_error(home, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match="Permission denied"):
        ServedLibrary(tmp_path / "cache", LocalServer(home)).get(CORRIDOR, 0)


def test_an_archive_is_written_completely_or_not_at_all(home, tmp_path):
    archive = pack(home.record_path(CORRIDOR, 0))
    with pytest.raises(EOFError):
        unpack(archive[: len(archive) // 2], tmp_path / "record")
    assert list(tmp_path.iterdir()) == []
    unpack(archive, tmp_path / "record")
    unpack(archive, tmp_path / "record")
    assert files(tmp_path / "record") == files(home.record_path(CORRIDOR, 0))


def test_an_archive_with_anything_but_files_is_refused(tmp_path):
    (tmp_path / "odd" / "folder").mkdir(parents=True)
    with pytest.raises(ValueError, match="must have files alone, got folder"):
        unpack(pack(tmp_path / "odd"), tmp_path / "record")
    assert not (tmp_path / "record").exists()
