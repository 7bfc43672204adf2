"""Child process of `dptse_env.utils.compile_ahead`: it compiles the functions of a list.

``python -m dptse_env.utils.compile_child ekf``. It ends with code 1 where an entry of the list
cannot be compiled, after all others.
"""

import os
import signal
import sys
import threading
from pkgutil import resolve_name

from dptse_env.utils.kernel_list import listed
from dptse_env.utils.kernels import compile_unless_busy


def main() -> int:
    """Compile the functions that no other process is compiling, one after the other."""
    # Ctrl-C reaches all processes of the group; the parent decides, and closes stdin, when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    failed = False
    for function, signature in listed(sys.argv[1]):
        try:
            compile_unless_busy(resolve_name(function), signature)
        except Exception as error:  # the list is out of date; the parent reports it
            print(f"{function}: {type(error).__name__}: {error}", file=sys.stderr)
            failed = True
    return int(failed)


def _end_with_stdin() -> None:
    """End this process, in the middle of a function too, when the parent ends."""
    # Not through `sys.stdin`, whose lock this thread would hold when the interpreter shuts down.
    while os.read(0, 1):
        pass
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
