"""How sure a completion is: probabilities that are what they say, and distances that truth does not
fall below."""
