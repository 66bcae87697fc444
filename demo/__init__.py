"""The demo: a scene made by an analytic ray tracer, and a report on what was trained from it."""
