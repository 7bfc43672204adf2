"""Evaluation, training, search and studies on top of dptse_env. They need the extra ``train``."""

import importlib.util

_MISSING = [name for name in ("jinja2", "rich") if importlib.util.find_spec(name) is None]
if _MISSING:
    raise ImportError(f"agents needs {', '.join(_MISSING)}: pip install 'dptse-env[train]'")
