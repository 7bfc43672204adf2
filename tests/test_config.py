"""`resolve`: presets, overrides, tuned settings, privacy and queries, and what is refused."""

import dataclasses
import itertools
import json
import warnings

import gymnasium as gym
import pytest

from dptse_env.config import (
    KEYWORDS,
    PRESETS,
    TEST_SEEDS,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    EnvConfig,
    UnknownKeywordError,
    parse_seeds,
    resolve,
)
from dptse_env.estimators import ESTIMATORS, EstimatorSettings, HorizonSettings
from dptse_env.estimators.settings import EnsembleSettings, SigmaPointSettings
from dptse_env.estimators.tuned import available_settings, load_settings
from dptse_env.model import available_parameters
from dptse_env.parts import make_release, make_task, privacy_report, warn_where_void
from dptse_env.release import MOST_QUERIES, RELEASE_MODELS, CappedSettings, PrivacySettings
from dptse_env.traffic import (
    CORRIDORS,
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    DemandDistribution,
    IncidentDistribution,
)
from tests.helpers import SHORT, MeanRelease, SumRelease


def test_seeds_of_training_validation_and_test_are_disjoint():
    for one, other in itertools.combinations((TRAINING_SEEDS, VALIDATION_SEEDS, TEST_SEEDS), 2):
        assert not {*one} & {*other}
    for preset in PRESETS.values():
        assert {*preset.traffic_seeds} <= {*TRAINING_SEEDS}


def test_seed_ranges():
    assert parse_seeds("3:6") == (3, 4, 5)
    assert parse_seeds("7") == (7,)
    for text in ("", "3:3", "4:2", "-1:2", "a:b", "1:2:3", " 0:1", "1:"):
        with pytest.raises(ValueError, match=r"^seeds must "):
            parse_seeds(text)


SUMS = "tests.helpers:SumRelease"
PRIVACY = {
    "preset": "capped", "epsilon": 2, "delta": 0.01, "unit": "event", "cap": 8,
    "adjacency": "add_remove", "share": 0.25,
    "boundary_inputs": "private", "noise": "secure",
}  # fmt: skip
LEDGERS = {
    "preset": "paced", "epsilon": 2.0, "adjacency": "add_remove", "clip": 25.0, "ratio": 3.0,
}  # fmt: skip
WHOLE = [
    {"incident": "random", "demand": "random", "action": "slots"},
    {"privacy": PRIVACY},
    {"privacy": LEDGERS, "incident": {"segment": 3, "phases": [[60.0, 120.0, 20.0]]}},
    {"estimator_settings": {"process_noise": [0.5, 0.25], "ukf": {"alpha": 1.0}}},
    {"privacy": SUMS, "query_spans": [1, 2, 4], "bandwidth_unit": "sums"},
]  # fmt: skip


@pytest.mark.parametrize("keywords", WHOLE)
def test_a_whole_configuration_survives_json_and_a_spec(keywords):
    config = resolve("paper-highway", json.loads(json.dumps(keywords)))
    plain = {name: dataclasses.asdict(config)[name] for name in KEYWORDS}
    plain["corridor"] = config.corridor.fields()
    if keywords.get("privacy") == SUMS:
        plain["privacy"]["preset"] = SUMS
    assert resolve("short-plain", json.loads(json.dumps(plain))) == config
    env = gym.make(SHORT, **keywords)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    assert again.action_space == env.action_space


def test_every_privacy_keyword_is_reachable_from_json():
    assert {*PRIVACY} == {field.name for field in dataclasses.fields(CappedSettings)}
    assert resolve("paper-highway", {"privacy": PRIVACY}).privacy == CappedSettings(**PRIVACY)


def test_partial_overrides_keep_the_rest():
    config = resolve("paper-highway", {"corridor": {"duration": 650}, "privacy": "corrected"})
    assert config.corridor == PAPER_HIGHWAY.replaced(duration=650)
    assert (config.privacy.preset, config.privacy.epsilon) == ("corrected", 1.0)
    config = resolve("paper-highway", {"privacy": {"delta": 0.01}, "epsilon": 2})
    assert (config.privacy.epsilon, config.privacy.delta) == (2.0, 0.01)
    config = resolve("paper-highway", {"corridor": "short-highway", "bandwidth": 2})
    assert config.corridor == SHORT_HIGHWAY
    config = resolve("private-highway", {"privacy": "corrected"})
    assert config.privacy == PrivacySettings("corrected", epsilon=5.0)
    assert make_task(config).centre is None
    config = resolve("paper-highway", {"privacy": "capped", "epsilon": 2})
    assert config.privacy == CappedSettings(epsilon=2.0)
    assert config.privacy.boundary == "nominal"
    nothing = {"privacy": {"boundary_inputs": None}}
    assert resolve("private-highway", nothing) == PRESETS["private-highway"]


def test_incident_and_demand_by_name():
    config = resolve("paper-highway", {"incident": "random", "demand": "random"})
    assert isinstance(config.corridor.conditions.incident, IncidentDistribution)
    assert isinstance(config.corridor.conditions.demand, DemandDistribution)
    assert resolve("paper-highway", {"incident": "none"}).corridor.conditions.incident is None
    assert resolve("paper-highway", {"incident": "preset"}).corridor == PAPER_HIGHWAY
    fields = {"corridor": {"incident": "none", "demand": "random", "duration": 600}}
    road = config.corridor.replaced(incident=None, duration=600)
    assert resolve("paper-highway", fields).corridor == road
    moved = resolve("paper-highway", {"incident": {"segment": 3}})
    assert moved.corridor.conditions.incident.segment == 3
    assert moved.corridor.conditions.incident.phases == PAPER_HIGHWAY.conditions.incident.phases


# --- settings of estimators -----------------------------------------------------------------------


def test_tuned_settings_are_found_by_estimator_parameters_privacy_and_road():
    given = {"parameters": "w99-3lane", "privacy": "printed", "estimator_settings": None}
    for estimator, found in (("ekf", load_settings("ekf-w99-3lane-printed")),
                             ("open_loop", EstimatorSettings())):  # fmt: skip
        assert resolve("paper-highway", {"estimator": estimator, **given}).settings() == found
    long = resolve("long-highway", {"estimator": "ekf"})
    assert long.settings_name == "ekf-w99-3lane-paced-long-highway"
    with pytest.warns(UserWarning, match="tuned on another road"):
        other = resolve("long-highway", {"estimator": "mhe"})
    assert other.settings_name == "mhe-w99-3lane-paced"
    assert resolve("private-highway", {"estimator": "ekf"}).settings_name == "ekf-w99-3lane-paced"


@pytest.mark.parametrize("estimator", ["ekf", "ukf", "enkf", "mhe", "recurrent", "blend"])
def test_the_papers_road_has_the_papers_filters_where_all_else_is_the_papers(estimator):
    for privacy in ("printed", "corrected", "capped", "paced"):
        keywords = {"estimator": estimator, "privacy": privacy}
        name = resolve("paper-highway", keywords).settings_name
        has_filter = estimator not in ("recurrent", "blend")
        assert str(name).endswith("-published") == has_filter
        for other in ({"parameters": "w99-3lane"}, {"corridor": {"lanes": 4}}):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = resolve("paper-highway", {**keywords, **other})
            assert found.estimator_settings is None


TUNED = {"ekf", "ukf", "enkf", "mhe", "random_walk", "blend"}


def test_every_shipped_combination_has_tuned_settings_or_says_that_it_has_none():
    for road, parameters, privacy, estimator in itertools.product(
        CORRIDORS, available_parameters(), RELEASE_MODELS, ESTIMATORS
    ):
        keywords = {"parameters": parameters, "privacy": privacy, "estimator": estimator}
        keywords["estimator_settings"] = None
        name = f"{estimator}-{parameters}-{privacy}"
        ways = (f"{name}-{road}",) if road == "long-highway" else (name,)
        is_tuned = estimator not in TUNED or any(way in available_settings() for way in ways)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            config = resolve("paper-highway", {"corridor": road, **keywords})
        expected = () if is_tuned else ("estimator_settings",)
        assert config.inherited == expected, (road, name)
        assert len(told) == len(expected)


@pytest.mark.filterwarnings("error")
def test_settings_that_are_given_need_no_tuned_ones():
    given = {"privacy": "printed", "estimator": "blend"}
    assert resolve("paper-highway", {**given, "estimator_settings": {}}).inherited == ()
    for none in ({}, {"estimator_settings": None}):  # which are the same
        with pytest.raises(UserWarning, match=r"^estimator_settings: .*defaults that nobody tuned"):
            resolve("paper-highway", {**given, **none})


PAPER_FILTERS = {
    "ekf": {},
    "ukf": {"ukf": SigmaPointSettings(alpha=0.1, beta=2.0, kappa=-4.0)},
    "enkf": {"enkf": EnsembleSettings(n_members=100, inflation=1.0, taper=None)},
    "mhe": {},
}


def test_the_papers_filters_have_its_settings_by_one_name():
    for parameters, privacy, (estimator, own) in itertools.product(
        available_parameters(), RELEASE_MODELS, PAPER_FILTERS.items()
    ):
        keywords = {"parameters": parameters, "privacy": privacy, "estimator": estimator}
        config = resolve("paper-highway", {**keywords, "estimator_settings": "published"})
        settings = config.settings()
        (q,), scale = {*settings.process_noise}, settings.noise_scale
        assert settings == EstimatorSettings(
            process_noise=(q, q), noise_scale=scale, bounds="box", mhe=settings.mhe, **own
        )
        if estimator == "mhe":
            (arrival,) = {*settings.mhe.arrival_noise}
            assert settings.mhe == HorizonSettings(horizon=10, arrival_noise=(arrival, arrival))
        if privacy in ("printed", "corrected"):  # R = r I, over rho_m and v_f
            stds = [each.noise_std for each in privacy_report(config).releases]
            arz = config.parameters
            density, speed = (std * each for std, each in zip(stds, scale, strict=True))
            ratio = density / arz.jam_density / (speed / arz.free_flow_speed)
            assert ratio == pytest.approx(1.0, rel=1e-3)
    assert EnvConfig(config, estimator="ekf").settings_name.startswith("ekf-")
    for keywords in ({"estimator": "blend"}, {"privacy": SUMS}):
        with pytest.raises(ValueError, match=r"^estimator_settings .* ekf, enkf, mhe, ukf with a"):
            resolve("paper-highway", {**keywords, "estimator_settings": "published"})


def test_a_tuned_set_by_name_serves_any_estimator():
    keywords = {"estimator": "ukf", "estimator_settings": "ekf-w99-3lane-printed"}
    config = resolve("paper-highway", keywords)
    assert config.estimator_settings == "ekf-w99-3lane-printed"
    assert config.settings() == load_settings("ekf-w99-3lane-printed")


def test_a_mapping_of_settings_keeps_what_would_have_been_chosen():
    keywords = {"parameters": "w99-3lane", "estimator_settings": {"mhe": {"horizon": 3}}}
    tuned = load_settings("ekf-w99-3lane-printed")
    assert tuned.process_noise != EstimatorSettings().process_noise
    expected = dataclasses.replace(tuned, mhe=dataclasses.replace(tuned.mhe, horizon=3))
    assert resolve("paper-highway", keywords).settings() == expected
    untuned = resolve("paper-highway", {**keywords, "estimator": "open_loop"}).settings()
    assert untuned == EstimatorSettings(mhe=HorizonSettings(horizon=3))
    given = EstimatorSettings(noise_scale=(2.0, 2.0))
    assert resolve("paper-highway", {"estimator_settings": given}).settings() is given


BAD_SETTINGS = [
    ("ekf", "best", r" must be .*, got 'best'$"),
    ("ekf", {"noise": 1.0}, r"\.noise is unknown; allowed: "),
    ("mhe", {"process_noise": [0.01, 0.0]}, r"\.process_noise\[1\] must be"),
    ("mhe", {"mhe": {"horizon": 1000}}, r"\.mhe\.horizon must be .* 1\.\.186"),
    ("ukf", {"ukf": {"kappa": -18.0}, "demand": {}}, r"\.ukf\.kappa must be > -18, got -18"),
    ("recurrent", {"recurrent": {"weights": "x"}}, r"\.recurrent\.weights must be"),
    ("random_walk", "ekf-w99-3lane-paced", r"\.demand must be None for 'random_walk'"),
    ("recurrent", "ekf-w99-3lane-paced", r"\.demand must be None for 'recurrent'"),
]


def test_settings_that_an_estimator_cannot_have_are_refused_when_it_is_made():
    for estimator, settings, message in BAD_SETTINGS:
        with pytest.raises(ValueError, match=f"^estimator_settings{message}"):
            gym.make(SHORT, estimator=estimator, estimator_settings=settings)


# --- privacy --------------------------------------------------------------------------------------


def test_neither_bandwidth_nor_sensors_enter_an_honest_bound_but_the_papers():
    more = {"bandwidth": 15, "corridor": {"fixed_sensors": [0, 7, 14]}}
    first, *others = (
        make_release(resolve("private-highway", {**keywords, "privacy": privacy})).sensitivity
        for keywords, privacy in (
            ({}, "capped"),
            (more, "capped"),
            ({}, {"preset": "capped", "boundary_inputs": "private"}),
        )
    )
    assert others == [first, first]
    private = {"privacy": {"boundary_inputs": "private"}}
    fewer, more = (make_release(resolve("paper-highway", k)).sensitivity[0] for k in ({}, private))
    assert dict(fewer.assumptions)["n_sensors"] == 8
    assert dict(more.assumptions)["n_sensors"] == 8 + 2 + PAPER_HIGHWAY.geometry.n_ramps


def test_no_warning_where_no_guarantee_is_requested_or_it_holds():
    second = {"preset": "capped", "boundary_inputs": "private", "unit": "event"}
    for privacy in ("printed", "corrected", "capped", second):
        warn_where_void(resolve("private-highway", {"privacy": privacy}))  # would be an error here


# --- queries --------------------------------------------------------------------------------------

LONG_ROAD = {
    "corridor": {
        "n_mainline": 200, "on_ramps": [], "off_ramps": [], "exit_shares": [],
        "demand": {"mainline": [[0, 1000]], "on_ramps": []},
    },
    "incident": "none",
    "query_spans": list(range(1, 101)),
}  # fmt: skip
BAD_QUERIES = [
    ({"query_spans": []}, "query_spans must be ascending"),
    ({"query_spans": [1, 1]}, "query_spans must be ascending"),
    ({"query_spans": [1, 7]}, "query_spans must be ascending"),
    ({"query_spans": [0, 1]}, r"query_spans\[0\] must be"),
    ({"query_spans": [1.5]}, r"query_spans\[0\] must be"),
    ({"query_spans": 2}, "query_spans must be"),
    ({"bandwidth_unit": "queries"}, "bandwidth_unit must be"),
    ({"query_spans": [3, 4]}, r"bandwidth must be in 3\.\.6"),
    ({"bandwidth": 7}, r"bandwidth must be in 1\.\.6"),
    (LONG_ROAD, rf"query_spans must leave at most {MOST_QUERIES} .*, got 15050$"),
    ({"privacy": MeanRelease, "query_spans": (1, 2)}, r"query_spans must be \(1,\) where mean"),
    *[
        ({"privacy": preset, "query_spans": [1, 2]}, rf"query_spans must be .* model '{preset}'")
        for preset in ("printed", "corrected", "capped")
    ],
]


def test_bad_queries_are_named():
    for keywords, message in BAD_QUERIES:
        with pytest.raises(ValueError, match=f"^{message}"):
            resolve("short-plain", {"privacy": SumRelease, **keywords})


@pytest.mark.parametrize("name", ["base", "inherited", "origins"])
def test_what_a_configuration_keeps_beside_its_keywords_is_no_keyword(name):
    with pytest.raises(UnknownKeywordError, match=rf"^{name} is unknown; allowed: corridor, "):
        resolve("short-plain", {name: ()})


def test_the_hint_on_an_unknown_keyword_imports_no_plugin(monkeypatch):
    monkeypatch.setitem(RELEASE_MODELS._parts, "other", "nowhere:Model")
    with pytest.raises(UnknownKeywordError, match="it is a field of privacy"):
        resolve("private-highway", {"unit": "event"})
