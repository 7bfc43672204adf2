"""Workflows on the forge ask for no more than they need, and for what there is."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
if not FILES:
    pytest.skip("a source archive has no workflows", allow_module_level=True)

import yaml  # noqa: E402

WORKFLOWS = {path.stem: yaml.safe_load(path.read_text(encoding="utf-8")) for path in FILES}
JOBS = {(name, job): each for name in WORKFLOWS for job, each in WORKFLOWS[name]["jobs"].items()}


def test_rights_times_and_runs_are_bounded():
    for workflow in WORKFLOWS.values():
        assert workflow["permissions"] == {"contents": "read"}
        assert workflow["concurrency"]["group"]
    more = {key: job["permissions"] for key, job in JOBS.items() if "permissions" in job}
    assert more == {
        ("release", "publish"): {"id-token": "write"},
        ("release", "notes"): {"contents": "write"},
        ("release", "pages"): {"id-token": "write", "pages": "write"},
    }
    assert all(job["timeout-minutes"] <= 150 for job in JOBS.values())


def test_actions_are_commits():
    lines = [line for path in FILES for line in path.read_text().splitlines() if "uses:" in line]
    assert len(lines) == sum("uses" in step for job in JOBS.values() for step in job["steps"])
    for line in lines:
        assert re.search(r"uses: [\w/-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+$", line), line


def test_targets_exist():
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    wanted = [*JOBS["nightly", "long"]["strategy"]["matrix"]["target"]]
    for command in (step.get("run", "") for job in JOBS.values() for step in job["steps"]):
        wanted += re.findall(r"^make ([a-z-]+)", command, re.M)
    assert {*wanted} <= {*targets}
    assert "wheel-test" in wanted


def test_every_version_of_python_that_is_named_is_tested():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = {each.rpartition(" ")[2] for each in project["classifiers"] if "Python :: 3." in each}
    rows = JOBS["ci", "tests"]["strategy"]["matrix"]["include"]
    linux = [each for each in rows if each["os"].startswith("ubuntu")]
    tested = {each["python"] for each in linux if not each["experimental"]}
    assert named == tested | {"3.11"} == {*JOBS["release", "wheel"]["strategy"]["matrix"]["python"]}
