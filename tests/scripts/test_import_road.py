import re
import sys
from pathlib import Path

import pytest

from dptse_env.traffic import RecordLibrary, read_corridor
from dptse_env.traffic.imported import recorded_seeds
from scripts.import_road import Args, Trajectories, main
from scripts.record import Args as RecordArgs
from scripts.record import main as record
from tests.importers.data import STRAIGHT, plain, stream, write_csv
from tests.importers.test_tables import ngsim
from tests.scripts.commands import ROOT, run_script

ROAD = 'dptse_env:dptse/PaperHighway-v0 {"corridor": {"n_mainline": 4, "on_ramps": [], "off_ramps": [], "exit_shares": [], "duration": 20,'
ROAD += ' "demand": {"mainline": [[0, 1]], "on_ramps": []}, "incident": null, "fixed_sensors": []}}'


def on(road):
    return f'dptse_env:dptse/PaperHighway-v0 {{"corridor": "{road}"}}'


COLUMNS = ("time=t", "vehicle=id", "x=s", "speed=v")


def test_one_command_makes_a_road_that_the_other_scripts_take(tmp_path, capsys):
    path = plain(tmp_path / "a.csv", stream(seconds=125.0))
    result = run_script(
        "import_road.py", "trajectories", "--files", str(path), "--env", ROAD,
        "--format", "table", "--columns", *COLUMNS, "--output", str(tmp_path / "my-data"),
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "training: 4 window(s), traffic seeds 0..3" in result.stdout
    assert "test: 1 window(s), traffic seeds 2000" in result.stdout
    road = tmp_path / "my-data" / "road.toml"
    assert {each.name for each in road.parent.iterdir()} == {
        "manifest.json", "records", "report.json", "report.md", "report.png", "road.toml"
    }  # fmt: skip
    record(RecordArgs(env=on(road), seeds="0:4"))
    assert "T_avg" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"must be one that was recorded \(0\.\.3, 1000, 2000"):
        record(RecordArgs(env=on(road), seeds="0:16"))


def test_a_mapping_file_and_a_road_file_describe_the_data(tmp_path):
    (tmp_path / "road.toml").write_text(
        'n_mainline = 4\nduration = 20\nspeed_limit = 100\n[demand]\nmainline = [[0, 1]]\n'
        "[environment]\nbandwidth = 2\n"
    )  # fmt: skip
    (tmp_path / "data.toml").write_text(
        'format = "ngsim"\n[where]\nLocation = "us-101"\n[layout.mainline]\nlanes = [1, 2, 3]\n'
    )
    columns = ngsim(stream())
    columns["Location"] = ["us-101"] * len(columns["Vehicle_ID"])
    path = write_csv(tmp_path / "a.csv", columns)
    given = Trajectories(
        files=(path,), env=on(tmp_path / "road.toml"), output=tmp_path / "new", mapping=tmp_path / "data.toml",
        shares=(1.0, 0.0, 0.0),
    )  # fmt: skip
    main(given)
    text = (tmp_path / "new" / "road.toml").read_text()
    assert re.search(r"\[environment\]\s+bandwidth = 2", text)
    corridor = read_corridor(tmp_path / "new" / "road.toml")
    assert recorded_seeds(corridor.recordings) == tuple(range(5))
    assert RecordLibrary().get(corridor, 0).n_steps == STRAIGHT.duration + 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "format must be given where no mapping is"),
        (("--format", "xls"), "source.format must be one of fcd, ngsim, highd"),
        (("--format", "table", "--columns", "t"), "columns must be key=value, got 't'"),
        (("--format", "table", "--columns", "when=t"), "source.columns must be one of time,"),
        (("--format", "table", "--units", "length=yd"), "source.units.length must be one of m,"),
        (("--mapping", "none.toml"), "none.toml: the mapping cannot be read: No such file"),
        (("--format", "table", "--shares", "1", "1", "0"), "shares must be at least 0"),
    ],
)
def test_mistakes_end_in_one_line_on_stderr(arguments, message, tmp_path, monkeypatch, capsys):
    from scripts.cli import run

    path = plain(tmp_path / "a.csv", stream(seconds=30.0))
    common = ["--files", str(path), "--env", ROAD, "--output", str(tmp_path / "new")]
    monkeypatch.setattr(sys, "argv", ["import_road.py", "trajectories", *common, *arguments])
    with pytest.raises(SystemExit) as ended:
        run(main, Args, None)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"error: {message}")
    assert not (tmp_path / "new").exists()


def test_the_page_on_own_data_has_commands_that_run(tmp_path):
    page = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
    files = dict(re.findall(r"```toml\n# (\S+)\n(.*?)```", page, re.DOTALL))
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    points = stream(seconds=723.0, headway=8.0, length=640.0)
    for name in ("0750", "0805", "0820"):
        write_csv(tmp_path / f"{name}.csv", ngsim(points))
    (command,) = re.findall(r"python scripts/import_road.py (.*?--mapping.*?)\n```", page,
                            re.DOTALL)  # fmt: skip
    words = command.replace("\\\n", " ").split()
    here = [str(tmp_path / word) if re.search(r"\.(csv|toml)$|^us-101$", word) else word
            for word in words]  # fmt: skip
    result = run_script("import_road.py", *here)
    assert result.returncode == 0, result.stderr
    assert Path(tmp_path / "us-101" / "road.toml").is_file()
    # The page goes on with these seeds.
    assert "training: 5 window(s), traffic seeds 0..4" in result.stdout
    assert "validation: 2 window(s), traffic seeds 1000..1001" in result.stdout
