import numpy as np
import pytest
from PIL import Image

from agents.figures import (
    RoadMap,
    draw_maps,
    estimate_map,
    save_errors,
    save_figure,
)
from agents.page import watch
from agents.play import Cell
from agents.statistics import Interval

SHORT = "dptse_env:dptse/ShortHighway-v0"


@pytest.fixture(scope="module")
def watched():
    episode = watch("paper", Cell(SHORT, "paper", {"estimator": "random_walk"}), 0)
    return episode.row["rmse_density"], episode.history


def test_a_map_names_exactly_the_error_of_the_row(watched):
    """The seconds of the figure's error are those of the row: from 61 on, not from 60."""
    rmse, history = watched
    squares = (np.array(history.estimate) - np.array(history.truth)) ** 2
    pooled = np.sqrt(squares[61:].mean())
    assert rmse == pytest.approx(pooled)
    assert estimate_map(history, rmse, "EKF").title == f"EKF, RMSE {pooled:.1f} veh/km"
    # One second makes a difference where its error is large.
    history.estimate[60] = history.estimate[60] + 1e4
    assert estimate_map(history, rmse, "EKF").title == f"EKF, RMSE {pooled:.1f} veh/km"


def test_maps_stand_in_columns_with_one_bar(watched, tmp_path):
    rmse, history = watched
    column = [
        RoadMap("truth", history.truth, history), estimate_map(history, rmse, "estimate"),
        RoadMap("queried", history.queried[::5], history, step=5),
    ]  # fmt: skip
    figure = draw_maps([column, column], width=8.0)
    assert len(figure.axes) == 2 * 3 + 1
    titles = [axis.get_title(loc="left") for axis in figure.axes[:-1]]
    assert titles[::2] == titles[1::2] == [panel.title for panel in column]
    image = figure.axes[0].images[0]
    np.testing.assert_array_equal(image.get_array(), np.array(history.truth).T)
    assert image.get_clim() == (0.0, history.density_scale)
    assert figure.axes[4].images[0].get_clim() == (0.0, 1.0)
    assert image.get_extent()[:2] == [-0.5, len(history.truth) - 0.5]
    assert figure.axes[4].images[0].get_extent()[0] == -2.5
    save_figure(figure, tmp_path / "deep" / "maps.png", "title")
    with Image.open(tmp_path / "deep" / "maps.png") as saved:
        assert saved.format == "PNG"


def test_errors_of_every_policy_are_drawn(tmp_path):
    pair = {
        "rmse_density": Interval(10.0, 9.0, 11.0, 3), "rmse_speed": Interval(5.0, 4.0, 6.0, 3),
    }  # fmt: skip
    rows = ["paper", "round-robin"]
    series = {name: dict.fromkeys(rows, pair) for name in ("ekf", "ukf")}
    save_errors(tmp_path / "errors.png", rows, series, "title")
    with Image.open(tmp_path / "errors.png") as image:
        # Something is drawn: neither one colour nor the few of an empty frame.
        assert len(image.convert("RGB").getcolors(maxcolors=2**20)) > 100
