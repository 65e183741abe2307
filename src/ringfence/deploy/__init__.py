"""Policies that leave: at run time, as exported files, and those that come with the package."""
