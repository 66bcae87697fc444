"""The gate: short trainings against a stored baseline, to be passed before a release."""
