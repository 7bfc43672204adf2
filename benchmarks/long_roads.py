"""Time of an estimator's step on roads of growing length.

The roads have a ramp about every 700 m. All lengths of an estimator take turns, a step as in
`benchmarks.estimators`, a third of the mainline segments queried. A ratio of 4 on a road four times
as long is linear growth.
"""

from __future__ import annotations

from agents.figures import LABELS
from benchmarks.estimators import repeating, tapped_calls
from benchmarks.turns import Row, compare, make_batch, take_turns
from dptse_env.traffic import Conditions, Corridor, Demand, Geometry, Incident, Scales

DURATION = 1200  # [s], in which a vehicle passes 200 segments and a jam ends
EVERY = 15  # segments from one on-ramp to the next, and from one off-ramp to the next
ESTIMATORS = ("ekf", "ukf", "enkf", "mhe", "recurrent", "asm")


def long_road(n_mainline: int) -> Corridor:
    """Return a road of 100 m segments with three lanes, a jam, and as many exits as entries.

    The flow of the on-ramps replaces what leaves by the off-ramps, so that the traffic is about as
    dense at both ends. The jam begins in two thirds of the way.
    """
    on_ramps, off_ramps = range(5, n_mainline, EVERY), range(12, n_mainline, EVERY)
    geometry = Geometry(
        n_mainline, tuple(on_ramps), tuple(off_ramps), exit_shares=(0.08,) * len(off_ramps)
    )
    demand = Demand(
        mainline=((0.0, 3600.0), (300.0, 5200.0), (800.0, 3600.0)),
        on_ramps=(350.0,) * len(on_ramps),
    )
    incident = Incident(
        segment=2 * n_mainline // 3, phases=((500.0, 800.0, 10.0), (800.0, 900.0, 50.0))
    )
    return Corridor(
        f"long-road-{n_mainline}",
        geometry,
        Conditions(demand, DURATION, incident),
        Scales.of(geometry, average_dwell=5.0),
        fixed_sensors=(n_mainline - 1, n_mainline, n_mainline + 1),
    )


def measure(*, quick: bool = False) -> list[Row]:
    """Return the rows of all estimators; the ratios are to the shortest road."""
    lengths, n_steps, block, rounds = ((16, 21), 6, 3, 2) if quick else ((30, 60, 120), 60, 10, 12)
    work, bases = {}, {}
    for n in lengths:
        road = long_road(n)
        if quick:
            road = road.replaced(duration=60, incident=None)
        env = make_batch(
            "dptse_env:dptse/PaperHighway-v0", 1, corridor=road,
            parameters="w99-3lane", bandwidth=n // 3, traffic_seeds=[0],
        )  # fmt: skip
        calls = tapped_calls(env, n_steps)
        for name in ESTIMATORS:
            what, base = (f"{LABELS[name]}, {each} segments" for each in (n, lengths[0]))
            work[what] = repeating(name, "compiled", env, calls, block)
            if what != base:
                bases[what] = base
    return compare(take_turns(work, rounds), bases)
