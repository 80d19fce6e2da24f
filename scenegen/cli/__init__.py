"""The terminal: what is printed there, and how a command ends, stops included. It knows no
command."""
