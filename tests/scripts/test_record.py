import dataclasses

import pytest

from dptse_env.config import resolve
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary, randomised
from scripts.cli import run
from scripts.record import Args, main
from tests.scripts.commands import run_script

SHORT = "dptse_env:dptse/ShortHighway-v0"


def test_the_command_records_into_the_library_and_reports_the_dwell(tmp_path):
    arguments = (
        "--env", SHORT, "--seeds", "3:5", "--workers", "1",
        "--records", str(tmp_path),
    )  # fmt: skip
    result = run_script("record.py", *arguments)
    assert result.returncode == 0, result.stderr
    assert f"short-highway: 2 record(s) in {tmp_path}" in result.stdout
    assert "T_avg" in result.stdout
    records = RecordLibrary(tmp_path)
    made = [seed for seed in range(10) if records.record_path(SHORT_HIGHWAY, seed).is_file()]
    assert made == [3, 4]


def test_random_traffic_is_recorded_on_request(tmp_path, capsys):
    main(
        Args(
            env=f'{SHORT} {{"demand": "random", "incident": "random"}}',
            seeds="0:1",
            workers=1,
            records=tmp_path,
        )
    )
    assert RecordLibrary(tmp_path).record_path(randomised(SHORT_HIGHWAY), 0).is_file()
    assert "1 record(s)" in capsys.readouterr().out


def test_fields_of_a_corridor_and_keywords_are_recorded(tmp_path):
    calm = dataclasses.replace(SHORT_HIGHWAY, duration=60, incident=None)
    given = Args(
        env=f'{SHORT} {{"corridor": {{"duration": 60, "incident": null}}}}', seeds="0:1",
        workers=1, records=tmp_path,
    )  # fmt: skip
    main(given)
    assert RecordLibrary(tmp_path).record_path(calm, 0).is_file()
    main(dataclasses.replace(given, env=f'{SHORT} {{"incident": "none"}}', seeds="1:2"))
    full = resolve("short-highway", {"incident": "none"}).corridor
    assert RecordLibrary(tmp_path).record_path(full, 1).is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--seeds", "x"), "error: seeds must be 'first:stop'"),
        (("--env", f'{SHORT} {{"corridor": {{"length": 3}}}}'), "error: corridor.length"),
        (("--env", f'{SHORT} {{"corridor": {{"duration": -3}}}}'), "error: corridor.duration must"),
        (("--env", f"{SHORT} 3"), "error: env must be"),
        (("--env", "dptse_env:dptse/Nowhere-v0"), "error: env must be"),
    ],
)
def test_mistakes_end_in_one_line_on_stderr(arguments, message, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["record.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        run(main, Args, None)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(message)
