import pytest

from dptse_env.release import VOID_REASONS
from dptse_env.release.report import in_order


def test_every_reason_has_an_explanation():
    assert all(VOID_REASONS.values())


def test_the_table_cannot_be_changed():
    with pytest.raises(TypeError):
        VOID_REASONS["average_dwell"] = ""  # type: ignore[index]


def test_reasons_come_in_the_order_of_the_table_and_unknown_ones_last():
    names = list(VOID_REASONS)
    assert in_order(["z", names[3], "a", names[0]]) == (names[0], names[3], "a", "z")
