"""Logged episodes: what they hold, where they come from."""
