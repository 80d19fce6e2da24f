"""What a completion is worth: reconstruction, planning on the completed map, statistics, and the
report.
"""
