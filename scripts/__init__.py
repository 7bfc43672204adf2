"""Command-line entry points, one job each. They need the extra ``train``."""

import importlib.util

_MISSING = [name for name in ("rich", "tyro") if importlib.util.find_spec(name) is None]
if _MISSING:
    raise ImportError(f"scripts needs {', '.join(_MISSING)}: pip install 'dptse-env[train]'")
