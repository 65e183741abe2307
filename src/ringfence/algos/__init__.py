"""Algorithms, one per file: losses first, config at the top of the file as the list of every choice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ringfence.algos.bc import BC, BC_SAFE
from ringfence.algos.fisor import FISOR
from ringfence.algos.flow import FLOW
from ringfence.algos.icbf import ICBF, MADIFF
from ringfence.algos.omar import MA_CQL, OMAR
from ringfence.algos.returns import BC_BEST, BC_RETURN
from ringfence.algos.td3bc import MA_TD3BC, MA_TD3BC_LAG
from ringfence.algos.untrained import MPC, NAIVE
from ringfence.errors import one_of
from ringfence.types import Algorithm
from ringfence.utils.config import build_config

_BC, _CRITICS = (BC, BC_SAFE, BC_BEST, BC_RETURN), (MA_TD3BC, OMAR, MA_CQL, MA_TD3BC_LAG, FISOR)
ALGORITHMS = {a.name: a for a in (ICBF, MADIFF, FLOW, MPC, NAIVE, *_BC, *_CRITICS)}


def get(name: str) -> Algorithm:
    """The algorithm of that name; an unknown one is refused with the nearest name."""
    return one_of("algorithm", name, ALGORITHMS)


def configured(algorithm: Algorithm, preset: str, changes: Mapping[str, Any]) -> Any:
    """The config of a preset with changes to it."""
    return build_config(algorithm.Config, {**algorithm.presets[preset], **changes}, algorithm.name)
