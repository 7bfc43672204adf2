"""A training of a few seconds on the short road."""

from agents.filters.plan import OWN, FilterPlan, Round
from agents.filters.scenarios import ScenarioRanges

SHORT = "dptse_env:dptse/ShortHighway-v0"
RANGES = ScenarioRanges(envs=(SHORT,), spans=((1,), (1, 2)))
PLAN = FilterPlan(
    seed=3,
    traffic_seeds=(0, 1, 2),
    validation_seeds=(1000, 1001),
    validation_envs=(SHORT,),
    ranges=RANGES,
    rounds=(Round("ekf", 2, 3), Round(OWN, 2, 3)),
    width=4,
    episodes=2,
    checkpoint_every=2,
)
