"""Partial maps become whole ones: what a completion is, methods that need no learning, networks, files of predictions."""
