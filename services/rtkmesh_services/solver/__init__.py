"""The solver part of the shell."""
