"""Checks of doctor.py: the environment, a dataset, a trained model. Each returns lines and changes nothing."""
