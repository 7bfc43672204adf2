"""Draw all pictures of the pages: docs/images.

make pictures
"""

import runpy
from pathlib import Path

FOLDER = Path(__file__).parent
SCRIPTS = ("episode.py", "two_worlds.py", "environment.py", "guides.py")

if __name__ == "__main__":
    for script in SCRIPTS:
        runpy.run_path(str(FOLDER / script), run_name="__main__")
