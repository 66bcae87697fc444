"""All that the layout of the reference has no room for, in one package."""
