"""One unit of a dataset: a world, a flight, scans, maps, truth, and the sample that they give."""
