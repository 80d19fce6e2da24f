"""What every room above stands on: errors, files and stores, limits, paths and their types, and
where work is done."""
