"""Drives: where they come from and what is done with them, from readers and simulation to the command line."""
