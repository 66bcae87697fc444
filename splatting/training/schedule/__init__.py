"""Pacing: which part of its schedule a run goes through in each iteration, so that it may be of any length."""
