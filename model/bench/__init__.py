"""What a completion is worth: reconstruction, navigation, and the report."""
