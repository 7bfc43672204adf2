import dataclasses

import numpy as np
import pytest

from dptse_env.model import ARZModel, load_parameters
from dptse_env.release.nominal import (
    free_flow_density,
    nominal_flows,
    nominal_inputs,
    nominal_state,
)
from dptse_env.traffic import PAPER_HIGHWAY, DemandDistribution, randomised


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


# --- inputs at the published demand ---------------------------------------------------------------


def test_nominal_inputs_are_the_published_demand_at_every_second(model):
    inputs, layout = nominal_inputs(PAPER_HIGHWAY, model), model.layout
    v_f = model.parameters.free_flow_speed
    assert inputs.shape == (701, model.n_inputs)
    for time in range(701):
        rate = 6050.0 if 200 <= time < 400 else 2050.0
        np.testing.assert_allclose(inputs[time, layout.entry_inputs], [rate, 320.0, 300.0])
    np.testing.assert_array_equal(inputs[:, layout.entry_inputs + 1], v_f)


def test_behind_the_exits_the_flow_that_reaches_them_is_carried_freely(model):
    inputs, layout = nominal_inputs(PAPER_HIGHWAY, model), model.layout
    v_f, gamma, jam = (
        model.parameters.free_flow_speed, model.parameters.gamma, model.exit_jam_density,
    )  # fmt: skip
    for time in (0, 150, 450):
        flows = nominal_flows(PAPER_HIGHWAY, time)
        density = inputs[time, layout.exit_inputs]
        carried = density * v_f * (1.0 - (density / jam) ** gamma)
        np.testing.assert_allclose(carried, flows[[14, 17, 18]], rtol=1e-3)


def test_nominal_inputs_know_neither_incident_nor_draws():
    model = ARZModel(PAPER_HIGHWAY, load_parameters("w99-3lane"))
    drawn = randomised(PAPER_HIGHWAY)
    assert drawn != PAPER_HIGHWAY
    np.testing.assert_array_equal(
        nominal_inputs(drawn, model), nominal_inputs(PAPER_HIGHWAY, model)
    )
