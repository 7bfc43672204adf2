"""Traffic: corridors, SUMO recordings and the library of records.

Importing this package does not import libsumo; only making a record does.
"""

from dptse_env.geometry import Geometry
from dptse_env.traffic.corridor import Conditions, Corridor, Recordings, Scales
from dptse_env.traffic.demand import (
    Demand,
    DemandDistribution,
    Drivers,
    Incident,
    IncidentDistribution,
    VehicleClass,
)
from dptse_env.traffic.imported import ranges
from dptse_env.traffic.library import RecordLibrary, Records, open_library
from dptse_env.traffic.loops import Loops, Stations
from dptse_env.traffic.own_sumo import SumoScenario
from dptse_env.traffic.penetration import Penetration
from dptse_env.traffic.readings import readings
from dptse_env.traffic.record import MOST_VEHICLES, InvalidRecordError, Record, average_dwell
from dptse_env.traffic.recording import simulate_in_worker
from dptse_env.traffic.roads import (
    CORRIDORS,
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    RoadFile,
    is_road_file,
    randomised,
    read_corridor,
    read_road,
    road_name,
    write_corridor,
)
from dptse_env.traffic.scenario import MAINLINE, Scenario, draw_scenario
from dptse_env.traffic.sumo import RecordingError, simulate
from dptse_env.traffic.sumo_input import NetconvertError
from dptse_env.versions import SumoVersionError

__all__ = [
    "CORRIDORS",
    "MAINLINE",
    "MOST_VEHICLES",
    "PAPER_HIGHWAY",
    "SHORT_HIGHWAY",
    "Conditions",
    "Corridor",
    "Demand",
    "DemandDistribution",
    "Drivers",
    "Geometry",
    "Incident",
    "IncidentDistribution",
    "InvalidRecordError",
    "Loops",
    "NetconvertError",
    "Penetration",
    "Record",
    "RecordLibrary",
    "RecordingError",
    "Recordings",
    "Records",
    "RoadFile",
    "Scales",
    "Scenario",
    "Stations",
    "SumoScenario",
    "SumoVersionError",
    "VehicleClass",
    "average_dwell",
    "draw_scenario",
    "is_road_file",
    "open_library",
    "randomised",
    "ranges",
    "read_corridor",
    "read_road",
    "readings",
    "road_name",
    "simulate",
    "simulate_in_worker",
    "write_corridor",
]
