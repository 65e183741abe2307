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
    "record": "ringfence.recorder",
    "judge": "ringfence.judging",
    "World": "ringfence.world",
    "fit": "ringfence.worlds",
    "load_world": "ringfence.worlds:load",
    "guard": "ringfence.guards",
    "build_report": "ringfence.report",
    "UserError": "ringfence.errors",
}
__all__ = list(_WHERE)


def __getattr__(name: str):
    if name in _WHERE:
        module, _, other = _WHERE[name].partition(":")
        return getattr(importlib.import_module(module), other or name)
    raise AttributeError(f"module 'ringfence' has no attribute '{name}'")
