import numpy as np

from dptse_env.utils.vector_info import in_vector_form, info_of, object_array

INFOS = {
    "error": np.array([1.5, 2.5]),
    "queried": np.array([[True, False], [False, True]]),
    "seed": np.array([3, 4]),
    "lists": object_array([[1], [2, 3]]),
}


def test_an_info_is_plain_python():
    info_of(INFOS, 1)["queried"][:] = False  # a copy
    info = info_of(INFOS, 1)
    assert info.pop("queried").tolist() == [False, True]
    assert info == {"error": 2.5, "seed": 4, "lists": [2, 3]}
    assert type(info["error"]) is float
    assert type(info["seed"]) is int


def test_vector_form_marks_the_episodes_that_have_a_value():
    infos = in_vector_form({**INFOS, "final_info": {"seed": INFOS["seed"]}}, np.array([3, 1]), 4)
    keys = {*INFOS, "final_info"}
    assert infos.keys() == keys | {f"_{key}" for key in keys}
    assert infos["error"].tolist() == [0.0, 2.5, 0.0, 1.5]
    assert infos["queried"].tolist() == [[False] * 2, [False, True], [False] * 2, [True, False]]
    assert infos["final_info"]["seed"].dtype == np.int64
    assert infos["lists"].tolist() == [None, [2, 3], None, [1]]
    for flags in (infos["_error"], infos["_final_info"], infos["final_info"]["_seed"]):
        assert flags.dtype == bool
        assert flags.tolist() == [False, True, False, True]
    assert infos["_error"] is not infos["_queried"]
