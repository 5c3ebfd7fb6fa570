"""The MAVProxy process, headless: a ground station, and a router."""

from __future__ import annotations

import os
import queue
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType

from tests.e2e.simulator_process import PATIENCE_S

MODULES = "param,mode,arm,wp,fence,link,cmdlong,misc"


class MavProxy:
    """A MAVProxy whose commands are piped in and whose lines are read.

    Args:
        directory: Its home, and where it runs.
        arguments: Command-line arguments, besides those for a machine without a screen.
    """

    def __init__(self, directory: Path, *arguments: str) -> None:
        script = Path(sys.executable).with_name("mavproxy.py")
        command = [sys.executable, "-W", "ignore", str(script), *arguments]
        command += ["--no-state", "--mav20", f"--default-modules={MODULES}"]
        self.arguments = arguments
        self._lines: queue.Queue[str] = queue.Queue()
        self._seen: list[str] = []
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
            cwd=directory,
            env=dict(os.environ, HOME=str(directory), MPLBACKEND="agg"),
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> MavProxy:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()

    def say(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def expect(self, pattern: str) -> str:
        """The next line in which a pattern is found."""
        until_s = time.monotonic() + PATIENCE_S
        while (left_s := until_s - time.monotonic()) > 0.0:
            try:
                line = self._lines.get(timeout=left_s)
            except queue.Empty:
                break
            self._seen.append(line)
            if re.search(pattern, line):
                return line
        raise AssertionError(f"`{pattern}` never came after {self._seen[-12:]}")

    def ask(self, command: str, pattern: str) -> str:
        self.say(command)
        return self.expect(pattern)

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line.rstrip())
