"""rtkmesh: the pure core of the positioning service: codecs, models, RTK engine, attitude, simulation.

Nothing here opens a file or a socket, reads a clock, logs, sleeps or looks at the environment.
"""

__version__ = "0.1.0"
