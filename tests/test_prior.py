import dataclasses

import numpy as np
import pytest

from dptse_env.model import ARZModel, load_parameters
from dptse_env.prior import free_flow_density, nominal_flows, nominal_state
from dptse_env.traffic import PAPER_HIGHWAY, DemandDistribution


@pytest.fixture(params=["paper", "w99-3lane"])
def model(request):
    return ARZModel(PAPER_HIGHWAY, load_parameters(request.param))


def test_flows_add_up_along_the_road():
    flows = nominal_flows(PAPER_HIGHWAY, 0.0)
    entering, leaving_first = 2050.0 + 320.0, 0.1 * (2050.0 + 320.0)
    np.testing.assert_allclose(flows[:3], 2050.0)
    np.testing.assert_allclose(flows[3:6], entering)
    np.testing.assert_allclose(flows[6:9], entering - leaving_first)
    before_second_exit = entering - leaving_first + 300.0
    np.testing.assert_allclose(flows[9:12], before_second_exit)
    np.testing.assert_allclose(flows[12:15], 0.9 * before_second_exit)
    np.testing.assert_allclose(flows[15:], [320.0, 300.0, leaving_first, 0.1 * before_second_exit])


@pytest.mark.parametrize(
    ("time", "rate"), [(0, 2050), (199, 2050), (200, 6050), (399, 6050), (400, 2050), (700, 2050)]
)
def test_the_demand_of_the_moment_counts(time, rate):
    assert nominal_flows(PAPER_HIGHWAY, time)[0] == rate


def test_a_distribution_counts_with_its_base():
    random = dataclasses.replace(PAPER_HIGHWAY, demand=DemandDistribution(PAPER_HIGHWAY.demand))
    np.testing.assert_array_equal(nominal_flows(random, 0.0), nominal_flows(PAPER_HIGHWAY, 0.0))


def test_the_density_carries_the_flow_freely(model):
    flow = np.full(19, 250.0)
    density = free_flow_density(model, flow)
    v_f, gamma = model.parameters.free_flow_speed, model.parameters.gamma
    speed = v_f * (1.0 - (density / model.jam_density) ** gamma)
    np.testing.assert_allclose(density * speed, flow, rtol=1e-3)
    critical = model.jam_density * (1.0 + gamma) ** (-1.0 / gamma)
    assert (density < critical).all()
    np.testing.assert_allclose(free_flow_density(model, np.full(19, 1e6)), critical)


def test_the_nominal_state_hardly_moves_under_its_own_demand(model):
    state = nominal_state(PAPER_HIGHWAY, model, 0.0)[None]
    flows = nominal_flows(PAPER_HIGHWAY, 0.0)
    v_f = model.parameters.free_flow_speed
    inputs = np.array([[flows[0], v_f, 20.0, flows[15], v_f, flows[16], v_f, 2.0, 2.0]])
    after = state
    for _ in range(100):
        after = model.step(after, inputs)
    # Ramps merge with a w of v_f as well, so only the drop of speed behind a merge is left.
    np.testing.assert_allclose(model.density(after), model.density(state), rtol=0.02, atol=0.1)
