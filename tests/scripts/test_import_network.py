import warnings

import gymnasium as gym
import pytest

from dptse_env.traffic import read_corridor
from scripts.cli import run
from scripts.import_network import Args, main
from tests.importers.network.conftest import PATH, motorway
from tests.scripts.commands import run_script


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("own")
    motorway(path)
    (path / "own.sumocfg").write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="road.rou.xml"/>'
        '<step-length value="0.5"/></configuration>'
    )
    result = run_script(
        "import_network.py", "--configuration", str(path / "own.sumocfg"), "--first", "in",
        "--last", "out", "--duration", "120", "--output", str(path / "My own.toml"),
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "on-ramp at face 3: ramp-b" in result.stdout
    assert "off-ramp at face 15: exit-a" in result.stdout
    return path


def test_an_imported_road_is_a_corridor_of_any_environment(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about values of another road
        env = gym.make(
            "dptse_env:dptse/PaperHighway-v0",
            corridor=str(folder / "My own.toml"), estimator="random_walk", traffic_seeds="0:1",
            records=str(folder / "records"), bandwidth=4,
        )  # fmt: skip
    observation, _ = env.reset(seed=0)
    assert observation is not None
    for _ in range(60):
        *_, info = env.step(env.action_space.sample())
    assert info["n_occupied"] > 5
    env.close()


def test_path_and_files_may_be_given_one_by_one(folder, monkeypatch):
    output = folder / "given.toml"
    args = Args(
        output=output, net=folder / "road.net.xml", routes=(folder / "road.rou.xml",),
        path=" ".join(PATH), step_length=0.5, duration=120,
    )  # fmt: skip
    main(args)
    given, named = read_corridor(output), read_corridor(folder / "My own.toml")
    assert given.digest == named.digest
    assert (given.name, named.name) == ("given", "my-own")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "error: net must be given, or a configuration"),
        (("--net", "{folder}/road.net.xml"), "error: path must be given, or first and last"),
        (("--net", "{folder}/road.net.xml", "--path", "on"), "error: path: {folder}/road.net.xml"),
        (("--net", "{folder}", "--path", "in"), "error: net: {folder} must be a file"),
        (("--output", "road.json"), "error: output must be a .toml file"),
    ],
)
def test_mistakes_end_in_one_line_on_stderr(folder, arguments, message, monkeypatch, capsys):
    given = [each.format(folder=folder) for each in arguments]
    monkeypatch.setattr("sys.argv", ["import_network.py", *given])
    with pytest.raises(SystemExit) as ended:
        run(main, Args, None)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(message.format(folder=folder))
