"""Runs as they are to be played: names and options resolved to values, once."""
