"""Densities and speeds that somebody measured: read as a road's, and replayed to estimators."""

import numpy as np
import pytest

from agents.environments import make_config, quietly
from agents.measured_field import Field, Replay, field_corridor, read_field
from dptse_env.importers.fields import FieldSource

PAPER = "dptse_env:dptse/PaperHighway-v0"


def source(folder, rows=10, columns=20, **changes):
    """Write fields that grow from cell to cell, and densities from interval to interval."""
    cells, times = np.arange(rows)[:, None], np.arange(columns)[None]
    np.savetxt(folder / "density.txt", 0.01 * (1.0 + 0.1 * cells + 0.01 * times))
    np.savetxt(folder / "speed.txt", 20.0 * (1.0 + 0.05 * cells + 0.0 * times))
    fields = {
        "density": folder / "density.txt", "speed": folder / "speed.txt", "cell": 0.05,
        "interval": 5.0, "density_unit": "veh/ft", "speed_unit": "ft/s",
    }  # fmt: skip
    return FieldSource(**{**fields, **changes})


def test_cells_become_segments_and_intervals_seconds(tmp_path):
    field = read_field(source(tmp_path), 3, 4, 50.0)
    assert field.density.shape == field.speed.shape == (100, 5)
    assert field.segment_length == pytest.approx(0.1)
    # At 2.5 s, the middle of the first interval, the mean of the first two cells.
    expected = 0.01 / 0.0003048 * (1.0 + 1.1) / 2
    middle = (field.density[2, 0] + field.density[3, 0]) / 2
    assert middle == pytest.approx(expected, rel=1e-3)
    # The mean speed of vehicles: flow over density.
    flow = (1.0 * 1.0 + 1.1 * 1.05) / (1.0 + 1.1)
    assert field.speed[0, 0] == pytest.approx(20.0 * 1.09728 * flow)
    turned = read_field(source(tmp_path, reversed=True), 3, 4, 50.0)
    np.testing.assert_allclose(turned.density, field.density[:, ::-1])
    with pytest.raises(ValueError, match=r"segments must be at most 8, on 10 cells of 0\.05 km"):
        read_field(source(tmp_path), 9, 4, 50.0)


def test_more_noise_costs():
    density, speed = np.full((200, 5), 75.0), np.full((200, 5), 90.0)
    density[:, 2] = 90.0
    field = Field(density, speed, 0.1)
    corridor = field_corridor(field, 3, 102.0)
    assert corridor.scales.density_scale == 333.0
    assert corridor.scales.average_dwell == pytest.approx(4.0)
    keywords = {"corridor": corridor, "estimator": "random_walk", "bandwidth": 1}

    def run(**privacy):
        with quietly():
            config = make_config(PAPER, {**keywords, "privacy": privacy})
        return Replay(field, config, window=150, n_repeats=3).run()

    runs = {epsilon: run(preset="corrected", epsilon=epsilon) for epsilon in (1.0, 1e4)}
    assert runs[1e4].error < 0.5 * runs[1.0].error
    assert runs[1e4].density < 5.0
    assert all(value > 0.0 for score in runs.values() for value in score)
    # The paper's printed noise is less.
    assert run(preset="printed").error < runs[1.0].error
    with pytest.raises(ValueError, match=r"privacy\.preset must be one that needs no vehicles"):
        run(preset="capped")
