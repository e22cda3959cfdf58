"""Figures as Vega-Lite specifications, and their files."""
