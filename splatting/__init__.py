"""The trainer: everything for which the layout of the reference has no place."""
