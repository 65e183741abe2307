"""Runs: what defines one, the loop that makes it, the folder that keeps it."""
