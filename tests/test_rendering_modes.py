"""A window that shows an episode, and videos of it."""

import sys

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.utils.extras import MissingExtraError

pytest.importorskip("pygame", reason="the extra video is not installed")

SHORT = "dptse_env:dptse/ShortHighway-v0"


@pytest.fixture
def display(monkeypatch):
    """A display in memory, by SDL's own driver for machines without one."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")


def make(render_mode="human"):
    return gym.make(SHORT, render_mode=render_mode, horizon=30, random_start=True)


def shown():
    """The pixels of the window, shape (height, width, 3); None while there is none."""
    import pygame

    if not pygame.display.get_init():
        return None
    return np.swapaxes(pygame.surfarray.array3d(pygame.display.get_surface()), 0, 1)


def test_a_window_shows_what_a_picture_would(display):
    human, picture = make(), make("rgb_array")
    for env in (human, picture):
        env.reset(seed=3)
        env.action_space.seed(0)
    np.testing.assert_array_equal(shown(), picture.render())
    for _ in range(4):
        before = shown()
        action = human.action_space.sample()
        human.step(action)
        picture.step(action)
        np.testing.assert_array_equal(shown(), picture.render())
        assert (shown() != before).any()
        assert human.render() is None
    human.close()
    assert shown() is None


def test_an_episode_goes_on_when_its_window_is_closed_by_hand(display):
    import pygame

    env = make()
    env.reset(seed=3)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    env.step(env.action_space.sample())
    assert shown() is None
    env.step(env.action_space.sample())
    assert shown() is None
    env.reset(seed=4)
    assert shown() is not None
    env.close()
    env.close()


def test_a_missing_pygame_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'dptse-env\[video\]'"):
        make()


def test_a_video_has_a_frame_for_each_second(tmp_path):
    pytest.importorskip("moviepy", reason="the extra video is not installed")
    import imageio_ffmpeg

    folder = tmp_path / "videos"
    env = gym.wrappers.RecordVideo(make("rgb_array"), str(folder), disable_logger=True)
    env.reset(seed=3)
    truncated = False
    while not truncated:
        *_, truncated, _ = env.step(env.action_space.sample())
    env.close()
    (video,) = folder.glob("*.mp4")
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(video))
    assert frames in (30, 31)  # the encoder may round the last one away
    assert seconds == pytest.approx(31 / env.metadata["render_fps"], abs=0.1)
