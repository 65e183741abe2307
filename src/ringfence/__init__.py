"""Ringfence: safe offline multi-agent reinforcement learning.

from ringfence import EpisodeStore, Separation, train, load, build_report
"""

from __future__ import annotations

import importlib

__version__ = "0.3.0"

# Loaded on first use, so that `import ringfence` and `ringfence --help` start at once.
_WHERE = {
    "EpisodeStore": "ringfence.logs.store",
    "Separation": "ringfence.problem.constraints",
    "SpeedLimit": "ringfence.problem.constraints",
    "CostColumn": "ringfence.problem.constraints",
    "All": "ringfence.problem.constraints",
    "train": "ringfence.training.loop",
    "load": "ringfence.loading.resolve",
    "Controller": "ringfence.deploy.controller",
    "play": "ringfence.evaluation.play",
    "stress": "ringfence.evaluation.stress",
    "Faults": "ringfence.faults",
    "certify": "ringfence.evaluation.certify",
    "collect": "ringfence.logs.collect",
    "undelay": "ringfence.logs.late",
    "padded": "ringfence.envs.padded",
    "Layout": "ringfence.envs.padded",
    "ope": "ringfence.evaluation.ope",
    "replay": "ringfence.evaluation.replay",
    "World": "ringfence.world",
    "fit": "ringfence.training.worlds",
    "fit_run": "ringfence.training.worlds",
    "load_world": "ringfence.world:load",
    "save_world": "ringfence.world:save",
    "guard": "ringfence.deploy.controller",
    "build_report": "ringfence.report",
    "UserError": "ringfence.errors",
}
__all__ = list(_WHERE)


def __getattr__(name: str):
    where = _WHERE.get(name)
    if where is not None:
        module, _, other = where.partition(":")
        return getattr(importlib.import_module(module), other or name)
    raise AttributeError(f"module 'ringfence' has no attribute '{name}'")
