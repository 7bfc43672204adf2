import shutil
from pathlib import Path

import numpy as np
import pytest

from agents.environments import make_config, quietly
from agents.studies import roads
from agents.studies.roads import idm, on_road, recorded
from agents.study import read_rows
from agents.tables import pick
from dptse_env.estimators import recurrent
from dptse_env.traffic import CORRIDORS, Record
from dptse_env.traffic.imported import load_record

RECORDED = Path(__file__).parents[3] / "results" / "roads"
WEIGHTS = Path(recurrent.__file__).parent / "weights"


@pytest.fixture
def rows():
    return read_rows("roads", RECORDED)


@pytest.fixture
def short(monkeypatch):
    """Make the other simulator's records short."""
    monkeypatch.setattr(idm, "WARM_UP", 100)
    monkeypatch.setattr(idm, "DURATION", 60)


def test_own_roads_are_others_and_their_filters_are_calibrated():
    with quietly():
        configs = {name: make_config(roads.PRIVATE, own) for name, own in roads.OWN_ROADS.items()}
    digests = {config.corridor.digest for config in configs.values()}
    assert len(digests) == 14
    assert make_config(roads.PRIVATE, {}).corridor.digest not in digests
    assert {config.settings_name for config in configs.values()} == {"ekf-w99-3lane-paced"}
    assert configs["two lanes, 80 km/h"].corridor.scales.density_scale == pytest.approx(222.0)
    assert set(roads.KEPT_BACK) < set(roads.OWN)


def test_all_roads_are_played():
    assert {cell.labels["road"] for cell in roads.study().cells} == set(roads.ROADS)


def test_weights_in_files_have_cells_of_their_own_which_follow_the_content(tmp_path):
    prefix = tmp_path / "mine"
    for kind in ("flows", "speeds"):
        shutil.copy(WEIGHTS / f"highway-{kind}.safetensors", f"{prefix}-{kind}.safetensors")
    name = roads.named(str(prefix))
    first, shipped = roads.study([str(prefix)]).cells, roads.study().cells
    known, first = {cell.id for cell in shipped}, {cell.id for cell in first}
    assert first > known
    shutil.copy(WEIGHTS / "highway-flows.safetensors", f"{prefix}-speeds.safetensors")
    assert roads.named(str(prefix)) != name
    changed = {cell.id for cell in roads.study([str(prefix)]).cells}
    assert changed & first == known
    Path(f"{prefix}-speeds.safetensors").unlink()
    cells = roads.study([str(prefix)]).cells
    assert {each.labels["release"] for each in cells if each.labels["network"]} == {"paced"}
    Path(f"{prefix}-flows.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"weights must be .*mine"):
        roads.study([str(prefix)])


def test_tables_have_the_numbers_of_the_rows(rows):
    line = "six ramps", "paced"
    errors = {
        name: -1000.0 * pick(rows, on_road(*line, name))["reward"].mean() for name in roads.FILTERS
    }
    best = roads.best_filter(rows, *line)
    assert errors[best] == min(errors.values())
    learned = roads.Learned("recurrent")
    network = pick(rows, on_road(*line, *learned))
    found = roads.gain(rows, learned, *line)
    own = -1000.0 * network["reward"].mean()
    assert found.mean == pytest.approx(100.0 * (1.0 - own / errors[best]))
    (entry,) = (
        text
        for text in roads.table_of(rows, learned).splitlines()
        if text.startswith("| six ramps, paced |")
    )
    assert all(f"| {each:.1f} ± " in entry for each in (*errors.values(), own))
    assert f"| {found.mean:.1f} [" in entry
    assert f"{network['chi2_density'].mean():.2f}, {network['chi2_speed'].mean():.2f} |" in entry


def test_the_summary_is_the_mean_over_own_roads_that_were_played(rows):
    some = rows.filter(road="six ramps")
    gain = roads.gain(some, roads.SHIPPED[1], "six ramps", "paced").mean
    said = roads.summary(some, roads.SHIPPED[1])
    assert f"`paced`: {gain:.1f} % below" in said
    assert "over 1 own roads" in said


@pytest.mark.usefixtures("short")
def test_vehicles_of_the_other_simulator_drive_downstream_segment_by_segment():
    record = idm.simulate(3)
    assert record.digest == idm.simulate(3).digest != idm.simulate(4).digest
    place = np.array([*range(1, idm.N + 1), 0, idm.N + 1])[record.segment]
    order = np.lexsort((record.step, record.vehicle))
    vehicle, step = record.vehicle[order], record.step[order]
    same = np.diff(vehicle) == 0
    moved = np.diff(place[order])[same]
    assert set(np.diff(step)[same]) == {1}
    assert set(moved) == {0, 1}
    assert 20.0 < record.speed.mean() < 1.2 * idm.LIMIT
    assert (record.counts[:, : idm.N].sum(axis=1) > 10).all()


def test_nobody_drives_through_a_leader_that_stands():
    rng = np.random.default_rng(0)
    n = 20
    cars = np.zeros((6, n))
    cars[0] = np.arange(n) * 40.0
    cars[1, :-1], cars[2], cars[3], cars[5] = 29.0, 29.0, 1.0, np.arange(n)
    cars[2, -1] = 1e-3  # which does not want to move
    for _ in range(400):
        idm.drive(cars, 1.0, rng)
        assert (np.diff(cars[0]) > idm.VEHICLE - 1e-9).all()
    assert cars[1].max() < 5.0
    assert np.diff(cars[0]).max() < 15.0


def test_a_queue_through_the_end_is_told_from_one_inside():
    road = idm.road()
    speeds = np.full((40, idm.N + 2), 90.0)

    def queue(*columns):
        slow = speeds.copy()
        slow[:10, columns] = 20.0
        return recorded.queue_of(road, field(np.full_like(slow, 30.0), slow))

    def field(*both):
        n_steps, n_columns = speeds.shape
        return Record(n_steps=n_steps, n_columns=n_columns, field=np.stack(both, axis=-1))

    end = idm.N + 1
    assert queue(idm.N - 1, end) == "queue through the end"
    assert queue(4, 5) == "queue inside"
    assert queue() == "no queue"
    assert queue(end) is queue(4, end) is None  # not on the section's last segment


@pytest.mark.slow
def test_sections_are_as_they_are_called():
    for queue, numbers in recorded.QUEUES.items():
        road = CORRIDORS.find(f"agents.studies.roads.recorded:section_{numbers[1]}")()
        record = load_record(road, numbers[1])
        assert recorded.queue_of(road, record) == queue


@pytest.mark.usefixtures("short")
def test_a_recorded_road_is_made_once_in_one_piece(tmp_path, monkeypatch):
    monkeypatch.setenv("DPTSE_CACHE", str(tmp_path))
    monkeypatch.setattr(recorded, "IDM_SEEDS", (2000,))
    simulate = idm.simulate

    def fail(seed):
        raise KeyboardInterrupt

    monkeypatch.setattr(idm, "simulate", fail)
    with pytest.raises(KeyboardInterrupt):
        CORRIDORS.find("agents.studies.roads.recorded:idm")()
    assert not list(tmp_path.glob("roads/idm*"))
    monkeypatch.setattr(idm, "simulate", simulate)
    road = CORRIDORS.find("agents.studies.roads.recorded:idm")()
    monkeypatch.setattr(idm, "simulate", fail)
    assert CORRIDORS.find("agents.studies.roads.recorded:idm")() == road
    keywords = {"corridor": road, "traffic_seeds": [2000]}
    with quietly():
        assert make_config(roads.PRIVATE, keywords).corridor.recordings == road.recordings
