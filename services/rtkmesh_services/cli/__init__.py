"""The cli part of the shell."""
