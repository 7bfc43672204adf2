"""Corridors with recordings: their records are read, never made."""

import dataclasses
import json
import pickle
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.traffic import (
    SHORT_HIGHWAY,
    InvalidRecordError,
    Record,
    RecordingError,
    RecordLibrary,
    randomised,
    read_corridor,
    simulate,
    sumo,
)
from dptse_env.traffic.imported import record_path, recorded_seeds, save_records
from dptse_env.traffic.roads import write_corridor
from dptse_env.utils.files import json_digest

FREE = SHORT_HIGHWAY.replaced(incident=None)
SEEDS = (0, 1, 1000, 2000)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Write a folder of recordings; return its corridor."""
    return write(tmp_path_factory.mktemp("recordings"), range(4))


def write(folder, variants):
    kept = save_records(folder, FREE, map(synthetic, variants), [{"seed": seed} for seed in SEEDS])
    corridor = FREE.replaced(recordings=kept)
    write_corridor(folder / "road.toml", corridor)
    return corridor


def synthetic(variant):
    steps = np.arange(FREE.conditions.duration + 1)
    return Record(
        step=steps, vehicle=np.full(len(steps), variant), segment=steps % 6,
        speed=np.full(len(steps), 50.0 + variant), n_steps=FREE.conditions.duration + 1,
        n_columns=FREE.geometry.n_cells,
    )  # fmt: skip


@pytest.fixture
def recorded(original, tmp_path):
    """Copy the folder, so that a test may damage it; return the copy's corridor."""
    folder = tmp_path / "moved"
    shutil.copytree(original.recordings.folder, folder)
    return read_corridor(folder / "road.toml")


def test_the_library_reads_each_recorded_seed(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "sumo_version", None)  # libsumo is not asked for
    library = RecordLibrary(tmp_path / "cache")
    library.ensure(recorded, SEEDS)
    assert library.missing(recorded, SEEDS) == []
    for variant, seed in enumerate(SEEDS):
        record = library.get(recorded, seed)
        assert set(record.speed.tolist()) == {50.0 + variant}
        assert library.record_path(recorded, seed).is_file()
    assert not (tmp_path / "cache").exists()


def test_a_seed_that_was_not_recorded_is_refused_with_those_that_are(recorded):
    library = RecordLibrary()
    message = r"must be one that was recorded \(0\.\.1, 1000, 2000 in .*\), got 5, 7\.\.8"
    for refused in (library.missing, library.ensure):
        with pytest.raises(ValueError, match=message):
            refused(recorded, [0, 5, 7, 8])
    with pytest.raises(ValueError, match=r"got 5$"):
        library.get(recorded, 5)
    with pytest.raises(ValueError, match="traffic seed must be an integer >= 0"):
        library.get(recorded, -1)


def test_seeds_are_in_order_whatever_that_of_the_manifest_is(recorded):
    manifest = Path(recorded.recordings.folder) / "manifest.json"
    content = json.loads(manifest.read_text())
    content["records"] = dict(reversed(content["records"].items()))  # which the digest allows
    manifest.write_text(json.dumps(content))
    assert recorded_seeds(recorded.recordings) == SEEDS


def test_a_damaged_exchanged_or_missing_record_is_an_error(recorded, tmp_path):
    paths = [record_path(recorded.recordings.folder, seed) for seed in (0, 1)]
    content = paths[0].read_bytes()
    paths[0].write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(InvalidRecordError, match="another digest"):
        RecordLibrary().get(recorded, 0)
    assert paths[0].read_bytes() != content, "it must not be made again"
    other = write(tmp_path / "other", (7, 8, 9, 10))
    paths[0].unlink()
    RecordLibrary().ensure(recorded, [0])  # it must not be made
    with pytest.raises(InvalidRecordError, match="the record is missing"):
        RecordLibrary().get(recorded, 0)
    paths[1].rename(paths[0])
    with pytest.raises(InvalidRecordError, match="source is"):
        RecordLibrary().get(recorded, 0)
    shutil.copy(record_path(other.recordings.folder, 0), paths[0])
    with pytest.raises(InvalidRecordError, match="not the record that was imported"):
        RecordLibrary().get(recorded, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace('"0": "', '"3": "'), "not the manifest of"),
        (lambda text: text[: len(text) // 2], "must be JSON"),
        (lambda text: text + " " * 10**7, "must have at most 10000000 bytes"),
        (lambda text: text.replace('"version": 2', '"version": 3'), "format must be"),
    ],
)
def test_a_damaged_manifest_is_an_error(change, message, recorded):
    manifest = Path(recorded.recordings.folder) / "manifest.json"
    content = json.loads(manifest.read_text()) | {"records": {"x" * 1000: ""}}
    manifest.write_text(change(manifest.read_text()))
    with pytest.raises(InvalidRecordError, match=message):
        recorded_seeds(recorded.recordings)
    manifest.write_text(json.dumps(content))
    digest = json_digest({key: content[key] for key in content if key != "sources"})
    with pytest.raises(InvalidRecordError, match=r"manifest\.json: records must have .{1,150}$"):
        recorded_seeds(dataclasses.replace(recorded.recordings, digest=digest))
    manifest.unlink()
    with pytest.raises(InvalidRecordError, match="recordings cannot be read"):
        recorded_seeds(recorded.recordings)


def test_the_digest_covers_the_content_and_not_the_folder(original, recorded, tmp_path):
    assert recorded.recordings.folder != original.recordings.folder
    assert recorded.digest == original.digest
    assert recorded.digest != FREE.digest
    other = write(tmp_path / "other", (0, 1, 2, 9))
    assert other.digest != original.digest
    assert pickle.loads(pickle.dumps(recorded)) == recorded


def test_recorded_traffic_has_a_fixed_demand_and_no_incident(recorded):
    with pytest.raises(ValueError, match=r"corridor\.incident must be None where traffic is rec"):
        recorded.replaced(incident=SHORT_HIGHWAY.conditions.incident)
    with pytest.raises(ValueError, match=r"corridor\.demand must be fixed where traffic is rec"):
        recorded.replaced(demand=randomised(SHORT_HIGHWAY).conditions.demand)
    with pytest.raises(RecordingError, match="its traffic is recorded, not simulated"):
        simulate(recorded, 0)


def test_environments_replay_recordings(recorded):
    road = {"corridor": f"{recorded.recordings.folder}/road.toml"}
    assert resolve("short-plain", road).traffic_seeds == (0, 1)  # those of training
    with pytest.raises(ValueError, match=r"must be one that was recorded .*, got 2\.\.63"):
        resolve("short-plain", {**road, "traffic_seeds": "0:64"})
    keywords = {"estimator": "random_walk", "truth_in_info": True, "traffic_seeds": [1000]}
    env = gym.make("dptse_env:dptse/ShortHighway-v0", **road, **keywords)
    env.reset(seed=0)
    for _ in range(3):
        info = env.step(np.zeros(6, dtype=np.int8))[4]
    np.testing.assert_allclose(info["true_density"], [0, 0, 0, 10, 0, 0, 0, 0])
    assert info["true_speed"][3] == pytest.approx(52.0)
