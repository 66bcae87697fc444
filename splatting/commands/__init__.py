"""The commands of the core: parse, call, report."""
