import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from agents.evaluation.episodes import run_episode
from agents.evaluation.statistics import Interval
from agents.experiments.runner import make_env
from agents.studies.paper import figures
from agents.studies.paper.figures import LOOKS, save_sweeps, save_times
from agents.studies.paper.plan import SETTINGS, Design
from agents.studies.paper.space_time import save_space_time, watch
from dptse_env.config import resolve
from dptse_env.schedules import make_schedule
from dptse_env.traffic import RecordLibrary
from tests.agents.studies.paper.made_up import make_up

MEASURED = make_up(lambda cell: 80.0 if cell.estimator == "open_loop" else 10.0 / cell.epsilon)


@pytest.fixture
def saved(monkeypatch):
    """The figures that were saved, to look into."""
    kept, save = [], figures.save

    def keep(figure, path):
        kept.append(figure)
        save(figure, path)

    monkeypatch.setattr(figures, "save", keep)
    return kept


@pytest.mark.parametrize("name", LOOKS)
def test_a_sweep_has_a_panel_for_each_metric_and_setting(name, saved, tmp_path):
    look = LOOKS[name]
    save_sweeps(tmp_path / name, MEASURED, look, "title")
    axes = saved[0].axes
    assert len(axes) == 4 * len(look.metrics)
    assert [axis.get_title(loc="left") for axis in axes[:4]] == [str(own) for own in SETTINGS]
    for axis in axes:
        assert len(axis.containers) == 5  # four estimators and the random walk, with bars
    labels = [text.get_text() for text in saved[0].legends[0].get_texts()]
    assert labels == ["EKF", "UKF", "EnKF", "MHE", "random walk", "open loop"]
    with Image.open(tmp_path / name) as image:
        assert min(image.size) > 500


def test_curves_show_the_means(saved, tmp_path):
    look = LOOKS["fig3_epsilon.png"]
    save_sweeps(tmp_path / "figure.png", MEASURED, look, "title")
    line = saved[0].axes[0].containers[0].lines[0]
    curve = MEASURED.curve("epsilon", "ekf", SETTINGS[0], "rmse_density")
    np.testing.assert_allclose(line.get_ydata(), curve.mean(axis=1))


@pytest.mark.parametrize(
    ("mean", "drawn", "is_line"), [(80.0, False, False), (11.0, False, True), (80.0, True, True)]
)
def test_an_open_loop_off_the_scale_is_named_with_its_value(mean, drawn, is_line):
    axis = Figure().subplots()
    axis.plot([0.0, 1.0], [5.0, 10.0])
    alone = Interval(mean, mean - 1.0, mean + 1.0, 9)
    figures._open_loop(axis, alone, 10.0, "veh/km", drawn)
    assert (len(axis.lines) == 2) is is_line
    words = [text.get_text() for text in axis.texts]
    assert words == ([] if is_line else ["open loop 80.0 ± 1.0 veh/km, off the scale ↑"])
    assert bool(axis.get_ylim()[1] > mean) is is_line


def test_times_stand_beside_the_paper_s(saved, tmp_path):
    save_times(tmp_path / "times.png", MEASURED, "title")
    absolute, relative = saved[0].axes
    told = absolute.lines[-1]
    np.testing.assert_allclose(told.get_xdata(), [60.0, 26.0, 40.0, 45.0])
    np.testing.assert_allclose(relative.lines[-1].get_xdata()[1], 0.026 / 0.06)
    assert absolute.get_xlabel().endswith("[ms]")


def test_the_map_shows_the_episodes_that_were_scored(tmp_path):
    design = Design(
        env="dptse_env:dptse/ShortHighway-v0", seeds=(2000, 2001), cv_segments=(1, 2, 3),
        picture_segments=3, privacy_segments=2, estimators=("ekf",),
    )  # fmt: skip
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, (2000,))
    histories = watch(design, None)
    assert set(histories) == {(a, b) for a in design.all_estimators for b in SETTINGS}
    history = histories["ekf", SETTINGS[1]]
    env = make_env(design.env, design.picture("ekf", SETTINGS[1]), design.seeds, None)
    score = run_episode(env, make_schedule("paper", env), traffic_seed=2000, seed=2000)
    difference = np.array(history.estimate[61:]) - np.array(history.truth[61:])
    assert np.sqrt(np.mean(difference**2)) == pytest.approx(score.rmse_density)
    assert history.queried[-1].sum() == 3
    save_space_time(tmp_path / "map.png", design, histories, "title")
    with Image.open(tmp_path / "map.png") as image:
        assert min(image.size) > 500


def test_figures_do_without_an_estimator(tmp_path):
    part = dataclasses.replace(MEASURED.design, estimators=("ukf",))
    measured = make_up(lambda cell: 10.0, design=part)
    save_sweeps(tmp_path / "a.png", measured, LOOKS["fig4_delta.png"], "title")
    save_times(tmp_path / "b.png", measured, "title")
