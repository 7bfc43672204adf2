import pickle
import threading
import time
from operator import getitem

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dptse_env.utils.threads import SMALLEST_BLOCK, EpisodeThreads


@given(threads=st.integers(1, 4), n_episodes=st.integers(0, 1000))
@example(threads=3, n_episodes=2 * SMALLEST_BLOCK)
@settings(max_examples=20)
def test_every_episode_is_worked_on_once(threads, n_episodes):
    seen = np.zeros(n_episodes, dtype=int)

    def work(episodes, data):
        seen[episodes] += 1
        np.testing.assert_array_equal(data, 2 * episodes)

    episodes = np.arange(n_episodes)
    EpisodeThreads(threads).run(work, episodes, 2 * episodes, getitem)
    assert (seen == 1).all()


def workers(blocks, n_episodes=2 * SMALLEST_BLOCK, n_threads=2):
    """Return the threads that work at the same time."""
    together, found = threading.Barrier(n_threads, timeout=300.0), []

    def work(episodes, data):
        together.wait()
        found.append(threading.current_thread())

    episodes = np.arange(n_episodes)
    blocks.run(work, episodes, episodes, getitem)
    return {*found}


def test_large_batches_use_the_threads_and_small_ones_do_not():
    blocks, here = EpisodeThreads(2), threading.current_thread()
    assert workers(blocks, 2 * SMALLEST_BLOCK - 1, n_threads=1) == {here}
    assert len(workers(blocks) - {here}) == 1


@pytest.mark.parametrize("own", [True, False])
def test_an_exception_is_raised_once_nobody_works_any_more(own):
    here, together, ended = threading.current_thread(), threading.Barrier(2, timeout=300.0), []

    def work(episodes, data):
        together.wait()
        if own == (threading.current_thread() is here):
            raise ZeroDivisionError
        time.sleep(0.05)  # long enough to be seen if nobody waits
        ended.append(episodes)

    episodes = np.arange(2 * SMALLEST_BLOCK)
    with pytest.raises(ZeroDivisionError):
        EpisodeThreads(2).run(work, episodes, episodes, getitem)
    assert len(ended) == 1


def test_the_threads_stay_behind_when_it_travels(monkeypatch):
    blocks = EpisodeThreads(2)
    before = workers(blocks)
    assert pickle.loads(pickle.dumps(blocks)).threads == 2
    monkeypatch.setattr("os.getpid", lambda: -1)  # as in a process that was forked
    assert workers(blocks) & before == {threading.current_thread()}
    with pytest.raises(ValueError, match="threads must be"):
        EpisodeThreads(0)
