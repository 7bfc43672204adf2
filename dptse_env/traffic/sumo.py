"""Simulation of scenarios by SUMO, which gives records.

libsumo has one simulation per process: starting a second one silently replaces the first. The
library therefore records in processes of its own (`dptse_env.traffic.recording`).

Two settings were chosen by measurement on the paper's corridor (W99, 12 seeds):

- internal links are off. With them, a vehicle of the ramp and one of the mainline can block each
  other inside a merge for the rest of the run, which blocked a ramp in half of the runs;
- collisions have no consequence. About six vehicles of 730 overlap another for a moment while
  merging; SUMO's default would remove it from the road and insert it elsewhere.
"""

import contextlib
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Self

import numpy as np

from dptse_env.traffic import own_sumo
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.demand import Incident, lowest_limit
from dptse_env.traffic.own_sumo import WARNING, Remark
from dptse_env.traffic.record import Record
from dptse_env.traffic.scenario import Scenario, draw_scenario
from dptse_env.traffic.sumo_input import LONGEST_OUTPUT, edge_ids, net_xml, routes_xml
from dptse_env.utils.units import KMH
from dptse_env.versions import SumoVersionError, require_sumo, sumo_version

STEP_LENGTH = 0.5
"""SUMO's time step [s]: at 1 s, W99 brakes in emergency four times as often (377 against 85 times
per run of 730 vehicles on the paper's corridor) and overlaps twice as often."""

SUBSTEPS = round(1.0 / STEP_LENGTH)

QUIET = (
    "--no-step-log",
    "--duration-log.disable",
    "--xml-validation=never",
    "--xml-validation.net=never",
    "--xml-validation.routes=never",
)
"""Options of every recording. Validation would look for schemas under SUMO_HOME."""

OPTIONS = (
    f"--step-length={STEP_LENGTH}",
    "--no-warnings",
    "--no-internal-links",
    "--collision.action=none",
    # Vehicles that stand still in a jam are not removed.
    "--time-to-teleport=-1",
)
"""Options on a net that is made for a corridor."""

_one_at_a_time = threading.Lock()


class RecordingError(RuntimeError):
    """A scenario could not be recorded; the message names corridor, seed and cause."""

    @classmethod
    def from_cause(cls, corridor: Corridor, seed: int, cause: str) -> Self:
        """Make the error of a scenario, given the cause of its failure."""
        return cls(f"recording {corridor.name} with traffic seed {seed} failed: {cause}")


def simulate(corridor: Corridor, seed: int, remark: Remark = lambda text: None) -> Record:
    """Simulate one scenario in this process and record it.

    The same corridor and seed give the same record, bit for bit, in any process. Meanwhile the
    process's current folder is a temporary one, so that SUMO writes nothing elsewhere.

    Args:
        corridor: The road.
        seed: The traffic seed.
        remark: Takes what SUMO warns of on a net of one's own, and who does not depart.

    Raises:
        RecordingError: SUMO fails, the corridor's own files are missing or changed, or libsumo
            already holds a simulation in this process, which is left unchanged.
        NetconvertError: The corridor has to be compiled and cannot be.
        SumoVersionError: libsumo is missing, broken or too old.
    """
    scenario = draw_scenario(corridor, seed)
    with running(corridor, scenario, remark) as libsumo:
        if corridor.sumo is None:
            return _observe(libsumo, corridor, scenario)
        clock = seconds(libsumo, corridor, scenario)
        rows = own_sumo.observe(libsumo, corridor.sumo, scenario.incidents, clock)
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 4).T
    step, vehicle, segment, speed = table[:, np.lexsort((table[2], table[0]))]
    return Record(
        step=step, vehicle=vehicle, segment=segment, speed=speed,
        n_steps=corridor.conditions.duration + 1, n_columns=corridor.geometry.n_cells,
    )  # fmt: skip


@contextlib.contextmanager
def running(
    corridor: Corridor, scenario: Scenario, remark: Remark = lambda text: None
) -> Iterator[ModuleType]:
    """Load a scenario into SUMO, at second 0, and close it afterwards.

    In the body the current folder is an empty one, where SUMO runs.

    Errors are those of `simulate`; a failure of SUMO in the body is one of them.

    Yields:
        The module libsumo; `seconds` advances its simulation.
    """
    if corridor.recordings is not None:
        cause = "its traffic is recorded, not simulated"
        raise RecordingError.from_cause(corridor, scenario.seed, cause)
    net = net_xml(corridor.geometry) if corridor.sumo is None else ""
    with _one_at_a_time, tempfile.TemporaryDirectory(prefix="dptse-sumo-") as directory:
        libsumo = _import_libsumo()
        if libsumo.isLoaded():
            cause = "libsumo holds another simulation in this process"
            raise RecordingError.from_cause(corridor, scenario.seed, cause)
        folder = Path(directory)
        messages = folder / "messages.txt"
        messages.touch()
        try:
            command = [*_command(folder, net, corridor, scenario), *QUIET]
            # Names in the folder are plain ASCII: SUMO opens no others where the locale is C.
            with contextlib.chdir(folder), _stderr_to(messages):
                try:
                    libsumo.start(command)
                    yield libsumo
                    if corridor.sumo is not None:
                        own_sumo.tell_departures(libsumo, remark)
                finally:
                    if libsumo.isLoaded():
                        libsumo.close()
            own_sumo.tell_warnings(messages, remark)
        except Exception as error:
            said = messages.read_text(encoding="utf-8", errors="replace").splitlines()
            output = "\n".join(line for line in said if not line.startswith(WARNING)).strip()
            output = output[-LONGEST_OUTPUT:]
            cause = f"{type(error).__name__}: {error}" + (f"\n{output}" if output else "")
            raise RecordingError.from_cause(corridor, scenario.seed, cause) from error


def seconds(libsumo: ModuleType, corridor: Corridor, scenario: Scenario) -> Iterator[int]:
    """Advance a loaded simulation second by second, with the scenario's incidents.

    Yields:
        0, 1, ..., `corridor.duration`: the second [s] whose state libsumo holds.
    """
    files, substeps, changes = corridor.sumo, SUBSTEPS, list[tuple[float, int, float]]()
    if files is None:
        changes = limit_changes(scenario.incidents, corridor.geometry.speed_limits)
    else:
        substeps = files.substeps
        for _ in range(files.warm_up * substeps):
            libsumo.simulationStep()
    yield 0
    for second in range(corridor.conditions.duration):
        for substep in range(substeps):
            while changes and changes[0][0] <= second + substep * STEP_LENGTH:
                _, segment, limit = changes.pop(0)
                libsumo.edge.setMaxSpeed(f"main_{segment}", limit / KMH)
            libsumo.simulationStep()
        yield second + 1


def limit_changes(
    incidents: Sequence[Incident], speed_limits: Sequence[float]
) -> list[tuple[float, int, float]]:
    """Return the changes of limits in order, each as (time [s], segment, new limit [km/h]).

    Where several incidents act on a segment at once, the lowest of their limits holds.

    Args:
        incidents: The incidents.
        speed_limits: Limit of each segment outside incidents [km/h].
    """
    changes = []
    ends = {
        (time, incident.segment)
        for incident in incidents
        for start, end, _ in incident.phases
        for time in (start, end)
    }
    for time, segment in sorted(ends):
        limit = lowest_limit(incidents, segment, time)
        changes.append((time, segment, speed_limits[segment] if limit is None else limit))
    return changes


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
    require_sumo(version)
    if version != expected:
        raise SumoVersionError(
            f"libsumo reports version {version} but is installed as {expected}: reinstall libsumo"
        )
    return libsumo  # type: ignore[no-any-return]


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


def _command(folder: Path, net: str, corridor: Corridor, scenario: Scenario) -> list[str]:
    """Write SUMO's input files and return its command line."""
    if corridor.sumo is not None:
        return own_sumo.command(folder, corridor.sumo, scenario.sumo_seed, scenario.scale)
    net_file, route_file = folder / "corridor.net.xml", folder / "scenario.rou.xml"
    net_file.write_text(net, encoding="utf-8")
    route_file.write_text(routes_xml(corridor, scenario), encoding="utf-8")
    files = ["-n", net_file.name, "-r", route_file.name]
    return ["sumo", *files, "--seed", str(scenario.sumo_seed), *OPTIONS]


def _observe(libsumo: ModuleType, corridor: Corridor, scenario: Scenario) -> Record:
    """Run the loaded simulation to its end and collect the vehicle table."""
    edges = edge_ids(corridor.geometry)
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
        n_steps=corridor.conditions.duration + 1,
        n_columns=len(edges),
    )
