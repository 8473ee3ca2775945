"""The command run inside this process."""

from __future__ import annotations

from compare.conftest import ident as ident
