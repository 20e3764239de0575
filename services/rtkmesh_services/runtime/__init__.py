"""The runtime part of the shell."""
