"""Roads of the kinds of `agents.filters.highways` but queues, with filters calibrated on each.

python -m agents.studies.roads.drawn

fits the ARZ parameters of those that ``calibrated.json`` lacks, on training traffic alone.
"""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

from agents.environments import PRIVATE, make_config, quietly
from agents.files import write_json
from agents.fitting.parameters import fit_parameters, start_from, traffic_of
from agents.play import Cell
from agents.seeds import TUNING
from agents.studies.roads.recorded import TRAINING
from dptse_env.estimators.tuned import DEFAULT_PARAMETERS
from dptse_env.model import ARZParameters, load_parameters
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.validation import read_json

NAMES = (
    "lorries_10000", "lorries_10001", "convoys_10000", "convoys_10001", "convoys_10002",
    "compliance_10000", "compliance_10001", "weaving_10000", "weaving_10001", "autobahn_10000",
    "autobahn_10001",
)  # fmt: skip
"""The first two highways of each kind from 10,000 on, and the first one with a moving load. Weights
are trained on smaller numbers."""
TRIALS = 40
"""Sets of parameters that are tried on each road."""
CALIBRATED = Path(__file__).with_name("calibrated.json")
"""File of the fitted values by road: v_f [km/h], jam density of a lane [veh/km], gamma, tau [s]."""


def keywords(name: str) -> dict[str, Any]:
    """Return the keywords of a road, with its calibrated parameters if there are any."""
    corridor = f"agents.studies.roads.recorded:{name}"
    values = read_json(CALIBRATED).get(name)
    return {"corridor": corridor} | ({"parameters": values} if values else {})


def calibrate(name: str) -> ARZParameters:
    """Return the parameters with which an EKF errs least on a road's training traffic."""
    given = {"corridor": keywords(name)["corridor"], "estimator": "ekf", "bandwidth": 5}
    with quietly():
        corridor = make_config(PRIVATE, given).corridor
    start = start_from(load_parameters(DEFAULT_PARAMETERS), corridor, name.replace("_", "-"))
    library = RecordLibrary()
    cell = Cell(PRIVATE, "round-robin", given, noise_seed=TUNING.start, seeds=TRAINING)
    densest = 1.01 * float(traffic_of(corridor, TRAINING, library)[0].max())
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "search.json"
        return fit_parameters(cell, corridor, start, densest, library, TRIALS, kept).parameters


def main() -> None:
    """Calibrate the roads that are not yet, and keep each when it is."""
    for name in NAMES:
        found = read_json(CALIBRATED)
        if name not in found:
            write_json(CALIBRATED, {**found, name: dataclasses.asdict(calibrate(name))})


if __name__ == "__main__":
    main()
