"""Demo: a scene made by an analytic ray tracer, and a report on a model trained from it."""
