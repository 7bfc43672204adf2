"""Roads of any length with a ramp about every 700 m, and their recorded traffic."""

from __future__ import annotations

from dptse_env.traffic import Corridor, Demand, Incident

DURATION = 1200  # [s], in which a vehicle passes 200 segments and a jam ends
EVERY = 15  # segments from one on-ramp to the next, and from one off-ramp to the next


def long_road(n_mainline: int) -> Corridor:
    """Return a road of 100 m segments with three lanes, a jam, and as many exits as entries.

    The flow of the on-ramps replaces what leaves by the off-ramps, so that the traffic is about as
    dense at both ends. The jam begins in two thirds of the way.
    """
    on_ramps, off_ramps = range(5, n_mainline, EVERY), range(12, n_mainline, EVERY)
    return Corridor(
        name=f"long-road-{n_mainline}",
        n_mainline=n_mainline,
        on_ramps=tuple(on_ramps),
        off_ramps=tuple(off_ramps),
        exit_shares=(0.08,) * len(off_ramps),
        demand=Demand(
            mainline=((0.0, 3600.0), (300.0, 5200.0), (800.0, 3600.0)),
            on_ramps=(350.0,) * len(on_ramps),
        ),
        incident=Incident(
            segment=2 * n_mainline // 3, phases=((500.0, 800.0, 10.0), (800.0, 900.0, 50.0))
        ),
        fixed_sensors=(n_mainline - 1, n_mainline, n_mainline + 1),
        duration=DURATION,
        average_dwell=5.0,
    )
