"""The data of `shoal dashboard`: what a report shows of a sweep or a run, and the episodes that it plays.

A table of results alone needs neither Ray, MLflow nor torch. Modules that do are imported where a run is shown or an
episode is played.
"""
