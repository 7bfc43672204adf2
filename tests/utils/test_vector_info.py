import numpy as np

from dptse_env.utils.vector_info import in_vector_form, info_of, object_array, repeated_infos

INFOS = {
    "error": np.array([1.5, 2.5]),
    "queried": np.array([[True, False], [False, True]]),
    "truth": {"time": np.array([3, 4]), "lists": object_array([[1], [2, 3]])},
}


def test_an_info_is_plain_python():
    info_of(INFOS, 1)["queried"][:] = False  # a copy
    info = info_of(INFOS, 1)
    assert info.pop("queried").tolist() == [False, True]
    assert info == {"error": 2.5, "truth": {"time": 4, "lists": [2, 3]}}
    assert type(info["error"]) is float
    assert type(info["truth"]["time"]) is int


def test_vector_form_marks_the_episodes_that_have_a_value():
    infos = in_vector_form(INFOS, np.array([3, 1]), 4)
    assert infos.keys() == {"error", "_error", "queried", "_queried", "truth", "_truth"}
    assert infos["error"].tolist() == [0.0, 2.5, 0.0, 1.5]
    assert infos["queried"].tolist() == [[False] * 2, [False, True], [False] * 2, [True, False]]
    assert infos["truth"]["time"].dtype == np.int64
    assert infos["truth"]["lists"].tolist() == [None, [2, 3], None, [1]]
    for flags in (infos["_error"], infos["_truth"], infos["truth"]["_lists"]):
        assert flags.dtype == bool
        assert flags.tolist() == [False, True, False, True]
    assert infos["_error"] is not infos["_queried"]


def test_one_value_is_repeated_for_several_episodes():
    info = {"mu": 0.5, "cap": None, "preset": "printed", "reasons": ["a"], "more": {"n": 3}}
    infos = repeated_infos(info, 2)
    assert infos["mu"].tolist() == [0.5, 0.5]
    assert infos["more"]["n"].dtype == np.int64
    assert info_of(infos, 0) == info_of(infos, 1) == info
