"""Training of networks: samples in a seeded order, the loop, validation, and the run's folder."""
