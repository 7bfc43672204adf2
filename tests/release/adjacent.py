"""Trips of two records that differ in one vehicle, drawn at random."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from .worlds import AWAY


@st.composite
def trips(draw, n_vehicles, n_steps, last_place, limit):
    """Places and speeds (n_vehicles, n_steps + 1); few segments, so that vehicles meet."""
    shape = n_vehicles, n_steps + 1
    places = draw(arrays(np.int16, shape, elements=st.integers(AWAY, last_place)))
    speed = st.sampled_from([0.0, limit / 2, limit, 1.5 * limit]) | st.floats(0.0, limit, width=32)
    return places, draw(arrays(np.float32, shape, elements=speed))


@st.composite
def adjacent_trips(draw, asked, most_vehicles, *road):
    """Places and speeds in two worlds that differ in vehicle 0 as `asked` protects.

    `road` is the number of steps, the last place and the speed limit, as for `trips`.
    """
    places, speeds = draw(trips(draw(st.integers(1, most_vehicles)), *road))
    other_places, other_speeds = places.copy(), speeds.copy()
    at, n_steps = np.arange(road[0] + 1), road[0]
    if asked.unit == "event":
        at = at[[draw(st.integers(1, n_steps))]]
    new_places, new_speeds = draw(trips(1, *road))
    if asked.adjacency == "add_remove":
        new_places = np.full_like(new_places, AWAY)
    other_places[0, at], other_speeds[0, at] = new_places[0, at], new_speeds[0, at]
    return places, speeds, other_places, other_speeds
