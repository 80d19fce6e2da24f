"""Datasets made of samples that are there: several merged into one, or a part taken of one, each
sample as it was."""
