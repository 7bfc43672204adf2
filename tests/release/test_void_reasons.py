from dptse_env.release import VOID_REASONS
from dptse_env.release.report import in_order


def test_reasons_come_in_the_order_of_the_table_and_unknown_ones_last():
    names = list(VOID_REASONS)
    assert in_order(["z", names[3], "a", names[0]]) == (names[0], names[3], "a", "z")
