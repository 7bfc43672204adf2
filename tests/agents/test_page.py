import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("plotly")

from agents.page import watch, write_page
from agents.play import Cell
from dptse_env.evaluation import evaluate

SHORT = "dptse_env:dptse/ShortHighway-v0"
KEYWORDS = {"horizon": 80, "estimator": "random_walk"}
ERRORS = [("paper", {"rmse_density": (10.5, 1.0), "rmse_speed": (5.0, 0.5)})]


@pytest.fixture(scope="module")
def episode():
    return watch("paper", Cell(SHORT, "paper", KEYWORDS, noise_seed=3), 0)


def test_a_watched_episode_is_that_of_the_rows(episode):
    env = gym.make(SHORT, traffic_seeds="0:1", **KEYWORDS)
    assert episode.row == evaluate(env, "paper", [0], 3)[0]
    assert len(episode.history.truth) == len(episode.density_std) == len(episode.epsilon) == 81
    counted = np.array(episode.history.rmse[61:])
    assert episode.row["rmse_density"] == pytest.approx(np.sqrt(np.mean(counted**2)))


def test_the_page_has_what_happened_and_needs_no_network(episode, tmp_path):
    path = tmp_path / "page.html"
    write_page(path, "A title with <script>", ERRORS, [episode], 0)
    text = path.read_text()
    assert '"label":"80"' in text
    assert "src=" not in text.replace("src=null", "").split("<body>")[0]
    assert text.count("<script src") == 0
    assert "title with <script>" not in text


def test_the_extra_is_named_where_plotly_is_missing(episode, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "plotly.graph_objects", None)
    with pytest.raises(ImportError, match=r"pip install 'dptse-env\[train\]'"):
        write_page(tmp_path / "page.html", "title", ERRORS, [episode], 0)
    assert list(tmp_path.iterdir()) == []
