import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.model.relations import Relations

JAM = np.array(300.0)
relations = st.builds(Relations, free_flow_speed=st.floats(20.0, 200.0), gamma=st.floats(0.3, 4.0))
share = st.floats(0.01, 1.0)


@given(relations, share)
def test_pressure_and_equilibrium_speed_add_up_to_free_flow(r, x):
    equilibrium = r.free_flow_speed * (1.0 - x**r.gamma)
    np.testing.assert_allclose(equilibrium + r.pressure(x * JAM, JAM), r.free_flow_speed)


@given(relations, share)
def test_inverse_pressure_inverts(r, x):
    np.testing.assert_allclose(r.inverse_pressure(r.pressure(x * JAM, JAM), JAM), x * JAM)


@given(relations, share)
def test_capacity_is_the_largest_flow_of_drivers_w(r, x):
    w = np.array(1.1 * x * r.free_flow_speed)
    density = np.linspace(0.0, 1.5, 20_001) * JAM
    flow = density * (w - r.pressure(density, JAM))
    critical = r.critical_density(w, JAM)
    assert np.all(flow <= r.capacity(w, JAM) * (1.0 + 1e-12))
    at_critical = critical * (w - r.pressure(critical, JAM))
    np.testing.assert_allclose(at_critical, r.capacity(w, JAM), rtol=1e-9)


@given(relations, share)
def test_demand_is_continuous_at_the_critical_density_and_never_falls(r, x):
    w = np.array(1.1 * x * r.free_flow_speed)
    critical = float(r.critical_density(w, JAM))
    below, above = r.demand(np.array([critical * (1 - 1e-9), critical * (1 + 1e-9)]), w, JAM)
    np.testing.assert_allclose(below, above, rtol=1e-6)
    demand = r.demand(np.linspace(0.0, 1.2, 500) * JAM, w, JAM)
    assert np.all(np.diff(demand) >= -1e-9 * demand.max())


@given(relations, share)
def test_supply_never_falls_in_the_speed_ahead_and_is_continuous(r, x):
    w = np.array(1.1 * x * r.free_flow_speed)
    speed = np.linspace(0.0, 1.5, 500) * w
    supply = r.supply(w, speed, JAM)
    assert np.all(np.diff(supply) >= -1e-9 * supply.max())
    sonic = w * r.gamma / (1.0 + r.gamma)
    below, above = r.supply(w, sonic * np.array([1 - 1e-9, 1 + 1e-9]), JAM)
    np.testing.assert_allclose(below, above, rtol=1e-6)


@given(relations, share)
def test_supply_never_falls_in_w(r, x):
    speed = np.array(x * r.free_flow_speed)
    w = np.linspace(0.0, 1.1, 500) * r.free_flow_speed
    supply = r.supply(w, speed, JAM)
    assert np.all(np.diff(supply) >= -1e-9 * supply.max())


@given(relations, share)
def test_supply_of_standing_traffic_is_nothing(r, x):
    assert r.supply(np.array(x * r.free_flow_speed), np.array(0.0), JAM) == 0.0


@given(relations, share, share)
def test_gradients_are_those_of_central_differences(r, x, y):
    density, w = x * JAM, np.array(y * 1.1 * r.free_flow_speed)
    speed = np.array(0.9 * x * y * r.free_flow_speed)
    for function, gradient, first, second in (
        (r.demand, r.demand_gradient, density, w),
        (r.supply, r.supply_gradient, w, speed),
    ):
        kink = (1.0 + r.gamma) * r.pressure(density, JAM) / w, speed / w * (1.0 + 1.0 / r.gamma)
        if min(abs(float(k) - 1.0) for k in kink) < 1e-3:
            continue
        by_first, by_second = gradient(first, second, JAM)
        h = 1e-5
        numeric = (function(first + h, second, JAM) - function(first - h, second, JAM)) / (2 * h)
        assert float(by_first) == pytest.approx(float(numeric), rel=1e-4, abs=1e-4)
        numeric = (function(first, second + h, JAM) - function(first, second - h, JAM)) / (2 * h)
        assert float(by_second) == pytest.approx(float(numeric), rel=1e-4, abs=1e-4)
