"""Robots that fly, and their flights."""
