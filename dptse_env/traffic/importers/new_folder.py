"""A folder that appears when it is complete."""

import contextlib
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from dptse_env.utils.fields import require


@contextlib.contextmanager
def new_folder(output: Path) -> Iterator[Path]:
    """Yield an empty folder that becomes `output` when the body ends, and vanishes if it fails.

    Its parent is a folder for this alone, in which the body may leave what is thrown away.

    Raises:
        ValueError: There is something at `output`.
        OSError: It cannot be written.
    """
    require(not output.exists(), "output", "a folder that does not exist yet", str(output))
    output.parent.mkdir(parents=True, exist_ok=True)
    work = output.parent / f".{output.name}-{uuid.uuid4().hex}"
    folder = work / "result"
    folder.mkdir(parents=True)
    try:
        yield folder
        folder.rename(output)
    finally:
        shutil.rmtree(work, ignore_errors=True)
