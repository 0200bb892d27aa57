"""Baselines, timings and comparisons: importable from the repository root, not part of the installed package."""
