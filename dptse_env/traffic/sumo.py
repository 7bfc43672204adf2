"""Simulation of scenarios by SUMO, which gives records.

libsumo has one simulation per process: starting a second one silently replaces the first. A
recording therefore takes place in a child process when this one holds another simulation.

Two settings were chosen by measurement on the paper's corridor (W99, 12 seeds):

- internal links are off. With them, a vehicle of the ramp and one of the mainline can block each
  other inside a merge for the rest of the run, which blocked a ramp in half of the runs;
- collisions have no consequence. About six vehicles of 730 overlap another for a moment while
  merging; SUMO's default would remove it from the road and insert it elsewhere.
"""

import contextlib
import importlib.metadata
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Self

import numpy as np

from dptse_env.traffic import sumo_files
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.incident import limit_changes
from dptse_env.traffic.record import Record
from dptse_env.traffic.scenario import Scenario, draw_scenario
from dptse_env.traffic.sumo_network import edge_ids, network_xml
from dptse_env.traffic.sumo_routes import routes_xml

SUPPORTED_SUMO = "1.28"
"""Release series that records are made with: others simulate the same scenario differently."""

STEP_LENGTH = 0.5
"""SUMO's time step [s]: at 1 s, W99 brakes in emergency four times as often (377 against 85 times
per run of 730 vehicles on the paper's corridor) and overlaps twice as often."""

SUBSTEPS = round(1.0 / STEP_LENGTH)
KMH = sumo_files.KMH

OPTIONS = (
    f"--step-length={STEP_LENGTH}",
    "--no-internal-links",
    "--collision.action=none",
    # Vehicles that stand still in a jam are not removed.
    "--time-to-teleport=-1",
    *sumo_files.QUIET,
)

_one_at_a_time = threading.Lock()


class RecordingError(RuntimeError):
    """A scenario could not be recorded; the message names corridor, seed and cause."""

    @classmethod
    def from_cause(cls, corridor: Corridor, seed: int, cause: str) -> Self:
        """Make the error of a scenario, given the cause of its failure."""
        return cls(f"recording {corridor.name} with traffic seed {seed} failed: {cause}")


class SumoVersionError(RuntimeError):
    """The installed libsumo is not of the release series that records are made with."""


def sumo_version() -> str:
    """Return the version of the installed libsumo, without importing it.

    Raises:
        SumoVersionError: libsumo is missing or of another release series.
    """
    try:
        version = importlib.metadata.version("libsumo")
    except importlib.metadata.PackageNotFoundError as error:
        raise SumoVersionError(
            f"libsumo is not installed: pip install 'libsumo=={SUPPORTED_SUMO}.*'"
        ) from error
    _check_series(version)
    return version


def simulation_is_loaded() -> bool:
    """Return whether libsumo holds a simulation in this process."""
    libsumo = sys.modules.get("libsumo")
    return libsumo is not None and bool(libsumo.isLoaded())


def simulate(corridor: Corridor, seed: int) -> Record:
    """Simulate one scenario in this process and record it.

    The same corridor and seed give the same record, bit for bit, in any process.

    Raises:
        RecordingError: SUMO fails, the corridor's own files are missing or changed, or libsumo
            already holds a simulation in this process, which is left unchanged (see
            `dptse_env.traffic.recording`).
        NetworkError: The corridor has to be compiled and cannot be.
        SumoVersionError: libsumo is missing, broken or of another release series.
    """
    scenario = draw_scenario(corridor, seed)
    with running(corridor, scenario) as libsumo:
        observe = _observe if corridor.network is None else sumo_files.observe
        return observe(libsumo, corridor, scenario)


@contextlib.contextmanager
def running(corridor: Corridor, scenario: Scenario) -> Iterator[ModuleType]:
    """Load a scenario into SUMO, at second 0, and close it afterwards.

    Errors are those of `simulate`; a failure of SUMO in the body is one of them.

    Yields:
        The module libsumo; `seconds` advances its simulation.
    """
    if corridor.recordings is not None:
        cause = "its traffic is recorded, not simulated"
        raise RecordingError.from_cause(corridor, scenario.seed, cause)
    network = network_xml(corridor) if corridor.network is None else ""
    with _one_at_a_time, tempfile.TemporaryDirectory(prefix="dptse-sumo-") as directory:
        if simulation_is_loaded():
            cause = "libsumo holds another simulation in this process"
            raise RecordingError.from_cause(corridor, scenario.seed, cause)
        libsumo = _import_libsumo()
        folder = Path(directory)
        messages = folder / "messages.txt"
        try:
            with _stderr_to(messages):
                if corridor.network is None:
                    libsumo.start(_command(folder, network, corridor, scenario))
                else:
                    libsumo.start(sumo_files.command(folder, corridor.network, scenario))
            yield libsumo
        except Exception as error:
            output = messages.read_text(encoding="utf-8", errors="replace").strip()
            cause = f"{type(error).__name__}: {error}" + (f"\n{output}" if output else "")
            raise RecordingError.from_cause(corridor, scenario.seed, cause) from error
        finally:
            if libsumo.isLoaded():
                libsumo.close()


def seconds(libsumo: ModuleType, corridor: Corridor, scenario: Scenario) -> Iterator[int]:
    """Advance a loaded simulation second by second, with the scenario's incidents.

    Yields:
        0, 1, ..., `corridor.duration`: the second [s] whose state libsumo holds.
    """
    if corridor.network is not None:
        yield from sumo_files.seconds(libsumo, corridor.network, corridor.duration)
        return
    changes = limit_changes(scenario.incidents, corridor.speed_limits)
    yield 0
    for second in range(corridor.duration):
        for substep in range(SUBSTEPS):
            while changes and changes[0][0] <= second + substep * STEP_LENGTH:
                _, segment, limit = changes.pop(0)
                libsumo.edge.setMaxSpeed(f"main_{segment}", limit / KMH)
            libsumo.simulationStep()
        yield second + 1


def _import_libsumo() -> ModuleType:
    """Import libsumo and check its version: libtraci's wheel overwrites it with 1.18."""
    expected = sumo_version()
    try:
        import libsumo  # noqa: PLC0415  (heavy, and only a recording needs it)
    except ImportError as error:
        raise SumoVersionError(
            f"libsumo {expected} is installed but cannot be imported ({error}): reinstall libsumo"
        ) from error
    version = str(libsumo.getVersion()[1]).removeprefix("SUMO ")
    _check_series(version)
    if version != expected:
        raise SumoVersionError(
            f"libsumo reports version {version} but is installed as {expected}: reinstall libsumo"
        )
    return libsumo  # type: ignore[no-any-return]


def _check_series(version: str) -> None:
    if version.split(".")[:2] != SUPPORTED_SUMO.split("."):
        raise SumoVersionError(
            f"libsumo must be of the series {SUPPORTED_SUMO}, found {version}: "
            f"pip install --force-reinstall 'libsumo=={SUPPORTED_SUMO}.*'"
        )


@contextlib.contextmanager
def _stderr_to(path: Path) -> Iterator[None]:
    """Divert the process's stderr to a file.

    libsumo's exception is often just "Process Error"; the reason goes to stderr, and SUMO's error
    log is not flushed before the process ends.
    """
    sys.stderr.flush()
    original = os.dup(2)
    try:
        with path.open("wb") as file:
            os.dup2(file.fileno(), 2)
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)


def _command(folder: Path, network: str, corridor: Corridor, scenario: Scenario) -> list[str]:
    """Write SUMO's input files and return its command line."""
    network_file, route_file = folder / "corridor.net.xml", folder / "scenario.rou.xml"
    network_file.write_text(network, encoding="utf-8")
    route_file.write_bytes(routes_xml(corridor, scenario))
    files = ["-n", str(network_file), "-r", str(route_file)]
    return ["sumo", *files, "--seed", str(scenario.sumo_seed), *OPTIONS]


def _observe(libsumo: ModuleType, corridor: Corridor, scenario: Scenario) -> Record:
    """Run the loaded simulation to its end and collect the vehicle table."""
    edges = edge_ids(corridor)
    vehicles_on, speed_of = libsumo.edge.getLastStepVehicleIDs, libsumo.vehicle.getSpeed
    n_on: list[int] = []
    names: list[str] = []
    speed: list[float] = []
    for _ in seconds(libsumo, corridor, scenario):
        for edge in edges:
            here = vehicles_on(edge)
            n_on.append(len(here))
            names += here
            speed += map(speed_of, here)
    # The other columns are made once at the end: this loop is all that recording adds to a bare
    # simulation.
    cells = np.repeat(np.arange(len(n_on)), n_on)
    return Record(
        step=(cells // len(edges)).astype(np.int32),
        vehicle=np.fromstring(" ".join(names), dtype=np.int32, sep=" "),
        segment=(cells % len(edges)).astype(np.int16),
        speed=(KMH * np.array(speed, dtype=np.float64)).astype(np.float32),
        n_steps=corridor.duration + 1,
        n_columns=len(edges),
    )
