"""A window that shows pictures as an episode goes on."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from dptse_env.utils.extras import needed_for


class Window:
    """A window for pictures of one size, by pygame.

    Closing it by hand ends the showing and nothing else: the episode goes on.
    """

    def __init__(self, title: str, frames_per_second: int) -> None:
        """Load pygame; the window opens with the first picture.

        Raises:
            MissingExtraError: pygame is not installed.
        """
        with needed_for("render_mode='human'"):
            import pygame  # noqa: PLC0415
        self._pygame: Any = pygame
        self._title, self._rate = title, frames_per_second
        self._surface: Any = None
        self._clock = pygame.time.Clock()
        self._was_closed = False

    @property
    def is_open(self) -> bool:
        """True while there is a window."""
        return self._surface is not None

    def reopen(self) -> None:
        """Let the next picture open a window, if the last one was closed by hand."""
        self._was_closed = False

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture of shape (height, width, 3), no sooner than its time has come.

        Raises:
            gymnasium.error.Error: There is no display.
        """
        pygame = self._pygame
        if self._was_closed:
            return
        if self._surface is None:
            self._surface = self._opened(picture.shape[1], picture.shape[0])
        pixels = pygame.surfarray.make_surface(np.swapaxes(picture, 0, 1))
        self._surface.blit(pixels, (0, 0))
        pygame.display.flip()
        if any(event.type == pygame.QUIT for event in pygame.event.get()):
            self.close()
            self._was_closed = True
        self._clock.tick(self._rate)

    def _opened(self, width: int, height: int) -> Any:
        pygame = self._pygame
        try:
            pygame.display.init()
            # Where SDL finds no display it draws into memory, which nobody sees.
            unseen = pygame.display.get_driver() == "offscreen"
            if unseen and os.environ.get("SDL_VIDEODRIVER") != "offscreen":
                raise pygame.error("no display found")
            surface = pygame.display.set_mode((width, height))
        except pygame.error as problem:
            pygame.display.quit()
            raise gym.error.Error(
                f"render_mode='human' needs a display, and none can be opened ({problem}): use "
                "render_mode='rgb_array', or gymnasium.wrappers.RecordVideo for a video"
            ) from problem
        pygame.display.set_caption(self._title)
        return surface

    def close(self) -> None:
        """Close the window; a closed one stays closed."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
