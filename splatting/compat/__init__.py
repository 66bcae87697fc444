"""Code that exists only so that code written for the reference runs; modules with the reference's names import it."""
