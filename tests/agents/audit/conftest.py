import numpy as np
import pytest

from dptse_env.traffic import Record

from .small import HORIZON, N_COLUMNS, ROAD


@pytest.fixture(scope="module")
def record():
    """Vehicles that enter one by one and drive through at speeds that vary."""
    generator, rows = np.random.default_rng(0), []
    for vehicle in range(12):
        place, speed = generator.uniform(0.0, 1.0), generator.uniform(10.0, 90.0)
        for step in range(1 + 2 * vehicle, HORIZON + 1):
            if place < ROAD.geometry.n_mainline:
                rows.append((step, vehicle, int(place), speed))
            place += speed / 100.0 * generator.uniform(0.1, 1.0)
            speed = float(np.clip(speed + generator.normal(0.0, 10.0), 0.0, 120.0))
    step, vehicle, segment, speed = (np.array(column) for column in zip(*sorted(rows), strict=True))
    return Record(
        step=step, vehicle=vehicle, segment=segment, speed=speed,
        n_steps=HORIZON + 1, n_columns=N_COLUMNS,
    )  # fmt: skip
