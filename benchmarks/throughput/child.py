"""One row of the table, measured in this process: `python -m benchmarks.throughput.child JOB`.

JOB is JSON with ``work`` (``module:function`` in this folder), ``seconds`` and ``options``. The
result goes to stdout as JSON; whatever libraries print goes to stderr.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import sys


def main() -> None:
    """Do the job."""
    job = json.loads(sys.argv[1])
    answer = os.dup(1)
    os.dup2(2, 1)
    module, function = job["work"].split(":")
    work = getattr(importlib.import_module(f"benchmarks.throughput.{module}"), function)
    measured = work(job["seconds"], **job["options"])
    with os.fdopen(answer, "w") as out:
        out.write(json.dumps(dataclasses.asdict(measured)) + "\n")


if __name__ == "__main__":
    main()
