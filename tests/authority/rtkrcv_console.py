"""RTKLIB's rtkrcv on a pseudo-terminal: words in, screens out."""

import os
import pty
import re
import select
import signal
import time
from pathlib import Path

_ESCAPES = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
PROMPT = "rtkrcv> "


class RtkrcvConsole:
    """A running rtkrcv (2.4.3); ``ask`` returns what it shows for a word, without echo and colours."""

    def __init__(self, program: str, folder: Path, options: dict[str, str]) -> None:
        (folder / "rtkrcv.conf").write_text("".join(f"{name} ={value}\n" for name, value in options.items()))
        self._pid, self._terminal = pty.fork()
        if self._pid == 0:
            os.chdir(folder)
            os.execv(program, [program, "-o", "rtkrcv.conf"])
        self._until_prompt()

    def ask(self, word: str) -> str:
        """Return the screen of a word."""
        os.write(self._terminal, f"{word}\r".encode())
        shown = self._until_prompt().replace("\r", "")
        return shown.partition("\n")[2].removesuffix(PROMPT).lstrip("\n")

    def close(self) -> None:
        """End it."""
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)
        os.close(self._terminal)

    def _until_prompt(self, timeout_s: float = 30.0) -> str:
        shown, deadline = "", time.monotonic() + timeout_s
        while not shown.endswith(PROMPT):
            assert select.select([self._terminal], [], [], max(0.0, deadline - time.monotonic()))[0], f"no prompt after {shown!r}"
            shown = _ESCAPES.sub("", shown + os.read(self._terminal, 65536).decode("latin1"))
        return shown
