"""Datasets without a disk: samples by number, drawn when asked for or by processes ahead of
need."""
