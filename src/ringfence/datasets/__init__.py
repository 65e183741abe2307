"""The benchmark's tasks, and how their data sets are made, imported and checked."""
