"""What goes wrong between a policy and what it acts on: actions that come late, observations that are lost or noisy."""

from __future__ import annotations

from ringfence.faults.faults import Faults

__all__ = ["Faults"]
