"""Loads policy files under a limit of memory; prints a line of JSON for each.

python tests/sb3/limited.py good.zip bad-1.zip bad-2.zip ...
"""

import json
import resource
import sys
import time
from pathlib import Path

import gymnasium as gym

from dptse_env.sb3 import load_policy

ADDITIONAL = 200 * 2**20
"""Bytes that loading may take beyond those of the imports and of a first, good file."""


def main():
    environments = {
        action: gym.make("dptse_env:dptse/ShortHighway-v0", action=action)
        for action in ("slots", "mask")
    }
    good, *paths = sys.argv[1:]
    load_policy(good, environments["slots"])
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + ADDITIONAL
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for path in paths:
        action = "mask" if "mask" in path else "slots"
        began, refusal = time.process_time(), None
        try:
            load_policy(path, environments[action])
        except ValueError as problem:
            refusal = str(problem)
        seconds = time.process_time() - began
        print(json.dumps({"path": path, "refusal": refusal, "seconds": seconds}), flush=True)


if __name__ == "__main__":
    main()
