"""The shell: one folder per role of the deployment."""
