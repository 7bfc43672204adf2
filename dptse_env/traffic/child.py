"""Child process of `dptse_env.traffic.worker`: tasks come from stdin, results go to stdout."""

import json
import os
import pickle
import signal
import sys

from dptse_env.traffic.sumo import RecordingError, simulate


def main() -> None:
    """Serve pickled tasks (corridor, seed, path, source) until stdin ends, one JSON line each."""
    # Ctrl-C reaches all processes of the group; the parent decides, and closes stdin, when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # SUMO's output is redirected to stderr, so that the original stdout has the results alone.
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as results:
        os.dup2(2, 1)
        while True:
            try:
                corridor, seed, path, source = pickle.load(sys.stdin.buffer)
            except EOFError:
                return
            failure = None
            try:
                simulate(corridor, seed).save(path, source)
            except RecordingError as error:
                failure = str(error)
            except Exception as error:
                # Reported to the parent, which raises it; this child can serve the next task.
                failure = str(
                    RecordingError.from_cause(corridor, seed, f"{type(error).__name__}: {error}")
                )
            print(json.dumps({"failure": failure}), file=results, flush=True)


if __name__ == "__main__":
    main()
