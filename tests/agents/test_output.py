"""Output for people: tables at a terminal, JSON, figures, and a page."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from agents import terminal
from agents.figures import (
    WIDTH,
    RoadMap,
    draw_errors,
    draw_maps,
    estimate_map,
    make_figure,
    save_figure,
)
from agents.files import write_json
from agents.page import watch, write_page
from agents.play import Cell
from agents.statistics import Interval
from agents.terminal import make_table, print_table
from dptse_env.evaluation import evaluate
from tests.helpers import SHORT

ROWS = (
    ("largest-density-variance", "14.38 ± 0.27", "-1234.56 ± 7.89"),
    ("shift-ahead", "9.10 ± 12.34", "-"),
)


@pytest.mark.parametrize("width", [40, 80, 200, None])
def test_tables_are_printed_with_all_their_numbers_whole(width, capsys, monkeypatch):
    """A narrow terminal wraps between numbers; a pipe takes the width that a table needs."""
    if width is None:
        monkeypatch.setenv("COLUMNS", "20")
    else:
        narrow = Console(force_terminal=True, width=width, color_system=None)
        monkeypatch.setattr(terminal, "Console", lambda: narrow)
    table = make_table("a title", "policy", "density RMSE", "against\nlargest-density-variance")
    for row in ROWS:
        table.add_row(*row)
    print_table(table)
    printed = capsys.readouterr().out
    assert "…" not in printed
    assert {word for row in ROWS for cell in row for word in cell.split()} <= {*printed.split()}
    if width in (200, None):
        assert all(cell in printed for row in ROWS for cell in row)


def test_numbers_that_are_not_finite_are_no_json(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"error": float("nan")})
    assert list(tmp_path.iterdir()) == []


KEYWORDS = {"horizon": 80, "estimator": "random_walk"}


@pytest.fixture(scope="module")
def episode():
    return watch("shift-ahead", Cell(SHORT, "shift-ahead", KEYWORDS, noise_seed=3), 0)


def test_a_watched_episode_is_that_of_the_rows_and_maps_have_its_error(episode):
    env = gym.make(SHORT, traffic_seeds="0:1", **KEYWORDS)
    assert episode.row == evaluate(env, "shift-ahead", [0], 3)[0]
    history, rmse = episode.history, episode.row["rmse_density"]
    assert len(history.truth) == len(episode.density_std) == len(episode.epsilon) == 81
    assert rmse == pytest.approx(np.sqrt(np.mean(np.square(history.rmse[61:]))))
    squares = (np.array(history.estimate) - np.array(history.truth)) ** 2
    assert rmse == pytest.approx(np.sqrt(squares[61:].mean()))  # from second 61 on, not from 60
    assert estimate_map(history, rmse, "EKF").title == f"EKF, RMSE {rmse:.1f} veh/km"


def test_maps_stand_in_columns_with_one_bar(episode, tmp_path):
    history = episode.history
    column = [
        RoadMap("truth", history.truth, history), estimate_map(history, 1.0, "estimate"),
        RoadMap("queried", history.queried[::5], history, step=5),
    ]  # fmt: skip
    figure = draw_maps([column, column])
    assert figure.get_figwidth() <= WIDTH
    titles = [axis.get_title(loc="left") for axis in figure.axes[:-1]]
    assert titles[::2] == titles[1::2] == [panel.title for panel in column]
    image, queried = figure.axes[0].images[0], figure.axes[4].images[0]
    np.testing.assert_array_equal(image.get_array(), np.array(history.truth).T)
    assert (image.get_clim()[1], queried.get_clim()[1]) == (history.density_scale, 1.0)
    assert (image.get_extent()[0], queried.get_extent()[0]) == (-0.5, -2.5)
    save_figure(figure, tmp_path / "deep" / "maps.png", "title")
    with Image.open(tmp_path / "deep" / "maps.png") as saved:
        assert saved.format == "PNG"


def test_errors_of_every_policy_are_drawn_from_top_to_bottom():
    pair = {"density": Interval(10.0, 9.0, 11.0, 3), "speed": Interval(5.0, 4.0, 6.0, 3)}
    rows = ["shift-ahead", "round-robin"]
    figure = draw_errors(rows, {"ekf": dict.fromkeys(rows, pair), "ukf": {"shift-ahead": pair}})
    for axis, (name, interval) in zip(figure.axes, pair.items(), strict=True):
        assert axis.get_xlabel() == name
        assert [text.get_text() for text in axis.texts] == [f"{interval.mean:.1f}"] * 3
        assert [text.xy[1] for text in axis.texts] == [0.15, -0.15, -1.0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ekf", "ukf"]


def contrast(inks, page):
    """Return WCAG's contrast of colours, shape (n, 3), with the colour of a page."""
    shares = np.vstack([inks, page]) / 255.0
    linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    light = linear @ [0.2126, 0.7152, 0.0722] + 0.05
    return np.maximum(light[:-1] / light[-1], light[-1] / light[:-1])


@pytest.mark.parametrize("page", [(255, 255, 255), (13, 17, 23)])
def test_what_is_black_in_a_figure_is_read_on_white_and_on_dark_pages(page, tmp_path):
    figure = make_figure(3.0, 2.0)
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], color="black")
    axis.set_title("a panel")
    save_figure(figure, tmp_path / "figure.png", "a title")
    with Image.open(tmp_path / "figure.png") as saved:
        pixels = np.asarray(saved)
    assert pixels[0, 0, 3] == 0
    inks = np.unique(pixels[pixels[..., 3] == 255][:, :3], axis=0)
    assert len(inks) > 0
    assert contrast(inks, page).min() > 4.0


def test_the_page_has_what_happened_and_needs_no_network(episode, tmp_path, monkeypatch):
    table = ("policy", "density RMSE\n[veh/km]"), [("shift-ahead", "10.5 ± 1.0")]
    path = tmp_path / "page.html"
    write_page(path, "A title with <script>", *table, [episode], 0)
    text = path.read_text("utf-8")
    assert '"label":"80"' in text
    assert "src=" not in text.replace("src=null", "").split("<body>")[0]
    assert text.count("<script src") == 0
    assert "title with <script>" not in text
    monkeypatch.setitem(sys.modules, "plotly.subplots", None)
    with pytest.raises(ImportError, match=r"pip install 'dptse-env\[train\]'"):
        write_page(tmp_path / "other.html", "title", *table, [episode], 0)
    assert list(tmp_path.iterdir()) == [path]
