"""The child process of `dptse_env.traffic.worker`: reads tasks from stdin, answers on stdout."""

import json
import os
import pickle
import signal
import sys

from dptse_env.traffic.sumo import RecordingError, simulate


def main() -> None:
    """Serve pickled tasks (corridor, seed, path, source) until stdin ends, one JSON line each."""
    # Ctrl-C reaches the whole process group. What it ends is the parent's choice, told by stdin.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Whatever SUMO prints goes to stderr; the answers keep the original stdout to themselves.
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
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
            print(json.dumps({"failure": failure}), file=answers, flush=True)


if __name__ == "__main__":
    main()
