"""The compiled stepper of the environments."""
