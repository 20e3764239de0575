"""Exceptions of the wire.

SchemaError
├── DecodeError        bytes are not the message that they claim to be
├── VersionError       a message of another major version
├── BadKeyError          no such key or a wrong id
└── ConfigError        a deployment or solver file is wrong; names file, line and key
"""


class SchemaError(Exception):
    """Root of the exceptions of the wire."""


class DecodeError(SchemaError):
    """Bytes are not the message that they claim to be."""


class VersionError(SchemaError):
    """A message of another major version, which must not be guessed at."""


class BadKeyError(SchemaError):
    """An id or key that the table of streams does not allow."""


class ConfigError(SchemaError):
    """A deployment or solver file is wrong: ``file:line: message`` with the key and the nearest right name."""

    def __init__(self, file: str, line: int | None, message: str) -> None:
        self.file, self.line, self.message = file, line, message
        super().__init__(f"{file}:{line}: {message}" if line else f"{file}: {message}")
