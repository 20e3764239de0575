"""Exceptions of the engine: faults of the caller. Faults of the data are values (see ``Rejection``, ``SolutionStatus``).

RtkmeshError
├── OptionError      an option is out of its range or contradicts another
└── FormatError      a text file (RINEX, .pos) is not what its header says
"""


class RtkmeshError(Exception):
    """Root of the engine's exceptions."""


class OptionError(RtkmeshError):
    """An option is out of its range or contradicts another."""


class FormatError(RtkmeshError):
    """A file is not of the format that its header says."""
