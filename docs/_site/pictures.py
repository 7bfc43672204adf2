"""Draw all pictures of the pages: docs/images. Those of the demo are copied from results/demo.

make pictures
"""

import runpy
import shutil
from pathlib import Path

FOLDER = Path(__file__).parent
SCRIPTS = ("episode.py", "two_worlds.py", "environment.py", "guides.py")
BARS = FOLDER.parents[1] / "results" / "demo" / "errors.png"

if __name__ == "__main__":
    for script in SCRIPTS:
        runpy.run_path(str(FOLDER / script), run_name="__main__")
    shutil.copyfile(BARS, FOLDER.parent / "images" / "demo.png")
