import dataclasses

import pytest

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.studies.paper.plan import SETTINGS, PaperCell
from agents.studies.paper.timing import StepTime
from tests.agents.studies.paper.made_up import DESIGN, score

CELL = DESIGN.base("ekf", SETTINGS[0])
OTHER = DESIGN.base("ukf", SETTINGS[0])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "episodes.csv"


def filled(path):
    ledger = Ledger(path, PaperCell, EpisodeScore)
    ledger.append(CELL, [score(2000, density=1.0 / 3.0), score(2001)])
    ledger.append(OTHER, [score(2000, speed=1e-17)])
    return ledger


def test_what_was_added_is_read_again_to_the_last_digit(path):
    rows = filled(path).rows
    assert len(rows) == 3
    assert Ledger(path, PaperCell, EpisodeScore).rows == rows
    assert rows[CELL, 2000].rmse_density == 1.0 / 3.0


def test_other_records_keep_their_own_columns(path):
    Ledger(path, PaperCell, StepTime).append(CELL, [StepTime(2000, 1e-5)])
    assert Ledger(path, PaperCell, StepTime).rows == {(CELL, 2000): StepTime(2000, 1e-5)}
    with pytest.raises(ValueError, match=r"must have the columns .*rmse_density.*seconds"):
        Ledger(path, PaperCell, EpisodeScore)


@pytest.mark.parametrize("cut", [1, 5, 30])
def test_a_torn_last_line_is_dropped_and_can_be_added_again(path, cut):
    filled(path)
    before = path.read_bytes()
    path.write_bytes(before[:-cut])
    ledger = Ledger(path, PaperCell, EpisodeScore)
    assert set(ledger.rows) == {(CELL, 2000), (CELL, 2001)}
    ledger.append(OTHER, [score(2000, speed=1e-17)])
    assert path.read_bytes() == before


def test_a_torn_header_is_an_empty_file(path):
    path.write_text("estimator,param")
    ledger = Ledger(path, PaperCell, EpisodeScore)
    assert ledger.rows == {}
    ledger.append(CELL, [score(2000)])
    assert set(Ledger(path, PaperCell, EpisodeScore).rows) == {(CELL, 2000)}


@pytest.mark.parametrize(("old", "new"), [("2001", "many"), ("ekf,", "")])
def test_a_damaged_line_inside_is_named(path, old, new):
    filled(path)
    lines = path.read_text().splitlines(keepends=True)
    lines[2] = lines[2].replace(old, new, 1)
    path.write_text("".join(lines))
    with pytest.raises(ValueError, match=r"episodes\.csv, line 3"):
        Ledger(path, PaperCell, EpisodeScore)


def test_sorting_forgets_the_order_of_the_run(path, tmp_path):
    filled(path).sort()
    other = Ledger(tmp_path / "other.csv", PaperCell, EpisodeScore)
    other.append(OTHER, [score(2000, speed=1e-17)])
    other.append(CELL, [score(2001)])
    other.append(CELL, [score(2000, density=1.0 / 3.0)])
    assert other.path.read_bytes() != path.read_bytes()
    other.sort()
    assert other.path.read_bytes() == path.read_bytes()
    assert Ledger(path, PaperCell, EpisodeScore).rows == other.rows


def test_cells_differ_by_every_field(path):
    ledger = Ledger(path, PaperCell, EpisodeScore)
    cells = [CELL, dataclasses.replace(CELL, epsilon=2.0), dataclasses.replace(CELL, bandwidth=6)]
    for cell in cells:
        ledger.append(cell, [score(2000)])
    assert list(Ledger(path, PaperCell, EpisodeScore).rows) == [(cell, 2000) for cell in cells]
