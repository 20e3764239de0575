"""On which line each key of a TOML text stands. tomllib has accepted the text already, so this only walks it."""

import re
from typing import Final

Path = tuple[str, ...]

_KEY: Final = re.compile(r"""[ \t]*(?:"((?:[^"\\]|\\.)*)"|'([^']*)'|([A-Za-z0-9_-]+))[ \t]*""")
_SPACE: Final = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_BARE: Final = re.compile(r"[^,\]}\n#]*")
_STRING: Final = re.compile(
    r'"""(?:[^\\]|\\.)*?"""+|\'\'\'.*?\'\'\'+|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'',
    re.DOTALL,
)


def lines_of(text: str) -> dict[Path, int]:
    """Return path -> line (from 1) of every table and key; rows of arrays of tables have their index as a chunk."""
    walk = _Walk(text)
    walk.document()
    return walk.lines


class _Walk:
    def __init__(self, text: str) -> None:
        self.text, self.position = text, 0
        self.lines: dict[Path, int] = {}
        self._rows: dict[Path, int] = {}

    def document(self) -> None:
        table: Path = ()
        while self._skip() < len(self.text):
            if self.text.startswith("[[", self.position):
                table = self._header(2)
            elif self.text.startswith("[", self.position):
                table = self._header(1)
            else:
                self._pair(table)

    def _header(self, brackets: int) -> Path:
        line = self._line()
        self.position += brackets
        path = self._dotted()
        self.position += brackets
        if brackets == 2:
            self._rows[path] = self._rows.get(path, -1) + 1
        path = self._with_rows(path)
        self._note((), path, line)
        return path

    def _with_rows(self, path: Path) -> Path:
        """Return the path with the index of the present row after each array of tables."""
        result: Path = ()
        for length in range(1, len(path) + 1):
            result = (*result, path[length - 1])
            if path[:length] in self._rows:
                result = (*result, str(self._rows[path[:length]]))
        return result

    def _pair(self, table: Path) -> None:
        line = self._line()
        path = self._dotted()
        self.position += 1  # =
        self._note(table, path, line)
        self._value((*table, *path))

    def _note(self, table: Path, path: Path, line: int) -> None:
        for length in range(1, len(path) + 1):
            self.lines.setdefault((*table, *path[:length]), line)

    def _dotted(self) -> Path:
        names: list[str] = []
        while match := _KEY.match(self.text, self.position):
            self.position = match.end()
            names.append(next(group for group in match.groups() if group is not None))
            if not self.text.startswith(".", self.position):
                break
            self.position += 1
        return tuple(names)

    def _value(self, path: Path) -> None:
        self._skip()
        start = self.text[self.position : self.position + 1]
        if start in {'"', "'"}:
            match = _STRING.match(self.text, self.position)
            assert match is not None  # tomllib accepted it
            self.position = match.end()
        elif start == "[":
            self._array(path)
        elif start == "{":
            self._inline(path)
        else:
            match = _BARE.match(self.text, self.position)
            assert match is not None  # it may match nothing
            self.position = match.end()

    def _array(self, path: Path) -> None:
        self.position += 1
        index = 0
        while self.text[self._skip()] != "]":
            if self.text[self.position] == ",":
                self.position += 1
                continue
            self._note(path, (str(index),), self._line())
            self._value((*path, str(index)))
            index += 1
        self.position += 1

    def _inline(self, path: Path) -> None:
        self.position += 1
        while self.text[self._skip()] != "}":
            if self.text[self.position] == ",":
                self.position += 1
                continue
            self._pair(path)
        self.position += 1

    def _skip(self) -> int:
        match = _SPACE.match(self.text, self.position)
        assert match is not None  # it may match nothing
        self.position = match.end()
        return self.position

    def _line(self) -> int:
        return self.text.count("\n", 0, self.position) + 1
