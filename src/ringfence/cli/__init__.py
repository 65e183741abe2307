"""The command line."""

from ringfence.cli.app import main

__all__ = ["main"]
