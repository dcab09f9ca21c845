"""The compiled stepper of the environments. Optional: without it they step in Python, with the same numbers."""
