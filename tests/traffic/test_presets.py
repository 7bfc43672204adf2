import pytest

from dptse_env.traffic import CORRIDORS, PAPER_HIGHWAY, DemandDistribution, randomised


def test_presets_are_found_by_their_names():
    for name in ("paper-highway", "short-highway", "long-highway"):
        assert CORRIDORS[name].name == name


def test_the_papers_demand_and_incident():
    assert PAPER_HIGHWAY.demand.mainline == ((0, 2050), (200, 6050), (400, 2050))
    assert PAPER_HIGHWAY.demand.on_ramps == (320, 300)
    assert PAPER_HIGHWAY.incident.segment == 10
    assert PAPER_HIGHWAY.incident.phases == ((200, 400, 10.08), (400, 500, 50.95))


@pytest.mark.parametrize("corridor", CORRIDORS.values(), ids=CORRIDORS)
def test_randomised_traffic_keeps_the_road_and_the_base_demand(corridor):
    random = randomised(corridor)
    assert random.demand == DemandDistribution(corridor.published_demand)
    assert random.digest != corridor.digest
    assert random.on_ramps == corridor.on_ramps
    assert randomised(random) == random
    last_start = random.incident.start[1]
    assert last_start + random.incident.duration[0] < corridor.duration
