"""Networks: Equinox modules whose leaves are all arrays, so a module is its own parameter pytree."""

from __future__ import annotations

from ringfence.errors import unknown
from ringfence.nets.agent_attention import AgentAttention
from ringfence.nets.layers import MLP
from ringfence.nets.team import TeamDenoiser
from ringfence.types import Key

__all__ = ["MLP", "AgentAttention", "build_denoiser"]


def build_denoiser(
    key: Key,
    kind: str,
    rows: int,
    features: int,
    width: int,
    depth: int,
    carried: tuple[int, ...] | None = None,
    agents: int = 0,
    team: int = 0,
    drivers: int = 0,
):
    """A denoiser F(x (B, H, N, D), k (B,), y (B,), keep (B,)) -> (B, H, N, D) by name. `agents`: their number where
    attention is to tell them apart; `team`: their number; `drivers`: how many it may plan as."""
    if kind == "attention":
        return AgentAttention(key, rows, features, width, depth, carried, agents, drivers)
    if kind == "residual":
        return TeamDenoiser(key, rows, features, width, depth, carried, team, drivers)
    if kind == "unet":
        from ringfence.nets.unet import TemporalUNet

        return TemporalUNet(key, rows, features, width, depth)
    raise unknown("denoiser", kind, ("attention", "residual", "unet"))
