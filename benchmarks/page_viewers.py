"""Viewers of a page that ask as often as the page in a browser does: ADDRESS COUNT."""

from __future__ import annotations

import http.client
import json
import sys
import threading
import time
from urllib.parse import urlsplit

_SIGNALS_EVERY, _STATUS_EVERY = 0.1, 0.5
_COLUMNS = "X-Columns"


class Viewer(threading.Thread):
    """Asks for what it has not got, until the page is gone."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self._connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=30.0)
        self._has: dict[str, tuple[str, int]] = {}
        self._window = 0

    def run(self) -> None:
        """Ask and ask again."""
        due, status_due = time.monotonic(), 0.0
        while True:
            try:
                self._ask("signals")
                if time.monotonic() >= status_due:
                    status_due = time.monotonic() + _STATUS_EVERY
                    before = self._window
                    if self.windows() > before:
                        for table in ("windows", "coefficients", "parameters"):
                            self._ask(table)
            except (OSError, http.client.HTTPException):
                return
            due += _SIGNALS_EVERY
            time.sleep(max(due - time.monotonic(), 0.0))

    def windows(self) -> int:
        """Number of the newest window that the page has."""
        told = json.loads(self._get(f"/status?windows={self._window}")[1])
        if told["windows"]:
            self._window = told["windows"][-1]["number"]
        return self._window

    def _ask(self, table: str) -> None:
        generation, last = self._has.get(table, ("-1", -1))
        answer, body = self._get(f"/tables/{table}?after={last}&generation={generation}")
        if body:
            rows = memoryview(body).cast("d")
            width = answer.headers[_COLUMNS].count(",") + 1
            self._has[table] = (answer.headers["X-Generation"], int(rows[len(rows) - width]))

    def _get(self, path: str) -> tuple[http.client.HTTPResponse, bytes]:
        self._connection.request("GET", path, headers={"User-Agent": "viewer", "Accept": "*/*"})
        answer = self._connection.getresponse()
        return answer, answer.read()


if __name__ == "__main__":
    viewers = [Viewer(sys.argv[1]) for _ in range(int(sys.argv[2]))]
    for viewer in viewers:
        viewer.start()
    for viewer in viewers:
        viewer.join()
