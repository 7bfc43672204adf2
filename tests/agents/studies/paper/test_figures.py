import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure

from agents.evaluation.episodes import run_episode
from agents.experiments.runner import make_env
from agents.statistics import Interval
from agents.studies.paper.figures import (
    LAYOUTS,
    draw_open_loop,
    draw_pictures,
    draw_sweeps,
    draw_times,
    watch_pictures,
)
from agents.studies.paper.plan import SETTINGS, PaperDesign
from dptse_env.config import resolve
from dptse_env.schedules import make_schedule
from dptse_env.traffic import RecordLibrary
from tests.agents.studies.paper.made_up import make_up

RESULTS = make_up(lambda cell: 80.0 if cell.estimator == "open_loop" else 10.0 / cell.epsilon)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_sweep_has_a_panel_for_each_metric_and_setting(name):
    layout = LAYOUTS[name]
    figure = draw_sweeps(RESULTS, layout)
    assert len(figure.axes) == 4 * len(layout.metrics)
    titles = [axis.get_title(loc="left") for axis in figure.axes[:4]]
    assert titles == [str(setting) for setting in SETTINGS]
    for axis in figure.axes:
        assert len(axis.containers) == 5  # four estimators and the random walk, with bars
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["EKF", "UKF", "EnKF", "MHE", "random walk", "open loop"]


def test_curves_show_the_means():
    figure = draw_sweeps(RESULTS, LAYOUTS["fig3_epsilon.png"])
    line = figure.axes[0].containers[0].lines[0]
    curve = RESULTS.curve("epsilon", "ekf", SETTINGS[0], "rmse_density")
    np.testing.assert_allclose(line.get_ydata(), curve.mean(axis=1))


@pytest.mark.parametrize(
    ("mean", "always", "is_line"), [(80.0, False, False), (11.0, False, True), (80.0, True, True)]
)
def test_an_open_loop_off_the_scale_is_named_with_its_value(mean, always, is_line):
    axis = Figure().subplots()
    axis.plot([0.0, 1.0], [5.0, 10.0])
    draw_open_loop(axis, Interval(mean, mean - 1.0, mean + 1.0, 9), 10.0, "veh/km", always)
    assert (len(axis.lines) == 2) is is_line
    assert ["80.0 ± 1.0 veh/km" in text.get_text() for text in axis.texts] == [True] * (not is_line)
    assert bool(axis.get_ylim()[1] > mean) is is_line


def test_times_stand_beside_the_paper_s():
    absolute, relative = draw_times(RESULTS).axes
    np.testing.assert_allclose(absolute.lines[-1].get_xdata(), [60.0, 26.0, 40.0, 45.0])
    np.testing.assert_allclose(relative.lines[-1].get_xdata()[1], 0.026 / 0.06)
    assert absolute.get_xlabel().endswith("[ms]")


def test_the_picture_shows_the_episodes_that_were_scored():
    design = PaperDesign(
        env="dptse_env:dptse/ShortHighway-v0", seeds="2000:2002", cv_segments=(1, 2, 3),
        picture_segments=3, privacy_segments=2, estimators=("ekf",),
    )  # fmt: skip
    RecordLibrary().ensure(resolve("short-highway", {}).corridor, (2000,))
    watched = watch_pictures(design, None)
    cell = design.picture("ekf", SETTINGS[1])
    score, history = watched[cell]
    env = make_env(design.env, cell.keywords, (2000,), None)
    assert score == run_episode(env, make_schedule("paper", env), traffic_seed=2000, seed=2000)
    assert history.queried[-1].sum() == 3
    figure = draw_pictures(design, watched)
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    for setting in SETTINGS:
        assert f"{setting}\ntruth" in titles
        for name, label in (("ekf", "EKF"), ("open_loop", "open loop")):
            error = watched[design.picture(name, setting)][0].rmse_density
            assert f"{label}, RMSE {error:.1f} veh/km" in titles


def test_figures_do_without_an_estimator():
    part = dataclasses.replace(RESULTS.design, estimators=("ukf",))
    results = make_up(lambda cell: 10.0, design=part)
    draw_sweeps(results, LAYOUTS["fig4_delta.png"])
    assert not draw_times(results).axes[1].get_visible()  # nothing relative to the EKF
