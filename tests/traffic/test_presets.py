import pytest

from dptse_env.traffic import CORRIDORS, DemandDistribution, randomised


@pytest.mark.parametrize("corridor", CORRIDORS.values(), ids=CORRIDORS)
def test_randomised_traffic_keeps_the_road_and_the_base_demand(corridor):
    random = randomised(corridor)
    assert random.demand == DemandDistribution(corridor.published_demand)
    assert random.digest != corridor.digest
    assert random.on_ramps == corridor.on_ramps
    assert randomised(random) == random
    last_start = random.incident.start[1]
    assert last_start + random.incident.duration[0] < corridor.duration
