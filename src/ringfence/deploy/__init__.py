"""Policies that leave: exported files, and those that come with the package."""
