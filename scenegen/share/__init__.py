"""Publish a dataset: check it, describe it, stage it as one folder, and send that to the Hugging
Face Hub."""
