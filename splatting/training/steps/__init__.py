"""The ways to take a step of training: all give the same bytes."""
