"""Traffic of another simulator than SUMO: unstable car following on a few parallel lanes.

Vehicles follow the intelligent driver model (Treiber, Hennecke and Helbing, 2000) with white noise
of the acceleration (Treiber and Kesting, 2017), from which waves grow. Desired speeds and headways
differ between drivers. At a bottleneck downstream of the section that is recorded headways are
longer, by a factor that changes now and then, so that queues and stop-and-go waves come in through
the section's end. Vehicles change lanes where there is more room.

Nothing is trained, tuned or chosen on this traffic.
"""

from __future__ import annotations

import numpy as np

from dptse_env.traffic import Conditions, Corridor, Demand, Geometry, Scales
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import AnyArray, FloatArray

LANES, LIMIT = 3, 105.0
"""Lanes of the road, and its speed limit [km/h]."""
LENGTH, FIRST, WIDTH, N = 3000.0, 1000.0, 100.0, 10
"""Length of the road, start of the first segment, length of a segment [m]; number of segments."""
BOTTLENECK = 2300.0, 2600.0
"""Stretch with longer headways [m]."""
WARM_UP, DURATION = 400, 600
"""Seconds ahead of a record, and of a record."""
STEP = 0.25
"""Time step [s]."""
ACCELERATION, BRAKING, GAP, VEHICLE = 0.8, 1.5, 2.0, 5.0
"""Largest acceleration, comfortable braking [m/s^2]; smallest gap, length of a vehicle [m]."""
NOISE = 0.3
"""Intensity of the noise of the acceleration [m/s^1.5]."""
CHANGE = 0.05
"""Rate at which a vehicle looks for room in another lane [1/s]."""


def road() -> Corridor:
    """Return the section that is recorded, without its records."""
    geometry = Geometry(N, lanes=LANES, segment_length=WIDTH / 1000.0, speed_limit=LIMIT)
    conditions = Conditions(Demand(mainline=((0.0, 4500.0),)), DURATION)
    return Corridor("idm", geometry, conditions, Scales.of(geometry, average_dwell=8.0))


def simulate(seed: int) -> Record:
    """Simulate a record of `road`; the same seed gives the same one."""
    rng = np.random.default_rng([seed, 71])
    cars = np.empty((6, 0))  # place, speed, desired speed, headway, lane, number
    waiting, rate = np.zeros(LANES), rng.uniform(0.38, 0.52)
    n_cars, factor, until = 0, 1.0, 0.0
    seen: list[AnyArray] = []
    for k in range(round((WARM_UP + DURATION) / STEP) + 1):
        t = k * STEP
        if t >= until:
            factor = rng.choice([1.0, rng.uniform(1.3, 2.5)])
            until = t + rng.uniform(20.0, 120.0)
        waiting += rng.poisson(rate * STEP, LANES)
        for lane in np.flatnonzero(waiting):
            ahead = cars[:2, cars[4] == lane]
            place, speed = ahead[:, ahead[0].argmin()] if ahead.size else (LENGTH, np.inf)
            wish = LIMIT / 3.6 * rng.normal(1.0, 0.08)
            start = min(wish, speed + 1.0)
            if place > VEHICLE + GAP + start:
                new = np.array([0.0, start, wish, rng.uniform(0.8, 1.5), lane, n_cars])
                cars = np.column_stack([cars, new])
                n_cars, waiting[lane] = n_cars + 1, waiting[lane] - 1
        cars = _in_order(cars)
        for i in np.flatnonzero(rng.random(cars.shape[1]) < CHANGE * STEP):
            _look_for_room(cars, int(i), int(rng.choice([-1, 1])))
        cars = _in_order(cars)
        if t >= WARM_UP and t % 1.0 == 0.0:
            seen.append(_seen(cars, int(t) - WARM_UP))
        drive(cars, factor, rng)
        cars = cars[:, cars[0] < LENGTH]
    step, vehicle, segment, speed = np.concatenate(seen, axis=1)
    return Record(
        n_steps=DURATION + 1, n_columns=N + 2, step=step, vehicle=vehicle, segment=segment,
        speed=speed,
    )  # fmt: skip


def _in_order(cars: FloatArray) -> FloatArray:
    """Return cars lane by lane, each from upstream on."""
    return cars[:, np.lexsort((cars[0], cars[4]))]


def _gaps(cars: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the gap [m] to each car's leader, and how much slower that is [m/s]."""
    leads = np.append(cars[4, 1:] == cars[4, :-1], False)
    gap, slower = np.roll(cars[0], -1) - cars[0] - VEHICLE, cars[1] - np.roll(cars[1], -1)
    return np.where(leads, gap, 1e4), np.where(leads, slower, 0.0)


def _look_for_room(cars: FloatArray, i: int, side: int) -> None:
    """Let a car change lanes if the gap is larger there, and the next one behind is far enough."""
    place, speed, lane = cars[0, i], cars[1, i], cars[4, i]
    own = cars[0, (cars[4] == lane) & (cars[0] > place)].min(initial=LENGTH) - place
    there = cars[:2, cars[4] == lane + side]
    ahead = there[0, there[0] > place].min(initial=LENGTH) - place
    behind = there[:, there[0] <= place]
    place_behind, speed_behind = behind[:, behind[0].argmax()] if behind.size else (-LENGTH, 0.0)
    room = VEHICLE + GAP + 0.6 * speed_behind + 2.0 * max(speed_behind - speed, 0.0)
    if 0 <= lane + side < LANES and ahead > 1.2 * own + 5.0 and place - place_behind > room:
        cars[4, i] = lane + side


def drive(cars: FloatArray, factor: float, rng: np.random.Generator) -> None:
    """Move cars for a step, by the intelligent driver model with noise."""
    place, speed, wish, headway = cars[:4]
    gap, slower = _gaps(cars)
    slow = (place > BOTTLENECK[0]) & (place < BOTTLENECK[1])
    kept = speed * headway * np.where(slow, factor, 1.0)
    kept += speed * slower / (2.0 * np.sqrt(ACCELERATION * BRAKING))
    ratio = (GAP + np.maximum(kept, 0.0)) / np.maximum(gap, 0.1)
    a = np.maximum(ACCELERATION * (1.0 - (speed / wish) ** 4 - ratio**2), -9.0)
    noise = NOISE * np.sqrt(STEP) * rng.normal(size=speed.size) * (speed > 0.0)
    # Nobody drives into the place where the leader is.
    speed[:] = np.clip(speed + STEP * a + noise, 0.0, np.maximum(gap, 0.0) / STEP)
    place += STEP * speed


def _seen(cars: FloatArray, second: int) -> AnyArray:
    """Return seconds, numbers, columns and speeds [km/h] of the cars on the section, by column."""
    segment = np.floor((cars[0] - FIRST) / WIDTH)
    cars, segment = (each[..., (segment >= -1) & (segment <= N)] for each in (cars, segment))
    column = np.where(segment < 0, N, np.where(segment == N, N + 1, segment))
    order = np.argsort(column, kind="stable")
    rows = np.full(column.size, second), cars[5], column, 3.6 * cars[1]
    return np.stack(rows)[:, order]
