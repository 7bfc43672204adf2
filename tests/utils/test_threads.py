import pickle
import threading
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dptse_env.utils.threads import SMALLEST_BLOCK, EpisodeThreads


@given(threads=st.integers(1, 4), n_rows=st.integers(0, 1000))
@example(threads=3, n_rows=2 * SMALLEST_BLOCK)
@settings(max_examples=20)
def test_every_row_is_worked_on_once(threads, n_rows):
    seen = np.zeros(n_rows, dtype=int)

    def work(rows):
        seen[rows] += 1

    EpisodeThreads(threads).run(n_rows, work)
    assert (seen == 1).all()


def test_large_batches_use_the_threads_and_small_ones_do_not():
    names = set()

    def work(rows):
        names.add(threading.current_thread().name)
        time.sleep(0.01)

    blocks = EpisodeThreads(2)
    blocks.run(2 * SMALLEST_BLOCK - 1, work)
    assert names == {threading.current_thread().name}
    blocks.run(2 * SMALLEST_BLOCK, work)
    assert len(names) == 2


@pytest.mark.parametrize("own", [True, False])
def test_an_exception_is_raised_once_nobody_works_any_more(own):
    running = []
    here = threading.current_thread()

    def work(rows):
        running.append(rows)
        fails = own == (threading.current_thread() is here)
        time.sleep(0.01 if fails else 0.03)
        running.remove(rows)
        if fails:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        EpisodeThreads(2).run(2 * SMALLEST_BLOCK, work)
    assert not running


def test_the_threads_stay_behind_when_it_travels():
    blocks = EpisodeThreads(2)
    blocks.run(2 * SMALLEST_BLOCK, lambda rows: None)
    assert pickle.loads(pickle.dumps(blocks)).threads == 2
    with pytest.raises(ValueError, match="threads must be"):
        EpisodeThreads(0)
