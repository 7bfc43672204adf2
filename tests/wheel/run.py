"""Build the wheel, install it into a fresh virtual environment elsewhere, and use it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
USE = Path(__file__).with_name("use.py")


def call(*command: object, cwd: Path, **environment: str) -> None:
    """Run a command, and stop if it fails."""
    subprocess.run(
        [str(part) for part in command], cwd=cwd, env={**os.environ, **environment}, check=True
    )


def main() -> None:
    """Build, install and use the wheel in a temporary folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        call(
            sys.executable, "-m", "build", "--wheel", "--outdir", folder / "dist", ROOT, cwd=folder
        )
        (wheel,) = (folder / "dist").glob("*.whl")
        venv.create(folder / "venv", with_pip=True)
        python = folder / "venv" / "bin" / "python"
        pins = ROOT / "constraints.txt"
        call(python, "-m", "pip", "install", "--quiet", "-c", pins, wheel, cwd=folder)
        # Another project's parts: copied, so that the build leaves nothing in the checkout.
        shutil.copytree(ROOT / "tests" / "plugin", folder / "plugin")
        call(python, "-m", "pip", "install", "--quiet", "-c", pins, folder / "plugin", cwd=folder)
        (folder / "use.py").write_text(USE.read_text())
        call(python, "-W", "error", "use.py", cwd=folder, DPTSE_CACHE=str(folder / "cache"))
        # The lowest Gymnasium that is allowed must serve as well as the pinned one.
        call(python, "-m", "pip", "install", "--quiet", "gymnasium==1.2.2", cwd=folder)
        call(python, "-W", "error", "use.py", cwd=folder, DPTSE_CACHE=str(folder / "cache"))


if __name__ == "__main__":
    main()
