"""The control part of the shell."""
