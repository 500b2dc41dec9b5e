"""Measurements: read from files, checked, repaired."""
