"""Drives, where they come from and what is done with them: readers, simulation, tracking, evaluation, the command line."""
