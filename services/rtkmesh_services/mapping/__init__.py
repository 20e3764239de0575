"""The mapping part of the shell."""
