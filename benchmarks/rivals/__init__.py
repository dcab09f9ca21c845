"""Rivals of the race: one file for each, with one interface, see `rivals.problem`. `run.py` starts one as a process."""
