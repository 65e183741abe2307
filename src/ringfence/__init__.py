"""Ringfence: safe offline multi-agent reinforcement learning.

from ringfence import EpisodeStore, Separation, train, load, build_report
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"

# Loaded on first use, so that `import ringfence` and `ringfence --help` start at once.
_WHERE = {
    "EpisodeStore": "ringfence.data.store",
    "Separation": "ringfence.hazards",
    "SpeedLimit": "ringfence.hazards",
    "CostColumn": "ringfence.hazards",
    "All": "ringfence.hazards",
    "train": "ringfence.training",
    "load": "ringfence.evaluate",
    "Controller": "ringfence.evaluate",
    "play": "ringfence.parallel",
    "build_report": "ringfence.report",
}
__all__ = list(_WHERE)


def __getattr__(name: str):
    if name in _WHERE:
        return getattr(importlib.import_module(_WHERE[name]), name)
    raise AttributeError(f"module 'ringfence' has no attribute '{name}'")
