"""Modules of 0.1.0 under their old paths: they import for one release, with a warning that says the new ones."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

# Old module -> where its names are now, in the order in which they are looked for; both below `ringfence`.
MOVED: dict[str, tuple[str, ...]] = {
    "barrier": ("proposals.retention",),
    "data": ("logs.store",),
    "data.audit": ("datasets.audit",),
    "data.bags": ("logs.io.rosbag",),
    "data.behaviour": ("datasets.behaviour",),
    "data.cache": ("utils.cache",),
    "data.hdf5": ("datasets.importers.hdf5",),
    "data.make": ("datasets.make",),
    "data.matd3": ("datasets.matd3",),
    "data.ogmarl": ("datasets.importers.ogmarl",),
    "data.omar": ("datasets.importers.omar",),
    "data.recipes": ("datasets.recipes",),
    "data.recipes.crossing": ("datasets.recipes.crossing",),
    "data.recipes.robots": ("datasets.recipes.robots",),
    "data.recipes.spread": ("datasets.recipes.spread",),
    "data.recipes.spread_alike": ("datasets.recipes.spread_alike",),
    "data.robots": ("datasets.robots",),
    "data.store": ("logs.store",),
    "data.tables": ("logs.io.table", "logs.io.observe"),
    "data.tracks": ("logs.io.tracks",),
    "diffusion": ("proposals.diffusion",),
    "each": ("problem.homogeneous",),
    "episodes": ("envs.episode",),
    "evaluate": (
        "evaluation.evaluate",
        "evaluation.protocol",
        "evaluation.rollout",
        "evaluation.latency",
        "loading.resolve",
        "loading.controller",
    ),
    "export": ("deploy.export",),
    "features": ("problem.features",),
    "files": ("utils.files",),
    "guards.danger": ("guards.barrier",),
    "hazards": ("problem.constraints",),
    "judging": ("evaluation.ope.judge", "evaluation.ope"),
    "normalise": ("problem.normalise",),
    "optim": ("nets.optim",),
    "parallel": ("evaluation.play",),
    "policies": ("proposals.planner", "proposals.base", "proposals.options"),
    "recorder": ("logs.collect",),
    "reference": ("evaluation.reference",),
    "runs": ("training.runs", "utils.config", "utils.environment"),
    "scores": ("proposals.conditions",),
    "stats": ("evaluation.statistics",),
    "tasks": ("datasets.registry", "datasets.task"),
    "windows": ("logs.windows",),
    "worlds": ("training.worlds", "loading.run_worlds"),
    "world.fitting": ("world.fit", "world.settings", "world.storage"),
    "world.world": ("world.model", "world.card"),
    "zoo": ("deploy.zoo",),
}
ROOT = "ringfence."


class _Moved(ModuleType):
    """A module whose names are looked up where they are now."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        for place in MOVED[self.__name__.removeprefix(ROOT)]:
            module = importlib.import_module(ROOT + place)
            if hasattr(module, name):
                return getattr(module, name)
        raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")


class _Finder(MetaPathFinder, Loader):
    """Finds what is in MOVED and nothing else."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        name = fullname.removeprefix(ROOT)
        if not fullname.startswith(ROOT) or name not in MOVED:
            return None
        package = any(other.startswith(f"{name}.") for other in MOVED)
        return ModuleSpec(fullname, self, is_package=package)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Moved(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        places = " and ".join(ROOT + place for place in MOVED[module.__name__.removeprefix(ROOT)])
        message = f"{module.__name__} is {places} now; the old path goes with the next release."
        warnings.warn(message, FutureWarning, stacklevel=2)


def install() -> None:
    """Let old paths be imported, after everything that exists was looked for."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.append(_Finder())
