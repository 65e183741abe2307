"""The proving ground: small systems of many kinds, none of which the library was made for."""

from ringfence.envs.proving.system import System, SystemState

__all__ = ["System", "SystemState"]
