"""Measures completions: reconstruction, planning on the completed map, statistics, and the
report.
"""
