"""Somebody at the keyboard of a terminal."""

from __future__ import annotations

import os
import threading
import time

REPEAT = 0.033  # s, a desktop's


class Hands:
    """Somebody at the keyboard in real time: holds the space bar until told to let go."""

    def __init__(self, master: int) -> None:
        self._master, self._let_go = master, threading.Event()
        self._thread = threading.Thread(target=self._hold, daemon=True)

    def __enter__(self) -> Hands:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.let_go()
        self._thread.join()

    def let_go(self) -> None:
        self._let_go.set()

    def _hold(self) -> None:
        while not self._let_go.is_set():
            os.write(self._master, b" ")
            time.sleep(REPEAT)
