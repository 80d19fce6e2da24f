"""Partial maps become whole ones: methods without learning, networks, and predictions on disk."""
