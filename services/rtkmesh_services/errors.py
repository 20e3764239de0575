"""Exceptions of the services: faults of the caller or the site. Faults of the data are values and counters.

ServiceError
├── SourceError         a recording or a receiver's source is missing, empty or of no known kind
│   └── RefusedError        a caster refuses us, and will for some time
├── BusError            the network refused something: an address in use, a wrong key
│   ├── UnreachableError    no hub answers
│   └── NamesakeError       another process has this id
├── CommandError        a command cannot be done; carries the code of the reply
├── ConfError           a key or value of an RTKLIB .conf file is wrong
└── StoppedError        the process was told to end while it waited
"""

from rtkmesh_schemas.command import Code


class ServiceError(Exception):
    """Root of the exceptions of the services."""


class SourceError(ServiceError):
    """A recording or a receiver's source is missing, empty or of no known kind."""


class RefusedError(SourceError):
    """A caster refuses us: ``wait_s`` is how long it wants to be left alone; ``lasting``: as long as nobody changes something."""

    def __init__(self, message: str, wait_s: float = 0.0, *, lasting: bool = False) -> None:
        super().__init__(message)
        self.wait_s, self.lasting = wait_s, lasting


class BusError(ServiceError):
    """The network refused something."""


class UnreachableError(BusError):
    """No hub answers."""


class NamesakeError(BusError):
    """Another process has this id."""


class CommandError(ServiceError):
    """A command cannot be done; ``code`` and the text go into its reply."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message)
        self.code = code


class ConfError(ServiceError):
    """A key or value of an RTKLIB .conf file is wrong; the text names the nearest right one."""


class StoppedError(ServiceError):
    """The process was told to end while it waited."""
