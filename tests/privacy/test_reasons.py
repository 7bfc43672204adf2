from typing import get_args

import pytest

from dptse_env.privacy.reasons import VOID_REASONS, VoidReason


def test_every_reason_has_its_sentence_and_the_order_is_that_of_the_type():
    assert tuple(VOID_REASONS) == get_args(VoidReason)
    assert all(VOID_REASONS.values())


def test_the_table_cannot_be_changed():
    with pytest.raises(TypeError):
        VOID_REASONS["average_dwell"] = ""  # type: ignore[index]
