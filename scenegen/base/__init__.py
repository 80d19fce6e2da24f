"""The base of all other rooms: errors, files and stores, limits, paths and their types, and
executors of work."""
