import shutil
from pathlib import Path

import pytest

from agents.filters.highways import KINDS
from agents.filters.plan import FilterPlan
from agents.filters.scenarios import ScenarioRanges
from agents.studies import roads
from agents.studies.roads import drawn, recorded
from agents.study import read_rows
from dptse_env.estimators import recurrent
from dptse_env.importers.folder import ROAD
from dptse_env.traffic import CORRIDORS, write_corridor

WEIGHTS = Path(recurrent.__file__).parent / "weights"


@pytest.fixture
def rows(results):
    return read_rows("roads", results / "roads")


def test_drawn_roads_are_no_training_roads_and_have_all_filters():
    for name in drawn.NAMES:
        kind, _, number = name.partition("_")
        trained = FilterPlan.validation_highways, ScenarioRanges.highways
        assert not any(int(number) in range(*each) for each in trained)
        assert kind in KINDS
    played = {
        cell.labels["estimator"]
        for cell in roads.study().cells
        if cell.labels["road"] in roads.DRAWN
    }
    assert played == {*roads.ALL_FILTERS, "recurrent"}


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
    releases = {each.labels["release"] for each in cells if each.labels["network"]}
    assert releases == {"paced", roads.MUCH_NOISE, roads.LITTLE_NOISE}
    Path(f"{prefix}-flows.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"weights must be .*mine"):
        roads.study([str(prefix)])


def test_the_summary_is_the_mean_over_own_roads_that_were_played(rows):
    some = rows.filter(road="six ramps")
    gain = roads.gain(some, "", "six ramps", "paced").mean
    said = roads.summary(some, "")
    assert f"`paced`: {gain:.1f} % below" in said
    assert "over 1 own roads" in said


def test_a_section_is_made_once_in_one_piece(tmp_path, monkeypatch):
    written = []

    def write(number, folder):
        written.append(number)
        write_corridor(folder / ROAD, CORRIDORS.find("short-highway"))
        if len(written) == 1:
            raise KeyboardInterrupt

    monkeypatch.setenv("DPTSE_CACHE", str(tmp_path))
    monkeypatch.setattr(recorded, "_write_section", write)
    make = CORRIDORS.find("agents.studies.roads.recorded:section_7")
    with pytest.raises(KeyboardInterrupt):
        make()
    assert not list(tmp_path.glob("roads/section*"))
    assert make() == make()
    assert written == [7, 7]
