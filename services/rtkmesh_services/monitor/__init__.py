"""The monitor part of the shell."""
