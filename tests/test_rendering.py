"""Pictures of an episode, a window that shows it, and videos."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dptse_env.utils.registry import MissingExtraError
from tests.helpers import make_env, play


@pytest.fixture
def display(monkeypatch):
    """A display in memory, by SDL's own driver for machines without one."""
    pytest.importorskip("pygame", reason="the extra video is not installed")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")


def make(render_mode="human", **keywords):
    keywords = {"horizon": 30, "random_start": True, "traffic_seeds": [0], **keywords}
    return make_env(render_mode=render_mode, **keywords)


def shown():
    """The pixels of the window, shape (height, width, 3); None while there is none."""
    import pygame

    if not pygame.display.get_init():
        return None
    return np.swapaxes(pygame.surfarray.array3d(pygame.display.get_surface()), 0, 1)


def test_a_picture_shows_the_episode_so_far():
    env = make("rgb_array")
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.render()
    env.reset(seed=0)
    empty = env.render()
    for seed in (0, 1):
        play(env, 20, seed)
        picture = env.render()
    texts = [text.get_text() for text in env.unwrapped.drawing._picture._canvas.figure.texts]
    assert texts == [
        "ShortHighway-v0, estimator ekf, release printed (ε 1, δ 0.05),\n"
        "queries 2 of 6 segments a second"
    ]
    assert (picture.dtype, picture.shape) == (np.uint8, empty.shape)
    assert (picture != empty).mean() > 0.05
    # A figure that is used again shows what a new one does.
    fresh = make("rgb_array")
    play(fresh, 20, 1)
    np.testing.assert_array_equal(picture, fresh.render())


def test_loops_and_ramps_are_marked_where_they_stand():
    env = make("rgb_array", loops={"positions": [0.0, 0.4], "ramps": [2]})
    env.reset(seed=0)
    env.render()
    (profile, *_) = env.unwrapped.drawing._picture._canvas.figure.axes
    names = [text.get_text() for text in profile.get_legend().get_texts()]
    assert names == ["queried now", "true density", "estimate", "loops"]
    (marks,) = (line for line in profile.lines if line.get_label() == "loops")
    np.testing.assert_allclose(marks.get_xdata(), [0.0, 0.4, 0.2])
    ramps = [(text.get_text(), pytest.approx(text.get_position()[0])) for text in profile.texts]
    assert ramps == [("on-ramp", 0.2), ("off-ramp", 0.4)]


def test_it_is_drawn_anew_every_kth_second_and_at_the_end():
    env = make("rgb_array", render_every=4, horizon=10)
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(10):
        env.step(env.action_space.sample())
        pictures.append(env.render())
    drawn = [k for k in range(1, 11) if (pictures[k] != pictures[k - 1]).any()]
    assert drawn == [4, 8, 10]


@pytest.mark.slow
def test_the_checker_finds_nothing_in_any_render_mode(display):
    check_env(make("rgb_array").unwrapped)


def test_a_window_shows_what_a_picture_would_until_it_is_closed(display):
    import pygame

    human, picture = make(), make("rgb_array")
    for env in (human, picture):
        env.reset(seed=3)
    for _ in range(4):
        before = shown()
        np.testing.assert_array_equal(before, picture.render())
        action = human.action_space.sample()
        human.step(action)
        picture.step(action)
        assert (shown() != before).any()
        assert human.render() is None
    pygame.event.post(pygame.event.Event(pygame.QUIT))  # closed by hand: the episode goes on
    for _ in range(2):
        human.step(human.action_space.sample())
        assert shown() is None
    human.reset(seed=4)
    assert shown() is not None
    human.close()
    human.close()
    assert shown() is None


@pytest.mark.parametrize(
    ("module", "mode", "extra"), [("matplotlib", "rgb_array", "plot"), ("pygame", "human", "video")]
)
def test_a_missing_package_names_the_extra_when_the_environment_is_made(
    module, mode, extra, monkeypatch
):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'dptse-env\[{extra}\]'"):
        make(mode)
