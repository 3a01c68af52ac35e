"""Figures, charts, claims and pages, made from results alone."""
