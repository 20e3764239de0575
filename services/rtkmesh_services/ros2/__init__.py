"""The ros2 part of the shell."""
