"""Two small worlds on the short road, and a design of them."""

from agents.studies.estimators.cell import LINEAR
from agents.studies.estimators.plan import OWN, EstimatorDesign
from agents.studies.estimators.worlds import World

SHORT = "dptse_env:dptse/ShortHighway-v0"
TINY = World("a short road", SHORT, {"privacy": "paced", "horizon": 90})
MOVED = World("another budget", SHORT, {"privacy": "paced", "epsilon": 1.0, "horizon": 90})

DESIGN = EstimatorDesign(
    seeds="2000:2003",
    elsewhere_seeds="2000:2002",
    schedules=("paper", "round-robin", OWN),
    quick_estimators=("ekf", "random_walk", LINEAR, "recurrent"),
    slow_estimators=("ukf",),
    fit_seeds="0:1",
    worlds=("tiny", "moved"),
)


def add_worlds(patch):
    """Make the two worlds known."""
    from agents.studies.estimators import worlds

    for table in (worlds.MAIN, worlds.WORLDS):
        patch.setitem(table, "tiny", TINY)
    for table in (worlds.ELSEWHERE, worlds.WORLDS):
        patch.setitem(table, "moved", MOVED)
