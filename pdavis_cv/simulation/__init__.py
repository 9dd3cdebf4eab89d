"""Simulated recordings with exact truth."""
