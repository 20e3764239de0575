"""The output part of the shell."""
